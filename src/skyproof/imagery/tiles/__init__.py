"""Cuts orthophotos and their labels into tiles of true metres, in splits by place."""
