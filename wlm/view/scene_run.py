"""`run`: pictures of a scene at hours, a film of its day, and a report of times, memory and errors."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats.film import film
from wlm.formats.folder import UNFINISHED, claim, write_index
from wlm.lightmap.groups import Weight
from wlm.metrics import Pictures
from wlm.scene.content import Scene
from wlm.scene.frame import STAGES, Frame, Renderer
from wlm.system import Meter, OnProgress, plain
from wlm.view.pictures import save_png

REPORT = "report.json"
"""Name of the file with the report."""

FORMAT = "wlm-scene-run"
"""`format` of the report."""

RATE = 24.0
"""Frames a second of a film whose number of frames is not given."""

_WEBP_BYTES = 2 << 30  # frames of an animated WebP wait in memory


def run(
    scene: Scene,
    folder: str | os.PathLike[str],
    *,
    hours: Sequence[float] | None = None,
    frames: int | None = None,
    height: int = 540,
    width: int = 960,
    samples: int = 2,
    device: str = "cpu",
    weights: Mapping[str, Weight] | None = None,
    progress: OnProgress | None = None,
) -> dict[str, Any]:
    """Draws a scene into a folder: `view_HH_HHh.png`, `film.mp4` or `film.webp`, and `report.json`.

    The film is H.264 if imageio-ffmpeg is installed (the extra "film"), else an animated WebP. Its first frame is
    complete, and is not counted in the times; later ones decode at most `wlm.scene.frame.DECODES` pages each.

    Args:
        scene: The scene.
        folder: The folder; an earlier run in it is replaced.
        hours: Hours of the pictures, each from the camera's place at that hour of the film; None: those of the
            originals, or every six hours.
        frames: Frames of the film; 0 for no film, None for 24 a second.
        height, width, samples, device: As for `wlm.scene.frame.Renderer`.
        weights: Weights of light groups, by name.
        progress: Called about twice a second.

    Returns:
        The report as JSON values: `film`, its file, frames and rate; `frame_ms`, milliseconds of a frame by stage and
        in `total`: `mean`, `p95` and `most`; `decoded`, pages decoded in a frame, `mean` and `most`; `current`, share
        of the points on the mesh that show their own page and time, `mean` and `least`; `memory`, bytes on the device
        by part; `views`, PSNR and FLIP of the pixels of the mesh at each hour of the originals, compared with a picture
        under the original lightmap.
    """
    folder = Path(folder)
    frames = round(RATE * scene.day.seconds) if frames is None else frames
    name = "film.mp4" if find_spec("imageio_ffmpeg") else "film.webp"
    _check(scene, frames, height, width, name)
    hours = sorted(set(scene.originals or (0.0, 6.0, 12.0, 18.0)) if hours is None else set(hours))
    if bad := [hour for hour in hours if not 0.0 <= hour < 48.0]:
        raise WlmError(f"hours: expected 0 to 48, got {bad[0]:g}")
    if bad := [pair for pair in pairwise(hours) if f"{pair[0]:.2f}" == f"{pair[1]:.2f}"]:
        raise WlmError(f"hours: expected hours that differ in two decimals, which name their pictures, got {bad[0]}")
    claim(folder, REPORT, FORMAT)
    report: dict[str, Any] = {"format": FORMAT, "scene": scene.title, "device": device}
    report |= {"width": width, "height": height, "samples": samples}
    with Renderer(scene, height, width, device, samples=samples) as renderer:
        renderer.pages.set_weights(weights or {})
        folder.mkdir(exist_ok=True)
        write_index(folder / REPORT, report | {UNFINISHED: True})
        for old in (*folder.glob("view_*h.png"), *folder.glob("film.*")):
            old.unlink()
        meter = Meter(progress, "pictures", len({*hours, *scene.originals}))
        report["views"] = _views(renderer, hours, folder, meter)
        if frames:
            report |= _film(renderer, folder / name, frames, progress)
        report["memory"], report["warnings"] = renderer.memory(), renderer.pages.warnings
    report = plain(report)
    write_index(folder / REPORT, report)
    return report


def _check(scene: Scene, frames: int, height: int, width: int, name: str) -> None:
    if not 0 <= frames <= 1_000_000:
        raise WlmError(f"frames: expected 0 to 1000000, got {frames}")
    if frames and name.endswith(".mp4") and (height % 2 or width % 2):
        raise WlmError(f"size: expected an even width and height for a film, got {width} x {height}")
    if name.endswith(".webp") and 3 * frames * height * width > _WEBP_BYTES:
        most = f"{_WEBP_BYTES // (3 * height * width)} of {width} x {height} pixels for an animated WebP"
        raise WlmError(f"frames: expected at most {most}, got {frames}; the extra wlm[film] writes longer films")


def _views(renderer: Renderer, hours: Sequence[float], folder: Path, meter: Meter) -> list[dict[str, float]]:
    """Writes the pictures of `hours`, and compares with the originals at theirs."""
    scene, rows = renderer.scene, []
    for done, hour in enumerate(sorted({*hours, *scene.originals}), 1):
        second = scene.second_at(hour)
        frame = renderer.draw(second, hour=hour, complete=True)
        if hour in hours:
            save_png(folder / f"view_{hour:05.2f}h.png".replace(".", "_", 1), frame.picture())
        if hour in scene.originals:
            original = renderer.draw(second, hour=hour, original=renderer.original(hour))
            seen = frame.surface.cpu().numpy()
            pictures = (np.where(seen[..., None], each.screen.cpu().numpy(), 0.0) for each in (original, frame))
            if (scores := Pictures().add(*pictures, seen)) is not None:
                rows.append({"hour": hour} | scores)
        meter.report(done)
    return rows


def _film(renderer: Renderer, path: Path, frames: int, progress: OnProgress | None) -> dict[str, Any]:
    """Writes the film and returns its figures."""
    seconds, drawn = renderer.scene.day.seconds, list[Frame]()
    rate, meter = frames / seconds, Meter(progress, "film", frames)
    with film(path, renderer.height, renderer.width, rate) as add:
        for number in range(frames):
            frame = renderer.draw(number / rate, complete=number == 0)
            add(frame.picture())
            drawn.append(frame)
            if meter.due(number + 1):
                meter.report(number + 1)
    made: dict[str, Any] = {"film": {"file": path.name, "frames": frames, "rate": rate}}
    if counted := drawn[1:]:
        times = {name: [1e3 * frame.stages[name] for frame in counted] for name in STAGES}
        times["total"] = [1e3 * sum(frame.stages.values()) for frame in counted]
        made["frame_ms"] = {
            name: {"mean": np.mean(each), "p95": np.percentile(each, 95), "most": max(each)}
            for name, each in times.items()
        }
        decoded, current = [frame.decoded for frame in counted], [frame.current for frame in counted]
        made["decoded"] = {"mean": np.mean(decoded), "most": max(decoded)}
        made["current"] = {"mean": np.mean(current), "least": min(current)}
    return made
