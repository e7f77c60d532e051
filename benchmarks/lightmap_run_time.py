"""Measures the virtual texture of lightmaps as a renderer uses it: a walk and a day through a set, or a large set.

A row is one path of a camera at 1280 x 720 pixels, with one setting:

- "walk": 600 frames of a walk through the scene while 10 minutes pass, in which a lamp is switched: 10 seconds of a
  game whose day takes 24 minutes, at 60 frames per second.
- "day": a whole day, with a frame for every minute, while the camera turns slowly.

`frame_ms` is the time of a frame on the device, without the gaps of the host that queues it: on CUDA a short wait is
queued first, and a frame is not timed if the host took longer than the wait. `current` is the share of pixels that show
the page that they need, with its light changed by at most the tolerance; `nearly_current` also counts pages that are
one level coarser. `staleness` is the relative change of a page's light since the time for which it was decoded, over
pixels. `cached_psnr` compares views, as a screen shows them, with views in which every page is decoded at the frame's
time; `view_psnr` and `view_flip` compare them with the uncompressed lightmaps, read trilinearly, and `gain` is the
difference of their PSNR to that of the views with every page decoded. Views are compared at a quarter of their pixels.

The rivals of `benchmarks.rivals.lightmap_run_time` show the same views at the same times: all maps decoded in each
frame or at each stored time, and all lightmaps as blocks of BC7 or BC6H on the GPU. `frame_ms` of a rival has no upload
of numbers of the time, and no reading of textures, which `shader-speed` measures; its views are read trilinearly from
means of the decoded texels.

Rows "format" have the error of the physical texture's format beside its rival, 8 bits per channel in gamma space
relative to the bound of a page, of the uncompressed lightmaps; `texel_rms` is relative to a texel's brightest channel.

The large set, which is measured if no set is given, has four sheets of 4096 x 4096 texels at 26 times, of random maps
and networks that change about as much in an hour as a real set does. Its sheets are a plain on which the camera walks.
Only some of its tiles are on the device; the others are loaded from a file.
"""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

import numpy as np
import torch
import warp as wp

import wlm
from benchmarks.rivals.lightmap import RIVALS
from benchmarks.rivals.lightmap_run_time import Blocks, EveryFrame, EveryTime, neighbours
from benchmarks.rows import Row
from benchmarks.runner import Bench, Note
from wlm import interop
from wlm.errors import WlmError
from wlm.formats.bc7 import pack_mode6
from wlm.formats.geometry import read_geometry
from wlm.formats.shared_exponent import pack_rgb9e5, unpack_rgb9e5
from wlm.lightmap.data import LightmapSet, SheetFrames, load
from wlm.lightmap.fit import compress
from wlm.lightmap.model import LightmapModel, SheetModel, part_table
from wlm.lightmap.profile import Profile
from wlm.lightmap.sheet import Sheet
from wlm.lightmap.tiles import TILE, TileKind
from wlm.lightmap.virtual.texture import BUDGET, Reading, VirtualTexture
from wlm.metrics import Pictures, psnr_from_mse
from wlm.ops import raster
from wlm.texels import exposure, filmic, nearest_valid, to_srgb

_SIZE, _QUICK_SIZE = (720, 1280), (180, 320)
_WALK, _DAY = 600, 1440
_QUICK = 60  # a quick run has one of so many frames
_SCORED, _QUICK_SCORED = 40, 4  # one of so many frames is scored
_WALK_HOURS = (18.4, 18.57)
_LARGE, _SHEETS, _LARGE_TIMES = 4096, 4, 26
_LARGE_BUDGET, _LARGE_TILES = 32 << 20, 24 << 20
_SPARSE = 2  # distance along both axes of the pixels whose colours are compared
_DECODERS: dict[str, type[EveryFrame | EveryTime]] = {"each-frame": EveryFrame, "each-time": EveryTime}
_BLOCKS = ("bc7", "bc6h")
_RIVALS = (*_DECODERS, *_BLOCKS)
_METRES = 128.0  # side of a sheet of the large set
_ALL = 1 << 40  # bytes: the pages of all levels
_EVERY = 6  # one of so many times is measured in a quick run
_GAMMA, _BORDER = 2.2, 4  # of colours of 8 bits; of a page
_WARMUP = 32  # frames, in which modules are loaded and the graph is captured
_WAIT_CYCLES = 10_000_000  # of the GPU, about 5 ms: as a rule longer than the host needs to queue a frame
_PACE_CYCLES = 30_000_000  # about 16 ms: 60 frames per second, where tiles are loaded beside the frames

View = tuple[wp.array, wp.array, wp.array]
Camera = Callable[[float], View]


def run(
    *,
    walked_path: str | os.PathLike[str] | None = None,
    rival_names: Sequence[str] | None = None,
    quick: bool,
    device: str,
    progress: Note | None = None,
    done: Callable[[list[Row]], None] | None = None,
) -> list[Row]:
    """Measures the virtual texture of one set with profile M, or of the large set.

    Args:
        walked_path: A lightmap set that names its mesh; None: the large set.
        rival_names: Rivals to measure: "each-frame", "each-time", "bc7", "bc6h"; None: all.
        quick: Whether to fit for 200 steps, and to draw few and small frames of a large set of 512 x 512 texels.
        device: "cpu" or "cuda:0".
        progress: Called with a line before each part of the work.
        done: Called with all rows so far after each row.

    Returns:
        Three rows: a walk, and a day with 8 and with 64 pages per frame; then the rows of the rivals in the walk and
        in the day, and of a set those of formats.

    Raises:
        WlmError: The set, its mesh, a rival or the device does not exist.
    """
    if unknown := set(rival_names or ()) - set(_RIVALS):
        raise WlmError(f"--rival: expected one of {', '.join(_RIVALS)}; found {', '.join(sorted(unknown))}")
    if walked_path is None:
        side = 512 if quick else _LARGE
        bench = _RunTime(f"{side} x {side} x {_LARGE_TIMES} x {_SHEETS}", quick, device, progress, rival_names, done)
        bench.note("making its tiles")
        with TemporaryDirectory(prefix="wlm-") as folder:
            path = Path(folder) / "large.wlm"
            large_model(side).save(path)
            with wlm.load(path) as model:
                camera = _PlainCamera(side, bench.size, bench.device)
                return bench.rows(model, camera, None, _LARGE_BUDGET, _LARGE_TILES)
    lightmaps = load(walked_path)
    bench = _RunTime(f"{lightmaps.name}, run time", quick, device, progress, rival_names, done)
    if lightmaps.light.mesh is None:
        raise WlmError(f"{lightmaps.name}: expected a set that names its mesh, for a walk through it")
    bench.note("fitting profile M")
    model = compress(lightmaps, "M", device=bench.device, **({"steps": 200} if quick else {}))
    return bench.rows(model, _RoomCamera(lightmaps, bench.size, bench.device), lightmaps.light)


class _RunTime(Bench):
    """The benchmark of one set: draws frames with a virtual texture and with its rivals, times and scores them."""

    def __init__(
        self,
        scene: str,
        quick: bool,
        device: str,
        progress: Note | None,
        rival_names: Sequence[str] | None = None,
        done: Callable[[list[Row]], None] | None = None,
    ) -> None:
        super().__init__("lightmap", device, progress, scene=scene, clock="frame_ms")
        self.quick, self.size = quick, _QUICK_SIZE if quick else _SIZE
        self._rival_names, self._done, self._rows = rival_names or _RIVALS, done, []

    def _add(self, row: Row) -> None:
        """Adds a row to those of the run, and reports these."""
        self._rows.append(row)
        if self._done is not None:
            self._done(self._rows)

    def rows(
        self,
        model: LightmapModel,
        camera: Camera,
        sheet: SheetFrames | None,
        budget: int = BUDGET,
        tiles: int | None = None,
    ) -> list[Row]:
        """Measures a walk and a day, with our textures and with rivals, and returns all rows of the run.

        Args:
            model: The compressed set.
            camera: Draws its views.
            sheet: The uncompressed lightmaps; None: errors are not measured.
            budget, tiles: As for `VirtualTexture`.
        """
        paths = {name: self._path(name, camera, sheet) for name in ("walk", "day")}
        for name, decodes in (("walk", 8), ("day", 8), ("day", 64)):
            self.note(f"{name}, {decodes} pages a frame")
            texture = VirtualTexture(model, self.device, budget=budget, decodes=decodes, tiles=tiles)
            with texture:
                self._add(self._row(texture, camera, paths[name]))
        self.rival_rows(model, sheet, list(paths.values()))
        if sheet is not None:
            self.format_rows(sheet)
        return self._rows

    def rival_rows(self, model: LightmapModel, sheet: SheetFrames | None, paths: Sequence["_Path"]) -> None:
        """Measures each rival on each path; blocks of a set without uncompressed lightmaps are left out."""
        hours = [shot.hour for path in paths for shot in path.shots.values()]
        for name in self._rival_names:
            if name in _BLOCKS and sheet is None:
                continue
            title = f"{RIVALS[name].title} resident" if name in _BLOCKS else _DECODERS[name].title
            self.note(title)
            try:
                rival = Blocks(name, sheet, hours) if name in _BLOCKS else _DECODERS[name](model, self.device)
            except WlmError as error:
                for path in paths:
                    self._add(self.missing_row(title, path.name, error))
                continue
            for path in paths:
                self._add(self._rival_row(rival, title, path))

    def format_rows(self, sheet: SheetFrames) -> None:
        """Measures the formats, on some of the uncompressed lightmaps."""
        self.note("formats")
        frames = sheet.frames[:: _EVERY if self.quick else 1].astype(np.float32)
        shared = unpack_rgb9e5(pack_rgb9e5(frames))
        for method, decoded in (("RGB9E5", shared), ("RGBA8", np.stack([_as_bytes(frame) for frame in frames]))):
            self._add(self.row("format", method, **_differences(decoded, frames, sheet.mask)))

    def _path(self, name: str, camera: Camera, sheet: SheetFrames | None) -> "_Path":
        count = (_WALK if name == "walk" else _DAY) // (_QUICK if self.quick else 1)
        hours = np.linspace(*_WALK_HOURS, count) if name == "walk" else np.arange(count) * 24.0 / count
        # A third of a turn in a day: the camera is almost still.
        places = np.arange(count) / count * (1.0 if name == "walk" else 1.0 / 3.0)
        every = _QUICK_SCORED if self.quick else _SCORED
        shots = {}
        if sheet is not None:
            nearest = nearest_valid(sheet.mask)
            for frame in range(every // 2, count, every):
                shots[frame] = _Shot(float(hours[frame]), camera(float(places[frame])), sheet, nearest, self.device)
        return _Path(name, hours.tolist(), places.tolist(), every, shots)

    def _row(self, texture: VirtualTexture, camera: Camera, path: "_Path") -> Row:
        model, whole = texture.model, None
        if path.shots:
            whole = VirtualTexture(model, self.device, budget=_ALL, decodes=1024, tolerance=1e-6)
        for _ in range(_WARMUP * (1 if self.quick else 8)):
            texture.frame(path.hours[0], *camera(path.places[0]))
            texture.wait(0.1)
        cycles = _WAIT_CYCLES if path.shots else _PACE_CYCLES  # the large set loads tiles
        times, hosts, decoded, visible = [], [], [], []
        shares, errors = _Shares(), _Errors()
        stages: dict[str, list[float]] = {}
        for frame, (hour, place) in enumerate(zip(path.hours, path.places, strict=True)):
            view = camera(place)
            if frame % path.every == 1:
                self._time_stages(texture, hour, view, stages)
            else:
                device_ms, host_ms = self._timed(lambda hour=hour, view=view: texture.frame(hour, *view), cycles)
                times.append(device_ms)
                hosts.append(host_ms)
            report = texture.report()
            decoded.append(report["decoded"])
            visible.append(report["visible"])
            if frame % path.every == path.every // 2:
                reading = texture.sample(*view)
                shares.add(reading, texture.tolerance)
                if whole is not None:
                    best = _all_decoded(whole, hour, view)
                    errors.add(path.shots[frame], *(light[::_SPARSE, ::_SPARSE] for light in (reading.light, best)))
        full = {"memory_full": sum(own.memory_bytes for own in model.sheets.values()) / 2**20}
        return self.row(
            "virtual texture",
            f"{path.name}, {texture.decodes} pages a frame",
            self._notes(path),
            **_frame_times(times),
            host_ms=float(np.mean(hosts)),
            host_ms_p95=float(np.percentile(hosts, 95)),
            host_ms_max=float(np.max(hosts)),
            **{f"{name}_ms": float(np.nanmean(values)) for name, values in stages.items()},
            pages_visible=float(np.mean(visible)),
            pages_decoded=float(np.mean(decoded)),
            pages_decoded_max=float(np.max(decoded)),
            **_memory(report["memory"]),
            **full,
            **shares.figures(),
            **errors.figures(),
        )

    def _rival_row(self, rival: EveryFrame | Blocks, title: str, path: "_Path") -> Row:
        times, errors = [], _Errors()
        for frame, hour in enumerate(path.hours):
            work = rival.prepare(hour)
            times.append(0.0 if work is None else self._timed(work)[0])
            if frame in path.shots:
                errors.add(path.shots[frame], path.shots[frame].read(rival.light(hour)))
        # The first frame fills memory.
        figures = _frame_times(times[1:]) | _memory(rival.memory) | errors.figures()
        return self.row(title, path.name, self._notes(path), **figures)

    def _notes(self, path: "_Path") -> str:
        return f"{len(path.hours)} frames of {self.size[1]}x{self.size[0]} pixels"

    def _timed(self, call: Callable[[], None], cycles: int = _WAIT_CYCLES) -> tuple[float, float]:
        """Returns the milliseconds of a call on the device, and those of the host to queue it.

        The first are NaN if the host took longer than a wait of so many cycles, so that the device waited for it.
        """
        if self.device == "cpu":
            start = time.perf_counter()
            call()
            duration = 1e3 * (time.perf_counter() - start)
            return duration, duration
        with interop.stream(self.device) as stream:
            idle, begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(3))
            torch.cuda.synchronize()
            start = time.perf_counter()
            idle.record(stream)
            torch.cuda._sleep(cycles)
            begin.record(stream)
            queued = time.perf_counter()
            call()
            end.record(stream)
            done = time.perf_counter()
            end.synchronize()
            in_time = 1e3 * (done - start) < idle.elapsed_time(begin)
            return begin.elapsed_time(end) if in_time else np.nan, 1e3 * (done - queued)

    def _time_stages(self, texture: VirtualTexture, hour: float, view: View, times: dict[str, list[float]]) -> None:
        """Draws a frame stage by stage, and adds the milliseconds of each stage to `times`."""

        def step() -> None:
            for name, stage in texture.stages.items():
                times.setdefault(name, []).append(self._timed(stage)[0])

        with mock.patch.object(texture, "_step", lambda: None):
            times.setdefault("feedback", []).append(self._timed(lambda: texture.frame(hour, *view))[0])
        with mock.patch.object(texture, "_step", step):
            texture.frame(hour, *view)


def _all_decoded(whole: VirtualTexture, hour: float, view: View) -> np.ndarray:
    """Returns the light of a view from a texture that has all pages of the view at its time."""
    for _ in range(64):  # every pixel takes a turn
        whole.frame(hour, *view)
    return whole.sample(*view).light


def _frame_times(times: Sequence[float]) -> dict[str, float]:
    mean, p95, most = np.nanmean(times), np.nanpercentile(times, 95), np.nanmax(times)
    return {"frame_ms": float(mean), "frame_ms_p95": float(p95), "frame_ms_max": float(most)}


def _memory(parts: Mapping[str, int]) -> dict[str, float]:
    """Returns the figures of memory in MiB, by part and in total."""
    figures = {f"{name}_memory": size / 2**20 for name, size in parts.items()}
    return figures | {"memory": sum(figures.values())}


class _Shares:
    """Counts the pixels that show what they need, and averages the change of light since pages were decoded."""

    def __init__(self) -> None:
        self._counts = np.zeros(3)
        self._change: list[np.ndarray] = []

    def add(self, reading: Reading, tolerance: float) -> None:
        lit = reading.coarser >= 0
        now = lit & (reading.change <= tolerance)
        self._counts += [lit.sum(), (now & (reading.coarser == 0)).sum(), (now & (reading.coarser <= 1)).sum()]
        self._change.append(reading.change[lit])

    def figures(self) -> dict[str, float]:
        lit, current, nearly = self._counts
        if not lit:
            return {}
        change = np.concatenate(self._change)
        stale = {"staleness": float(change.mean()), "staleness_p95": float(np.percentile(change, 95))}
        return {"current": current / lit, "nearly_current": nearly / lit, **stale}


@dataclass(frozen=True)
class _Path:
    """A path of a camera: the hour and the place of each frame, and the frames whose views are scored.

    Attributes:
        name: "walk" or "day".
        every: One of so many frames is scored.
        shots: The scored views by their frames; empty if errors are not measured.
    """

    name: str
    hours: list[float]
    places: list[float]
    every: int
    shots: "dict[int, _Shot]"


class _Shot:
    """A view under the uncompressed lightmaps, at a quarter of its pixels.

    Attributes:
        hour: Time of the view.
        picture: [h, w, 3], sRGB in [0, 1].
        lit: bool [h, w], the pixels with a surface.
    """

    def __init__(
        self, hour: float, view: View, sheet: SheetFrames, nearest: tuple[np.ndarray, np.ndarray], device: str
    ) -> None:
        number, uv, slopes = (wp.to_torch(part)[::_SPARSE, ::_SPARSE] for part in view)
        self.hour, self.lit, self._uv = hour, (number >= 0).cpu().numpy(), uv.contiguous()
        # The level of a square pixel with the longer side: the virtual texture's, not that of an ellipse.
        height, width = sheet.mask.shape
        size = torch.tensor([width, height], device=device)
        texels = torch.linalg.vector_norm(slopes.reshape(*uv.shape, 2) * size[:, None], dim=2).amax(2)
        self._slopes = torch.diag_embed(texels[..., None] / size)
        before, after, share = neighbours(sheet.times, hour)
        frame = (1.0 - share) * sheet.frames[before] + share * sheet.frames[after]
        self._gain, self._device = np.float32(exposure(frame[sheet.mask])), device
        self.picture = self.shown(self.read(frame[nearest].astype(np.float32)))

    def read(self, image: np.ndarray) -> np.ndarray:
        """Reads the view's light from a map, float32 [H, W, 3], trilinearly."""
        light = raster.texture(torch.tensor(image, device=self._device), self._uv, derivatives=self._slopes)
        return light.cpu().numpy()

    def shown(self, light: np.ndarray) -> np.ndarray:
        """Returns light of the view's pixels as a screen shows it; pixels without a surface are black."""
        return to_srgb(filmic(np.maximum(light, 0.0) * self._gain)) * self.lit[..., None]


class _Errors:
    """Compares views with the uncompressed lightmaps, and with views in which every page is decoded."""

    def __init__(self) -> None:
        self._views = Pictures()
        self._sums, self._count = np.zeros(2), 0

    def add(self, shot: _Shot, light: np.ndarray, whole: np.ndarray | None = None) -> None:
        """Adds a view: its light and, if it is known, its light with all pages decoded."""
        own = shot.shown(light)
        self._views.add(shot.picture, own, shot.lit)
        if whole is not None and shot.lit.any():
            best = shot.shown(whole)
            pairs = ((best, shot.picture), (own, best))
            self._sums += [np.square(a[shot.lit] - b[shot.lit], dtype=np.float64).sum() for a, b in pairs]
            self._count += 3 * int(shot.lit.sum())

    def figures(self) -> dict[str, float]:
        figures = {"view_psnr": self._views.psnr, "view_flip": self._views.flip}
        if self._count:
            best, cached = (psnr_from_mse(total / self._count, 1.0) for total in self._sums)
            figures |= {"gain": self._views.psnr - best, "cached_psnr": cached}
        return figures


# ---- formats ----


def _as_bytes(frame: np.ndarray) -> np.ndarray:
    """Encodes a lightmap with 8 bits per channel relative to the largest colour of each page, and decodes it."""
    colour, out = np.maximum(frame, 0.0) ** (1.0 / _GAMMA), np.empty_like(frame)
    for y in range(0, len(frame), TILE):
        for x in range(0, frame.shape[1], TILE):
            page = colour[max(y - _BORDER, 0) : y + TILE + _BORDER, max(x - _BORDER, 0) : x + TILE + _BORDER]
            bound = max(float(page.max()), 1e-30)
            part = np.s_[y : y + TILE, x : x + TILE]
            out[part] = (np.rint(colour[part] / bound * 255.0) / 255.0 * bound) ** _GAMMA
    return out


def _differences(decoded: np.ndarray, exact: np.ndarray, mask: np.ndarray) -> dict[str, float]:
    """Returns the PSNR of lightmaps over the valid texels, relative to their range, and the error of a texel."""
    found, wanted = decoded[:, mask].astype(np.float64), exact[:, mask].astype(np.float64)
    error = found - wanted
    brightest = wanted.max(2, keepdims=True)
    relative = np.divide(error, brightest, out=np.zeros_like(error), where=brightest > 0)
    return {
        "psnr": psnr_from_mse(float(np.square(error).mean()), float(np.ptp(wanted))),
        "texel_rms": float(np.sqrt(np.square(relative).mean())),
    }


# ---- cameras ----


def _arrays(sheet: torch.Tensor, uv: torch.Tensor, derivative: torch.Tensor) -> View:
    sheet, uv, derivative = (each.contiguous() for each in (sheet, uv, derivative))
    return wp.from_torch(sheet), wp.from_torch(uv, dtype=wp.vec2), wp.from_torch(derivative, dtype=wp.vec4)


class _RoomCamera:
    """Walks in a circle inside the box of a set's mesh and looks outward, slowly from side to side."""

    def __init__(self, lightmaps: LightmapSet, size: tuple[int, int], device: str) -> None:
        mesh = read_geometry(lightmaps.light.mesh)
        low, high = mesh.box
        self._middle, self._half, self._size = (low + high) / 2, (high - low) / 2, size
        self._position = torch.tensor(mesh.position, dtype=torch.float32, device=device)
        self._triangle = torch.tensor(mesh.triangle.astype(np.int32), device=device)
        self._uv = torch.tensor(mesh.uv, dtype=torch.float32, device=device)

    def __call__(self, place: float) -> View:
        angle = 2.0 * np.pi * place
        eye = self._middle + self._half * [0.3 * np.cos(angle), 0.1, 0.3 * np.sin(angle)]
        turn = angle + 0.7 * np.sin(3.0 * angle)
        forward = np.array([np.cos(turn), -0.15, np.sin(turn)])
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        offset = self._position - torch.tensor(eye, dtype=torch.float32, device=self._position.device)
        height, width = self._size
        axes = (right, np.cross(right, forward), forward)
        # No matrix product, which would round equal vertices to different pixels.
        x, y, w = (sum(offset[:, i] * float(axis[i]) for i in range(3)) for axis in axes)
        near = 1e-3 * float(self._half.max())
        clip = torch.stack([x, y * (width / height), w - 2.0 * near, w], 1)
        drawn = raster.rasterize(clip, self._triangle, height, width, cull=True, derivative=True)
        uv = raster.interpolate(self._uv, self._triangle, drawn)
        corner = self._uv[self._triangle[drawn.triangle.clamp(min=0)].long()]
        edges = (corner[..., :2, :] - corner[..., 2:, :]).movedim(-2, -1)
        slopes = torch.einsum("hwcb,hwbd->hwcd", edges, drawn.derivative.reshape(height, width, 2, 2))
        sheet = torch.where(drawn.triangle >= 0, 0, -1).to(torch.int32)
        return _arrays(sheet, uv, slopes.reshape(height, width, 4))


class _PlainCamera:
    """Walks over a plain of 2 x 2 sheets at eye height, in a circle, and looks ahead."""

    def __init__(self, side: int, size: tuple[int, int], device: str) -> None:
        self._size, self._device = size, device
        self._metres = _METRES * side / _LARGE

    def __call__(self, place: float) -> View:
        height, width = self._size
        angle = 2.0 * np.pi * place
        # 600 frames: 10 seconds of a quick run, 40 m.
        eye, turn = 6.4 * np.array([np.cos(angle), np.sin(angle)]), angle + np.pi / 2
        column = (torch.arange(width + 1, device=self._device) + 0.5 - width / 2) / (width / 2)
        row = (torch.arange(height + 1, device=self._device) + 0.5 - height / 2) / (width / 2)
        down = row[:, None] + 0.2
        distance = torch.where(down > 0.0, 1.7 / down, torch.inf)
        ahead, aside = distance, distance * column[None]
        x = float(eye[0]) + ahead * float(np.cos(turn)) - aside * float(np.sin(turn))
        y = float(eye[1]) + ahead * float(np.sin(turn)) + aside * float(np.cos(turn))
        point = torch.stack([x, y.expand_as(x)], 2) / self._metres
        slopes = torch.stack([point[:-1, 1:] - point[:-1, :-1], point[1:, :-1] - point[:-1, :-1]], 3)
        point = point[:-1, :-1]
        inside = (point.abs() < 1.0).all(2) & torch.isfinite(slopes).all((2, 3))
        number = (point[..., 0] >= 0).to(torch.int32) + 2 * (point[..., 1] >= 0).to(torch.int32)
        sheet = torch.where(inside, number, -1).to(torch.int32)
        return _arrays(
            sheet, torch.where(inside[..., None], point - point.floor(), 0.0), slopes.reshape(height, width, 4)
        )


# ---- the large set ----


def large_model(side: int) -> LightmapModel:
    """Makes a model of four sheets of dynamic tiles with random maps and networks, for profile M at 26 times."""
    times = np.concatenate([np.arange(24.0), [18.45, 18.55]])
    times.sort()
    profile = Profile.load("M")
    sheets = {Sheet(atlas=str(number)): random_sheet(side, times, number, profile) for number in range(_SHEETS)}
    first = next(iter(sheets.values()))
    return LightmapModel("large", "0123456789abcdef", first.profile, sheets)


def random_sheet(side: int, times: np.ndarray, seed: int, profile: Profile) -> SheetModel:
    """Makes a sheet of dynamic tiles with random maps and networks.

    Args:
        side: Texels along each side, a multiple of 128.
        times: Stored times, hours of a day.
        seed: Seed of the random numbers.
        profile: Sizes of maps and networks.
    """
    random, profile = np.random.default_rng(seed), profile.for_times(len(times))
    count = (side // TILE) ** 2
    kind = np.full(count, TileKind.DYNAMIC, np.uint8)
    table = part_table(profile, kind, len(times))
    parts: dict[str, np.ndarray] = {name: np.zeros(part.shape, _dtype(part.dtype)) for name, part in table.items()}
    # Endpoints that lie close together, and the same in all slices: a lightmap is smooth, and changes slowly.
    parts["uv"] = _blocks(random, parts["uv"].shape[:-1])
    slices = _blocks(random, (count, 1, *parts["uvt"].shape[2:-1]))
    parts["uvt"] = np.ascontiguousarray(np.broadcast_to(slices, parts["uvt"].shape))
    for name in ("ut", "vt"):
        rows, columns = parts[name].shape[1:3]
        steps = random.integers(-3, 4, (count, rows, columns, 2)).cumsum(1)
        parts[name] = np.clip(128 + steps - steps.mean(1, keepdims=True), 0, 255).astype(np.uint8)
    parts["net"] = (random.standard_normal(parts["net"].shape) * 0.25).astype(np.float16)
    sun = np.clip(np.sin((times - 6.0) / 12.0 * np.pi), 0.0, None)
    lamp = (times > 18.5) | (times < 5.5)
    parts["scale"][:] = (120.0 + 30.0 * sun + 12.0 * lamp)[None, :, None].astype(np.uint8)
    parts["peak"][:] = 200
    parts["affine"][:, 0], parts["affine"][:, 1] = 1.0, 0.15
    mask = np.ones((side, side), bool)
    return SheetModel("large", side, side, times, 24.0, profile, mask, kind, **parts)


def _dtype(dtype: Any) -> Any:
    return dtype[0] if isinstance(dtype, tuple) else dtype


def _blocks(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Returns random BC7 blocks of mode 6, uint8 [*shape, 16]; the texels of a block are alike."""
    middle = random.integers(96, 160, (*shape, 1, 4))
    ends = np.clip(middle + random.integers(-16, 17, (*shape, 2, 4)), 0, 255)
    ends = ends & ~1 | random.integers(0, 2, (*shape, 2, 1))
    return pack_mode6(ends.astype(np.uint8), random.integers(0, 16, (*shape, 16), np.uint8))
