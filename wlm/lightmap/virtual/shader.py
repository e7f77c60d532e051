"""GLSL that reads a virtual texture as `VirtualTexture.sample` does."""

import numpy as np

from wlm.bundle import filled, sampler
from wlm.lightmap.virtual.layout import Layout

_HEAD, _SHEET, _LEVELS = 4, 36, 16  # words before the sheets, words of a sheet, and most levels
_ROW = 256  # words in a row of the texture of sheets


def virtual_glsl() -> str:
    """Returns GLSL that reads the light of any virtual texture, to be included below `#version`."""
    kinds = {"pages": "sampler2DArray", "table": "usampler2D", "sheets": "usampler2D"}
    samplers = {name: sampler(f"wlm_virtual_{name}", kind) for name, kind in kinds.items()}
    words = {"head": _HEAD, "sheet": _SHEET, "levels": _LEVELS, "columns": 4 + _LEVELS}
    words |= {"row_mask": _ROW - 1, "row_bits": _ROW.bit_length() - 1}
    return filled(__package__, "virtual.glsl", **samplers, **words)


def sheet_words(layout: Layout) -> np.ndarray:
    """Returns the texels of the texture `wlm_virtual_sheets`, uint32 [rows, 256]."""
    count = len(layout.sheets)
    words = np.zeros((count, _SHEET), np.uint32)
    words[:, 0], words[:, 1] = zip(*((own.height, own.width) for own in layout.models), strict=True)
    words[:, 2] = layout.levels
    levels = layout.first.shape[1]
    words[:, 4 : 4 + levels] = layout.first
    words[:, 4 + _LEVELS : 4 + _LEVELS + levels] = layout.columns
    whole = np.concatenate([np.array([layout.side, layout.border, count, 0], np.uint32), words.ravel()])
    return np.pad(whole, (0, -len(whole) % _ROW)).reshape(-1, _ROW)
