"""Pure tensor mathematics: the oblique projection, meshes, the rasteriser, colour.

It imports torch alone and knows no vehicles, scenes or files.
"""
