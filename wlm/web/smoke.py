"""The page of six-way lightmaps of smoke."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from wlm.errors import WlmError
from wlm.smoke.camera import DIRECTIONS
from wlm.smoke.data import read_six_way
from wlm.smoke.lightmaps import SixWay
from wlm.web.page import Page

_WHITE = 0.8  # of the screen, where the brightest lightmap is


def smoke_page(paths: Sequence[Path], *, rate: float = 30.0) -> Page:
    """Makes the page of six-way lightmaps.

    Args:
        paths: One EXR a frame, of one size, as `wlm smoke bake` or `predict` wrote them.
        rate: Frames a second.

    Raises:
        WlmError: A file can't be read or is of another size, or the rate isn't above 0.
    """
    if not 0 < rate < float("inf"):
        raise WlmError(f"--rate: expected a number above 0, got {rate}")
    frames = [read_six_way(path) for path in paths]
    height, width = frames[0].lightmaps.shape[1:]
    arrays: dict[str, np.ndarray] = {}
    most = []
    for i, (path, frame) in enumerate(zip(paths, frames, strict=True)):
        if tuple(frame.lightmaps.shape[1:]) != (height, width):
            size = frame.lightmaps.shape
            raise WlmError(f"{path}: expected {width}x{height} pixels as the first frame, found {size[2]}x{size[1]}")
        planes, scales = _planes(frame)
        # sRGB-like codes of 8 bits: what a flip book has.
        codes = np.round(np.sqrt(planes) * 255.0).astype(np.uint8).transpose(1, 2, 0)
        arrays[f"first_{i}"], arrays[f"second_{i}"] = codes[..., :4], codes[..., 4:]
        most.append(scales)
    shown = [*DIRECTIONS, "opacity"] + ["emission"] * any(frame.emission is not None for frame in frames)
    manifest = {
        "width": width,
        "height": height,
        "exposure": _WHITE / max(scales[0] for scales in most),
        "smoke": {"frames": len(frames), "planes": shown, "most": most, "rate": rate},
    }
    figures = [
        ("files", f"{sum(path.stat().st_size for path in paths):,} bytes"),
        ("frames", f"{len(frames)}"),
        ("size", f"{width} × {height}"),
        ("light at most", f"{max(scales[0] for scales in most):.3g}"),
    ]
    note = "Six-way lightmaps of smoke. Drag over the picture: the light follows the pointer."
    return Page("smoke", paths[0].stem, note, figures, manifest, arrays)


def _planes(frame: SixWay) -> tuple[np.ndarray, list[float]]:
    """The eight planes in [0, 1], and by what to multiply the lightmaps, the opacity and the emission."""
    lightmaps = frame.lightmaps.numpy().clip(0.0, None)
    opacity = np.ones_like(lightmaps[0]) if frame.transparency is None else 1.0 - frame.transparency.numpy()
    glow = np.zeros_like(lightmaps[0]) if frame.emission is None else frame.emission.numpy().clip(0.0, None)
    scales = [max(float(lightmaps.max()), 1e-12), 1.0, max(float(glow.max()), 1e-12)]
    planes = np.concatenate([lightmaps / scales[0], opacity.clip(0.0, 1.0)[None], glow[None] / scales[2]])
    return planes, scales
