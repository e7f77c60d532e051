"""Exports light to three.js: a `LightProbeGrid`, a texture of spherical harmonics over a box.

The layout follows examples/jsm/lighting/LightProbeGridWebGL.js of r187: one 3D texture in RGBA of nx x ny x 7 (nz + 2)
texels. A probe's 27 numbers (coefficient after coefficient, each red, green and blue) and one 0 are split into 7
texels; texel t of all probes is in the slices t (nz + 2) to (t + 1) (nz + 2) - 1, of which the first and the last are
copies of their neighbours. The coefficients are those of this package: radiance on the orthonormal real basis, all
signs plus. Since r187 a probe is at the centre of its cell of the box; up to r186 the outermost probes were on its
faces. The export has both boxes, and its loader uses the one that fits the version of three.js in which it runs.
"""

from pathlib import Path
from typing import Any

import numpy as np

from wlm.bundle import filled
from wlm.errors import WlmError
from wlm.formats.ktx2 import write_ktx2
from wlm.probe.engines.lattice import NUMBERS, Lattice, lattice_kit

_TEXTURE_FILE, _LOADER_FILE = "grid.ktx2", "grid.js"
_PARTS = 7
_MOST_CELLS = 256
_ABOUT = (
    "Light for three.js: grid.js loads grid.ktx2 with its KTX2Loader into its LightProbeGrid. box spans the cells, "
    "with a probe at the centre of each (r187 and later); corners spans the probes themselves (up to r186). Positions "
    "are in the axes and units of the scene."
)


def _write(folder: Path, lattice: Lattice, values: np.ndarray) -> dict[str, Any]:
    """Writes `grid.ktx2`, with light in half floats, and its loader `grid.js`."""
    low, size, count = lattice.low, lattice.size, lattice.count
    box = np.stack([low, low + count * size])
    if not np.abs(values).max() <= np.finfo(np.float16).max:
        raise WlmError(
            f"{lattice.name}: expected light within the range of half floats, got {np.abs(values).max():.3g}"
        )
    nx, ny, nz = (int(n) for n in count)
    padded = np.zeros((nz, ny, nx, 4 * _PARTS), "<f2")
    padded[..., :NUMBERS] = values.reshape(nz, ny, nx, NUMBERS)
    parts = np.moveaxis(padded.reshape(nz, ny, nx, _PARTS, 4), 3, 0)
    texels = np.concatenate([parts[:, :1], parts, parts[:, -1:]], 1)
    write_ktx2(folder / _TEXTURE_FILE, texels.tobytes(), nx, ny, "R16G16B16A16_SFLOAT", _PARTS * (nz + 2))
    (folder / _LOADER_FILE).write_text(filled(__package__, "three_probes.js"), encoding="utf-8")
    corners = [(box[0] + size / 2).tolist(), (box[1] - size / 2).tolist()]
    return {"texture": _TEXTURE_FILE, "box": box.tolist(), "corners": corners}


write_kit = lattice_kit("wlm-light-probe-grid", "grid.json", _ABOUT, _MOST_CELLS, _write)
