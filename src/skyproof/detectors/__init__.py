"""Detectors: RetinaNet, Faster R-CNN, YOLOv5, imported checkpoints, and the user's own objects.

This package holds their losses and detections, trains and stores them, matches their detections
with vehicles, and freezes the score threshold before any attack.
"""
