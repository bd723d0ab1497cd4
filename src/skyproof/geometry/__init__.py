"""Pure tensor mathematics: the oblique projection, meshes, the rasteriser, colour.

It imports torch and kernels alone and knows no vehicles, scenes or files.
"""
