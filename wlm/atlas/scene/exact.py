"""The decode in float64, from a model's stored numbers to light: the reference of the runtime kernel."""

import numpy as np

from wlm.atlas.model import BLOCK_SIDE
from wlm.atlas.scene.model import SceneModel, coarse_place, unpack_tiles
from wlm.formats.shared_exponent import unpack_rgb9e5


def decode64(model: SceneModel, uv: np.ndarray, sheet: np.ndarray, state: int) -> np.ndarray:
    """Reads light at points, by `wlm.atlas.scene.model`'s sum, clipped at 0.

    Args:
        model: The model.
        uv: [N, 2], finite, in the sheets; clamped to [0, 1].
        sheet: int [N], sheets, or levels: rows of `SceneModel.table` of the first state.
        state: Its number.

    Returns:
        float64 [N, 3].
    """
    table = model.table()[np.asarray(sheet) + state * model.stride].astype(np.int64)
    size, origin, tiles = table[:, 1::-1], table[:, 3:1:-1], table[:, 5:3:-1]
    x = (np.asarray(uv, np.float64).clip(0.0, 1.0) * size - 0.5).clip(0, size - 1) / model.profile.tile
    tile = np.minimum(np.floor(x), tiles - 1).astype(np.int64)
    entry = model.lut[tile[:, 1] + origin[:, 1], tile[:, 0] + origin[:, 0]]
    first, count, component, components, page, blocks, coarse = unpack_tiles(entry, model.colour)
    light = model.factor[state, component].astype(np.float64) * (components > 0)[:, None]
    for k in range(int(components.max(initial=0))):
        at = np.flatnonzero(components > k)
        factor, whole = model.factor[state, component[at] + 1 + k].astype(np.float64), (components - coarse)[at]
        small = (k >= whole)[:, None]
        side = np.where(small, BLOCK_SIDE, count[at])
        step = np.stack([k * count[at, 0], np.zeros(len(at), np.int64)], 1)
        begin = first[at] + np.where(small, coarse_place(count[at], whole, np.maximum(k - whole, 0)), step)
        place = begin + (x - tile)[at] * (side - 1)
        low = np.clip(np.floor(place).astype(np.int64), begin, begin + side - 1)
        high = np.minimum(low + 1, begin + side - 1)
        share = place - low
        for column, a in ((low[:, 0], 1.0 - share[:, 0]), (high[:, 0], share[:, 0])):
            for row, b in ((low[:, 1], 1.0 - share[:, 1]), (high[:, 1], share[:, 1])):
                texel = np.empty((len(at), 3))
                for second in (False, True):
                    part = blocks[at] == second
                    spot = page[at][part], row[part], column[part]
                    texel[part] = model.block_texels[spot] if second else unpack_rgb9e5(model.texels[spot])
                light[at] += factor * texel * (a * b)[:, None]
    return light.clip(min=0.0)
