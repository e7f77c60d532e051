"""A sheet decoded to one RGB9E5 texture of the whole map with mips, by which the virtual texture is measured."""

import numpy as np
import warp as wp

from benchmarks.rivals.whole_tiles import FrameDecoder, TileDecoder, fast_decoder
from wlm.formats.shared_exponent import unpack_rgb9e5
from wlm.lightmap.encodings.constant import ConstantTiles
from wlm.lightmap.model import SheetModel
from wlm.lightmap.tiles import TILE, TileKind
from wlm.texels import near_gaps
from wlm_kernels.shared_exponent import pack_rgb9e5 as pack_kernel
from wlm_kernels.shared_exponent import unpack_rgb9e5 as unpack_kernel

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _place(
    # in:
    tiles: wp.array3d[wp.uint32],
    corners: wp.array1d[wp.vec2i],
    # out:
    texture: wp.array2d[wp.uint32],
):
    n, i, j = wp.tid()
    y = corners[n][0] + i
    x = corners[n][1] + j
    if y < texture.shape[0] and x < texture.shape[1]:
        texture[y, x] = tiles[n, i, j]


@wp.kernel
def _halve(
    # in:
    fine: wp.array2d[wp.uint32],
    weight: wp.array2d[float],
    # out:
    coarse: wp.array2d[wp.uint32],
):
    y, x = wp.tid()
    # The last texel of an odd side covers three texels.
    bottom = wp.where(y == coarse.shape[0] - 1, fine.shape[0], 2 * y + 2)
    right = wp.where(x == coarse.shape[1] - 1, fine.shape[1], 2 * x + 2)
    light = wp.vec3()
    total = float(0.0)  # noqa: UP018  (a variable of Warp)
    for i in range(2 * y, bottom):
        for j in range(2 * x, right):
            w = weight[i, j]
            light += w * unpack_kernel(fine[i, j])
            total += w
    if total > 0.0:
        light = light / total
    coarse[y, x] = pack_kernel(light)


@wp.kernel
def _fill(
    # in:
    target: wp.array1d[wp.vec2i],
    source: wp.array1d[wp.vec2i],
    # in and out:
    texture: wp.array2d[wp.uint32],
):
    g = wp.tid()
    texture[target[g][0], target[g][1]] = texture[source[g][0], source[g][1]]


@wp.kernel
def _paint(
    # in:
    colours: wp.array1d[wp.vec3],
    # out:
    tiles: wp.array3d[wp.uint32],
):
    n, i, j = wp.tid()
    tiles[n, i, j] = pack_kernel(colours[n])


class WholeMap:
    """Decodes all tiles of a sheet into one texture and its mips, with gaps between charts filled.

    Attributes:
        levels: `wp.array` uint32 [h, w] each, RGB9E5, written by `decode`: the map, then mips of half the size, rounded
            down, to one texel. A mip texel is the mean of the valid texels that it covers, in tiles that are not empty;
            texels in gaps within `wlm.texels.REACH` of a valid texel have the light of the nearest valid one.
    """

    def __init__(self, model: SheetModel, device: str) -> None:
        """Uploads the sheet and allocates all buffers; the time is initially the first stored one."""
        self._model, self._device = model, device
        self._decoders = _tile_decoders(model, device)
        self._constant = ConstantTiles(model)
        count = len(self._constant.numbers)
        self._painted = wp.zeros((count, TILE, TILE), dtype=wp.uint32, device=device)
        self._colours = wp.zeros(count, dtype=wp.vec3, device=device)
        self._corners = [
            self._vectors(np.array([model.grid.origin(n) for n in numbers.tolist()]).reshape(-1, 2))
            for numbers in (*(one.numbers for one in self._decoders), self._constant.numbers)
        ]
        self.levels, self._coverage, self._gaps = [], [], []
        coverage = model.mask.astype(np.float32)
        # Valid texels of tiles that are not stored would darken mips.
        for number in np.flatnonzero(model.kind == TileKind.EMPTY).tolist():
            coverage[model.grid.window(number)] = 0.0
        for level in range(max(coverage.shape).bit_length()):
            coverage = _halved(coverage) if level else coverage
            self.levels.append(wp.zeros(coverage.shape, dtype=wp.uint32, device=device))
            self._coverage.append(wp.array(coverage, dtype=float, device=device))
            self._gaps.append([self._vectors(at) for at in near_gaps(coverage > 0)])
        self.set_time(float(model.times[0]))

    def _vectors(self, at: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(at, np.int32), dtype=wp.vec2i, device=self._device)

    def set_time(self, time: float) -> None:
        """Sets the time of the following decodes; a CUDA graph captured before must be captured again."""
        for decoder in self._decoders:
            decoder.set_time(time)
        if len(self._colours):
            self._colours.assign(self._constant.colours(time).astype(np.float32))
            wp.launch(_paint, self._painted.shape, [self._colours, self._painted], device=self._device)

    def decode(self) -> None:
        """Decodes the map into `levels`; it only launches kernels, so that a CUDA graph can capture it."""
        for decoder in self._decoders:
            decoder.decode()
        for tiles, corners in zip((*(one.out for one in self._decoders), self._painted), self._corners, strict=True):
            if len(tiles):
                wp.launch(_place, tiles.shape, [tiles, corners, self.levels[0]], device=self._device)
        for i, (level, gaps) in enumerate(zip(self.levels, self._gaps, strict=True)):
            if i:
                finer = [self.levels[i - 1], self._coverage[i - 1]]
                wp.launch(_halve, level.shape, [*finer, level], device=self._device)
            if len(gaps[0]):
                wp.launch(_fill, len(gaps[0]), [*gaps, level], device=self._device)

    def numpy(self, level: int = 0) -> np.ndarray:
        """Copies a level (0: the map, 1: the first mip) to the host: linear radiance, float32 [h, w, 3]."""
        return unpack_rgb9e5(self.levels[level].numpy())


def _halved(weight: np.ndarray) -> np.ndarray:
    """Sums blocks of 2x2 texels of an image [h, w]; if a side is odd, its last blocks are three texels long."""
    for axis in (0, 1):
        starts = np.arange(max(weight.shape[axis] // 2, 1)) * 2
        weight = np.add.reduceat(weight, starts, axis)
    return weight


def _tile_decoders(model: SheetModel, device: str) -> list[TileDecoder]:
    """Makes the fastest decoder to RGB9E5 of each kind of tile that a sheet has; constant tiles need none."""
    decoders: list[TileDecoder] = []
    if (model.kind == TileKind.DYNAMIC).any():
        decoders.append(fast_decoder(model, device))
    if (model.kind == TileKind.FRAMES).any():
        decoders.append(FrameDecoder(model, device))
    return decoders
