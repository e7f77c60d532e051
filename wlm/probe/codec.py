"""Probe models in files. Packed Gaussians are as `wlm.probe.gaussian_codec` has them, transforms as
`wlm.probe.transform_codec`; here are those of Gaussians that are not packed, as in earlier files.

`gaussians` holds for every Gaussian three centres of 16 bits and 7 + L codes of b bits, packed without a gap, the
lowest bit first; `frame` is origin, extent, size of the box and gain; `dead` is a bit for each probe, deflated.
"""

from typing import Any

import numpy as np
from pydantic import Field

from wlm.config import check_settings
from wlm.formats.artifact import Artifact
from wlm.formats.bits import pack_bits, unpack_bits
from wlm.formats.compact import HEAD
from wlm.formats.limits import NUMBERS, PROBES
from wlm.formats.parts import Part, check_parts
from wlm.probe.day import DayModel
from wlm.probe.day_codec import decode_day, encode_day
from wlm.probe.fields import GAUSSIANS, HOURS, is_of, pack_dead, unpack_dead
from wlm.probe.gaussian_codec import decode_gaussians, encode_gaussians
from wlm.probe.model import LATENT, SCALE, ProbeModel, Profile, layer_shapes
from wlm.probe.region_codec import decode_regions, encode_regions
from wlm.probe.regions import RegionModel
from wlm.probe.transform import Transform, TransformModel
from wlm.probe.transform_codec import decode_transform, encode_transform, is_transform
from wlm.system import Header, Name

_MOST, _MOST_LOG = 1e38, 40.0


class _Header(Header):
    """The settings of a file of Gaussians."""

    name: Name
    probes: int = Field(ge=1, le=PROBES)
    outputs: int = Field(ge=1, le=NUMBERS)
    profile: Profile
    gaussians: int = Field(ge=1, le=PROBES)
    dropped: int = Field(ge=0, le=PROBES)


def _parts(header: _Header) -> dict[str, Part]:
    """The table of parts."""
    profile = header.profile
    layers = layer_shapes(profile.latent, profile.hidden, header.outputs)
    bits = header.gaussians * int(profile.code_bits().sum())
    return {
        "gaussians": Part(np.uint8, (-(-bits // 8),)),
        "bounds": Part(np.float32, (2, LATENT.start + profile.latent), least=-_MOST, most=_MOST),
        "net": Part(np.float16, (sum(rows * columns for rows, columns in layers),)),
        "frame": Part(np.float64, (8,)),
        "dead": Part(np.uint8, (None,), optional=True),
        "positions": Part(np.uint16, (header.probes, 3), optional=True),
    }


def encode(model: ProbeModel | Transform) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    """Settings, parts and source of a model's file."""
    if isinstance(model, RegionModel):
        return encode_regions(model)
    if isinstance(model, DayModel):
        return encode_day(model)
    if isinstance(model, TransformModel):
        return encode_transform(model)
    if model.packed is not None:
        return encode_gaussians(model)
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


def decode(artifact: Artifact) -> ProbeModel | Transform:
    """Makes the model of a file; what `encode` gave comes back bit for bit.

    Raises:
        WlmError, ValueError: A setting or a part is missing or wrong, or they don't fit each other.
    """
    if HEAD in artifact.tensors:
        return decode_regions(artifact)
    if is_of(artifact, HOURS):
        return decode_day(artifact)
    if is_of(artifact, GAUSSIANS):
        return _checked(decode_gaussians(artifact))
    if is_transform(artifact):
        return decode_transform(artifact)
    header = check_settings(_Header, artifact.settings, "setting ")
    parts = check_parts(artifact.tensors, _parts(header))
    frame = parts["frame"]
    codes = unpack_bits(parts["gaussians"], header.profile.code_bits(), header.gaussians)
    model = ProbeModel(
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
        dead=unpack_dead(parts["dead"], header.probes),
        positions=parts["positions"],
        dropped=header.dropped,
    )
    return _checked(model)


def _checked(model: ProbeModel) -> ProbeModel:
    """The model, if all of its numbers can be used.

    Raises:
        ValueError: They can't.
    """
    _check_frame(model.origin, model.extent, model.size, model.gain)
    _check_bounds(model.bounds)
    _check_values(model)
    return model


def _check_frame(origin: np.ndarray, extent: float, size: np.ndarray, gain: float) -> None:
    with np.errstate(over="ignore"):
        reaches = np.isfinite(origin + extent * size).all()
    if not (extent > 0 and reaches and (size >= 0).all() and (size <= 1).all()):
        raise ValueError("part frame: expected a positive extent and a size within it")
    if not 0 < gain <= np.finfo(np.float32).max:
        raise ValueError(f"part frame: expected a positive gain that float32 holds, found {gain:g}")


def _check_bounds(bounds: np.ndarray) -> None:
    # The difference of any two is finite.
    if not np.abs(bounds).max() <= _MOST:
        raise ValueError(f"part bounds: expected numbers of at most {_MOST:g} either way")
    if (bounds[0] > bounds[1]).any():
        raise ValueError("part bounds: expected no lowest value above its highest")
    # Scales are logarithms: their squares, and the squares' inverses, must be float32.
    if np.abs(bounds[:, SCALE]).max() > _MOST_LOG:
        raise ValueError(f"part bounds: expected logs of scales of at most {_MOST_LOG:g} either way")


def _check_values(model: ProbeModel) -> None:
    """Checks that no number on the way to a probe's values is beyond float32, wherever it is decoded."""
    # The sum of what each output may become, of inputs in [-1, 1].
    first, _, third = (np.abs(layer.astype(np.float64)) for layer in model.layers())
    sums = model.count * np.abs(model.bounds[:, LATENT].astype(np.float64)).max(0)
    first *= np.concatenate([np.maximum(sums, 1.0), np.ones(4)])[:, None]
    most = max(first.sum(0).max(), model.gain * third.sum(0).max())
    if not most <= np.finfo(np.float32).max:
        raise ValueError("parts net, bounds and frame: expected values that float32 holds")
