"""The inputs and the expected pictures of the shader tests."""

from dataclasses import dataclass

import numpy as np


@dataclass
class Subject:
    """A shader, and what it should show.

    Attributes:
        text: The functions, in GLSL.
        main: `vec4 shown(ivec2 pixel)`, which calls them.
        expected: [rows, columns, 1 to 4].
        bound: Textures and buffers by name.
        exact: The macro that fetches rather than filters; "": there is none.
        tolerance: Of what is fetched; None of the other: it is what the filters allow.
        filtered: Tolerance where the sampler filters; llvmpipe's has 8 bits of a place between two texels.
        as_textures: In GLSL, macros that read buffers from textures.
        version: Of GLSL.
    """

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
