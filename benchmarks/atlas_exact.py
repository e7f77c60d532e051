"""Decodes light in float64 from a model's stored numbers: the reference for the runtime kernels."""

import numpy as np

from wlm.atlas.model import BLOCK_SIDE, LUT_STEPS, AtlasModel, coarse_place, unpack_tiles


def decode64(model: AtlasModel, uv: np.ndarray, sheet: np.ndarray | int = 0, state: int = 0) -> np.ndarray:
    """Returns light at points (lightmap-uv-clustering-cascade, eq. 7; for shared tiles see `wlm.atlas.model`).

    Light may jump where tiles meet, so a float32 decoder may differ where it rounds a point into the neighbouring tile.

    Args:
        model: The model.
        uv: [N, 2], finite: the model's new UVs if it has any, else the UVs of the sheets; clamped to [0, 1].
        sheet: int [N], or one number for all points: number of the sheet or mip level, its row in `AtlasModel.table`
            for the first state.
        state: The number of the state.

    Returns:
        Light, float64 [N, 3].
    """
    uv = np.asarray(uv, np.float64).clip(0.0, 1.0)
    if model.method in ("tiles", "shared"):
        return _tiles(model, uv, np.broadcast_to(np.asarray(sheet), len(uv)) + state * model.stride, state)
    if model.method == "cascade":
        uv = _bilinear(model.lut / LUT_STEPS, uv)
    return _bilinear(model.texels[0].astype(np.float64), uv)


def _tiles(model: AtlasModel, uv: np.ndarray, row: np.ndarray, state: int) -> np.ndarray:
    """Returns light from tiles, [N, 3]: components times factors, at least 0. One lightmap has one component, factor
    1."""
    factor = model.factor[state] if len(model.factor) else np.array([[0.0] * 3, [1.0] * 3])
    table = model.table()[row].astype(np.int64)
    size, origin, tiles = table[:, 1::-1], table[:, 3:1:-1], table[:, 5:3:-1]
    x = (uv * size - 0.5).clip(0, size - 1) / model.profile.tile
    tile = np.minimum(np.floor(x), tiles - 1).astype(np.int64)
    entry = model.lut[tile[:, 1] + origin[:, 1], tile[:, 0] + origin[:, 0]]
    first, texels, component, count, page, blocks, coarse = unpack_tiles(entry, model.first_block_code)
    blocks &= model.colour == "mixed"
    textures = model.texels.astype(np.float64), model.block_texels.astype(np.float64)
    light = factor[component].astype(np.float64) * (count > 0)[:, None]
    for k in range(int(count.max(initial=0))):
        at = np.flatnonzero(count > k)
        whole = (count - coarse)[at]
        small = (k >= whole)[:, None]
        side = np.where(small, BLOCK_SIDE, texels[at])
        step = np.stack([k * texels[at, 0], np.zeros(len(at), np.int64)], 1)
        begin = first[at] + np.where(small, coarse_place(texels[at], whole, np.maximum(k - whole, 0)), step)
        place = begin + (x - tile)[at] * (side - 1)
        for second, texture in enumerate(textures):
            part = blocks[at] == second
            ends = begin[part], (begin + side - 1)[part]
            read = _between(texture, page[at][part], *ends, place[part])
            light[at[part]] += factor[component[at] + 1 + k][part] * read
    return light.clip(min=0.0)


def _bilinear(texels: np.ndarray, uv: np.ndarray) -> np.ndarray:
    size = np.array(texels.shape[1::-1])
    place, page = (uv * size - 0.5).clip(0, size - 1), np.zeros(len(uv), np.int64)
    return _between(texels[None], page, np.zeros(2, np.int64), size - 1, place)


def _between(
    texels: np.ndarray, page: np.ndarray, first: np.ndarray, last: np.ndarray, place: np.ndarray
) -> np.ndarray:
    """Reads texture pages [pages, H, W, C] bilinearly at `place` [N, 2], x and y in texels from texel 0's centre, using
    only the texels from `first` to `last` [N, 2]."""
    low = np.clip(np.floor(place).astype(np.int64), first, last)
    high = np.minimum(low + 1, last)
    share = (place - low)[:, :, None]
    (x0, y0), (x1, y1) = low.T, high.T
    top = texels[page, y0, x0] * (1.0 - share[:, 0]) + texels[page, y0, x1] * share[:, 0]
    bottom = texels[page, y1, x0] * (1.0 - share[:, 0]) + texels[page, y1, x1] * share[:, 0]
    return top * (1.0 - share[:, 1]) + bottom * share[:, 1]
