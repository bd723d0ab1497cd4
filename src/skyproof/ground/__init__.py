"""Procedural ground: tiles of streets, lots, roofs, fields and water, painted without a photograph.

Here belongs what draws such a tile and writes a background set of them. Ground that was
photographed belongs to `imagery`, and reading either to `scenes`.
"""
