"""Differentiable operations for torch on Warp kernels.

Functions with gradients by autograd, on the device of their tensors; on CUDA they queue work on torch's current stream.
All floats are float32, and there is no second derivative. ``plain`` has each of them again in a few lines of torch, of
any float type: the definition that the kernels are held to. The page is docs/ops.md.

    bc7_map, bc7_texels     a feature map in BC7 mode 6 blocks, sampled or whole
    plane, triplane, volume     feature grids, sampled linearly
    mlp                     small networks of two hidden layers
    gaussian_sum            a sum of 3D Gaussians at any points
    rasterize, rasterize_uv, interpolate, texture       triangles to pixels
    march                   transmittance and single-scattered light through a density grid
"""

from importlib import import_module
from typing import Any

_MODULES = {
    "bc7_map": "blocks",
    "bc7_texels": "blocks",
    "gaussian_sum": "gaussians",
    "interpolate": "raster",
    "march": "marching",
    "mlp": "networks",
    "plane": "sampling",
    "Raster": "raster",
    "rasterize": "raster",
    "rasterize_uv": "raster",
    "texture": "raster",
    "triplane": "sampling",
    "volume": "sampling",
}

__all__ = ["plain", *_MODULES]


def __getattr__(name: str) -> Any:
    if name == "plain":
        return import_module("wlm.ops.plain")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"wlm.ops.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
