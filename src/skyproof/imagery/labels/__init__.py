"""Reads labels of vehicles in other tools' formats, in pixels of images or on the ground."""
