"""The renderer's kernels: triangles to samples, samples to pixels, and their gradients.

NVIDIA Warp compiles them from their source, for a CPU or CUDA. They take only numbers and arrays;
the modules of `render` hand them tensors.
"""
