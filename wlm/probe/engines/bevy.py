"""Exports light to Bevy: an `IrradianceVolume` over the probes' box (see `wlm.probe.ambient_cube`)."""

from pathlib import Path
from typing import Any

import numpy as np

from wlm.probe.ambient_cube import write_irradiance_volume
from wlm.probe.engines.lattice import Lattice, lattice_kit

_VOLUME_FILE = "light.vxgi.ktx2"
_MOST_CELLS = 512  # 3 * 512 slices are within the 2,048 of most GPUs

_ABOUT = (
    "An irradiance volume for Bevy: spawn LightProbe, IrradianceVolume with voxels = light.vxgi.ktx2 and intensity = 1 "
    "(if the light is in cd/m2), and a Transform with the translation and scale of light.json and no rotation, in "
    "the axes and the unit of the scene. A texel is the irradiance over pi of a surface that faces one of six "
    "directions; clamped is the largest negative one, set to 0, over the brightest."
)


def _write(folder: Path, lattice: Lattice, values: np.ndarray) -> dict[str, Any]:
    size = lattice.count * lattice.size
    return {
        "volume": _VOLUME_FILE,
        "translation": (lattice.low + size / 2).tolist(),
        "scale": size.tolist(),
        "clamped": write_irradiance_volume(folder / _VOLUME_FILE, values.reshape(-1, 9, 3), lattice.count),
    }


write_kit = lattice_kit("wlm-bevy-irradiance-volume", "light.json", _ABOUT, _MOST_CELLS, _write)
