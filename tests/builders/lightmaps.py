"""Single lightmaps in formulas."""

import numpy as np


def smooth_light(height=120, width=120) -> np.ndarray:
    """Soft light of one hue, float32 [height, width, 3], from 0.25 to 4.5."""
    y, x = np.mgrid[:height, :width] / 40.0
    base = 0.5 + (np.sin(y + 0.5) * np.cos(x) + 1.0) ** 2
    return (base[..., None] * np.array([1.0, 0.8, 0.5])).astype(np.float32)
