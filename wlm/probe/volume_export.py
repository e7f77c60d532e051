"""A cascaded volume for engines: its blocks, its page table and where its windows lie, with shaders that read them."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats.folder import made_parents, staged, write_index
from wlm.probe.conventions import CANONICAL
from wlm.probe.sphere import sh_count
from wlm.probe.volume import Volume
from wlm.probe.volume_shader import volume_glsl, volume_hlsl

FORMAT = "wlm-probe-volume"
_VERSION = 1
INFO_FILE = "volume.json"
HEAD_FILE = "volume.bin"
PAGES_FILE = "pages.bin"
POOL_FILE = "pool.bin"
GLSL_FILE = "volume.glsl"
HLSL_FILE = "volume.hlsl"
REFERENCE_FILE = "reference.json"

_FILES = {INFO_FILE, HEAD_FILE, PAGES_FILE, POOL_FILE, GLSL_FILE, HLSL_FILE, REFERENCE_FILE}
_REFERENCES = 64

_ABOUT = {
    "buffers": "volume.bin, pages.bin and pool.bin are laid out as volume.glsl and volume.hlsl say at their heads. The "
    "pool has the blocks of the windows alone, without those that were kept for their return.",
    "block": "Block b of a level, three whole numbers, spans [b, b + 1) * block; its numbers are the light at its "
    "centre. base is the first block of the level's window, in volume.bin it is counted from start.",
    "viewpoint": "Points are given to the shader from here: position - viewpoint, computed in doubles where the scene "
    "is large.",
    "values": "Of a block, outputs numbers. Spherical harmonics: coefficient after coefficient, of each red, green and "
    "blue; orthonormal real basis in the order 1; y, z, x; xy, yz, 3z2-1, xz, x2-y2; all signs plus, of radiance.",
    "reference": "reference.json has points of the scene, the values that are read there, and how much of the weight "
    "was found.",
}


def export_volume(volume: Volume, directory: str | os.PathLike[str]) -> list[Path]:
    """Writes what a volume has round its viewer.

    All files are made beside the folder and moved in together, `volume.json` last. A new export replaces an earlier
    one in its folder; other files there stay.

    Args:
        volume: After an update.
        directory: The folder; made if it isn't there.

    Returns:
        The files written, `volume.json` last.

    Raises:
        WlmError: The folder holds something other than an earlier export, or can't be written; or the volume has no
            block yet.
    """
    state = volume.state()
    rows, pages = np.unique(state.pages[state.pages >= 0]), state.pages
    if not len(rows):
        raise WlmError("volume: cannot export: there is no block round the viewer")
    compact = np.where(pages >= 0, np.searchsorted(rows, pages), -1).astype("<i4")
    head = np.array([len(volume.sizes), volume.side, volume.channels, len(rows)], "<u4").tobytes()
    for view, base in zip(state.views, state.bases, strict=True):
        head += view.astype("<f4").tobytes() + np.append(base, 0).astype("<i4").tobytes()
    files = {
        HEAD_FILE: head,
        PAGES_FILE: compact.tobytes(),
        POOL_FILE: state.pool[rows].astype("<f4").tobytes(),
        GLSL_FILE: volume_glsl(volume.channels).encode(),
        HLSL_FILE: volume_hlsl(volume.channels).encode(),
    }
    folder = Path(directory)
    with made_parents(folder), staged(folder, INFO_FILE, FORMAT, _FILES.__contains__) as temporary:
        for name, content in files.items():
            (temporary / name).write_bytes(content)
        write_index(temporary / REFERENCE_FILE, _reference(volume))
        write_index(temporary / INFO_FILE, _document(volume, {name: len(content) for name, content in files.items()}))
    return [folder / name for name in (*files, REFERENCE_FILE, INFO_FILE)]


def _reference(volume: Volume) -> dict[str, Any]:
    """Points round the viewer, at all distances, and what is read there."""
    random = np.random.default_rng(0)
    reach = np.repeat(np.array(volume.sizes) * volume.side / 2, _REFERENCES // len(volume.sizes))
    near = volume.viewpoint + random.uniform(-1.1, 1.1, (len(reach), 3)) * reach[:, None]
    lit = volume.position[volume.numbers]
    points = np.concatenate([near, lit[:: max(1, len(lit) // _REFERENCES)]])
    reading = volume.read(points)
    return {"position": points.tolist(), "values": reading.values.tolist(), "weight": reading.weight.tolist()}


def _document(volume: Volume, sizes: dict[str, int]) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": _VERSION,
        "about": _ABOUT,
        "bytes": sizes,
        "outputs": volume.channels,
        "coefficients": sh_count(volume.channels),
        "convention": CANONICAL,
        "viewpoint": volume.viewpoint.tolist(),
        "side": volume.side,
        "levels": [
            {"block": size, "base": base.tolist(), "start": start.tolist()}
            for size, base, start in zip(volume.sizes, volume.base, volume.index.start, strict=True)
        ],
    }
