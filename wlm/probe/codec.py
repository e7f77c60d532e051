"""Probe models in files: packed Gaussians and a half-float network, or the stream of a transform.

`gaussians` holds for every Gaussian three centres of 16 bits and 7 + L codes of b bits, packed without a gap, the
lowest bit first; `frame` is origin, extent, size of the box and gain; `dead` is a bit for each probe, deflated.

A transform has `light`, its stream and the dead probes' bits, in place of Gaussians, bounds and network; `places` are
differences of 16 bits from probe to probe, deflated, and `frame` is then origin and extent alone. Several hours are in
the part `hours` (`wlm.probe.day`) in place of `light`.
"""

import zlib
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from wlm.config import check_settings
from wlm.formats.artifact import Artifact
from wlm.formats.bits import pack_bits, unpack_bits
from wlm.formats.deflate import inflate
from wlm.formats.limits import NUMBERS, PROBES
from wlm.formats.parts import Part, check_part, check_parts
from wlm.probe.day import DayModel, pack_hours, unpack_hours
from wlm.probe.hours import PERIOD, TIMES
from wlm.probe.model import LATENT, SCALE, ProbeModel, Profile, layer_shapes
from wlm.probe.transform import Places, TransformModel, read_head
from wlm.system import Header, Name

_MOST_LOG = 40.0


_LIGHT, _HOURS = "light", "hours"
_L2 = 27  # numbers of a probe that a transform's file doesn't state
# Numbers that a transform may unpack to: those of a set without any light have next to no bytes.
_SURE_NUMBERS, _NUMBERS_A_BYTE = 1 << 23, 4096
# Live probes of it: each takes some 20 microseconds and 500 bytes to place among the others.
_SURE_PROBES, _PROBES_A_BYTE = 1 << 17, 16
_STATES = 1 << 27  # probes times hours: a byte each tells who is dead


class _TransformHeader(Header):
    """The settings of a transform's file."""

    name: Name
    probes: int = Field(ge=1, le=PROBES)
    outputs: int = Field(_L2, ge=1, le=NUMBERS)
    dead: int = Field(0, ge=0, le=2 * PROBES)


class _DayHeader(Header):
    """The settings of a file of several hours."""

    name: Name
    probes: int = Field(ge=1, le=PROBES)
    outputs: int = Field(_L2, ge=1, le=NUMBERS)
    times: list[Annotated[float, Field(ge=0.0, lt=PERIOD)]] = Field(min_length=1, max_length=TIMES)


class _Header(Header):
    """The settings of a file of Gaussians."""

    name: Name
    probes: int = Field(ge=1, le=PROBES)
    outputs: int = Field(ge=1, le=NUMBERS)
    profile: Profile
    gaussians: int = Field(ge=1, le=PROBES)
    dropped: int = Field(ge=0, le=PROBES)


_TRANSFORM_PARTS = {
    _LIGHT: Part(np.uint8, (None,)),
    "places": Part(np.uint8, (None,), optional=True),
    "frame": Part(np.float64, (4,), optional=True, least=-1e150, most=1e150),
}


_DAY_PARTS = {_HOURS: _TRANSFORM_PARTS[_LIGHT]} | {name: _TRANSFORM_PARTS[name] for name in ("places", "frame")}


def _parts(header: _Header) -> dict[str, Part]:
    """The table of parts."""
    profile = header.profile
    layers = layer_shapes(profile.latent, profile.hidden, header.outputs)
    bits = header.gaussians * int(profile.code_bits().sum())
    return {
        "gaussians": Part(np.uint8, (-(-bits // 8),)),
        # The difference of any two is finite.
        "bounds": Part(np.float32, (2, LATENT.start + profile.latent), least=-1e38, most=1e38),
        "net": Part(np.float16, (sum(rows * columns for rows, columns in layers),)),
        "frame": Part(np.float64, (8,)),
        "dead": Part(np.uint8, (None,), optional=True),
        "positions": Part(np.uint16, (header.probes, 3), optional=True),
    }


def encode(model: ProbeModel | TransformModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    """Settings, parts and source of a model's file."""
    if isinstance(model, DayModel):
        return _encode_day(model)
    if isinstance(model, TransformModel):
        return _encode_transform(model)
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


def decode(artifact: Artifact) -> ProbeModel | TransformModel:
    """Makes the model of a file; what `encode` gave comes back bit for bit.

    Raises:
        WlmError, ValueError: A setting or a part is missing or wrong, or they don't fit each other.
    """
    if _LIGHT in artifact.tensors:
        return _decode_transform(artifact)
    if _HOURS in artifact.tensors:
        return _decode_day(artifact)
    header = check_settings(_Header, artifact.settings, "setting ")
    parts = check_parts(artifact.tensors, _parts(header))
    _check_frame(parts["frame"])
    _check_bounds(parts["bounds"])
    _check_values(header, parts)
    frame = parts["frame"]
    codes = unpack_bits(parts["gaussians"], header.profile.code_bits(), header.gaussians)
    return ProbeModel(
        name=header.name,
        source=artifact.source,
        profile=header.profile,
        probes=header.probes,
        outputs=header.outputs,
        origin=frame[:3].copy(),
        extent=float(frame[3]),
        size=frame[4:7].copy(),
        gain=float(frame[7]),
        centre=codes[:, :3],
        code=codes[:, 3:],
        bounds=parts["bounds"],
        net=parts["net"],
        dead=_unpack_dead(parts["dead"], header.probes),
        positions=parts["positions"],
        dropped=header.dropped,
    )


def _encode_transform(model: TransformModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    settings: dict[str, Any] = {"name": model.name, "probes": model.probes}
    if model.outputs != _L2:
        settings["outputs"] = model.outputs
    # A part of its own would cost a line of the header, half of what a small set has.
    dead = pack_dead(model.dead)
    if len(dead):
        settings["dead"] = len(dead)
    parts = {_LIGHT: np.concatenate([model.stream, dead])}
    parts |= _encode_places(model.places)
    return settings, {name: part for name, part in parts.items() if part.size}, model.source


def _encode_day(model: DayModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    settings: dict[str, Any] = {"name": model.name, "probes": model.probes, "times": list(model.times)}
    if model.outputs != _L2:
        settings["outputs"] = model.outputs
    return settings, {_HOURS: pack_hours(model.hours, model.probes)} | _encode_places(model.places), model.source


def _encode_places(places: Places | None) -> dict[str, np.ndarray]:
    """The parts of places that are stored."""
    if places is None:
        return {}
    change = np.diff(places.code.astype(np.uint16), axis=0, prepend=np.zeros((1, 3), np.uint16))
    # Axis by axis, low bytes and then high ones: those of a lattice repeat.
    planes = np.ascontiguousarray(change.T.astype("<u2")).view(np.uint8).reshape(3, -1, 2).transpose(0, 2, 1)
    return {
        "places": np.frombuffer(zlib.compress(planes.tobytes(), 9), np.uint8),
        "frame": np.array([*places.origin, places.extent], np.float64),
    }


def _decode_transform(artifact: Artifact) -> TransformModel:
    header = check_settings(_TransformHeader, artifact.settings, "setting ")
    parts = check_parts(artifact.tensors, _TRANSFORM_PARTS)
    light = parts[_LIGHT]
    end = len(light) - header.dead
    if end < 0:
        raise ValueError(f"part light: expected at least {header.dead} bytes, found {len(light)}")
    _check_numbers(header.probes, header.outputs, end)
    dead = _unpack_dead(light[end:], header.probes)
    _check_live([header.probes - int(dead.sum())], end)
    places = _decode_places(artifact, parts, header.probes)
    model = TransformModel(
        name=header.name,
        source=artifact.source,
        probes=header.probes,
        outputs=header.outputs,
        dead=dead,
        stream=light[:end],
        places=places,
    )
    _ = model.head
    if places is not None:
        # What can be unpacked here is, so that whatever is wrong with it is said of the file.
        _ = model.stored_values
    return model


def _decode_day(artifact: Artifact) -> DayModel:
    header = check_settings(_DayHeader, artifact.settings, "setting ")
    parts = check_parts(artifact.tensors, _DAY_PARTS)
    times, data = tuple(header.times), parts[_HOURS]
    if any(a >= b for a, b in pairwise(times)):
        raise ValueError("setting times: expected increasing hours")
    if header.probes * len(times) > _STATES:
        raise ValueError(f"setting times: expected at most {_STATES // header.probes} of {header.probes} probes")
    _check_numbers(header.probes, header.outputs * len(times), len(data))
    hours = unpack_hours(data, len(times), header.probes, header.outputs)
    _check_live([header.probes - int(hour.dead.sum()) for hour in hours], len(data))
    places = _decode_places(artifact, parts, header.probes)
    model = DayModel.of(header.name, artifact.source, header.probes, header.outputs, times, hours, places)
    checks = {read_head(hour.stream, header.outputs).check for hour in hours}
    if len(checks) > 1:
        raise ValueError("part hours: expected hours of the same places")
    if places is not None:
        for time in times:
            model.at(time).values(places)
    return model


def _check_numbers(probes: int, outputs: int, size: int) -> None:
    most = _SURE_NUMBERS + _NUMBERS_A_BYTE * size
    if probes * outputs > most:
        numbers = f"{probes} probes of {outputs} numbers"
        raise ValueError(f"part light: expected at most {most} numbers of {size} bytes, found {numbers}")


def _check_live(live: list[int], size: int) -> None:
    """Checks that every hour has light, and how many probes all of them have together."""
    most = _SURE_PROBES + _PROBES_A_BYTE * size
    if min(live) < 1 or sum(live) > most:
        found = sum(live) if min(live) else 0
        raise ValueError(f"part light: expected 1 to {most} live probes of {size} bytes, found {found}")


def _decode_places(artifact: Artifact, parts: Mapping[str, np.ndarray], probes: int) -> Places | None:
    """The places that are stored, if they are."""
    if not parts["places"].size:
        if parts["frame"].size:
            raise ValueError("part frame: expected none without places")
        return None
    data = inflate(parts["places"].tobytes(), 6 * probes, "part places", f"the places of {probes} probes")
    planes = np.frombuffer(data, np.uint8).reshape(3, 2, probes).transpose(0, 2, 1)
    change = np.ascontiguousarray(planes).view("<u2")[..., 0].T
    frame = check_part(artifact.tensors, "frame", replace(_TRANSFORM_PARTS["frame"], optional=False))
    if not frame[3] > 0:
        raise ValueError(f"part frame: expected a positive extent, found {frame[3]:g}")
    return Places(frame[:3].copy(), float(frame[3]), np.cumsum(change, axis=0, dtype=np.uint16))


def _check_frame(frame: np.ndarray) -> None:
    origin, extent, size, gain = frame[:3], frame[3], frame[4:7], frame[7]
    with np.errstate(over="ignore"):
        reaches = np.isfinite(origin + extent * size).all()
    if not (extent > 0 and reaches and (size >= 0).all() and (size <= 1).all()):
        raise ValueError("part frame: expected a positive extent and a size within it")
    if not 0 < gain <= np.finfo(np.float32).max:
        raise ValueError(f"part frame: expected a positive gain that float32 holds, found {gain:g}")


def _check_bounds(bounds: np.ndarray) -> None:
    if (bounds[0] > bounds[1]).any():
        raise ValueError("part bounds: expected no lowest value above its highest")
    # Scales are logarithms: their squares, and the squares' inverses, must be float32.
    if np.abs(bounds[:, SCALE]).max() > _MOST_LOG:
        raise ValueError(f"part bounds: expected logs of scales of at most {_MOST_LOG:g} either way")


def _check_values(header: _Header, parts: Mapping[str, np.ndarray]) -> None:
    """Checks that no number on the way to a probe's values is beyond float32, wherever it is decoded."""
    layers, begin = [], 0
    for rows, columns in layer_shapes(header.profile.latent, header.profile.hidden, header.outputs):
        # The sum of what each output may become, of inputs in [-1, 1].
        layers.append(np.abs(parts["net"][begin : begin + rows * columns].reshape(rows, columns).astype(np.float64)))
        begin += rows * columns
    sums = header.gaussians * np.abs(parts["bounds"][:, LATENT].astype(np.float64)).max(0)
    first = layers[0] * np.concatenate([np.maximum(sums, 1.0), np.ones(4)])[:, None]
    most = max(first.sum(0).max(), parts["frame"][7] * layers[2].sum(0).max())
    if not most <= np.finfo(np.float32).max:
        raise ValueError("parts net, bounds and frame: expected values that float32 holds")


def pack_dead(dead: np.ndarray) -> np.ndarray:
    """A bit for each probe, bool [N], deflated; uint8, empty where none is dead."""
    packed = zlib.compress(np.packbits(dead).tobytes(), 9) if dead.any() else b""
    return np.frombuffer(packed, np.uint8)


def _unpack_dead(packed: np.ndarray, probes: int) -> np.ndarray:
    """bool [N], or empty where none is dead."""
    if not packed.size:
        return np.zeros(0, bool)
    size = -(-probes // 8)
    bits = inflate(packed.tobytes(), size, "part dead", f"a bit for each of {probes} probes")
    return np.unpackbits(np.frombuffer(bits, np.uint8), count=probes).astype(bool)
