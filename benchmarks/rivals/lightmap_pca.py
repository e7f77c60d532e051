"""Principal components over the hours: a few maps of coefficients for each tile, and how each changes over the day.

In each 128 x 128 tile a texel's levels at T hours (`benchmarks.rivals.lightmap_levels`; the ranges are over all hours)
are a vector of 3 T numbers. A texel keeps the coefficients of its vector along the tile's first K principal axes; the
tile keeps the axes and the mean vector as half floats. Two functions store the maps of coefficients differently:

- `encode_pca_bc4`: K maps as BC4 textures, 4 bits a texel each.
- `encode_pca`: every map rounded with the same step, which gives the smallest squared error at a given rate; K follows
  from the step. A map takes a byte per texel in memory, and on disk it is lossless JPEG XL, a quarter smaller than
  with zstd.

Both take lightmaps [T, H, W, 3] in linear RGB and their mask [H, W], and return a `Rival` whose `decoded` is float32
[T, H, W, 3]. They raise a `WlmError` like the block codecs.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks.rivals.lightmap_levels import TileRanges, prepare, seen_texels, to_codes
from benchmarks.rivals.rival import EXTRA, Rival, disk_size, measure
from wlm.errors import WlmError
from wlm.formats.hdr_blocks import need
from wlm.lightmap.tiles import TILE
from wlm.texels import fill_gaps

_BC4_BLOCK = 4
_MOST_LEVELS = 255  # levels of a map in bytes


@dataclass(frozen=True, eq=False)
class _Tile:
    """The principal components of one tile over T times.

    Attributes:
        area: Slices of the map's rows and columns that the tile covers.
        inside: bool [h, w], which texels of the tile are coded: N texels at and just around charts.
        mean: Mean vector, half [3 T].
        axes: K principal axes, half [K, 3 T], the axis of the largest variance first.
        coefficients: Coefficients of the N coded texels, float32 [N, K].
    """

    area: tuple[slice, slice]
    inside: np.ndarray
    mean: np.ndarray
    axes: np.ndarray
    coefficients: np.ndarray


def encode_pca_bc4(frames: np.ndarray, mask: np.ndarray, components: int = 4) -> Rival:
    """Encodes K principal coefficients per texel as BC4 textures, whose 256 levels span a map's range in a tile.

    Args:
        frames, mask: The lightmaps [T, H, W, 3] and their mask [H, W].
        components: K, at least 1; a tile has at most 3 T coefficients per texel.
    """
    if components < 1:
        raise WlmError(f"pca: expected at least 1 component, got {components}")
    for package in ("ispc_texcomp", "imagecodecs"):  # the time to import them isn't the codec's
        need(package, EXTRA)
    images = prepare(frames, mask)

    def encode() -> tuple[TileRanges, list[tuple[_Tile, list[tuple[bytes, np.ndarray]]]]]:
        ranges, tiles = _tiles(images, mask)
        return ranges, [(tile, [_bc4(plane, tile) for plane in tile.coefficients[:, :components].T]) for tile in tiles]

    def decode(payload: tuple) -> np.ndarray:
        ranges, tiles = payload
        read = ((tile, np.stack([_from_bc4(*plane, tile) for plane in planes], axis=1)) for tile, planes in tiles)
        return _decode(read, ranges, images.shape)

    def stored(payload: tuple) -> bytes:
        ranges, tiles = payload
        maps = [data + scale.tobytes() for _, planes in tiles for data, scale in planes]
        return b"".join([ranges.tobytes(), *(_basis(tile, len(planes)) for tile, planes in tiles), *maps])

    return measure(
        f"pca-bc4-{components}",
        encode,
        decode,
        bytes=lambda payload: len(stored(payload)),
        disk_bytes=lambda payload: disk_size(stored(payload)),
    )


def encode_pca(frames: np.ndarray, mask: np.ndarray, step: float = 0.04) -> Rival:
    """Encodes principal coefficients rounded to multiples of a step, and leaves out maps that become zero.

    Args:
        frames, mask: The lightmaps [T, H, W, 3] and their mask [H, W].
        step: Step of the rounding, above 0, where levels range from 0 to 1. A map that would need more than 256 steps
            gets a wider step.
    """
    if not 0.0 < step < np.inf:
        raise WlmError(f"pca: expected a step above 0, got {step:g}")
    need("imagecodecs", EXTRA)
    images = prepare(frames, mask)

    def encode() -> tuple[TileRanges, list[tuple[_Tile, list[np.ndarray], np.ndarray]]]:
        ranges, tiles = _tiles(images, mask)
        return ranges, [(tile, *_rounded(tile, step)) for tile in tiles]

    def decode(payload: tuple) -> np.ndarray:
        ranges, tiles = payload
        read = ((tile, planes * scale[:, 1] + scale[:, 0]) for tile, planes, scale in tiles)
        return _decode(read, ranges, images.shape)

    def size(payload: tuple) -> int:
        """Returns the size in bytes in a GPU's memory, where a map takes one byte per texel."""
        ranges, tiles = payload
        texels = sum(tile.inside.size * planes.shape[1] for tile, planes, _ in tiles)
        rest = sum(len(_basis(tile, planes.shape[1])) + scale.nbytes for tile, planes, scale in tiles)
        return texels + rest + len(ranges.tobytes())

    def disk_bytes(payload: tuple) -> int:
        ranges, tiles = payload
        rest = [ranges.tobytes(), *(_basis(tile, planes.shape[1]) + scale.tobytes() for tile, planes, scale in tiles)]
        maps = sum(len(_lossless(plane, tile)) for tile, planes, _ in tiles for plane in planes.T)
        return maps + disk_size(b"".join(rest))

    return measure(f"pca-{step:g}", encode, decode, bytes=size, disk_bytes=disk_bytes)


def _tiles(images: np.ndarray, mask: np.ndarray) -> tuple[TileRanges, list[_Tile]]:
    """Computes the ranges of all tiles, and the principal components of every tile that has a texel to encode."""
    seen = seen_texels(mask)
    codes = to_codes(images)
    ranges = TileRanges.over_times(codes, seen)
    levels = ranges.levels(codes)
    tiles = []
    for area in _areas(*seen.shape):
        inside = seen[area]
        if inside.any():
            vectors = levels[(slice(None), *area)][:, inside].transpose(1, 0, 2).reshape(np.count_nonzero(inside), -1)
            tiles.append(_Tile(area, inside, *_principal(vectors)))
    return ranges, tiles


def _areas(height: int, width: int) -> Iterator[tuple[slice, slice]]:
    for y in range(0, height, TILE):
        for x in range(0, width, TILE):
            yield slice(y, min(y + TILE, height)), slice(x, min(x + TILE, width))


def _principal(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Computes the PCA of N vectors [N, D]. Returns mean, half [D], axes, half [D, D], and coefficients [N, D]."""
    mean = vectors.mean(axis=0, dtype=np.float64).astype(np.float16)
    centred = vectors - mean.astype(np.float32)
    _, axes = np.linalg.eigh(centred.T.astype(np.float64) @ centred)
    axes = np.ascontiguousarray(axes.T[::-1]).astype(np.float16)
    return mean, axes, centred @ axes.astype(np.float32).T


def _basis(tile: _Tile, components: int) -> bytes:
    return tile.mean.tobytes() + tile.axes[:components].tobytes()


def _rounded(tile: _Tile, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Rounds a tile's coefficients. Returns bytes [N, K] of K maps, and each map's minimum and step, float32 [K, 2]."""
    span = np.ptp(tile.coefficients, axis=0)
    steps = np.maximum(np.float32(step), span / np.float32(_MOST_LEVELS - 1))
    whole = np.rint(tile.coefficients / steps)
    kept = np.flatnonzero(whole.any(axis=0))
    count = kept[-1] + 1 if kept.size else 0  # those in between are kept: they cost nothing
    least = whole[:, :count].min(axis=0)
    return (whole[:, :count] - least).astype(np.uint8), np.stack([least * steps[:count], steps[:count]], axis=1)


def _lossless(plane: np.ndarray, tile: _Tile) -> bytes:
    return need("imagecodecs", EXTRA).jpegxl_encode(_over_tile(plane, tile), lossless=True)


def _over_tile(values: np.ndarray, tile: _Tile) -> np.ndarray:
    """Spreads the values [N] of a tile's N coded texels over a map [h, w]; other texels take the nearest value."""
    texels = np.zeros(tile.inside.shape, values.dtype)
    texels[tile.inside] = values
    return fill_gaps(texels[..., None], tile.inside)[..., 0]


def _bc4(plane: np.ndarray, tile: _Tile) -> tuple[bytes, np.ndarray]:
    """Encodes a map of N values [N] as BC4. Returns the blocks, and minimum and range of the map, float32 [2]."""
    least = plane.min()
    span = plane.max() - least
    texels = _over_tile(np.rint((plane - least) / (span or 1.0) * 255.0).astype(np.uint8), tile)
    height, width = texels.shape
    padded = np.pad(texels, ((0, -height % _BC4_BLOCK), (0, -width % _BC4_BLOCK)), mode="edge")
    texcomp = need("ispc_texcomp", EXTRA)
    surface = texcomp.RGBASurface(padded.tobytes(), padded.shape[1], padded.shape[0], padded.shape[1])
    return texcomp.compress_blocks_bc4(surface), np.array([least, span], np.float32)


def _from_bc4(data: bytes, scale: np.ndarray, tile: _Tile) -> np.ndarray:
    height, width = tile.inside.shape
    shape = (height + -height % _BC4_BLOCK, width + -width % _BC4_BLOCK)
    texels = need("imagecodecs", EXTRA).bcn_decode(data, 4, shape=shape)[:height, :width]
    return texels[tile.inside] / np.float32(255.0) * scale[1] + scale[0]


def _decode(
    tiles: Iterator[tuple[_Tile, np.ndarray]],
    ranges: TileRanges,
    shape: tuple[int, ...],
) -> np.ndarray:
    """Decodes lightmaps [T, H, W, 3] from each tile's coefficients [N, K]; black where no texel is coded."""
    levels = np.zeros(shape, np.float32)
    for tile, coefficients in tiles:
        axes = tile.axes[: coefficients.shape[1]].astype(np.float32)
        vectors = coefficients.astype(np.float32) @ axes + tile.mean.astype(np.float32)
        levels[(slice(None), *tile.area)][:, tile.inside] = vectors.reshape(-1, shape[0], 3).transpose(1, 0, 2)
    return ranges.radiance(levels)
