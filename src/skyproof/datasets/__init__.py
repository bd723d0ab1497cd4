"""Labelled images: PNGs with COCO annotations, read lazily. Training and evaluation use them."""
