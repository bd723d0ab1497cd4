"""Blender Cycles as a second renderer: the same scenes, path-traced in worker processes.

Here belong the crops and what becomes of them, the processes, and the one file that runs in
Blender. What a scene or a label is belongs to `scenes` and `render` (section S3.2.2).
"""
