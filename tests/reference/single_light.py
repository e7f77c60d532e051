"""Smoke under one light by a march from every sample: slow, and independent of the lattices of the product."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import warp as wp

from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import Camera, unit
from wlm.smoke.march.launch import run
from wlm_kernels.smoke.march import (
    OPTIONS,
    MarchParameters,
    Medium,
    View,
    absorbed,
    begin,
    for_smoke,
    look,
    optical_depth,
    parameters,
    pass_step,
    phase,
)
from wlm_kernels.smoke.settings import March


@for_smoke
def _lit(smoke_type: Any) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(smoke: smoke_type, view: View, toward: wp.vec3, march: MarchParameters, out: wp.array2d[float]):
        row, col = wp.tid()
        r = begin(view, row, col, smoke, march.step, 0.5)
        light = float(0.0)
        while r.done < r.count:
            r = look(r, smoke)
            if r.x > 0.0:
                light += wp.exp(-r.tau - optical_depth(smoke, r.place, toward, march.step)) * absorbed(r.x)
            r = pass_step(r, 0.0)
        out[row, col] = light * phase(march.g, wp.dot(toward, r.direction))

    return kernel


def march_lit(medium: Medium, view: View, toward: Sequence[float], march: March, out: wp.array) -> None:
    """Computes smoke of albedo 1, float [H, W], under a light of irradiance 4 pi from a direction of length 1."""
    _lit(medium.in_bricks(), out.shape, [view, wp.vec3(*map(float, toward)), parameters(march)], [out])


def lit(
    volume: DensityVolume, camera: Camera, toward: Sequence[float] | np.ndarray, *, step: float = 0.5, g: float = 0.0
) -> torch.Tensor:
    """Computes a volume under one light, float32 [H, W]; the step is in voxels."""
    return run(march_lit, volume, camera, (), unit(toward), March(step=step, g=g))
