"""Decodes a whole map at run time into one texture that a renderer samples: RGB9E5 with mips, on the device.

Tiles decoded to 8 bits per channel have different bounds, so that a filter must not read across two tiles. RGB9E5, also
32 bits per texel, needs no bounds. Gaps between charts are filled, and mips average only texels inside charts.
"""

import os

import numpy as np
import warp as wp

from wlm import interop
from wlm.errors import WlmError
from wlm.formats.dds import write_dds
from wlm.formats.float_texels import MOST_SIDE
from wlm.formats.shared_exponent import unpack_rgb9e5
from wlm.lightmap.encodings.constant import ConstantTiles
from wlm.lightmap.model import SheetModel
from wlm.lightmap.runtime import runtime_decoders
from wlm.lightmap.tiles import TILE, TileKind
from wlm.texels import near_gaps
from wlm_kernels.lightmap import texture


class MapDecoder:
    """Decodes all tiles of a sheet into one texture and its mips.

    Attributes:
        levels: `wp.array` uint32 [h, w] each, RGB9E5, written by `decode`: the map, then mips of half the size, rounded
            down. A mip texel is the mean of the valid texels that it covers, in tiles that are not empty; texels in
            gaps within `wlm.texels.REACH` of a valid texel have the light of the nearest valid one of the same level.
        decoders: The decoder of each kind of tile.
    """

    def __init__(self, model: SheetModel, device: str = "cpu", mips: int | None = None) -> None:
        """Uploads a sheet and allocates all buffers; the time is initially the first stored one.

        Args:
            model: The sheet.
            device: "cpu", "cuda" or "cuda:N".
            mips: Number of mips besides the map itself; None: down to one texel.

        Raises:
            WlmError: There is no such device, or the map does not have that many mips.
        """
        self.model, self.device = model, interop.check_device(device)
        most = max(model.height, model.width).bit_length() - 1
        if mips is not None and not 0 <= mips <= most:
            raise WlmError(f"mips: expected 0 to {most} for a map of {model.width}x{model.height}, got {mips}")
        self.decoders = runtime_decoders(model, self.device, shared=True)
        self._corners = [self._places(decoder.numbers) for decoder in self.decoders]
        self._constant = ConstantTiles(model)
        self._constant_corners = self._places(self._constant.numbers)
        self._colours = wp.empty(len(self._constant.numbers), dtype=wp.vec3, device=self.device)
        self._allocate(most if mips is None else mips)
        self.set_time(float(model.times[0]))

    def _allocate(self, mips: int) -> None:
        self.levels, self._weights, self._gaps = [], [], []
        weight = self.model.mask.astype(np.float32)
        # Valid texels of tiles that are not stored would darken mips.
        for number in self.model.numbers(TileKind.EMPTY):
            weight[self.model.grid.window(number)] = 0.0
        for level in range(mips + 1):
            if level:
                weight = _halved(weight)
            self.levels.append(wp.zeros(weight.shape, dtype=wp.uint32, device=self.device))
            self._weights.append(wp.array(weight, dtype=float, device=self.device))
            self._gaps.append([self._vectors(at) for at in near_gaps(weight > 0)])

    def _vectors(self, at: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(at, np.int32), dtype=wp.vec2i, device=self.device)

    def _places(self, numbers: np.ndarray) -> wp.array:
        grid = self.model.grid
        return self._vectors(np.array([grid.origin(int(number)) for number in numbers]).reshape(-1, 2))

    def set_time(self, time: float) -> None:
        """Sets the time of the following decodes; a CUDA graph captured before must be captured again.

        Args:
            time: In the unit of the set's times, stored or between; see `wlm.lightmap.decode.SheetDecoder`.
        """
        for decoder in self.decoders:
            decoder.set_time(time)
        self._colours.assign(self._constant.colours(time))

    def decode(self) -> None:
        """Decodes the map into `levels`; it only launches kernels and allocates nothing: CUDA graphs can capture it."""
        whole = self.levels[0]
        for decoder, corners in zip(self.decoders, self._corners, strict=True):
            decoder.decode()
            texture.place(decoder.out, corners, whole)
        if len(self._colours):
            texture.paint(self._colours, self._constant_corners, TILE, whole)
        for i, (level, (target, source)) in enumerate(zip(self.levels, self._gaps, strict=True)):
            if i:
                texture.halve(self.levels[i - 1], self._weights[i - 1], level)
            if len(target):
                texture.fill(target, source, level)

    def numpy(self, level: int = 0) -> np.ndarray:
        """Copies a level (0: the map, 1: the first mip) to the host: linear radiance, float32 [h, w, 3]."""
        return unpack_rgb9e5(self.levels[level].numpy())


def write_texture(path: str | os.PathLike[str], model: SheetModel, time: float, device: str = "cpu") -> None:
    """Writes the map at one time as a renderer samples it: a DDS of RGB9E5 texels with all mips.

    Args:
        path: The DDS file to write.
        model: The sheet.
        time: In the unit of the set's times.
        device: Device that decodes.

    Raises:
        WlmError: There is no such device, the time is not finite, the map is larger than a DDS may be, or the file can
            not be written.
    """
    if max(model.height, model.width) > MOST_SIDE:
        size = f"{model.width}x{model.height}"
        raise WlmError(f"{model.name}: expected at most {MOST_SIDE} texels along each side of a DDS, found {size}")
    decoder = MapDecoder(model, device)
    decoder.set_time(time)
    decoder.decode()
    texels = b"".join(level.numpy().astype("<u4").tobytes() for level in decoder.levels)
    mips = len(decoder.levels) - 1
    write_dds(path, texels, model.width, model.height, fmt="R9G9B9E5_SHAREDEXP", mips=mips)


def _halved(weight: np.ndarray) -> np.ndarray:
    """Sums blocks of 2x2 texels of an image [h, w]; if a side is odd, its last blocks are three texels long."""
    for axis in (0, 1):
        starts = np.arange(max(weight.shape[axis] // 2, 1)) * 2
        weight = np.add.reduceat(weight, starts, axis)
    return weight
