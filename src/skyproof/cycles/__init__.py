"""Blender Cycles: the same scenes path-traced in worker processes, as a second renderer (section S3.2.2)."""
