"""Streams of coded numbers: maps, planes and bytes to a stream and back, see `wlm_kernels.lightmap.coder`."""

import math
from collections.abc import Callable
from functools import cache

import numpy as np
import warp as wp

from wlm_kernels.lightmap import coder, map_coder

_ROOM = 1.1  # of a stream, beside its plain size
_BLOCK = 16


@cache
def _tables() -> tuple[wp.array, wp.array, wp.array]:
    """Logarithm, sigmoid and rate, see `coder.Coder`."""
    logarithm = [0] + [round(256 * math.log(i)) for i in range(1, 65538)]
    half = coder.HALF
    sigmoid = [round(65536 / (1 + math.exp((half - i) / 256))) for i in range(2 * half)]
    rate = [131072 // (2 * n + 3) for n in range(coder.LIMIT + 1)]
    return tuple(wp.array(values, dtype=int, device="cpu") for values in (logarithm, sigmoid, rate))


def _coder(data: np.ndarray, encode: bool, predictions: int, width: int) -> coder.Coder:
    c = coder.Coder()
    weights = np.full((coder.MIXTURES, 8, coder.INPUTS), 19661, np.int32)
    weights[:, :, : coder.PREDICTIONS] = 45875 // max(predictions, 1)
    c.logarithm, c.sigmoid, c.rate = _tables()
    c.encode = int(encode)

    def put(values: np.ndarray, dtype: type = wp.int32) -> wp.array:
        return wp.array(values, dtype=dtype, device="cpu")

    c.data, c.range, c.place = put(data, wp.uint8), put(np.zeros(3, np.uint32), wp.uint32), put(np.zeros(1, np.int32))
    widths = np.full((coder.MIXTURES, coder.PREDICTIONS), 1024 * width, np.int32)
    c.weights, c.widths = put(weights), put(widths)
    c.chance = put(np.full((coder.TREES, 512), 32768, np.int32))
    c.met = put(np.full((coder.TREES, 512), 2, np.int32))
    return c
