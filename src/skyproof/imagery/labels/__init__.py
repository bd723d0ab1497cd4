"""Reads labels that other tools wrote. They are in pixels of images, or on the ground."""
