"""Orthophotos are cut here into tiles of true metres, in splits by place.

Labels are taken along, from the sources to the tiles.
"""
