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

_PLACES = {
    "Raster": "wlm.ops.raster",
    "antialias": "wlm.ops.silhouettes",
    "bc7_blocks": "wlm.ops.blocks",
    "bc7_map": "wlm.ops.blocks",
    "bc7_texels": "wlm.ops.blocks",
    "funcs": "wlm.ops.funcs",
    "gaussian_sum": "wlm.ops.gaussians",
    "interpolate": "wlm.ops.raster",
    "march": "wlm.ops.marching",
    "mlp": "wlm.ops.networks",
    "plane": "wlm.ops.sampling",
    "rasterize": "wlm.ops.raster",
    "rasterize_uv": "wlm.ops.raster",
    "texture": "wlm.ops.raster",
    "triplane": "wlm.ops.sampling",
    "volume": "wlm.ops.sampling",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
