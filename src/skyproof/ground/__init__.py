"""Procedural ground: tiles of streets, lots, roofs, fields and water, painted without a photograph.

The code that draws such tiles and writes background sets of them belongs here. Ground that was
photographed belongs to `imagery`, and reading either of them to `scenes`.
"""
