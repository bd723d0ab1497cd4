"""Measures detectors on scenes with and without a change, and matches detections with vehicles.

The package `results`, which loads no torch, makes rates, intervals and decisions of the outcomes.
"""
