"""Packs a cascaded volume into GPU buffers: its blocks, its page table and the origins of its windows."""

import numpy as np

from wlm.bundle import Bundle
from wlm.errors import WlmError
from wlm.probe.conventions import CANONICAL
from wlm.probe.sphere import sh_count
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.shader import volume_glsl

_REFERENCES = 64

_ABOUT = {
    "buffers": "The buffers volume, pages and pool are laid out as described at the head of the shader. The pool has "
    "the blocks of the windows only, without cached ones.",
    "block": "Block b of a level, three integers, spans [b, b + 1) * block; its numbers are the light at its centre. "
    "base is the first block of the level's window; the buffer volume counts it from start.",
    "viewpoint": "Points are given to the shader relative to this: position - viewpoint, computed in doubles where the "
    "scene is large.",
    "values": "A block has `outputs` numbers. Spherical harmonics: coefficient after coefficient, each red, green and "
    "blue; orthonormal real basis in the order 1; y, z, x; xy, yz, 3z2-1, xz, x2-y2; all signs plus, of radiance.",
    "reference": "position: points of the scene; values: the light read there; weight: the share of the trilinear "
    "weight that was found.",
}


def volume_bundle(volume: Volume) -> Bundle:
    """Returns the GPU buffers and shader of a volume in its state after the last update.

    Raises:
        WlmError: The volume has no block yet.
    """
    state = volume.state()
    rows, pages = np.unique(state.pages[state.pages >= 0]), state.pages
    if not len(rows):
        raise WlmError("volume: cannot export: no block of light is near the viewpoint; choose one near the probes")
    head = [np.array([len(volume.sizes), volume.side, volume.channels, len(rows)], "<u4")]
    for view, base in zip(state.views, state.bases, strict=True):
        head += [view.astype("<f4").view("<u4"), np.append(base, 0).astype("<i4").view("<u4")]
    document = {
        "about": _ABOUT,
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
    return Bundle(
        system="probe",
        name="volume",
        shader=volume_glsl(volume.channels),
        document=document,
        buffers={
            "volume": np.concatenate(head),
            "pages": np.where(pages >= 0, np.searchsorted(rows, pages), -1).astype("<i4"),
            "pool": state.pool[rows].astype("<f4"),
        },
        reference=_reference(volume),
    )


def _reference(volume: Volume) -> dict[str, np.ndarray]:
    """Returns random points around the viewer and positions of probes, and the volume's light and weight at them."""
    random = np.random.default_rng(0)
    reach = np.repeat(np.array(volume.sizes) * volume.side / 2, _REFERENCES // len(volume.sizes))
    near = volume.viewpoint + random.uniform(-1.1, 1.1, (len(reach), 3)) * reach[:, None]
    lit = volume.position[volume.numbers]
    points = np.concatenate([near, lit[:: max(1, len(lit) // _REFERENCES)]])
    reading = volume.read(points)
    return {"position": points, "values": reading.values, "weight": reading.weight}
