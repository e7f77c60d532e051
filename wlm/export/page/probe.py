"""The page of light probes."""

from __future__ import annotations

import math
import os
from typing import Any, Literal

import numpy as np

from wlm.errors import WlmError
from wlm.export.page.html import Page, pack_triangles
from wlm.formats.geometry import read_geometry
from wlm.probe.data import load
from wlm.probe.day import DayModel
from wlm.probe.decode import Decoder
from wlm.probe.evaluation import evaluate
from wlm.probe.exporter import gaussian_bytes, network_bytes
from wlm.probe.model import ProbeModel
from wlm.probe.places import ball_exposure, ball_radius, probes_of
from wlm.probe.shader import probe_glsl
from wlm.probe.sphere import sh_count
from wlm.probe.transform import Transform
from wlm.probe.transform_export import light_bytes, transform_glsl

_BANDS = 9  # coefficients that diffuse light needs


def probe_page(
    model: ProbeModel | Transform,
    file_bytes: int,
    *,
    mesh: str | os.PathLike[str] | None = None,
    original: str | os.PathLike[str] | None = None,
    key: str | None = None,
    up: Literal["y", "z"] = "y",
) -> Page:
    """Makes the page of a probe model: spheres at its positions or at those of the original.

    Args:
        model: The model.
        file_bytes: Size of its file.
        mesh, original, key, up: As for `wlm.export.page.pages.make_page`.

    Of Gaussians the page carries codes and network as they are, of a transform the unpacked light of its probes.

    Raises:
        WlmError: A probe's numbers are no spherical harmonics; the positions are not known; the mesh or the original
            can't be read, or is of other probes.
    """
    coefficients = sh_count(model.outputs)
    if coefficients is None:
        raise WlmError(f"{model.name}: expected spherical harmonics, found {model.outputs} numbers a probe")
    position, values, live, _ = probes_of(model, original, key)
    places = position[live].astype(np.float32)
    if isinstance(model, Transform):
        decoded = model.decoder(position=None if original is None else position).decode_probes()[live]
        content = {"light": light_bytes(model, position[live], decoded)[0]}
        shader, fact = transform_glsl(len(places), model.outputs), _fact(model)
    else:
        decoded = Decoder(model).decode(position[live])
        content = {"gaussians": gaussian_bytes(model), "network": network_bytes(model)}
        shader, fact = probe_glsl(model), ("Gaussians", f"{model.count:,}")
    arrays = {name: np.frombuffer(_whole(part), "<u4") for name, part in content.items()}
    arrays["places"] = places
    radius = ball_radius(places)
    light = decoded if values is None else values[live]
    manifest: dict[str, Any] = {
        "shader": shader,
        "exposure": ball_exposure(light.reshape(len(places), coefficients, 3)),
        "low": (places.min(0) - radius).tolist(),
        "high": (places.max(0) + radius).tolist(),
        "up": "xyz".index(up),
        "probe": {"count": len(places), "radius": radius, "coefficients": coefficients},
    }
    if values is not None:
        stored = np.zeros((len(places), _BANDS, 3), np.float16)
        shown = values[live].reshape(len(places), coefficients, 3)[:, :_BANDS]
        stored[:, : shown.shape[1]] = shown.clip(-65504, 65504)
        arrays["original"] = stored
        manifest["reference"] = {"times": [0.0]}
    if mesh is not None:
        triangles, box = pack_triangles(read_geometry(mesh, with_uv=False), up)
        arrays |= triangles
        manifest["low"] = np.minimum(manifest["low"], box["low"]).tolist()
        manifest["high"] = np.maximum(manifest["high"], box["high"]).tolist()
        manifest["inward"] = box["inward"]
    figures = [
        ("file", f"{file_bytes:,} bytes"),
        ("bits per probe", f"{file_bytes * 8 / model.probes:.1f}"),
        ("size", f"{100 * file_bytes / (4 * model.outputs * model.probes):.2f}% of float32"),
        ("live probes", f"{len(places):,} of {model.probes:,}"),
        fact,
        ("profile", model.profile.name),
    ]
    if original is not None:
        score = evaluate(model, load(original, key=key), file_bytes=file_bytes).psnr
        figures.append(("PSNR of coefficients", "–" if math.isnan(score) else f"{score:.2f} dB"))
    return Page("probe", model.name, "Light probes, decoded on this GPU.", figures, manifest, arrays)


def _fact(model: Transform) -> tuple[str, str]:
    """What is said of a transform: its step, or which of its hours it shows."""
    if isinstance(model, DayModel):
        return "hour", f"{model.time:g}, of {', '.join(f'{time:g}' for time in model.times)}"
    return "step", f"{model.head.step:.3g}"


def _whole(content: bytes) -> bytes:
    """Filled up to whole words of 32 bits."""
    return content + bytes(-len(content) % 4)
