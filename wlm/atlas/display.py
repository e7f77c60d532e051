"""Errors as a screen shows them: light tone mapped, its PSNR and FLIP.

Light is exposed so that nearly all of the original's charts are below white, `wlm.texels.exposure`, and coded as sRGB,
clipped to [0, 1]. The peak of the PSNR is 1.
"""

import math
from dataclasses import dataclass, field
from statistics import fmean

import numpy as np
import torch

from wlm.atlas.data import LightmappedMesh
from wlm.metrics import flip_display
from wlm.metrics.error import psnr_from_mse
from wlm.texels import exposure, to_srgb

FLIP_VIEWS = 8
"""FLIP is the mean of about this many views, evenly chosen: it takes longer than all else of a score."""


class Screen:
    """The original in a view, as a screen shows it.

    Args:
        factor: The exposure, `screen_exposure`.
        hit: bool [h, w], the covered pixels.
        target: float [N, 3], the original's linear light there, row by row.
        flip: Whether FLIP is taken too.
    """

    def __init__(self, factor: float, hit: torch.Tensor, target: torch.Tensor, flip: bool) -> None:
        self._factor, self._shown = factor, self._coded(target, factor)
        hit = hit.cpu().numpy()
        rows, columns = (np.flatnonzero(hit.any(axis=axis)) for axis in (1, 0))
        self._hit = hit[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        self._flip = flip

    def errors(self, light: torch.Tensor) -> tuple[float, float]:
        """Mean squared error, and FLIP or NaN, of the covered pixels.

        Args:
            light: float [N, 3], decoded.
        """
        shown = self._coded(light, self._factor)
        mse = float(np.square(shown - self._shown).mean())
        if not self._flip:
            return mse, math.nan
        pictures = np.zeros((2, *self._hit.shape, 3))
        pictures[0][self._hit], pictures[1][self._hit] = self._shown, shown
        return mse, float(flip_display(*pictures)[self._hit].mean())

    @staticmethod
    def _coded(light: torch.Tensor, factor: float) -> np.ndarray:
        return to_srgb(light.cpu().numpy() * factor)


@dataclass
class ScreenTally:
    """The errors of a decoder on the screen, view by view."""

    mse: list[float] = field(default_factory=list)
    flip: list[float] = field(default_factory=list)

    def add(self, mse: float, flip: float) -> None:
        """Adds a view's, as `Screen.errors` gives them."""
        self.mse.append(mse)
        if not math.isnan(flip):
            self.flip.append(flip)

    def figures(self) -> dict[str, float]:
        """`tone_psnr` and `flip` of `wlm.atlas.evaluation.Score`; NaN without a view."""
        psnr = [psnr_from_mse(mse, 1.0) for mse in self.mse]
        return {
            "tone_psnr": fmean(psnr) if psnr else math.nan,
            "flip": fmean(self.flip) if self.flip else math.nan,
        }


def screen_exposure(mesh: LightmappedMesh) -> float:
    """The factor on the light of a mesh that a screen shows."""
    return exposure(mesh.filled[mesh.mask])
