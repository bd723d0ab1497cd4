"""The renderer's kernels: triangles to samples, samples to pixels, and their gradients.

NVIDIA Warp compiles them from their source, for a CPU or CUDA. They see numbers and arrays alone;
the files above hand them tensors.
"""
