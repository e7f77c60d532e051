"""The decode in float64, from a model's stored numbers to light: the reference of the runtime kernels."""

import numpy as np

from wlm.atlas.model import LUT_STEPS, AtlasModel, unpack_entries


def decode64(model: AtlasModel, uv: np.ndarray) -> np.ndarray:
    """Reads light at points (lightmap-uv-clustering-cascade, eq. 7).

    Light has a step where tiles meet; a point that float32 rounds into the neighbouring tile differs by that step.

    Args:
        model: The model.
        uv: [N, 2], finite: the model's new UVs where it has any, else the lightmap's; clamped to [0, 1].

    Returns:
        float64 [N, 3].
    """
    uv = np.asarray(uv, np.float64).clip(0.0, 1.0)
    texels = model.texels.astype(np.float64)
    if model.method == "tiles":
        return _tiles(model, texels, uv)
    if model.method == "cascade":
        uv = _bilinear(model.lut / LUT_STEPS, uv)
    return _bilinear(texels, uv)


def _tiles(model: AtlasModel, texels: np.ndarray, uv: np.ndarray) -> np.ndarray:
    last = np.array([model.width, model.height]) - 1
    x = (uv * (last + 1) - 0.5).clip(0, last) / model.profile.tile
    tile = np.minimum(np.floor(x), np.array(model.lut.shape[1::-1]) - 1).astype(np.int64)
    first, size, blocks = unpack_entries(model.lut[tile[:, 1], tile[:, 0]], model.first_block_code)
    place, blocks = first + (x - tile) * (size - 1), blocks[:, 0] & (model.colour == "mixed")
    light = np.empty((len(uv), 3))
    for texture, part in ((texels, ~blocks), (model.block_texels.astype(np.float64), blocks)):
        light[part] = _between(texture, first[part], (first + size - 1)[part], place[part])
    return light


def _bilinear(texels: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Reads [H, W, C] between texel centres, clamped."""
    size = np.array(texels.shape[1::-1])
    return _between(texels, np.zeros(2, np.int64), size - 1, (uv * size - 0.5).clip(0, size - 1))


def _between(texels: np.ndarray, first: np.ndarray, last: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Reads [H, W, C] bilinearly at places [N, 2] in texels from texel 0's centre, clamped to first..last texels."""
    low = np.clip(np.floor(place).astype(np.int64), first, last)
    high = np.minimum(low + 1, last)
    share = (place - low)[:, :, None]
    (x0, y0), (x1, y1) = low.T, high.T
    top = texels[y0, x0] * (1.0 - share[:, 0]) + texels[y0, x1] * share[:, 0]
    bottom = texels[y1, x0] * (1.0 - share[:, 0]) + texels[y1, x1] * share[:, 0]
    return top * (1.0 - share[:, 1]) + bottom * share[:, 1]
