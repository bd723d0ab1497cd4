"""Removes vehicles from tiles: they are found, masked, filled with ground and checked."""
