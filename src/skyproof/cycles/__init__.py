"""Blender Cycles: the same scenes path-traced in worker processes, as a second renderer (PAPER 7, 9, 58)."""
