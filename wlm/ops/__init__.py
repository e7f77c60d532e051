"""Differentiable operations on Warp kernels, for torch and for Warp.

The functions take torch tensors, with autograd, or Warp arrays, whose gradients they record on the active `wp.Tape`.
They run on the device of their arguments and, on CUDA, queue work on the current stream of torch or of Warp. All floats
are float32, and there is no second derivative. `benchmarks/plain.py` implements each of them in a few lines of torch,
for any float type, as the reference for the kernels. The documentation is docs/ops.md.

    bc7_map, bc7_texels, bc7_blocks     feature maps in BC7 blocks
    plane, triplane, volume             feature grids, sampled linearly
    mlp                                 networks of two hidden layers
    gaussian_sum                        3D Gaussians at any points
    rasterize, rasterize_uv             triangles to pixels
    interpolate, texture                attributes and texture values per pixel
    antialias                           silhouettes, with gradients for their places
    march                               light through a density grid
    funcs                               functions for your own kernels
"""

from wlm._facade import facade

__getattr__, __dir__, __all__ = facade(__name__, __file__)
