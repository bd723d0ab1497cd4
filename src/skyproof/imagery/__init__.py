"""Reads real imagery and its labels, cuts it into tiles, and removes its vehicles."""
