"""Exports light to Unreal, packed like the bricks of its volumetric lightmap: 28 bytes per probe.

A texel of a brick has the ambient colour, the coefficient L00, as R11G11B10F, and the other 8 coefficients in 8 bits,
divided by the ambient colour and by the largest ratio that light can have to it. Coefficients 1 to 4 and 5 to 8 of red,
green and blue are in six RGBA textures (VolumetricLightmapShared.ush, without sky occlusion and shadowing). Only Unreal
itself can build such bricks, so the export has seven volume textures over a lattice, and functions for materials that
read them.
"""

from pathlib import Path
from typing import Any

import numpy as np

from wlm.bundle import filled
from wlm.errors import WlmError
from wlm.formats.dds import write_dds
from wlm.probe.conventions import from_canonical
from wlm.probe.engines.lattice import Lattice, lattice_kit

AMBIENT_FILE = "ambient.dds"
SH_FILES = tuple(f"sh{number}.dds" for number in range(6))
_MOST_CELLS = 128
_AMBIENT, _RATIOS = "R11G11B10_FLOAT", "R8G8B8A8_UNORM"

# Ranges of coefficients 1 to 8 over the ambient one, as in the engine: sqrt(3) for L1, the bound for non-negative
# light, and twice the bound for L2.
RANGE = np.sqrt([3.0, 3.0, 3.0, 15.0, 15.0, 20.0, 15.0, 15.0])
# Largest finite numbers with 6, 6 and 5 bits of mantissa and half float's exponent.
_PACKED_MAX = np.array([65024.0, 65024.0, 64512.0])
# Low bits of a half float's mantissa that R11G11B10F drops.
_DROPPED = np.array([4, 4, 5], np.uint32)
_SHIFT = np.array([0, 11, 22], np.uint32)

_ABOUT = (
    "ambient.dds and sh0.dds to sh5.dds are volume textures of one size, with a probe at the centre of each texel, x "
    "along rows, then y, then z. ambient has the first coefficient of radiance; the others are ratios to it and to "
    "their ranges, 1 to 4 and 5 to 8 of red, of green and of blue, with Unreal's signs, in the axes and the unit of "
    "the scene. WlmProbes.usf explains how to read them; box has the two corners of the lattice."
)


def _write(folder: Path, lattice: Lattice, values: np.ndarray) -> dict[str, Any]:
    """Writes seven volume textures in Unreal's packing, and a reader, `WlmProbes.usf`. A coefficient beyond the bound
    of non-negative light is clamped, and a negative ambient colour becomes 0."""
    corner, size = lattice.low, lattice.count * lattice.size
    sh = from_canonical(values.reshape(-1, 9, 3).astype(np.float64), "unreal")
    if not np.abs(sh[:, 0]).max() <= _PACKED_MAX.min():
        found = np.abs(sh[:, 0]).max()
        raise WlmError(
            f"{lattice.name}: expected light within {_PACKED_MAX.min():g}, as R11G11B10F holds, got {found:.3g}"
        )
    width, height, depth = (int(count) for count in lattice.count)
    ambient, level = packed(sh)
    ratios = level.reshape(-1, 6, 4)  # of each colour coefficients 1 to 4, then 5 to 8
    textures = {AMBIENT_FILE: (ambient, _AMBIENT)}
    textures |= {name: (np.ascontiguousarray(ratios[:, i]), _RATIOS) for i, name in enumerate(SH_FILES)}
    for name, (texels, form) in textures.items():
        write_dds(folder / name, texels.tobytes(), width, height, form, depth)
    marks = {
        mark: ", ".join(f"{number:.9e}" for number in numbers) for mark, numbers in (("CORNER", corner), ("SIZE", size))
    }
    text = filled(__package__, "unreal_probes.usf", **marks)
    (folder / "WlmProbes.usf").write_text(text, encoding="utf-8")
    return {"box": [corner.tolist(), (corner + size).tolist()]}


write_kit = lattice_kit("wlm-unreal-light", "light.json", _ABOUT, _MOST_CELLS, _write)


def packed(sh: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Packs coefficients, float64 [N, C, 3], to ambient colours, uint32 [N], and ratios, uint8 [N, 3, C - 1]."""
    colour = np.clip(sh[:, 0], 0.0, _PACKED_MAX)
    step = np.exp2(np.maximum(np.frexp(colour)[1] - 1, -14) - 10.0 + _DROPPED)
    code = (np.rint(colour / step) * step).astype(np.float16).view(np.uint16).astype(np.uint32) >> _DROPPED
    ambient = np.bitwise_or.reduce(code << _SHIFT, axis=1).astype("<u4")
    others = sh[:, 1:].transpose(0, 2, 1)
    # Ratios to the decoded ambient colour are more exact, at no cost.
    unit = ambient_colour(ambient)[:, :, None] * RANGE[: others.shape[2]]
    ratio = np.divide(others, unit, out=np.zeros_like(others), where=unit > 0.0)
    return ambient, np.rint((np.clip(ratio, -1.0, 1.0) * 0.5 + 0.5) * 255.0).astype(np.uint8)


def ambient_colour(code: np.ndarray) -> np.ndarray:
    """Converts packed R11G11B10F colours to float64 [N, 3]."""
    part = (code[:, None] >> _SHIFT) & ((1 << (15 - _DROPPED)) - 1)
    return (part << _DROPPED).astype(np.uint16).view(np.float16).astype(np.float64)
