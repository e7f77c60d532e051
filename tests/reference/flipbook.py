"""Light and motion of a flip book in torch, in the way of the shader that `wlm.smoke.flipbook.shader` writes."""

import math
from collections.abc import Sequence

import numpy as np
import torch

from wlm.smoke.camera import DIRECTIONS
from wlm.smoke.flipbook import motion
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.transport.lights import PointLight

_PAIRS = (("right", "left"), ("top", "bottom"), ("front", "back"))  # lightmaps along x, y and z
_NEAREST = 1e-6  # least squared distance to a light


def between(one: SixWay, other: SixWay, moved: torch.Tensor, share: float) -> SixWay:
    """Interpolates lightmaps between a frame and the next, in the way of the shader.

    Args:
        one, other: The frames, with transparency.
        moved: float32 [2, H, W], motion of the first frame, see `frames_motion`.
        share: 0 is the first frame, 1 the next.
    """
    place = motion._places(moved)
    # Motion of the smoke that is at a pixel at this time, which was elsewhere in the first frame.
    way = motion._read(moved, place - share * motion._read(moved, place))
    ends = (one, place - share * way), (other, place + (1.0 - share) * way)
    mixed = torch.lerp(*(motion._read(motion._planes(six), at) for six, at in ends), share)
    hot = one.emission is not None or other.emission is not None
    return SixWay(mixed[:6], 1.0 - mixed[6], mixed[7] if hot else None, one.camera)


def from_point(six: SixWay, depth: torch.Tensor, light: PointLight, middle: Sequence[float]) -> torch.Tensor:
    """Computes the light of a point light on a billboard, in the way of the shader.

    Each pixel is lit from the direction to the light, with the irradiance at the position of its smoke.

    Args:
        six: Lightmaps with their camera.
        depth: float32 [H, W], from `middle_depth`; 0: on the billboard.
        light: The light.
        middle: Centre of the smoke's volume, [3].

    Returns:
        float32 [H, W, 3], linear.
    """
    camera = six.camera
    start, _ = camera.rays(depth.device)
    axes = torch.tensor(camera.axes, device=depth.device)
    place = start - torch.tensor(np.asarray(middle, np.float64), device=depth.device)
    across, rise, _ = (place @ axes.T).unbind(-1)
    lamp = camera.axes @ (np.asarray(light.position, np.float64) - np.asarray(middle, np.float64))
    way = torch.stack([float(lamp[0]) - across, float(lamp[1]) - rise, float(lamp[2]) - depth], -1)
    square = way.square().sum(-1)
    shares = way.square() / square.clamp(min=_NEAREST)[..., None]
    pairs = torch.tensor([[DIRECTIONS.index(name) for name in pair] for pair in _PAIRS], device=depth.device)
    ahead, behind = six.lightmaps[pairs[:, 0]], six.lightmaps[pairs[:, 1]]
    grey = (shares.movedim(-1, 0) * torch.where(way.movedim(-1, 0) > 0, ahead, behind)).sum(0)
    grey = grey / square.clamp(min=max(light.radius**2, _NEAREST)) / (4.0 * math.pi)
    return grey.float()[..., None] * torch.tensor(light.intensity, device=depth.device)
