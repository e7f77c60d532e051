"""Principal components over the hours: a few maps of coefficients for each tile, and how each changes over the day.

In each 128 x 128 tile a texel's levels at T hours (`benchmarks.rivals.lightmap_levels`; the ranges are over all hours)
are a vector of 3 T numbers. A texel keeps the coefficients of its vector along the tile's first K principal axes, in K
BC4 textures of 4 bits a texel each; the tile keeps the axes and the mean vector as half floats.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks.rivals.lightmap_levels import TileRanges, areas, prepare, seen_texels, to_codes
from benchmarks.rivals.rival import EXTRA, Rival, disk_size, measure, need_bc
from wlm.errors import WlmError
from wlm.formats.hdr_blocks import need
from wlm.lightmap.tiles import TILE
from wlm.texels import fill_gaps

_BC4_BLOCK = 4


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
        frames: Lightmaps at T times, [T, H, W, 3], linear RGB.
        mask: [H, W], true where a texel is valid.
        components: K, at least 1; a tile has at most 3 T coefficients per texel.

    Returns:
        The rival; `decoded` is float32 [T, H, W, 3].

    Raises:
        WlmError: As for the block codecs, or `components` is below 1.
    """
    if components < 1:
        raise WlmError(f"pca: expected at least 1 component, got {components}")
    need_bc()
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


def _tiles(images: np.ndarray, mask: np.ndarray) -> tuple[TileRanges, list[_Tile]]:
    """Computes the ranges of all tiles, and the principal components of every tile that has a texel to encode."""
    seen = seen_texels(mask)
    codes = to_codes(images)
    ranges = TileRanges.over_times(codes, seen)
    levels = ranges.levels(codes)
    tiles = []
    for area in areas(*seen.shape, TILE):
        inside = seen[area]
        if inside.any():
            vectors = levels[(slice(None), *area)][:, inside].transpose(1, 0, 2).reshape(np.count_nonzero(inside), -1)
            tiles.append(_Tile(area, inside, *_principal(vectors)))
    return ranges, tiles


def _principal(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Computes the PCA of N vectors [N, D]. Returns mean, half [D], axes, half [D, D], and coefficients [N, D]."""
    mean = vectors.mean(axis=0, dtype=np.float64).astype(np.float16)
    centred = vectors - mean.astype(np.float32)
    _, axes = np.linalg.eigh(centred.T.astype(np.float64) @ centred)
    axes = np.ascontiguousarray(axes.T[::-1]).astype(np.float16)
    return mean, axes, centred @ axes.astype(np.float32).T


def _basis(tile: _Tile, components: int) -> bytes:
    return tile.mean.tobytes() + tile.axes[:components].tobytes()


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


def _decode(tiles: Iterator[tuple[_Tile, np.ndarray]], ranges: TileRanges, shape: tuple[int, ...]) -> np.ndarray:
    """Decodes lightmaps [T, H, W, 3] from each tile's coefficients [N, K]; black where no texel is coded."""
    levels = np.zeros(shape, np.float32)
    for tile, coefficients in tiles:
        axes = tile.axes[: coefficients.shape[1]].astype(np.float32)
        vectors = coefficients.astype(np.float32) @ axes + tile.mean.astype(np.float32)
        levels[(slice(None), *tile.area)][:, tile.inside] = vectors.reshape(-1, shape[0], 3).transpose(1, 0, 2)
    return ranges.radiance(levels)
