"""Blender Cycles as a second renderer: the same scenes, path-traced in worker processes.

This room holds crops and their compositing, the processes, and the one file that runs in Blender.
"""
