"""Labelled images: a folder of PNGs with COCO annotations, and any such set, read lazily.

This room serves training, evaluation and export. `render`, `cycles` and `imagery` make the images.
"""
