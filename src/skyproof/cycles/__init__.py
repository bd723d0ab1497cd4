"""Blender Cycles as a second renderer: the same scenes, path-traced in worker processes.

The package holds crops and their compositing, processes, and the one file that runs in Blender.
"""
