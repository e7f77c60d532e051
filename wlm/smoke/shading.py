"""Lights, colours of emission, and shadows of obstacles on smoke, all in linear light; `SixWay.shade` uses them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp

from wlm.interop import torch_memory
from wlm.smoke.camera import Camera
from wlm_kernels.smoke import shadow
from wlm_kernels.smoke.march import View

SHADOW_MAP = 512
"""Texels along an edge of a shadow map."""


@dataclass(frozen=True)
class Light:
    """A directional light.

    Attributes:
        toward: Direction to the light in the world, of any length except 0.
        irradiance: R, G, B on a surface that faces the light; not negative.
    """

    toward: tuple[float, float, float]
    irradiance: tuple[float, float, float] = (4 * math.pi,) * 3


@dataclass(frozen=True)
class Ramp:
    """Colour of emission, linear between stops and constant beyond them.

    Attributes:
        stops: Values of emission, increasing.
        colours: R, G, B of each stop, not negative.
    """

    stops: tuple[float, ...]
    colours: tuple[tuple[float, float, float], ...]

    def __post_init__(self) -> None:
        if len(self.stops) < 2 or np.shape(self.colours) != (len(self.stops), 3):
            raise ValueError("ramp: expected at least two stops and as many colours of R, G, B")
        if not (np.isfinite(self.stops).all() and np.isfinite(self.colours).all() and (np.diff(self.stops) > 0).all()):
            raise ValueError(f"ramp: expected finite colours and rising stops, got {self.stops}")

    def __call__(self, emission: torch.Tensor) -> torch.Tensor:
        """Returns colours [..., 3] of emissions of any shape."""
        stops = torch.tensor(self.stops, dtype=emission.dtype, device=emission.device)
        colours = torch.tensor(self.colours, dtype=emission.dtype, device=emission.device)
        after = torch.searchsorted(stops, emission.contiguous()).clamp(1, len(self.stops) - 1)
        share = ((emission - stops[after - 1]) / (stops[after] - stops[after - 1])).clamp(0, 1)[..., None]
        return (1 - share) * colours[after - 1] + share * colours[after]


def light_axes(toward: Sequence[float] | np.ndarray) -> list[float]:
    """Returns the rows of three axes, 9 numbers, of which the third points to a light."""
    return Camera.look_at(toward, np.zeros(3), extent=1.0, height=1, width=1).axes.ravel().tolist()


def cast_shadow(
    points: wp.array,
    triangles: wp.array,
    axes: Sequence[float],
    view: View,
    depth: wp.array,
    out: wp.array,
    resolution: int = SHADOW_MAP,
    bias: float | None = None,
) -> None:
    """Computes the share of a light that reaches the smoke's surface past obstacles, by a shadow map (section 4.5).

    The map is rendered from the light, and each pixel is looked up at the depth of its smoke's surface, bilinearly
    between four texels. A CUDA graph can capture the call.

    Args:
        points, triangles: Corners of the obstacles in the world, vec3 [V], and their triangles int32 [F, 3], at least
            one.
        axes: Result of `light_axes`.
        view: Result of `Camera.in_world`.
        depth: float [H, W], distance along the ray to the smoke's surface; 0: none, which counts as lit.
        out: float [H, W], written: in [0, 1].
        resolution: Texels along an edge of the shadow map, at least 8.
        bias: Distance in the world's unit by which an obstacle must be nearer to the light to shadow the surface;
            None: 1.5 texels.
    """
    options = {"resolution": resolution, "bias": -1.0 if bias is None else bias}
    memory = torch_memory(wp.device_to_torch(depth.device))
    shadow.visibility(points, triangles, axes, view, depth, out, **options, empty=memory)
