"""A whole map at runtime as one texture that a renderer samples: RGB9E5 with mips, on the device.

Tiles of 8 bits have a bound each, so that a filter may not cross from one to the next. Here they lie in one texture of
the same 32 bits a texel, with gaps filled over the whole map and mips of what is inside charts.
"""

import numpy as np
import warp as wp

from wlm import interop
from wlm.errors import WlmError
from wlm.formats.shared_exponent import unpack_rgb9e5
from wlm.lightmap.decode import TimeTable
from wlm.lightmap.frame_decode import image_kinds
from wlm.lightmap.model import TILE, LightmapModel
from wlm.lightmap.runtime import ExactDecoder, FrameDecoder, MatrixDecoder, StripDecoder, fast_decoder
from wlm.lightmap.tiles import TileGrid, TileKind
from wlm.texels import near_gaps
from wlm_kernels.lightmap import page


class MapDecoder:
    """All tiles of a model in one texture and its mips.

    Attributes:
        levels: `wp.array` uint32 [h, w] each, RGB9E5: the map, then mips of half the size, rounded down; written by
            `decode`. A mip's texel is the mean of the valid texels of the file's tiles that it covers; gaps within
            `wlm.texels.REACH` of those hold the nearest one of their own level.
        decoders: The tiles by kind.
    """

    def __init__(self, model: LightmapModel, device: str = "cpu", mips: int | None = None) -> None:
        """Uploads the model and allocates all buffers; the time is the first stored one.

        Args:
            model: The model.
            device: "cpu", "cuda" or "cuda:N".
            mips: Levels after the map; None: down to one texel.

        Raises:
            WlmError: No such device, or the map has no so many mips.
        """
        self.model, self.device = model, interop.check_device(device)
        most = max(model.height, model.width).bit_length() - 1
        if mips is not None and not 0 <= mips <= most:
            raise WlmError(f"mips: expected 0 to {most} for a map of {model.width}x{model.height}, got {mips}")
        self.decoders: list[StripDecoder | MatrixDecoder | ExactDecoder | FrameDecoder] = []
        if (model.kind == TileKind.DYNAMIC).any():
            self.decoders.append(fast_decoder(model, self.device, shared=True))
        if (model.kind == TileKind.STATIC).any():
            self.decoders.append(ExactDecoder(model, self.device, kind=TileKind.STATIC, shared=True))
        for kind in image_kinds(model):
            self.decoders.append(FrameDecoder(model, self.device, kind, shared=True))
        self._corners = [self._places(decoder.numbers) for decoder in self.decoders]
        self._times = TimeTable(model, self.device)
        self._constant = self._places(np.flatnonzero(model.kind == TileKind.CONSTANT))
        self._colours = wp.empty(len(self._constant), dtype=wp.vec3, device=self.device)
        self._allocate(most if mips is None else mips)
        self.set_time(float(model.times[0]))

    def _allocate(self, mips: int) -> None:
        self.levels, self._weights, self._gaps = [], [], []
        weight = self.model.mask.astype(np.float32)
        # Valid texels that the file doesn't hold would darken mips.
        grid = TileGrid.of(self.model.height, self.model.width)
        for number in np.flatnonzero(self.model.kind == TileKind.EMPTY).tolist():
            y, x = grid.origin(number)
            weight[y : y + TILE, x : x + TILE] = 0.0
        for level in range(mips + 1):
            if level:
                weight = _halved(weight)
            self.levels.append(wp.zeros(weight.shape, dtype=wp.uint32, device=self.device))
            self._weights.append(wp.array(weight, dtype=float, device=self.device))
            self._gaps.append([self._vectors(at) for at in near_gaps(weight > 0)])

    def _vectors(self, at: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(at, np.int32), dtype=wp.vec2i, device=self.device)

    def _places(self, numbers: np.ndarray) -> wp.array:
        grid = TileGrid.of(self.model.height, self.model.width)
        return self._vectors(np.array([grid.origin(int(number)) for number in numbers]).reshape(-1, 2))

    def set_time(self, time: float) -> None:
        """Sets the time of the decodes that follow; a graph captured before is out of date, as of `StripDecoder`.

        Args:
            time: In the unit of the set's times, stored or between; see `Decoder`.

        Raises:
            WlmError: It isn't finite.
        """
        before, after, share = self._times.neighbours(time)
        for decoder in self.decoders:
            decoder.set_time(time)
        colours = self.model.constant.astype(np.float32)
        self._colours.assign((1.0 - share) * colours[:, before] + share * colours[:, after])

    def decode(self) -> None:
        """Decodes the map into `levels`: launches alone, no allocation, no wait; can be captured."""
        whole = self.levels[0]
        for decoder, corners in zip(self.decoders, self._corners, strict=True):
            decoder.decode()
            page.place(decoder.out, corners, whole)
        if len(self._constant):
            page.paint(self._colours, self._constant, TILE, whole)
        for i, (level, (target, source)) in enumerate(zip(self.levels, self._gaps, strict=True)):
            if i:
                page.halve(self.levels[i - 1], self._weights[i - 1], level)
            if len(target):
                page.fill(target, source, level)

    def numpy(self, level: int = 0) -> np.ndarray:
        """A level of the last decode on the host: linear radiance, float32 [h, w, 3]."""
        return unpack_rgb9e5(self.levels[level].numpy())


def _halved(weight: np.ndarray) -> np.ndarray:
    """Sums of two by two texels [h, w]; the last of an odd side takes three."""
    for axis in (0, 1):
        starts = np.arange(max(weight.shape[axis] // 2, 1)) * 2
        weight = np.add.reduceat(weight, starts, axis)
    return weight
