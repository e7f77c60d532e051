"""Probe models in files: packed Gaussians and a half-float network.

`gaussians` holds for every Gaussian three centres of 16 bits and 7 + L codes of b bits, packed without a gap, the
lowest bit first; `frame` is origin, extent, size of the box and gain; `dead` is a bit for each probe, deflated.
"""

import zlib
from typing import Any

import numpy as np

from wlm.config import check_settings
from wlm.formats.artifact import Artifact
from wlm.formats.bits import pack_bits, unpack_bits
from wlm.probe.model import LATENT, ProbeModel, Profile, layer_shapes
from wlm.system import Part, check_parts


def _parts(profile: Profile, outputs: int) -> dict[str, Part]:
    """The table of parts."""
    layers = layer_shapes(profile.latent, profile.hidden, outputs)
    return {
        "gaussians": Part(np.uint8, (None,)),
        "bounds": Part(np.float32, (2, LATENT.start + profile.latent)),
        "net": Part(np.float16, (sum(rows * columns for rows, columns in layers),)),
        "frame": Part(np.float64, (8,)),
        "dead": Part(np.uint8, (None,), optional=True),
        "positions": Part(np.uint16, (None, 3), optional=True),
    }


def encode(model: ProbeModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    """Settings, parts and source of a model's file."""
    settings = {
        "name": model.name,
        "probes": model.probes,
        "outputs": model.outputs,
        "gaussians": model.count,
        "dropped": model.dropped,
        "profile": model.profile.changes(),
    }
    parts = {
        "gaussians": pack_bits(model.codes, model.profile.code_bits()),
        "bounds": model.bounds.astype(np.float32),
        "net": model.net,
        "frame": np.array([*model.origin, model.extent, *model.size, model.gain], np.float64),
        "dead": pack_dead(model.dead),
        "positions": model.positions,
    }
    return settings, {name: part for name, part in parts.items() if part.size}, model.source


def decode(artifact: Artifact) -> ProbeModel:
    """Makes the model of a file; what `encode` gave comes back bit for bit.

    Raises:
        WlmError, ValueError, LookupError: A setting or a part is missing, or they don't fit each other.
    """
    settings = artifact.settings
    profile = check_settings(Profile, settings["profile"], "profile: ")
    sizes = [settings[key] for key in ("probes", "outputs", "gaussians", "dropped")]
    if not all(type(size) is int for size in sizes) or min(sizes[:3]) < 1 or sizes[3] < 0:
        raise ValueError(f"probes, outputs, gaussians, dropped: expected whole numbers, got {sizes}")
    probes, outputs, count, dropped = sizes
    parts = check_parts(artifact.tensors, _parts(profile, outputs))
    frame, positions = parts["frame"], parts["positions"]
    if not (frame[3] > 0 and (frame[4:7] >= 0).all() and (frame[4:7] <= 1).all()):
        raise ValueError("part frame: expected a positive extent and a size within it")
    if len(positions) not in (0, probes):
        raise ValueError(f"part positions holds {len(positions)}, expected {probes}")
    codes = unpack_bits(parts["gaussians"], profile.code_bits(), count)
    return ProbeModel(
        name=str(settings["name"]),
        source=artifact.source,
        profile=profile,
        probes=probes,
        outputs=outputs,
        origin=frame[:3].copy(),
        extent=float(frame[3]),
        size=frame[4:7].copy(),
        gain=float(frame[7]),
        centre=codes[:, :3],
        code=codes[:, 3:],
        bounds=parts["bounds"],
        net=parts["net"],
        dead=_unpack_dead(parts["dead"], probes),
        positions=positions,
        dropped=dropped,
    )


def pack_dead(dead: np.ndarray) -> np.ndarray:
    """A bit for each probe, bool [N], deflated; uint8, empty where none is dead."""
    packed = zlib.compress(np.packbits(dead).tobytes(), 9) if dead.any() else b""
    return np.frombuffer(packed, np.uint8)


def _unpack_dead(packed: np.ndarray, probes: int) -> np.ndarray:
    """bool [N], or empty where none is dead."""
    if not packed.size:
        return np.zeros(0, bool)
    size = -(-probes // 8)
    inflater = zlib.decompressobj()
    try:
        bits = inflater.decompress(packed.tobytes(), size + 1)
    except zlib.error as error:
        raise ValueError(f"part dead: {error}") from error
    if len(bits) != size or not inflater.eof or inflater.unused_data:
        raise ValueError(f"part dead: expected a bit for each of {probes} probes")
    return np.unpackbits(np.frombuffer(bits, np.uint8), count=probes).astype(bool)
