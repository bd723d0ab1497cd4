"""Scenes as plain data: place, time, and the number and choice of vehicles.

The room also holds background sets with their splits and sensors; `ground` and `imagery` make them.
"""
