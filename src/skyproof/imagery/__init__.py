"""Real imagery: orthophotos become tiles, labels of all forms become boxes, and back.

Vehicles are removed from tiles, so that they can serve as ground; whole annotated images are read.
"""
