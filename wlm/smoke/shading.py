"""Lights, colours of emission, and shadows of obstacles on smoke, all in linear light; `SixWay.shade` uses them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp

from wlm.interop import device_name, stream, to_warp, torch_memory
from wlm.smoke.camera import Camera, unit
from wlm_kernels.smoke import shadow
from wlm_kernels.smoke.march import View

SHADOW_MAP = 512
"""Texels along an edge of a shadow map."""

_SMALLEST_MAP = 8  # texels along an edge, of which four are the empty border


@dataclass(frozen=True, eq=False)
class Light:
    """A directional light.

    Attributes:
        toward: Direction to the light in the world, of any length except 0.
        irradiance: R, G, B on a surface that faces the light; not negative.
        visibility: float tensor [H, W], share of the light that reaches the smoke at a pixel; None: all of it.
    """

    toward: tuple[float, float, float]
    irradiance: tuple[float, float, float] = (4 * math.pi,) * 3
    visibility: torch.Tensor | None = None


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


def obstacle_visibility(
    depth: torch.Tensor,
    camera: Camera,
    toward: Sequence[float] | np.ndarray,
    vertices: torch.Tensor,
    triangles: torch.Tensor,
    *,
    resolution: int = SHADOW_MAP,
    bias: float | None = None,
) -> torch.Tensor:
    """Computes the share of a light that reaches the smoke's surface past obstacles, by a shadow map (section 4.5).

    The map is rendered from the light. Each pixel is looked up only at the depth of its smoke's surface.

    Args:
        depth: float32 [H, W], distance along the ray to the smoke's surface; 0: none.
        camera: Camera of the depths.
        toward: [3], direction to the light in the world, of any length except 0.
        vertices: float32 [V, 3], corners of the obstacles in the world.
        triangles: int32 or int64 [F, 3], rows of the vertices.
        resolution: Texels along an edge of the shadow map, at least 8.
        bias: Distance in the world's unit by which an obstacle must be nearer to the light to shadow it, at least 0;
            None: 1.5 texels.

    Returns:
        float32 [H, W] in [0, 1], bilinear between four texels; 1 where there is no smoke.

    Raises:
        ValueError: A shape is wrong, the direction has no length, or the map is too small.
    """
    size = (camera.height, camera.width)
    if depth.shape != size:
        raise ValueError(f"depth: expected {size}, got {tuple(depth.shape)}")
    direction = unit(toward)
    lit = torch.ones(size, dtype=torch.float32, device=depth.device)
    if resolution < _SMALLEST_MAP:
        raise ValueError(f"resolution: expected at least {_SMALLEST_MAP}, got {resolution}")
    if bias is not None and not bias >= 0:
        raise ValueError(f"bias: expected at least 0, got {bias}")
    if not len(triangles):
        return lit
    with stream(device_name(depth.device)):
        arrays = to_warp(vertices.float().contiguous(), wp.vec3), to_warp(triangles.int().contiguous())
        surface = to_warp(depth.float().contiguous())
        cast_shadow(*arrays, light_axes(direction), camera.in_world(), surface, to_warp(lit), resolution, bias)
    return lit


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
    """Runs `obstacle_visibility` on arrays that stay in place, without checks; a CUDA graph can capture it.

    Args:
        points, triangles: vec3 [V] and int32 [F, 3], at least one.
        axes: Result of `light_axes`.
        view: Result of `Camera.in_world`.
        depth, out: float [H, W].
        resolution, bias: As for `obstacle_visibility`.
    """
    options = {"resolution": resolution, "bias": -1.0 if bias is None else bias}
    memory = torch_memory(wp.device_to_torch(depth.device))
    shadow.visibility(points, triangles, axes, view, depth, out, **options, empty=memory)
