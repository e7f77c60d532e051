"""Distance of a flip book's smoke in front of its billboard, for point lights, whose direction and distance depend on
the depth of the smoke."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import Camera
from wlm.smoke.data import Frames
from wlm.smoke.flipbook.motion import ZERO, spread_out
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.transport.lighting import light_smoke
from wlm.system import Meter, OnProgress
from wlm_kernels.smoke.settings import March

_STEP = March(step=1.0, jitter=0.0)


def middle_depth(volume: DensityVolume, camera: Camera) -> torch.Tensor:
    """Computes the mean depth of the visible smoke of each pixel, weighted by visibility.

    Args:
        volume: The smoke.
        camera: Orthographic.

    Returns:
        float32 [H, W] in the world's unit: distance of the smoke in front of the plane through the volume's centre that
        faces the camera. Where there is no smoke, it is filled from the smoke around.

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
    # A march integrates emission: with the depth, measured from behind all smoke, times the density as temperature, the
    # emission is the depth weighted by visibility.
    density = volume.density.float()
    glowing = replace(volume, density=density, temperature=density * (before + reach), emission=volume.extinction)
    seen = light_smoke(glowing, camera, [], _STEP)
    opacity = 1.0 - seen.transparency
    mean = seen.emission / opacity.clamp(min=1e-6) - reach
    return spread_out(mean[None], opacity)[0]


def frames_depth(
    frames: Frames, numbers: Sequence[int], book: Sequence[SixWay], progress: OnProgress | None = None
) -> torch.Tensor:
    """Computes `middle_depth` for the frames of a flip book.

    Args:
        frames: The smoke.
        numbers: Numbers of the flip book's frames.
        book: These frames, with their cameras.
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
    """Returns a texture's cells, float32 [N, H, W, 3] with equal channels: `ZERO` on the billboard, more in front."""
    return np.repeat(np.float32(ZERO) + depths.numpy()[..., None] / np.float32(2.0 * scale), 3, axis=-1)
