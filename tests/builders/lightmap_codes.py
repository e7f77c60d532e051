"""8-bit colours of lightmap tiles: as a run-time decoder gives them, and as the float64 reference does."""

from collections.abc import Sequence

import numpy as np

from benchmarks.lightmap_exact import bound64, colour_tile64
from wlm.lightmap.model import SheetModel
from wlm.lightmap.runtime import RuntimeDecoder


def codes_at(decoder: RuntimeDecoder, time: float) -> np.ndarray:
    """Decodes all tiles of a run-time decoder at a time, uint8 [n, 128, 128, 4]."""
    decoder.set_time(time)
    decoder.decode()
    return decoder.numpy()


def shares_of(model: SheetModel, numbers: Sequence[int] | np.ndarray, time: float) -> np.ndarray:
    """Returns the colour of tiles divided by their bounds, at most 1, float64 [n, 128, 128, 3]; 0 for a bound of 0."""
    bounds = np.array([bound64(model, int(number), time) for number in numbers])[:, None, None, None]
    colours = np.stack([colour_tile64(model, int(number), time) for number in numbers])
    return np.minimum(np.divide(colours, bounds, out=np.zeros_like(colours), where=bounds > 0), 1.0)
