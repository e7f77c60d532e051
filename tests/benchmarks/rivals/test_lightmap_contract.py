"""Every kind of rival of lightmaps keeps the same contract: gaps, extreme values, errors and missing packages."""

import numpy as np
import pytest
from builders.lightmaps import smooth_light

from benchmarks.rivals.lightmap import RIVALS

# One of each kind with a package that it needs; other names differ in a number.
PACKAGES = {
    "bc6h": "imagecodecs",
    "bc7": "ispc_texcomp",
    "astc4": "astc_encoder",
    "astc12": "astc_encoder",
    "pca-bc4-4": "imagecodecs",
    "av1-85": "imagecodecs",
}


def decoded(name: str, frames: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Encodes lightmaps [T, H, W, 3] at once or one by one, and decodes them."""
    method = RIVALS[name]
    if not method.alone:
        return method.encode(frames, mask).decoded
    return np.stack([method.encode(frame, mask).decoded for frame in frames])


def hours(height: int, width: int) -> np.ndarray:
    light = smooth_light(height, width)
    return np.stack([light, light[::-1]]).astype(np.float32)


@pytest.mark.parametrize("name", PACKAGES)
def test_texels_in_gaps_have_no_influence(name):
    frames, mask = hours(48, 48), np.ones((48, 48), bool)
    mask[7:30, 18:35] = False
    zeros, garbage = frames.copy(), frames.copy()
    zeros[:, ~mask] = 0.0
    garbage[:, ~mask] = np.nan
    garbage[:, 8, 20] = 1e30
    a, b = (decoded(name, given, mask) for given in (zeros, garbage))
    np.testing.assert_array_equal(a, b)
    # The ring that a filtered read reaches is like the texels beside it.
    np.testing.assert_allclose(a[:, 7, 21:32], frames[:, 6, 21:32], atol=0.12 * frames.max())
