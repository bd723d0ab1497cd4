"""Detectors: RetinaNet, Faster R-CNN and YOLOv5, imported checkpoints, or an object of the user's.

Here belong their losses and detections, how they are trained, stored and matched with vehicles,
and the threshold that is frozen before any attack.
"""
