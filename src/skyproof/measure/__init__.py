"""Detectors measured: scenes are drawn with and without a change, and detections matched.

Rates, intervals and decisions are made of the outcomes in `results`, which loads no torch.
"""
