"""The inputs and the expected pictures of the shader tests."""

from dataclasses import dataclass

import numpy as np


@dataclass
class Subject:
    """A shader, and what it should show."""

    text: str
    main: str
    expected: np.ndarray
    bound: dict[str, np.ndarray]
    exact: str
    tolerance: float
    filtered: float | None = None
    as_textures: str = ""
    version: int = 330


def points_of(values: np.ndarray) -> np.ndarray:
    """Places as a texture of fours, one row."""
    values = np.asarray(values, np.float32)
    return np.pad(values, ((0, 0), (0, 4 - values.shape[1])))[None]


POINTS = "uniform sampler2D u_points;\n"
