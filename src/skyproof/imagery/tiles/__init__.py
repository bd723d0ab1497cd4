"""Orthophotos cut into tiles of true metres, in splits by place."""
