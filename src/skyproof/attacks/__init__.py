"""Attacks: what is minimised, and the one loop that minimises it."""
