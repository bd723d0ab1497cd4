"""Detectors: RetinaNet, Faster R-CNN, YOLOv5, or the user's own; training and the frozen threshold."""
