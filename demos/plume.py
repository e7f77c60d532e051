"""Procedural smoke for demos, benchmarks and tests."""

import numpy as np

from wlm.fluid.volume import DensityVolume, from_array

_BILLOWS = 160
_MOST = 1.5  # density
_REACH = 1.5  # extent of a billow relative to its radius
_HOT = 0.3  # height up to which a plume is hot


def make_plume(
    n: int = 48, *, seed: int = 1, hot: bool = True, extinction: float = 1.0, device: str = "cpu"
) -> DensityVolume:
    """Makes smoke in a box of edge 1 with `n` voxels: a leaning column of billows that widens with height.

    `seed` is that of the billows; `hot` smoke has a temperature, which is highest at the bottom; `extinction` is the
    optical depth of density 1 across the box.
    """
    random = np.random.default_rng(seed)
    axis = (np.arange(n) + 0.5) / n
    density = np.zeros((n, n, n))
    for _ in range(_BILLOWS):
        height = random.uniform(0.06, 0.82)
        wide = 0.04 + 0.16 * height
        at = np.array([0.44 + 0.14 * height, height, 0.5]) + wide * random.normal(0, 0.6, 3) * [1, 0.3, 1]
        radius = wide * random.uniform(0.25, 0.6)
        # The voxels within its reach.
        near = [np.flatnonzero(np.abs(axis - centre) <= _REACH * radius) for centre in at]
        x, y, z = ((axis[voxels] - centre) ** 2 for voxels, centre in zip(near, at, strict=True))
        distance = np.sqrt(x[:, None, None] + y[:, None] + z)
        density[np.ix_(*near)] += np.clip(_REACH - distance / radius, 0, 1)
    density = np.minimum(density, _MOST).astype(np.float32)
    temperature = density * np.clip(1.0 - axis[:, None] / _HOT, 0, 1).astype(np.float32) if hot else None
    return from_array(density, extinction=extinction, voxel=1.0 / n, temperature=temperature, device=device)
