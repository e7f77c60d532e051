"""Tiles that are stored as images, frames, video or levels, on a device."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from wlm.errors import WlmError
from wlm.formats import bc7_modes
from wlm.lightmap.model import TILE, LightmapModel
from wlm.lightmap.tiles import UNPACKED, TileKind
from wlm_kernels.lightmap.frames import FRAMES, StoredFrames, Tables
from wlm_kernels.lightmap.images import ImageKernels
from wlm_kernels.lightmap.video import VIDEO, StoredVideo


def inverse_of(bounds: np.ndarray) -> np.ndarray:
    """1 / each bound, float32; 0 for that of a black tile."""
    return np.divide(1.0, bounds, out=np.zeros_like(bounds), where=bounds > 0)


class HeldTiles:
    """Some tiles of a grid.

    Attributes:
        numbers: int [n], their numbers in the grid.
    """

    def __init__(self, numbers: np.ndarray) -> None:
        self.numbers = numbers
        self._row_of = {int(number): i for i, number in enumerate(numbers)}

    def among(self, numbers: Sequence[int]) -> list[tuple[int, int]]:
        """Those of `numbers` that are here: their places in `numbers` and in `self.numbers`."""
        return [(i, self._row_of[number]) for i, number in enumerate(numbers) if number in self._row_of]


class ImageTiles(HeldTiles):
    """Tiles with an image at each time.

    Attributes:
        numbers: int [n], numbers of the tiles in the grid.
        device_bytes: Memory that they take up on the device, bytes.
    """

    def __init__(
        self, model: LightmapModel, kinds: Sequence[TileKind], greatest: np.ndarray, kernels: ImageKernels
    ) -> None:
        """Finds the tiles of some kinds.

        Args:
            model: The model.
            kinds: Their kinds.
            greatest: float32 [n, T], their greatest colour.
            kernels: Those of its images.

        Raises:
            WlmError: The model has none.
        """
        super().__init__(np.flatnonzero(np.isin(model.kind, kinds)))
        if not len(self.numbers):
            names = " or ".join(kind.name.lower() for kind in kinds)
            raise WlmError(f"{model.name}: expected at least one tile of {names}, found none")
        self._axis, self._greatest, self._kernels = model.axis, greatest, kernels
        self._stored: Any = None
        self.device_bytes = 0

    def bounds(self, time: float) -> np.ndarray:
        """Bound of each tile, float32 [n]; between two times the larger."""
        before, after, share = self._axis.neighbours(time)
        return self._greatest[:, before] if share == 0 else self._greatest[:, [before, after]].max(1)

    def decode(self, time: float, rows: wp.array, out: wp.array, inverse_peak: wp.array | None = None) -> None:
        """Decodes tiles: one launch, which can be captured.

        Args:
            time: Stored or between; there the radiance of both is mixed (eq. 2), whatever the model's networks do.
            rows: int [k], places in `numbers`.
            out: [k, 128, 128], radiance, vec3 or uint32 of RGB9E5; with `inverse_peak` uint32 of 8 bits, as of
                `wlm_kernels.lightmap.images`.
            inverse_peak: float [n], 1 / the bound of each tile.
        """
        arguments = self._stored, *self._axis.neighbours(time), rows
        if inverse_peak is not None:
            self._kernels.decode_bytes(*arguments, inverse_peak, out)
        elif out.dtype == wp.uint32:
            self._kernels.decode_shared(*arguments, out)
        else:
            self._kernels.decode_radiance(*arguments, out)


class FrameTiles(ImageTiles):
    """The frames of a model on a device."""

    def __init__(self, model: LightmapModel, device: str) -> None:
        """Uploads the frames.

        Raises:
            WlmError: The model has none.
        """
        super().__init__(model, (TileKind.FRAMES,), model.ranges[:, :, 1].astype(np.float32).max(2), FRAMES)
        ends = model.ranges.astype(np.float32).reshape(-1, 2, 3)
        words = np.ascontiguousarray(model.frames).view("<u8").reshape(-1, TILE // 4, TILE // 4, 2)
        stored = StoredFrames()
        stored.blocks = wp.array(words, dtype=wp.uint64, device=device)
        stored.least = wp.array(np.ascontiguousarray(ends[:, 0]), dtype=wp.vec3, device=device)
        stored.span = wp.array(np.ascontiguousarray(ends[:, 1] - ends[:, 0]), dtype=wp.vec3, device=device)
        stored.times, stored.gamma = len(model.times), model.profile.gamma
        tables = Tables()
        tables.modes = wp.array(bc7_modes.MODES, dtype=int, device=device)
        tables.partitions = wp.array(bc7_modes.PARTITIONS, dtype=wp.uint32, device=device)
        tables.anchors = wp.array(bc7_modes.ANCHORS, dtype=int, device=device)
        tables.shares = wp.array(bc7_modes.SHARES, dtype=int, device=device)
        stored.tables = tables
        self._stored = stored
        self.device_bytes = sum(array.capacity for array in (stored.blocks, stored.least, stored.span))


class UnpackedTiles(ImageTiles):
    """The unpacked video and levels of a model on a device."""

    def __init__(self, model: LightmapModel, device: str) -> None:
        """Uploads the levels.

        Raises:
            WlmError: The model has none.
        """
        super().__init__(model, UNPACKED, model.word_peaks, VIDEO)
        least, greatest = np.moveaxis(model.word_ranges.astype(np.float32), 2, 0).reshape(2, -1, 3)
        stored = StoredVideo()
        stored.levels = wp.array(model.words.reshape(-1, TILE, TILE), dtype=wp.uint32, device=device)
        stored.least = wp.array(np.ascontiguousarray(least), dtype=wp.vec3, device=device)
        stored.span = wp.array(greatest - least, dtype=wp.vec3, device=device)
        stored.times, stored.gamma = len(model.times), model.profile.gamma
        self._stored = stored
        self.device_bytes = sum(array.capacity for array in (stored.levels, stored.least, stored.span))


def image_tiles(model: LightmapModel, device: str) -> list[ImageTiles]:
    """The tiles of a model that are images: frames, then what is unpacked; without those that it has none of."""
    return [IMAGE_TILES[kind](model, device) for kind in image_kinds(model)]


def image_kinds(model: LightmapModel) -> list[TileKind]:
    """Those of `IMAGE_TILES` that a model has."""
    kinds = (TileKind.FRAMES,), UNPACKED
    return [kind for kind, held in zip(IMAGE_TILES, kinds, strict=True) if np.isin(model.kind, held).any()]


IMAGE_TILES: dict[TileKind, type[FrameTiles] | type[UnpackedTiles]] = {
    TileKind.FRAMES: FrameTiles,
    TileKind.VIDEO: UnpackedTiles,
}
"""Tiles that are decoded together: frames, and video with levels."""
