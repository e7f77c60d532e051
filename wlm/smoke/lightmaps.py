"""Six-way lightmaps of one frame, the result of each march and of the network, and their shading.

A lightmap holds the light that smoke of albedo 1 sends to the camera under one light of irradiance 4 pi from its
direction: with g = 0 at most 1/2 from the front and 1 from a side. All is linear. The lightmaps are orthographic, as a
flat billboard has no other view.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from wlm.smoke.camera import DIRECTIONS, Camera, weights
from wlm.smoke.shading import Light, Ramp
from wlm.smoke.transport.lights import checked_albedo


@dataclass(frozen=True)
class StepError:
    """The change by halving the step.

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
        lightmaps: float32 tensor [6, H, W], in the order of `wlm.smoke.camera.DIRECTIONS`.
        transparency: float32 tensor [H, W], or None: not known, as in files without it.
        emission: float32 tensor [H, W], the light that the smoke gives off itself, or None: it is cold.
        camera: The view, or None: not known, as in an engine's textures.
        depth: float32 tensor [H, W], distance along the ray to the smoke's surface in the world's unit, 0 where there
            is none; or None: not known.
        error: Of the march, or None: not estimated.
    """

    lightmaps: torch.Tensor
    transparency: torch.Tensor | None
    emission: torch.Tensor | None = None
    camera: Camera | None = None
    depth: torch.Tensor | None = None
    error: StepError | None = None

    def __post_init__(self) -> None:
        if self.lightmaps.ndim != 3 or self.lightmaps.shape[0] != 6:
            raise ValueError(f"lightmaps: expected [6, H, W], got {tuple(self.lightmaps.shape)}")
        size = tuple(self.lightmaps.shape[1:])
        for name in ("transparency", "emission", "depth"):
            plane = getattr(self, name)
            if plane is not None and tuple(plane.shape) != size:
                raise ValueError(f"{name}: expected {size}, got {tuple(plane.shape)}")
        if self.camera is not None and (self.camera.height, self.camera.width) != size:
            raise ValueError(f"camera: expected {size} pixels, got {(self.camera.height, self.camera.width)}")

    def __getitem__(self, direction: str) -> torch.Tensor:
        """The lightmap of a direction by its name, [H, W]."""
        return self.lightmaps[DIRECTIONS.index(direction)]

    def shade(
        self,
        lights: Sequence[Light],
        *,
        background: torch.Tensor | Sequence[float] | None = None,
        rule: str = "squared",
        ramp: Ramp | None = None,
        albedo: Sequence[float] = (1.0, 1.0, 1.0),
    ) -> torch.Tensor:
        """Lights the smoke: a light of irradiance E counts for E / (4 pi) of each lightmap's weight (eq. 4 and 5).

        Args:
            lights: Any number.
            background: Linear light behind the smoke, [H, W, 3] or one colour; None: the smoke's light alone, to be
                added to what is behind times the transparency.
            rule: How a light's direction weighs the lightmaps, one of `wlm.smoke.camera.RULES`.
            ramp: Colour of the emission; None: grey, as it is.
            albedo: R, G, B, the share of light that a scattering leaves, 0 to 1.

        Returns:
            float32 [H, W, 3], linear.

        Raises:
            ValueError: The camera is needed and not known, or the transparency for a background; a light has no
                direction, a negative irradiance or a visibility of another shape; not an albedo.
        """
        if self.camera is None and lights:
            raise ValueError("camera: expected that of the lightmaps, found none; give it by dataclasses.replace")
        height, width = self.lightmaps.shape[1:]
        scattered = checked_albedo(albedo) / (4 * math.pi)
        image = torch.zeros((height, width, 3), dtype=torch.float32, device=self.lightmaps.device)
        for light in lights:
            irradiance = np.asarray(light.irradiance, np.float64)
            if irradiance.shape != (3,) or not ((irradiance >= 0) & np.isfinite(irradiance)).all():
                raise ValueError(f"irradiance: expected three numbers of at least 0, got {light.irradiance}")
            share = weights(self.camera.axes @ np.asarray(light.toward, np.float64), rule)
            grey = torch.einsum("c,chw->hw", torch.tensor(share).to(self.lightmaps), self.lightmaps)
            if light.visibility is not None:
                if light.visibility.shape != grey.shape:
                    raise ValueError(f"visibility: expected {tuple(grey.shape)}, got {tuple(light.visibility.shape)}")
                grey = grey * light.visibility
            image += grey[..., None] * torch.tensor(irradiance * scattered).to(image)
        if self.emission is not None:
            image += self.emission[..., None] if ramp is None else ramp(self.emission)
        if background is None:
            return image
        if self.transparency is None:
            raise ValueError("transparency: expected that of the lightmaps, found none")
        return image + self.transparency[..., None] * torch.as_tensor(background).to(image)
