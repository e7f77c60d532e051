"""Training data of a batch of tiles: normalised colours and their weights in the loss."""

from dataclasses import dataclass

import numpy as np

from wlm.lightmap.profile import Profile, TimeAxis
from wlm.lightmap.tiles import TILE, TileCut
from wlm.workers import each


class Targets:
    """The training data of N tiles, on the host.

    Attributes:
        number: int [N], numbers of the tiles in their grid.
        colour: float32 [N, T, 128 * 128, 3], (colour / scale - shift) / spread.
        texels: int32 [N, K], flat indices of valid texels, padded to the largest count K.
        count: int32 [N], number of valid texels.
        weight, emphasis: Loss weights, float32 [N, T, 3], and a number, see `wlm_kernels.lightmap.features.Batch`.
        shift, spread: float32 [N, 3], mean and standard deviation of colour / scale.
        scale: float32 [N, T, 3], mean of each channel at each time.
        range: float32 [N, T], range of the radiance that errors are relative to, or `peak` if it is given.
    """

    def __init__(
        self,
        number: np.ndarray,
        colour: np.ndarray,
        mask: np.ndarray,
        scale: np.ndarray,
        affine: np.ndarray,
        *,
        gamma: float,
        metric_weight: float,
        peak: float | None = None,
    ) -> None:
        """Normalises and weights gamma-space colours [N, T, 128, 128, 3] where `mask` [N, 128, 128] is true.

        `scale` [N, T, 3] and `affine` [N, 2, 3], which holds shift and spread, are float32, as rounded for the file.
        """
        n, times = colour.shape[:2]
        self.number = number.astype(np.int32)
        self.scale = scale
        self.shift = affine[:, 0].astype(np.float32)
        self.spread = affine[:, 1].astype(np.float32)
        factor = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0)
        flat = colour.reshape(n, times, TILE * TILE, 3)
        valid = mask.reshape(n, -1)
        self.colour = np.empty_like(flat)
        self.count = valid.sum(1).astype(np.int32)
        self.texels = np.zeros((n, max(int(self.count.max()), 1)), np.int32)
        self.weight = np.ones((n, times, 3), np.float32)
        self.range = np.zeros((n, times), np.float32)

        def fill(i: int) -> None:
            np.multiply(flat[i], factor[i, :, None], out=self.colour[i])
            self.colour[i] -= self.shift[i]
            self.colour[i] /= self.spread[i]
            self.texels[i, : self.count[i]] = np.flatnonzero(valid[i])
            values = flat[i][:, valid[i]]
            span = values.max((1, 2)) ** gamma - values.min((1, 2)) ** gamma  # [T] of linear radiance
            if peak is not None:
                span = np.full_like(span, peak)
            self.range[i] = span
            if metric_weight > 0:
                # d radiance / d y = gamma (colour / scale)^(gamma - 1) scale^gamma spread; the middle factor is the
                # texel's emphasis. A tile without a range is not scored and gets no weight.
                slope = gamma * scale[i] ** gamma * self.spread[i] / np.where(span > 0, span, 1.0)[:, None]
                self.weight[i] = np.where(span[:, None] > 0, slope, 0.0) ** (2.0 * metric_weight)

        list(each(fill, range(n)))
        # A black channel has scale 0: it decodes to 0 whatever the network's output is.
        self.weight *= scale > 0
        self.emphasis = 2.0 * (gamma - 1.0) * metric_weight


@dataclass(frozen=True, eq=False)
class TileJob:
    """A batch of N tiles of one kind, sent to a worker, which computes the training data from it.

    Attributes:
        tiles: Light and masks of the tiles.
        dynamic: Whether the tiles are dynamic instead of static.
        scale, affine: See `Targets`.
        profile: The settings.
        axis: The time axis.
    """

    tiles: TileCut
    dynamic: bool
    scale: np.ndarray
    affine: np.ndarray
    profile: Profile
    axis: TimeAxis

    def targets(self) -> Targets:
        """Computes the training data."""
        tiles, settings = self.tiles.encoded(self.profile.gamma), self.profile
        options = {"gamma": settings.gamma, "metric_weight": settings.metric_weight, "peak": settings.peak}
        return Targets(tiles.index, tiles.colour, tiles.mask, self.scale, self.affine, **options)
