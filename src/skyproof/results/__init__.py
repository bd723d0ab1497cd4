"""Evaluation: one outcome per vehicle, success rates, intervals over background tiles, the table of results."""
