"""Exports light to Bevy: an `IrradianceVolume` over the probes' box (see `wlm.probe.ambient_cube`)."""

import os
from pathlib import Path
from typing import Any

from wlm.bundle import Bundle
from wlm.formats.folder import write_index
from wlm.probe.ambient_cube import write_irradiance_volume
from wlm.probe.engines.lattice import CELLS, lattice_of
from wlm.probe.places import positions_of

FORMAT = "wlm-bevy-irradiance-volume"
_VERSION = 1
INFO_FILE = "light.json"
VOLUME_FILE = "light.vxgi.ktx2"
_MOST_CELLS = 512  # 3 * 512 slices are within the 2,048 of most GPUs

_ABOUT = (
    "An irradiance volume for Bevy: spawn LightProbe, IrradianceVolume with voxels = light.vxgi.ktx2 and intensity = 1 "
    "(if the light is in cd/m2), and a Transform with the translation and scale of light.json and no rotation, in "
    "the axes and the unit of the scene. A texel is the irradiance over pi of a surface that faces one of six "
    "directions; clamped is the largest negative one, set to 0, over the brightest."
)


def write_kit(
    bundle: Bundle,
    folder: Path,
    engine: str,
    *,
    cells: int = CELLS,
    original: str | os.PathLike[str] | None = None,
    device: str = "cpu",
) -> dict[str, Any]:
    """Writes second-order spherical harmonics as an irradiance volume for Bevy, `light.vxgi.ktx2`, and `light.json`.

    Voxels are cubes that fill the probes' box, 1 to 512 `cells` along its longest side. `original` is the file that was
    compressed, required if the decoder needs positions and the model stores none.

    Raises:
        WlmError: A probe has other than 9 coefficients, `cells` is out of range, the light exceeds RGB9E5, or the
            device does not exist.
    """
    model = bundle.model
    lattice = lattice_of(model, cells, _MOST_CELLS, positions_of(model, original), device)
    size = lattice.count * lattice.size
    light = lattice.light(lattice.centres()).reshape(-1, 9, 3)
    document = {
        "format": FORMAT,
        "version": _VERSION,
        "about": _ABOUT,
        "name": model.name,
        "volume": VOLUME_FILE,
        "resolution": lattice.count.tolist(),
        "translation": (lattice.low + size / 2).tolist(),
        "scale": size.tolist(),
        "clamped": write_irradiance_volume(folder / VOLUME_FILE, light, lattice.count),
    }
    write_index(folder / INFO_FILE, document)
    return {"about": _ABOUT}
