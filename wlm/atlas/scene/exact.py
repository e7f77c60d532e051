"""The decode in float64, from a model's stored numbers to light: the reference of the runtime kernel."""

import numpy as np

from wlm.atlas.model import TEXELS, unpack_entries
from wlm.atlas.scene.model import SceneModel
from wlm.formats.shared_exponent import unpack_rgb9e5


def decode64(model: SceneModel, uv: np.ndarray, sheet: np.ndarray, state: int) -> np.ndarray:
    """Reads light at points, by `wlm.atlas.scene.model`'s sum.

    Args:
        model: The model.
        uv: [N, 2], finite, in the sheets; clamped to [0, 1].
        sheet: int [N], 0 to S - 1.
        state: Its number.

    Returns:
        float64 [N, 3].
    """
    table = model.table()[np.asarray(sheet)].astype(np.int64)
    size, origin, tiles, page = table[:, 1::-1], table[:, 3:1:-1], table[:, 5:3:-1], table[:, 6]
    x = (np.asarray(uv, np.float64).clip(0.0, 1.0) * size - 0.5).clip(0, size - 1) / model.profile.tile
    tile = np.minimum(np.floor(x), tiles - 1).astype(np.int64)
    first, count, _ = unpack_entries(model.lut[tile[:, 1] + origin[:, 1], tile[:, 0] + origin[:, 0]], TEXELS)
    place = first + (x - tile) * (count - 1)
    low = np.clip(np.floor(place).astype(np.int64), first, first + count - 1)
    high = np.minimum(low + 1, first + count - 1)
    share = place - low
    factor = model.factor[state].astype(np.float64)
    light = np.zeros((len(x), 3))
    for k in range(len(factor)):
        layer = page * len(factor) + k
        for column, a in ((low[:, 0], 1.0 - share[:, 0]), (high[:, 0], share[:, 0])):
            for row, b in ((low[:, 1], 1.0 - share[:, 1]), (high[:, 1], share[:, 1])):
                texel = unpack_rgb9e5(model.texels[layer, row, column]).astype(np.float64)
                light += factor[k] * texel * (a * b)[:, None]
    return light
