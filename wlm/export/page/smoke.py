"""The HTML pages of smoke: one plays six-way lightmaps, the other computes them from volumes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.export.page.html import Page, asset
from wlm.smoke.camera import DIRECTIONS
from wlm.smoke.codec import open_network
from wlm.smoke.data import load_frames, read_six_way
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.six_way import coarse_march
from wlm.system import Meter, OnProgress

_WHITE = 0.8  # screen value of the brightest lightmap
_MOST_BYTES = 2**28  # of volumes in a page


def smoke_page(paths: Sequence[Path], *, rate: float = 30.0, progress: OnProgress | None = None) -> Page:
    """Makes the HTML page that plays six-way lightmaps of smoke, an EXR per frame of `wlm smoke bake` or `predict`, all
    of one size, at `rate` frames per second."""
    _check_rate(rate)
    codes, most, hot = pack_frames(paths, progress)
    arrays = {}
    for i, code in enumerate(codes):
        arrays[f"first_{i}"], arrays[f"second_{i}"] = code[..., :4], code[..., 4:]
    height, width = codes.shape[1:3]
    shown = [*DIRECTIONS, "opacity"] + ["emission"] * hot
    manifest = {
        "width": width,
        "height": height,
        "exposure": _WHITE / max(scales[0] for scales in most),
        "smoke": {"frames": len(paths), "planes": shown, "most": most, "rate": rate},
    }
    figures = [
        ("files", f"{sum(path.stat().st_size for path in paths):,} bytes"),
        ("frames", f"{len(paths)}"),
        ("lightmaps", f"{width} × {height} texels"),
        ("brightest texel", f"{max(scales[0] for scales in most):.3g}"),
    ]
    title = paths[0].stem if len(paths) == 1 else paths[0].resolve().parent.name
    note = "Six-way lightmaps of smoke. Drag over the picture: the light follows the pointer."
    return Page("smoke", title, note, figures, manifest, arrays)


def live_page(
    paths: Sequence[Path],
    *,
    rate: float = 30.0,
    network: str | None = None,
    volume: Mapping[str, Any] | None = None,
    progress: OnProgress | None = None,
) -> Page:
    """Makes the HTML page of a volume of smoke or a folder of frames, for which the browser computes what
    `wlm.smoke.predict` does, from all sides; the options are those of `wlm.export.make_page`."""
    _check_rate(rate)
    model = None if network is None else open_network(network)
    if model is not None and model.settings.guide != "six":
        raise WlmError(f"{network}: network.guide: expected six for a page, found {model.settings.guide}")
    frames, arrays, entries = load_frames(paths[0], **dict(volume or {})), dict[str, np.ndarray](), list[dict]()
    for i, (_, smoke) in enumerate(frames.volumes(progress=progress)):
        march = coarse_march(smoke) if model is None else model.dataset.look(smoke.shape)
        place = {"shape": smoke.shape, "voxel": smoke.voxel, "origin": list(map(float, smoke.origin))}
        entries.append(place | {"march": asdict(march)})
        parts = ("density", smoke.density, smoke.extinction), ("heat", smoke.temperature, smoke.emission)
        for name, field, factor in parts:
            if field is not None:
                # Relative to the largest number, since half floats have a small range.
                most = max(float(field.max()), 1e-30)
                arrays[f"{name}_{i}"] = (field.float() / most).numpy().astype(np.float16)
                entries[-1][name] = factor * smoke.voxel * most
        if sum(array.nbytes for array in arrays.values()) > _MOST_BYTES:
            raise WlmError(f"{frames.path}: expected at most {_MOST_BYTES >> 20} MiB of volumes, as half floats")
    live: dict[str, Any] = {"frames": entries, "network": None}
    if model is not None:
        bundle = model.bundle()
        live["network"], arrays["weights"] = bundle.document, bundle.buffers["weights"]
    figures = [("frames", f"{len(entries)}"), ("voxels of the last", " × ".join(map(str, smoke.shape)))]
    figures.append(("its optical thickness", f"{smoke.thickness:.3g}"))
    note = " ".join(["Six-way lightmaps, computed as you turn the smoke.", *frames.warnings, *smoke.warnings])
    manifest = {"smoke": {"frames": len(entries), "rate": rate}, "live": live}
    return Page("smoke", frames.path.stem, note, figures, manifest, arrays, [asset("live.js")])


def _check_rate(rate: float) -> None:
    if not 0 < rate < float("inf"):
        raise WlmError(f"--rate: expected a number above 0, got {rate}")


def pack_frames(paths: Sequence[Path], progress: OnProgress | None) -> tuple[np.ndarray, list[list[float]], bool]:
    """Reads frames of smoke for a script.

    Returns:
        Codes uint8 [N, H, W, 8] of the six lightmaps, the opacity and the emission: square roots, whose steps are
        perceptually more even. The largest number of each frame's lightmaps, opacity and emission, which its codes are
        relative to. And whether any frame has emission.
    """
    codes, most, hot = list[np.ndarray](), list[list[float]](), False
    meter = Meter(progress, "read", len(paths))
    for path in paths:
        frame = read_six_way(path)
        hot |= frame.emission is not None
        planes, scales = _planes(frame)
        codes.append(np.round(np.sqrt(planes) * 255.0).astype(np.uint8).transpose(1, 2, 0))
        if codes[-1].shape != codes[0].shape:
            first, found = ("{1}x{0}".format(*code.shape) for code in (codes[0], codes[-1]))
            raise WlmError(f"{path}: expected {first} pixels as the first frame, found {found}")
        most.append(scales)
        if meter.due(len(most)):
            meter.report(len(most))
    return np.stack(codes), most, hot


def _planes(frame: SixWay) -> tuple[np.ndarray, list[float]]:
    """Returns the frame's eight channels scaled to [0, 1], and the scale factors of lightmaps, opacity and emission."""
    lightmaps = frame.lightmaps.numpy().clip(0.0, None)
    opacity = np.ones_like(lightmaps[0]) if frame.transparency is None else 1.0 - frame.transparency.numpy()
    glow = np.zeros_like(lightmaps[0]) if frame.emission is None else frame.emission.numpy().clip(0.0, None)
    scales = [max(float(lightmaps.max()), 1e-12), 1.0, max(float(glow.max()), 1e-12)]
    planes = np.concatenate([lightmaps / scales[0], opacity.clip(0.0, 1.0)[None], glow[None] / scales[2]])
    return planes, scales
