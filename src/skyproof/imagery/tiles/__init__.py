"""Cuts orthophotos into tiles in true metres, in splits by place. Takes their labels along."""
