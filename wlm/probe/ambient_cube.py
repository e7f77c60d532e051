"""Irradiance volumes of Bevy: six irradiances per voxel of a regular grid, read and written as spherical harmonics.

A volume of X x Y x Z voxels is a 3D texture of X x 2Y x 3Z texels. The light of surfaces that face x, y and z is in
three stacks along the third axis, and in each stack that of the negative direction lies Y texels after that of the
positive one. A texel is the irradiance of such a surface over pi; between directions Bevy weights by the squares of the
normal (Mitchell, Shading in Valve's Source Engine, 2006, "Ambient Cube Basis").

Six numbers determine six spherical harmonics: 1; y, z, x; 3z2-1 and x2-y2. Those are taken whose irradiance is that of
the texels in the six directions; x2, y2 and z2 are reproduced exactly, and the differences of opposite directions fall
with the cosine instead of its square.
"""

import os

import numpy as np

from wlm.errors import WlmError
from wlm.formats.ktx2 import read_ktx2_volume, write_ktx2
from wlm.formats.limits import PROBES
from wlm.formats.shared_exponent import LARGEST, pack_rgb9e5
from wlm.probe.sphere import irradiance_weights

_STACKS, _SIDES = 3, 2
_COEFFICIENTS = 9
_USED = [0, 1, 2, 3, 6, 8]  # 1; y, z, x; 3z2-1, x2-y2

# Irradiance over pi in the directions +x, -x, +y, -y, +z, -z for each coefficient of radiance.
_SEEN = irradiance_weights(np.repeat(np.eye(3), 2, 0) * np.tile([[1.0], [-1.0]], (3, 1)), _COEFFICIENTS) / np.pi

READING = (
    "an irradiance volume of Bevy: irradiance over pi in six directions, in the file's unit (Bevy multiplies by its "
    "intensity), as SH of radiance that yield it; positions in the cube from -0.5 to 0.5, which the entity's "
    "Transform places; directions as stored"
)
"""How the numbers are read, in one line."""


def read_irradiance_volume(path: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray]:
    """Reads an irradiance volume from a KTX2 file.

    Returns:
        Centres of the voxels in the volume's cube, float64 [N, 3], x fastest; and canonical spherical harmonics of
        radiance, float64 [N, 9, 3].

    Raises:
        WlmError: The file cannot be read, its size is not that of an irradiance volume, or a number is negative.
    """
    texels = read_ktx2_volume(path)
    depth, height, width = texels.shape[:3]
    if height % _SIDES or depth % _STACKS or width * height * depth > PROBES * _SIDES * _STACKS:
        raise WlmError(
            f"{path}: expected an irradiance volume, X x 2Y x 3Z texels of at most {PROBES} voxels, found a volume of "
            f"{width} x {height} x {depth}"
        )
    if (texels < 0.0).any():
        raise WlmError(f"{path}: expected an irradiance volume, found negative numbers: another kind of volume?")
    count = np.array([width, height // _SIDES, depth // _STACKS])
    faces = texels.reshape(_STACKS, count[2], _SIDES, count[1], width, 3).transpose(1, 3, 4, 0, 2, 5)
    light = np.zeros((int(count.prod()), _COEFFICIENTS, 3))
    with np.errstate(invalid="ignore"):  # NaN and infinity
        light[:, _USED] = np.linalg.inv(_SEEN[:, _USED]) @ faces.reshape(-1, _STACKS * _SIDES, 3).astype(np.float64)
    return (np.indices(count[::-1])[::-1].reshape(3, -1).T + 0.5) / count - 0.5, light


def write_irradiance_volume(path: str | os.PathLike[str], values: np.ndarray, count: np.ndarray) -> float:
    """Writes canonical spherical harmonics as an irradiance volume in RGB9E5.

    Args:
        path: The KTX2 file to write.
        values: [N, 9, 3], radiance at the centres of the voxels, x fastest, in the axes of the scene.
        count: The voxels along x, y and z, whose product is N.

    Returns:
        The largest share of the brightest texel by which a negative irradiance is clamped to 0.

    Raises:
        WlmError: The light exceeds RGB9E5, or the file cannot be written.
    """
    nx, ny, nz = (int(n) for n in count)
    seen = (_SEEN @ np.asarray(values, np.float64)).reshape(nz, ny, nx, _STACKS, _SIDES, 3)
    if not np.abs(seen).max() <= LARGEST:
        raise WlmError(
            f"{path}: expected irradiance of at most {LARGEST:g}, as RGB9E5 holds, got {np.abs(seen).max():.3g}"
        )
    words = pack_rgb9e5(seen.transpose(3, 0, 4, 1, 2, 5).reshape(_STACKS * nz, _SIDES * ny, nx, 3))
    write_ktx2(path, words.astype("<u4").tobytes(), nx, _SIDES * ny, "E5B9G9R9_UFLOAT_PACK32", _STACKS * nz)
    return float(max(-seen.min(), 0.0) / max(seen.max(), np.finfo(np.float64).tiny))
