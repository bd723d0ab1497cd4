"""The renderer's kernels: triangles to samples, samples to pixels, and their gradients."""
