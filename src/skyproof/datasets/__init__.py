"""Labelled images, written as a folder of PNGs with COCO annotations, and any such set read lazily.

Here belongs what training, judging and exporting need to know of a set of images. Making the
images belongs to `render`, `cycles` and `imagery`.
"""
