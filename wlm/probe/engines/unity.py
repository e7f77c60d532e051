"""Exports light to Unity: the numbers of `SphericalHarmonicsL2` in JSON, and a component that applies them to a scene.

Unity creates `LightProbes` only by baking, but scripts may replace the baked light, `LightProbes.bakedProbes`. Before a
bake, the component places a `LightProbeGroup` at the model's positions; after the bake, it gives each of the
scene's probes the light of the model's probe at its place. `sh[channel, coefficient]` follows the convention "unity".
"""

import os
from pathlib import Path
from typing import Any

import numpy as np

from wlm.bundle import Bundle, filled
from wlm.errors import WlmError
from wlm.formats.folder import compact_json, rounded
from wlm.probe.axes import read_axes, turned
from wlm.probe.conventions import from_canonical
from wlm.probe.places import positions_of
from wlm.probe.sphere import sh_count

FORMAT = "wlm-unity-probes"
_VERSION = 1
INFO_FILE = "probes.json"
SCRIPT_FILE = "WlmLightProbes.cs"
_L2 = 9
_MOST_PROBES = 1 << 17  # the JSON stays short enough to be read as an index
_ABOUT = (
    "position: x, y, z of each probe, in Unity's units and axes. sh: of each probe 27 numbers, 9 of red, 9 of green, 9 "
    "of blue, as SphericalHarmonicsL2 has them. Put this folder into Assets; the script's head says the rest."
)


def write_kit(
    bundle: Bundle,
    folder: Path,
    engine: str,
    *,
    axes: str | None = None,
    original: str | os.PathLike[str] | None = None,
    device: str = "cpu",
) -> dict[str, Any]:
    """Writes a model's probes for Unity: `WlmLightProbes.cs`, and `probes.json`, which it reads.

    Unity is left-handed: importers mirror a glTF scene along x or z, hence `axes` "-x,y,z" or "x,y,-z"
    (`wlm.probe.axes`), or None for a scene that came from Unity. The positions are read from `original`, the file that
    was compressed; if it is None, the stored positions are used. Raises a WlmError if the numbers are not spherical
    harmonics of order 0 to 2, there are over 131,072 probes, the axis does not exist, the positions are unknown or of
    other probes, a number exceeds float32, or the device does not exist."""
    model, position = bundle.model.at(), positions_of(bundle.model, original)
    coefficients = sh_count(model.outputs)
    if coefficients is None or coefficients > _L2:
        raise WlmError(f"{model.name}: expected 3, 12 or 27 numbers per probe (RGB SH, up to L2), got {model.outputs}")
    if model.probes > _MOST_PROBES:
        raise WlmError(f"{model.name}: expected at most {_MOST_PROBES} probes, got {model.probes}")
    matrix = read_axes(axes)
    place = model.stored_positions() if position is None else np.array(position, np.float64)
    values = turned(model.decoder(device, position=place).decode_probes(), matrix)
    place = place @ matrix.T
    light = np.zeros((len(values), _L2, 3))
    light[:, :coefficients] = from_canonical(values.reshape(len(values), coefficients, 3), "unity")
    if not max(np.abs(place).max(), np.abs(light).max()) < np.finfo(np.float32).max:
        raise WlmError(f"{model.name}: expected positions and light within the range of float32")
    document = {
        "format": FORMAT,
        "version": _VERSION,
        "about": _ABOUT,
        "name": model.name,
        "position": rounded(place.astype(np.float32).reshape(-1)),
        # [N, C, 3] to channel after channel.
        "sh": rounded(light.astype(np.float32).swapaxes(1, 2).reshape(-1)),
    }
    (folder / SCRIPT_FILE).write_text(filled(__package__, "unity_probes.cs"), encoding="utf-8")
    (folder / INFO_FILE).write_text(compact_json(document), encoding="utf-8")
    return {"about": _ABOUT}
