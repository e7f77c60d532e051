"""The artifact of a probe model: packed Gaussians and a half-float network in one file, and reading it back.

Parts: ``gaussians`` (uint8: for every Gaussian three centres of 16 bits and 7 + L codes of b bits, packed without a
gap, the lowest bit first), ``bounds``, ``net``, ``frame`` (origin, extent, size of the box, gain) and, where there
are any, ``dead`` (a bit a probe, deflated) and ``positions``.
"""

import os
import zlib

import numpy as np
from pydantic import ValidationError

from wlm.errors import WlmError
from wlm.formats.artifact import Artifact, read_artifact, write_artifact
from wlm.probe.model import CENTRE_BITS, LATENT, ProbeModel, Profile, network_size

__all__ = ["SYSTEM", "pack_bits", "read", "unpack_bits", "write"]

SYSTEM = "probe"


def pack_bits(values: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """Packs integers of given widths, row after row.

    Args:
        values: uint16 [K, C].
        widths: int [C], bits of each column, 1 to 16.

    Returns:
        uint8 [ceil(K * sum(widths) / 8)], the lowest bit of each number first.

    Raises:
        ValueError: A number needs more bits than its column has.
    """
    values = np.asarray(values, np.uint16)
    if values.size and (values.astype(np.int64).max(0) >> widths).any():
        raise ValueError("a number doesn't fit the width of its column")
    columns = [(values[:, c, None] >> np.arange(width)) & 1 for c, width in enumerate(widths)]
    bits = np.concatenate(columns, 1).astype(np.uint8)
    return np.packbits(bits, bitorder="little")


def unpack_bits(packed: np.ndarray, widths: np.ndarray, count: int) -> np.ndarray:
    """Undoes ``pack_bits`` for ``count`` rows; uint16 [count, C].

    Raises:
        ValueError: Another number of bytes than so many rows take.
    """
    total = int(np.sum(widths))
    if len(packed) != -(-count * total // 8):
        raise ValueError(f"{len(packed)} bytes for {count} rows of {total} bits")
    bits = np.unpackbits(packed, count=count * total, bitorder="little").reshape(count, total).astype(np.uint16)
    ends = np.cumsum(widths)
    columns = [
        (bits[:, end - width : end] << np.arange(width, dtype=np.uint16)).sum(1, dtype=np.uint16)
        for end, width in zip(ends, widths, strict=True)
    ]
    return np.stack(columns, 1)


def _widths(profile: Profile) -> np.ndarray:
    return np.array([CENTRE_BITS] * 3 + [profile.bits] * (7 + profile.latent))


def write(path: str | os.PathLike[str], model: ProbeModel) -> int:
    """Writes a model to one file, atomically.

    Returns:
        The file's size in bytes.

    Raises:
        WlmError: The file can't be written; what was there before is untouched.
    """
    profile = model.profile.model_dump()
    defaults = Profile(name="").model_dump()
    settings = {
        "name": model.name,
        "probes": model.probes,
        "outputs": model.outputs,
        "gaussians": model.count,
        "dropped": model.dropped,
        "profile": {key: value for key, value in profile.items() if value != defaults[key]},
    }
    tensors = {
        "gaussians": pack_bits(np.concatenate([model.centre, model.code], 1), _widths(model.profile)),
        "bounds": model.bounds.astype(np.float32),
        "net": model.net,
        "frame": np.array([*model.origin, model.extent, *model.size, model.gain], np.float64),
    }
    if model.dead.any():
        tensors["dead"] = np.frombuffer(zlib.compress(np.packbits(model.dead).tobytes(), 9), np.uint8)
    if len(model.positions):
        tensors["positions"] = model.positions
    return write_artifact(path, SYSTEM, settings, tensors, model.source)


def read(path: str | os.PathLike[str]) -> ProbeModel:
    """Reads a model.

    Raises:
        WlmError: One line: not such a file, truncated, tampered with, of another system or version, or with parts
            that don't fit each other.
    """
    artifact = read_artifact(path, SYSTEM)
    try:
        return _model(artifact)
    except (LookupError, TypeError, ValueError, ValidationError, zlib.error) as error:
        raise WlmError(f"{path}: the file's parts do not fit its settings: {error}") from error


def _model(artifact: Artifact) -> ProbeModel:
    settings, tensors = artifact.settings, artifact.tensors
    profile = Profile(**settings["profile"])
    probes, outputs, count, dropped = (int(settings[key]) for key in ("probes", "outputs", "gaussians", "dropped"))
    if min(probes, outputs, count) < 1 or dropped < 0:
        raise ValueError(f"{count} Gaussians for {probes} probes of {outputs} numbers")
    channels = LATENT.start + profile.latent
    expected = {
        "bounds": (np.float32, (2, channels)),
        "net": (np.float16, (network_size(profile.latent, profile.hidden, outputs),)),
        "frame": (np.float64, (8,)),
    }
    for key, (kind, shape) in expected.items():
        value = tensors[key]
        if value.dtype != kind or value.shape != shape or not np.isfinite(value).all():
            raise ValueError(f"part {key} is {value.dtype} {value.shape}, expected finite {np.dtype(kind)} {shape}")
    frame = tensors["frame"]
    if not (frame[3] > 0 and (frame[4:7] >= 0).all() and (frame[4:7] <= 1).all()):
        raise ValueError("part frame: expected a positive extent and a size within it")
    codes = unpack_bits(tensors["gaussians"], _widths(profile), count)
    dead = np.zeros(0, bool)
    if "dead" in tensors:
        inflated = zlib.decompressobj().decompress(tensors["dead"].tobytes(), -(-probes // 8) + 1)
        if len(inflated) != -(-probes // 8):
            raise ValueError(f"part dead: expected a bit for each of {probes} probes")
        dead = np.unpackbits(np.frombuffer(inflated, np.uint8), count=probes).astype(bool)
    positions = tensors.get("positions", np.zeros((0, 3), np.uint16))
    if positions.dtype != np.uint16 or positions.shape not in ((0, 3), (probes, 3)):
        raise ValueError(f"part positions is {positions.dtype} {positions.shape}, expected uint16 {(probes, 3)}")
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
        bounds=tensors["bounds"],
        net=tensors["net"],
        dead=dead,
        positions=positions,
        dropped=dropped,
    )
