"""Scenes as plain data: where, when, how many vehicles, and which ones.

Here also belong the background sets under them, with their splits and their sensor; what paints or
cuts such a set belongs to `ground` and `imagery`.
"""
