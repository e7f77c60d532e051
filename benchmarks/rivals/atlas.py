"""Rivals of a compressed lightmap (lightmap-uv-clustering-cascade, sections 4.3 and 4.4).

A budget is stated as a share of the lightmap's bits at 48 per texel, 1 - CR in eq. 9 of the paper. Each method gives
its best result within the share. `bytes` counts all that a decoder needs except the UVs, which cost nothing in eq. 9,
and `decoded` is a `Sampler` of `wlm.atlas.evaluation`. Gaps around charts are filled before the lightmap is resized.

Our tiles leave out the gaps between charts, so a rival's texture is counted only in the texels or blocks that are read
for its charts, as if a packer had put charts side by side without any loss.

The paper's DownSampling is bilinear, in half floats. `downsampling` is better: RGB9E5 has half the bits on a GPU and
little more error, and the smaller texture has the least squared error at the texels of charts. On 18 lightmaps of 512²
at a share of 0.17 this is 1.7 dB better than bilinear downsampling, 1.5 dB than Lanczos and 2.0 dB than a box filter.
"""

import functools
import math
import time
from collections.abc import Callable

import numpy as np
import torch

from benchmarks.rivals import astcenc
from benchmarks.rivals.lightmap_blocks import ispc_bc6h
from benchmarks.rivals.rival import Rival
from wlm.atlas.colour import quantise
from wlm.atlas.data import LightmappedScene, Sheet
from wlm.atlas.model import COLOUR_BITS, SOURCE_BITS, TEXELS
from wlm.atlas.resize import resized
from wlm.atlas.views import Points
from wlm.formats import hdr_blocks
from wlm.ops import raster

_BLOCK_BITS = 128
_BC6H = (4, 4)
_EXTRA = "baselines"


def share_of(rival: Rival, scene: LightmappedScene) -> float:
    """Returns the compressed size as a fraction of the lightmap's bits at 48 per texel."""
    return rival.bytes * 8 / (scene.texels * SOURCE_BITS)


def downsampling(scene: LightmappedScene, share: float, bilinear: bool = False) -> Rival:
    """Stores the lightmap at a lower resolution in RGB9E5, to be read bilinearly.

    Args:
        scene: A scene of one lightmap.
        share: Budget as a share of the lightmap's bits at 48 per texel; from 2/3 on full resolution is kept.
        bilinear: Whether to downsample bilinearly as in the paper, instead of by least squares.

    Raises:
        ValueError: The share has no room for one texel.
    """
    start, (sheet,) = time.perf_counter(), scene.sheets
    size, count = _fitting_size(sheet, share, (1, 1), COLOUR_BITS[TEXELS])
    if bilinear:
        row, column = np.meshgrid(*((np.arange(side) + 0.5) / side for side in size), indexing="ij")
        uv = torch.from_numpy(np.stack([column, row], -1).reshape(-1, 2)).float()
        small = raster.texture(torch.from_numpy(sheet.lightmap), uv).reshape(*size, 3)
    else:
        small = resized(sheet.lightmap, sheet.mask, *size)
    texels = quantise(small, TEXELS)["texels"]
    return _texture("downsampling" + " bilinear" * bilinear, texels, count * COLOUR_BITS[TEXELS] // 8, start)


def block_codec(scene: LightmappedScene, share: float, codec: str) -> Rival:
    """Stores the lightmap in a block format, at the highest resolution whose blocks of 16 bytes fit the budget.

    Args:
        scene: A scene of one lightmap.
        share: Budget as a share of the lightmap's bits.
        codec: "bc6h" (Intel's encoder at its second best setting), "bc6h own" (our encoder), or "astcWxH" with one of
            `hdr_blocks.ASTC_BLOCKS`, such as "astc6x5".

    Raises:
        ValueError: The codec is unknown, or the share has no room for one block.
        WlmError: A package is missing; the message names the extra that installs it.
    """
    sides = {f"astc{w}x{h}": (w, h) for w, h in hdr_blocks.ASTC_BLOCKS} | {"bc6h": _BC6H, "bc6h own": _BC6H}
    if codec not in sides:
        raise ValueError(f"codec: expected bc6h, bc6h own or astc with a block such as astc6x5, got {codec!r}")
    start, block, (sheet,) = time.perf_counter(), sides[codec], scene.sheets
    (height, width), count = _fitting_size(sheet, share, block, _BLOCK_BITS)
    half = resized(sheet.lightmap, sheet.mask, height, width).numpy().astype(np.float16)
    if codec == "bc6h own":
        decoded = quantise(half.astype(np.float32), "bc6h")["texels"]
    elif codec == "bc6h":
        padded = np.pad(half, ((0, -height % block[1]), (0, -width % block[0]), (0, 0)), mode="edge")
        data = ispc_bc6h(padded)
        decoded = hdr_blocks.decode_bc6h(data, *padded.shape[:2], _EXTRA)[:height, :width]
    else:
        coder = astcenc.astc(block, astcenc.MEDIUM, _EXTRA)
        data = coder.encode(half)
        decoded = coder.decode(data, height, width)
    return _texture(codec, decoded, count * _BLOCK_BITS // 8, start)


def best_astc(scene: LightmappedScene, share: float) -> Rival:
    """Stores the lightmap in the smallest ASTC blocks with which its full resolution fits the budget.

    If no blocks fit, it is downsampled and stored as `astc12x12`: larger blocks lose less than slight downsampling.
    """
    (sheet,) = scene.sheets
    most = share * sheet.mask.size * SOURCE_BITS / _BLOCK_BITS
    fitting = ((w, h) for w, h in hdr_blocks.ASTC_BLOCKS if _read_blocks(sheet, sheet.mask.shape, (w, h)) <= most)
    w, h = next(fitting, hdr_blocks.ASTC_BLOCKS[-1])
    return block_codec(scene, share, f"astc{w}x{h}")


def _fitting_size(sheet: Sheet, share: float, block: tuple[int, int], bits: int) -> tuple[tuple[int, int], int]:
    """Finds the largest resolution at which the blocks that are read for charts fit the budget. Returns height and
    width, and the number of these blocks."""
    if not 0.0 < share < math.inf:
        raise ValueError(f"share: expected a number above 0, got {share}")
    most = int(share * sheet.mask.size * SOURCE_BITS) // bits
    longest = max(sheet.mask.shape)

    def size(side: int) -> tuple[int, int]:
        rows, columns = (max(1, round(side * texels / longest)) for texels in sheet.mask.shape)
        return rows, columns

    # Bisection: hardly any size needs more blocks than a larger one.
    low, high = 0, longest
    while low < high:
        middle = (low + high + 1) // 2
        if _read_blocks(sheet, size(middle), block) <= most:
            low = middle
        else:
            high = middle - 1
    if low == 0:
        raise ValueError(f"share: {share} of {sheet.mask.size} texels of 48 bits is less than one block, {bits} bits")
    return size(low), _read_blocks(sheet, size(low), block)


def _read_blocks(sheet: Sheet, size: tuple[int, int], block: tuple[int, int]) -> int:
    """Counts the blocks of a resized texture that are read for bilinear samples at the centres of charts' texels."""
    place = (np.argwhere(sheet.mask) + 0.5) * (np.array(size) / sheet.mask.shape) - 0.5
    low = np.floor(place).astype(np.int64)
    # A read at a texel's centre touches only this texel.
    last, side = np.minimum(low + (place > low), np.array(size) - 1), np.array(block[::-1])
    read = np.zeros([-(-count // each) for count, each in zip(size, side, strict=True)], bool)
    for y in (low[:, 0], last[:, 0]):
        for x in (low[:, 1], last[:, 1]):
            read[np.maximum(y, 0) // side[0], np.maximum(x, 0) // side[1]] = True
    return int(np.count_nonzero(read))


def _texture(name: str, texels: np.ndarray, bytes: int, start: float) -> Rival:
    """Makes the `Rival` of a decoded texture that is read at the lightmap's UVs."""
    image = np.ascontiguousarray(texels, np.float32)

    def sample(points: Points, state: int) -> torch.Tensor:
        return raster.texture(torch.tensor(image, device=points.uv.device), points.uv)

    return Rival(name, bytes, time.perf_counter() - start, None, sample, size=texels.shape[:2])


RIVALS: dict[str, Callable[[LightmappedScene, float], Rival]] = {
    "downsampling": downsampling,
    "downsampling bilinear": functools.partial(downsampling, bilinear=True),
    **{
        name: functools.partial(block_codec, codec=name)
        for name in ("bc6h", "bc6h own", "astc4x4", "astc6x6", "astc8x8")
    },
    "astc": best_astc,
}
"""Rivals by name: functions of a scene and a budget, as a share of the lightmap's bits."""
