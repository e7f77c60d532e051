"""Six-way lightmaps of smoke by a fine march: single scattering with no noise, and with its own error beside it.

The paper's references are one bounce by path tracing, 512 samples a pixel (section 5); one bounce is an integral that
can be had without. What a lightmap holds is the light that smoke of albedo 1 sends to the camera under one light of
irradiance 4 pi from its direction: with g = 0 at most 1/2 from the front and 1 from a side. The lightmaps are
orthographic, as a flat billboard has no other; so must the camera be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from wlm.fluid.volume import DensityVolume
from wlm.interop import device_name, stream, to_warp, torch_memory
from wlm.smoke.camera import DIRECTIONS, Camera
from wlm.smoke.guide import check_march
from wlm_kernels.smoke import march_six

__all__ = ["SixWay", "StepError", "lit", "six_way"]


@dataclass(frozen=True)
class StepError:
    """What halving the step changed.

    It bounds the error of the finer result where the error falls at least in proportion to the step, as it does down to
    rounding: by experience with its square, so that a third of this remains.

    Attributes:
        largest: Greatest difference of a pixel in any lightmap.
        rms: Root of the mean square of the differences, over that of the lightmaps; 0 where these are black.
        transparency: Greatest difference of a pixel's transparency.
    """

    largest: float
    rms: float
    transparency: float


@dataclass(frozen=True, eq=False)
class SixWay:
    """Six-way lightmaps of one frame; H x W pixels.

    Attributes:
        lightmaps: float32 tensor [6, H, W], in the order of `axes.DIRECTIONS`, linear.
        transparency: float32 tensor [H, W], or None: not known, as in files without it.
        emission: float32 tensor [H, W], the light that the smoke gives off itself, or None: it is cold.
        error: Of the march, or None: not estimated.
    """

    lightmaps: torch.Tensor
    transparency: torch.Tensor | None
    emission: torch.Tensor | None = None
    error: StepError | None = None

    def __post_init__(self) -> None:
        if self.lightmaps.ndim != 3 or self.lightmaps.shape[0] != 6:
            raise ValueError(f"lightmaps: expected [6, H, W], got {tuple(self.lightmaps.shape)}")
        for name, plane in (("transparency", self.transparency), ("emission", self.emission)):
            if plane is not None and plane.shape != self.lightmaps.shape[1:]:
                raise ValueError(f"{name}: expected {tuple(self.lightmaps.shape[1:])}, got {tuple(plane.shape)}")

    def __getitem__(self, direction: str) -> torch.Tensor:
        """The lightmap of a direction by its name, [H, W]."""
        return self.lightmaps[DIRECTIONS.index(direction)]


def six_way(
    volume: DensityVolume,
    camera: Camera,
    *,
    step: float = 0.5,
    g: float = 0.0,
    supersample: int = 1,
    estimate: bool = True,
) -> SixWay:
    """Makes the lightmaps, the transparency and, of hot smoke, the emission (eq. 4).

    Args:
        volume: The smoke.
        camera: Orthographic. Smoke behind its plane or outside the image isn't seen and still casts its shadow.
        step: The longest step, in voxels, along rays and to the lights.
        g: Henyey and Greenstein's mean cosine, within -1 and 1.
        supersample: Rays along a pixel's edge, whose mean is the pixel; 1: the ray through its centre.
        estimate: Whether to march in steps of twice the length too, for the error: half as much work again.

    Returns:
        The lightmaps on the smoke's device.

    Raises:
        ValueError: A setting is out of its range, or the camera is in perspective.
    """
    check_march(step, g)
    if supersample < 1:
        raise ValueError(f"supersample: expected at least 1, got {supersample}")
    with stream(device_name(volume.device)):
        fine = _march(volume, camera, step, g, supersample)
        error = None
        if estimate:
            coarse = _march(volume, camera, 2.0 * step, g, supersample)
            off = (fine - coarse).double()
            energy = float(fine[:6].double().square().mean())
            error = StepError(
                float(off[:6].abs().max()),
                (float(off[:6].square().mean()) / energy) ** 0.5 if energy > 0 else 0.0,
                float(off[march_six.TRANSPARENCY].abs().max()),
            )
    hot = fine[march_six.EMISSION] if volume.temperature is not None else None
    return SixWay(fine[:6], fine[march_six.TRANSPARENCY], hot, error)


def lit(
    volume: DensityVolume,
    camera: Camera,
    toward: Sequence[float] | np.ndarray,
    *,
    step: float = 0.5,
    g: float = 0.0,
) -> torch.Tensor:
    """Smoke under one light from anywhere, of irradiance 4 pi: what six-way shading approximates.

    Each sample of each ray marches to the light: slow, and apart from the marcher of the lightmaps, which it checks.

    Args:
        volume: The smoke, of albedo 1.
        camera: Any.
        toward: [3], the direction to the light in the world, of any length but 0.
        step: In voxels.
        g: Henyey and Greenstein's mean cosine, within -1 and 1.

    Returns:
        float32 [H, W].

    Raises:
        ValueError: The direction has no length.
    """
    direction = np.asarray(toward, np.float64)
    length = np.linalg.norm(direction)
    if direction.shape != (3,) or not 1e-12 < length < np.inf:
        raise ValueError(f"toward: expected a direction of some length, got {direction.tolist()}")
    view, _ = camera.view(volume.origin, volume.voxel, volume.shape)
    with stream(device_name(volume.device)):
        out = torch.empty((camera.height, camera.width), dtype=torch.float32, device=volume.device)
        density, _ = volume.arrays()
        extinction = volume.extinction * volume.voxel
        march_six.lit(
            density,
            extinction,
            view,
            direction / length,
            to_warp(out),
            step=step,
            g=g,
            empty=torch_memory(volume.device),
        )
    return out


def _march(volume: DensityVolume, camera: Camera, step: float, g: float, supersample: int) -> torch.Tensor:
    finer = camera.finer(supersample)
    view, _ = finer.view(volume.origin, volume.voxel, volume.shape)
    out = torch.empty((8, finer.height, finer.width), dtype=torch.float32, device=volume.device)
    density, temperature = volume.arrays()
    march_six.six_way(
        density,
        volume.extinction * volume.voxel,
        view,
        to_warp(out),
        step=step,
        g=g,
        temperature=temperature,
        emission=volume.emission * volume.voxel,
        empty=torch_memory(volume.device),
    )
    if supersample == 1:
        return out
    return torch.nn.functional.avg_pool2d(out[None], supersample)[0]
