"""Packs a cascaded volume into GPU buffers: its blocks, its page table and the origins of its windows."""

import numpy as np

from wlm.bundle import Bundle
from wlm.errors import WlmError
from wlm.probe.conventions import CANONICAL
from wlm.probe.sphere import sh_count
from wlm.probe.volume.cascade import State, Volume
from wlm.probe.volume.shader import volume_glsl

_REFERENCES = 64

_ABOUT = {
    "buffers": "The buffers volume, pages and pool are laid out as described at the head of the shader. The pool has "
    "the blocks of the windows only, without cached ones.",
    "block": "Block b of a level, three integers, spans [b, b + 1) * block; its numbers are the light at its centre. "
    "base is the first block of the level's window, which has `sides` blocks along the axes; the buffer volume counts "
    "it from start.",
    "viewpoint": "Points are given to the shader relative to this: position - viewpoint, computed in doubles where the "
    "scene is large.",
    "values": "A block has `outputs` numbers. Spherical harmonics: coefficient after coefficient, each red, green and "
    "blue; orthonormal real basis in the order 1; y, z, x; xy, yz, 3z2-1, xz, x2-y2; all signs plus, of radiance.",
    "reference": "position: points of the scene; values: the light read there; weight: the share of the trilinear "
    "weight that was found.",
}


def volume_bundle(volume: Volume) -> Bundle:
    """Returns the GPU buffers and shader of a volume in its state after the last update. Raises a WlmError if the
    volume has no block yet."""
    state = volume.state()
    rows, pages = np.unique(state.pages[state.pages >= 0]), state.pages
    if not len(rows):
        raise WlmError("volume: cannot export: no block of light is near the viewpoint; choose one near the probes")
    document = {
        "about": _ABOUT,
        "outputs": volume.channels,
        "coefficients": sh_count(volume.channels),
        "convention": CANONICAL,
        "viewpoint": volume.viewpoint.tolist(),
        "levels": [
            {"block": size, "base": base.tolist(), "start": start.tolist(), "sides": sides.tolist()}
            for size, base, start, sides in zip(
                volume.sizes, volume.base, volume.index.start, volume.sides, strict=True
            )
        ],
    }
    return Bundle(
        system="probe",
        name="volume",
        shader=volume_glsl(volume.channels),
        document=document,
        buffers={
            "volume": head_words(volume, state, len(rows)),
            "pages": pack_words(np.where(pages >= 0, np.searchsorted(rows, pages), -1).astype("<i2")),
            "pool": pool_words(state.pool[rows], state.factor[rows]),
        },
        reference=_reference(volume),
    )


def head_words(volume: Volume, state: State, rows: int) -> np.ndarray:
    """Returns the buffer `volume`, uint32, of a volume in a state with some rows; its layout is in the shader."""
    starts, index = np.cumsum(volume.sides.prod(1)) - volume.sides.prod(1), volume.index
    counts = [len(starts), len(state.pages), volume.channels, rows]
    counts += [volume.frame, index.count, len(index.block), volume.sides.max()]
    ends = (starts, index.level_start[:-1], index.ratios)
    threes = (state.bases, volume.sides, state.before)
    levels = [np.column_stack([three, end]) for three, end in zip(threes, ends, strict=True)]
    whole = np.concatenate([state.views.astype("<f4").view("<i4"), *levels], 1)
    return np.concatenate([counts, whole.reshape(-1)]).astype("<i4").view("<u4")


def pack_words(numbers: np.ndarray) -> np.ndarray:
    """Returns 16-bit numbers [..., M] as 32-bit words [..., ceil(M / 2)], the first in the lower half."""
    padded = np.pad(numbers, [(0, 0)] * (numbers.ndim - 1) + [(0, numbers.shape[-1] % 2)])
    return padded.view("<u4")


def pool_words(light: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """Returns rows of the pool, half floats [R, D] and float [R], as the shader reads them: 1 + ceil(D / 2) words."""
    return np.column_stack([factor.astype("<f4").view("<u4"), pack_words(light)])


def _reference(volume: Volume) -> dict[str, np.ndarray]:
    """Returns random points around the viewer and positions of probes, and the volume's light and weight at them."""
    random = np.random.default_rng(0)
    reach = np.repeat(volume.sides * np.array(volume.sizes)[:, None] / 2, _REFERENCES // len(volume.sizes), 0)
    near = volume.viewpoint + random.uniform(-1.1, 1.1, reach.shape) * reach
    lit = volume.position[volume.numbers]
    points = np.concatenate([near, lit[:: max(1, len(lit) // _REFERENCES)]])
    reading = volume.read(points)
    return {"position": points, "values": reading.values, "weight": reading.weight}
