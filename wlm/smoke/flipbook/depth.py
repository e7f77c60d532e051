"""How far before its billboard a flip book's smoke lies, for lights at a point: their direction and distance are others
at each pixel and each depth.

Read first: `from_point`, which `wlm.smoke.flipbook.shader` writes for engines.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import DIRECTIONS, Camera
from wlm.smoke.data import Frames
from wlm.smoke.flipbook.motion import ZERO, spread_out
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.transport.lighting import light_smoke
from wlm.smoke.transport.lights import PointLight
from wlm.system import Meter, OnProgress
from wlm_kernels.smoke.settings import March

_STEP = March(step=1.0, jitter=0.0)
_PAIRS = (("right", "left"), ("top", "bottom"), ("front", "back"))  # of the lightmaps along x, y and z
_NEAREST = 1e-6  # squared distance to a light below which it counts the same


def middle_depth(volume: DensityVolume, camera: Camera) -> torch.Tensor:
    """The mean depth of the smoke that pixels see, each part weighed by how much of it is seen.

    Args:
        volume: The smoke.
        camera: Orthographic.

    Returns:
        float32 [H, W], the world's unit: how far the smoke lies before the plane through the volume's middle that
        faces the camera. Where there is no smoke it is that of the smoke around.

    Raises:
        ValueError: The camera is in perspective.
    """
    if camera.perspective:
        raise ValueError("camera: expected an orthographic one, as a billboard is seen by")
    reach = 0.5 * float(np.linalg.norm(volume.size)) + volume.voxel
    before = torch.zeros((), device=volume.device)
    for axis, (count, along) in enumerate(zip(volume.shape, camera.toward, strict=True)):
        at = (torch.arange(count, device=volume.device) + 0.5 - 0.5 * count) * (volume.voxel * float(along))
        before = before + at.reshape([-1 if n == axis else 1 for n in range(3)])
    # A march adds up what hot smoke gives off: heat that is the depth, from behind all smoke on, and of density 1 is
    # seen as much as the smoke is.
    density = volume.density.float()
    glowing = replace(volume, density=density, temperature=density * (before + reach), emission=volume.extinction)
    seen = light_smoke(glowing, camera, [], _STEP)
    opacity = 1.0 - seen.transparency
    mean = seen.emission / opacity.clamp(min=1e-6) - reach
    return spread_out(mean[None], opacity)[0]


def frames_depth(
    frames: Frames, numbers: Sequence[int], book: Sequence[SixWay], progress: OnProgress | None = None
) -> torch.Tensor:
    """`middle_depth` of the frames of a flip book.

    Args:
        frames: The smoke.
        numbers: Of the flip book's frames.
        book: These, with their cameras.
        progress: Called after each.

    Returns:
        float32 [N, H, W] on the CPU, in heights of a frame.

    Raises:
        WlmError: A frame is missing or damaged.
    """
    found = []
    meter = Meter(progress, "depth", len(numbers))
    for i, (number, six) in enumerate(zip(numbers, book, strict=True)):
        if number not in frames.files:
            raise WlmError(f"{frames.path}: expected {frames.file(number).name}, of the flip book's frame {i + 1}")
        found.append(middle_depth(frames.load(number), six.camera).cpu() / six.camera.extent)
        meter.report(i + 1)
    return torch.stack(found)


def encoded_depth(depths: torch.Tensor, scale: float) -> np.ndarray:
    """A texture's cells, float32 [N, H, W, 3], all channels alike: `ZERO` on the billboard, more before it."""
    return np.repeat(np.float32(ZERO) + depths.numpy()[..., None] / np.float32(2.0 * scale), 3, axis=-1)


def from_point(six: SixWay, depth: torch.Tensor, light: PointLight, middle: Sequence[float]) -> torch.Tensor:
    """The light of a point light on a billboard.

    Each pixel is lit as from the direction to the light, by its irradiance there, at the place where its smoke lies.

    Args:
        six: Lightmaps with their camera.
        depth: float32 [H, W], of `middle_depth`; 0: all is on the billboard.
        light: The light.
        middle: Of the smoke's volume, [3].

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
