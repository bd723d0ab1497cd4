"""The renderer's kernels: triangles to samples, samples to pixels, and their gradients.

They take only numbers and arrays; the modules of `render` hand them tensors.
"""
