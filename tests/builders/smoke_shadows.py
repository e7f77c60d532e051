"""Shadows of obstacles on a surface of smoke, from tensors."""

import numpy as np
import torch
import warp as wp

from wlm.interop import device_name, stream, to_warp
from wlm.smoke.camera import Camera
from wlm.smoke.shading import cast_shadow, light_axes


def shadow_of(
    depth: torch.Tensor, camera: Camera, toward: tuple, vertices: torch.Tensor, triangles: torch.Tensor, **options
) -> torch.Tensor:
    """Computes the share of a light that reaches the surface, float32 [H, W]; arguments as for `cast_shadow`."""
    lit = torch.ones_like(depth)
    with stream(device_name(depth.device)):
        mesh = to_warp(vertices, wp.vec3), to_warp(triangles.int().contiguous())
        view, axes = camera.in_world(), light_axes(np.asarray(toward, float))
        cast_shadow(*mesh, axes, view, to_warp(depth), to_warp(lit), **options)
    return lit
