"""Shadows of obstacles on a surface of smoke, from tensors."""

import numpy as np
import torch
import warp as wp

from wlm.interop import device_name, stream, to_warp, torch_memory
from wlm.smoke.camera import Camera
from wlm.smoke.shading import light_axes
from wlm_kernels.smoke.shadow import visibility


def shadow_of(
    depth: torch.Tensor, camera: Camera, toward: tuple, vertices: torch.Tensor, triangles: torch.Tensor, **options
) -> torch.Tensor:
    """Computes the share of a light that reaches the surface, float32 [H, W]; arguments as for `visibility`."""
    lit = torch.ones_like(depth)
    with stream(device_name(depth.device)):
        mesh = to_warp(vertices, wp.vec3), to_warp(triangles.int().contiguous())
        view, axes = camera.in_world(), light_axes(np.asarray(toward, float))
        visibility(*mesh, axes, view, to_warp(depth), to_warp(lit), empty=torch_memory(lit.device), **options)
    return lit
