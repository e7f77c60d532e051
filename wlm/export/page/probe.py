"""The HTML page that shows light probes."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from wlm.bundle import filled
from wlm.errors import WlmError
from wlm.export.page.html import Page, compare_sizes, pack_triangles
from wlm.formats.geometry import read_geometry
from wlm.probe.bundle import bundle
from wlm.probe.data import load
from wlm.probe.evaluation import evaluate
from wlm.probe.places import ball_exposure, ball_radius, probes_of
from wlm.probe.sphere import sh_count
from wlm.system import load as load_model

_BANDS = 9  # coefficients for diffuse light
_BUFFERS = ("gaussians", "network", "probes")


def probe_page(
    paths: Sequence[Path],
    *,
    mesh: str | os.PathLike[str] | None = None,
    original: str | os.PathLike[str] | None = None,
    key: str | None = None,
    time: float | None = None,
    up: Literal["y", "z"] = "y",
) -> Page:
    """Makes the HTML page of a probe model, which shows spheres at the positions of the model or the original."""
    whole, file_bytes = load_model(paths[0], "probe"), paths[0].stat().st_size
    model = whole.at(time)
    coefficients = sh_count(model.outputs)
    if coefficients is None:
        raise WlmError(
            f"{model.name}: expected probes of RGB spherical harmonics, found {model.outputs} numbers a probe"
        )
    position, values, live, _ = probes_of(model, original, key, time)
    places = position[live].astype(np.float32)
    decoded = model.decoder(position=position).decode_probes()[live]
    made = bundle(model)
    if made.parts:
        raise WlmError(f"{model.name}: cannot be a page, which decodes one region, found {len(made.parts)}")
    shader = made.shader
    arrays = {name: made.buffers[name] for name in _BUFFERS if name in made.buffers}
    if "probes" in arrays:
        arrays["own"] = places.reshape(-1).view("<u4")
        shader += filled(__package__, "between.glsl", COUNT=coefficients)
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
        *compare_sizes(file_bytes, 4 * model.outputs * model.probes * max(len(whole.times), 1), "float32"),
        ("live probes", f"{len(places):,} of {model.probes:,}"),
        *((name.replace("_", " "), str(value)) for name, value in model.content.facts().items()),
        ("profile", model.profile.name),
    ]
    if original is not None:
        score = evaluate(model, load(original, key=key).at(time), file_bytes=file_bytes).psnr
        figures.append(("PSNR of coefficients", "–" if math.isnan(score) else f"{score:.2f} dB"))
    return Page("probe", model.name, "Light probes, decoded on this GPU.", figures, manifest, arrays)
