"""Labelled images: a folder of PNGs with COCO annotations, and any such set, read lazily."""
