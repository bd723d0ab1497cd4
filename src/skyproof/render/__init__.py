"""The differentiable renderer: rasterise, shade, average, blur, lay over the photograph.

Here also belong the datasets and close-ups that are rendered, by this renderer or by another.
"""
