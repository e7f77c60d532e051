"""The HTML page that shows a scene over a day."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.export.engines.kit import filled
from wlm.export.page.html import Page, asset, compare_sizes
from wlm.export.page.lightmap import half_bytes, pack_groups, pack_originals
from wlm.export.page.smoke import pack_frames
from wlm.formats.hours import DAY
from wlm.formats.light import read_light
from wlm.formats.shared_exponent import pack_rgb9e5
from wlm.lightmap.data import SheetFrames
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.groups import times_of
from wlm.lightmap.model import SheetModel
from wlm.lightmap.profile import TimeAxis
from wlm.lightmap.sheet import first_light
from wlm.lightmap.virtual.clock import Clock
from wlm.probe.model import ProbeModel
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.light import StoredLight
from wlm.probe.volume.walk import settle
from wlm.scene import Mesh, Scene, load
from wlm.scene.probes import SIDE
from wlm.system import Meter, OnProgress
from wlm.texels import fill_gaps, repair

_PATH_RATE = 20  # positions of the camera's path a second
_PLACES = 64  # places on the path of a moving object at which its light is stored
_FIRST_HOUR = 12.0  # of the page; an hour with an original if there is one
_FIRST_SIDE = 512  # most texels along a side of the light of the first picture
_FILMIC = 1  # of the tones of the script


def scene_page(paths: Sequence[Path], *, progress: OnProgress | None = None) -> Page:
    """Makes the HTML page of a scene's YAML file: its lightmaps are decoded by the page, and the light of its probes is
    stored at the smoke and along the paths of moving objects."""
    with load(paths[0]) as scene:
        return _page(scene, progress)


def _page(scene: Scene, progress: OnProgress | None) -> Page:
    sheet = first_light(scene.light.sheets)
    groups = scene.light.maps(sheet)
    model = groups[sheet.group]
    described, arrays = pack_groups(scene.light, sheet)
    for entry, own in zip(described, groups.values(), strict=True):
        times = [*own.times.tolist(), float(own.times[0]) + (own.period or 0.0)]
        entry["lightmap"]["switches"] = [times[i : i + 2] for i in Clock(own.axis).switches]
    probes = _day_volume(scene.probes) if scene.moving or scene.smoke else None
    parts, moving = _moving(scene, probes, progress)
    arrays |= _mesh("mesh", scene.mesh, "uv") | parts
    parts, smoke = _smoke(scene, probes, progress)
    arrays |= parts
    hours = scene.probe_hours
    film = np.arange(int(np.ceil(scene.day.seconds * _PATH_RATE)) + 1) / _PATH_RATE
    arrays["path"] = np.array([np.hstack(scene.camera_at(float(second))) for second in film], np.float32)
    manifest: dict[str, Any] = {
        "width": model.width,
        "height": model.height,
        "exposure": 1.0,
        "tone": _FILMIC,
        "time": _FIRST_HOUR,
        "times": times_of({replace(sheet, group=name): own for name, own in groups.items()}).tolist(),
        "period": model.period,
        "groups": described,
        "low": scene.mesh.position.min(0).tolist(),
        "high": scene.mesh.position.max(0).tolist(),
        "scene": {
            "day": scene.day.model_dump(),
            "path_rate": _PATH_RATE,
            "probe_hours": hours.tolist(),
            "probe_switches": Clock(TimeAxis(hours, DAY, "frames")).switches if len(hours) else [],
            "sky": {"hours": scene.sky[:, 0].tolist(), "rows": scene.sky[:, 1:].tolist()},
            "moving": moving,
            "smoke": smoke,
        },
    }
    decoders = [SheetDecoder(own) for own in groups.values()]

    def decode(time: float) -> np.ndarray:
        return sum(decoder.frame(time) for decoder in decoders)

    if scene.originals:
        manifest["reference"], parts = _originals(scene, model, decode, progress)
        arrays |= parts
        manifest["time"] = min(scene.originals, key=lambda hour: abs(hour - _FIRST_HOUR))
    first = fill_gaps(decode(manifest["time"]), model.mask)
    step = -(-max(first.shape) // _FIRST_SIDE)
    arrays["first"] = pack_rgb9e5(first[step // 2 :: step, step // 2 :: step])
    manifest["scene"]["first"] = arrays["first"].shape[1::-1]
    stored = scene.light.file_bytes()
    figures = [
        ("file of lightmaps", f"{stored:,} bytes"),
        *compare_sizes(stored, half_bytes(scene.light)),
        ("lightmaps", f"{model.width} × {model.height}, {len(manifest['times'])} hours"),
        ("light groups", ", ".join(groups)),
        ("triangles", f"{len(scene.mesh.triangle):,}"),
        ("probes", f"{scene.probes.probes:,} at {len(hours)} hours" if scene.probes else "none"),
    ]
    scripts = [filled("lightmap_table.js").rstrip("\n"), asset("lightmap.js")]
    note = "Lightmaps over time, decoded on this GPU; moving objects and smoke are lit by probes."
    return Page("scene", scene.title, note, figures, manifest, arrays, scripts)


def _mesh(name: str, mesh: Mesh, further: str) -> dict[str, np.ndarray]:
    parts = {part: getattr(mesh, part) for part in ("position", "colour", further)}
    parts["triangles"] = mesh.triangle.astype(np.uint32)
    return {f"{name}_{part}": values for part, values in parts.items()}


def _moving(
    scene: Scene, probes: Volume | None, progress: OnProgress | None
) -> tuple[dict[str, np.ndarray], list[dict[str, Any]]]:
    """Returns the arrays of moving objects, with the coefficients [hours, places, 27] along their paths, and rows."""
    arrays, rows = dict[str, np.ndarray](), []
    meter = Meter(progress, "light of moving objects", len(scene.moving))
    for i, each in enumerate(scene.moving):
        places = [each.centre(each.pose(each.seconds * k / _PLACES)) for k in range(_PLACES)]
        arrays |= _mesh(f"moving_{i}", each.mesh, "normal") | {f"moving_{i}_light": _probe_light(probes, places)}
        rows.append({"path": each.path.tolist(), "seconds": each.seconds, "places": _PLACES})
        if meter.due(len(rows)):
            meter.report(len(rows))
    return arrays, rows


def _smoke(
    scene: Scene, probes: Volume | None, progress: OnProgress | None
) -> tuple[dict[str, np.ndarray], list[dict[str, Any]]]:
    """Returns the arrays of smoke, with the coefficients [hours, 1, 27] at its middle, and rows of the manifest."""
    arrays, rows = dict[str, np.ndarray](), []
    for i, puff in enumerate(scene.smoke):
        codes, most, _ = pack_frames(puff.files, progress)
        for number, code in enumerate(codes):
            arrays[f"smoke_{i}_first_{number}"], arrays[f"smoke_{i}_second_{number}"] = code[..., :4], code[..., 4:]
        arrays[f"smoke_{i}_light"] = _probe_light(probes, [puff.position + [0.0, 0.5 * puff.size, 0.0]])
        row = {"position": puff.position.tolist(), "size": puff.size, "rate": puff.rate, "most": most}
        rows.append(row | {"pixels": codes.shape[2:0:-1]})
    return arrays, rows


def _day_volume(model: ProbeModel) -> Volume:
    """Returns a volume whose blocks have the light of all hours, so that none is decoded for each hour."""
    decoder, light = model.decoder(), []
    for time in model.times.tolist() or [0.0]:
        decoder.set_time(time)
        light.append(decoder.decode_probes())
    return Volume(decoder.own_positions(), StoredLight(np.concatenate(light, 1)), live=model.live, side=SIDE)


def _probe_light(probes: Volume, places: Sequence[np.ndarray]) -> np.ndarray:
    """Returns coefficients at places [M, 3], float32 [hours of the probes, M, 27], each from a volume around it."""
    light = []
    for place in places:
        settle(probes, place)
        light.append(probes.read(place[None]).values.reshape(-1, 27))
    return np.stack(light, 1)


def _originals(
    scene: Scene, model: SheetModel, decode: Callable[[float], np.ndarray], progress: OnProgress | None
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Returns the entry of the manifest and the arrays of the original lightmaps; see `pack_originals`."""
    hours, frames = sorted(scene.originals), []
    for path in (scene.originals[hour] for hour in hours):
        frame = np.ascontiguousarray(read_light(path)[0][..., :3])
        if frame.shape[:2] != (model.height, model.width):
            raise WlmError(
                f"{path}: expected a lightmap of {model.width}x{model.height}, found {frame.shape[1]}x{frame.shape[0]}"
            )
        repair(frame, model.mask, str(path))
        frames.append(frame)
    lightmaps = SheetFrames(scene.title, np.array(hours), np.stack(frames), model.mask, DAY, "", ())
    return pack_originals(model, lightmaps, decode, scene.path, len(hours), progress)
