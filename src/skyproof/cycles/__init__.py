"""Blender Cycles as a second renderer: the same scenes, path-traced in worker processes.

This room holds the crops and their compositing, the processes, and the one file that runs in
Blender. `scenes` and `render` define scenes and labels (section S3.2.2).
"""
