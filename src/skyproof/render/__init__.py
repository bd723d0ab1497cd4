"""The differentiable renderer: rasterise, shade, average, blur, lay over the photograph.

Rendered datasets and close-ups belong here as well, whether by this renderer or another.
"""
