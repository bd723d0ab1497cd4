"""Orthophotos are cut into tiles of true metres, in splits by place. Labels are taken along."""
