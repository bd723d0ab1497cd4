"""Reads labels of vehicles in the formats of other tools.

Every form becomes labels in pixels of images, or labels on the ground.
"""
