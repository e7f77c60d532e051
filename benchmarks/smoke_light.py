"""Images of smoke: guiding maps, six-way lightmaps and their weights, each against a finer march, and a frame."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch.nn.functional import interpolate

from benchmarks.rows import Row
from benchmarks.smoke_setup import SmokeBench
from wlm.fluid.volume import DensityVolume
from wlm.metrics.error import psnr_from_mse
from wlm.smoke.camera import RULES, Camera
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.coarse import Guide, guide
from wlm.smoke.march.fine import bake, lit
from wlm.smoke.scene import CameraSettings, Scene, load_scene, make_camera, obstacle_mesh
from wlm.smoke.shading import Light, obstacle_visibility
from wlm.smoke.simulation import make_solver, volume_of
from wlm.smoke.synthetic import make_plume
from wlm.smoke.transport.lights import PointLight
from wlm.smoke.transport.orders import scatter
from wlm.smoke.transport.tracing import trace
from wlm.view.smoke import Drawing
from wlm.view.smoke_run import AllOrders, SixWays
from wlm_kernels.smoke.settings import March

_CLOUD = "cloud"
_DEPTH = 8.0  # optical, through the cloud's box at density 1
_OCTAVES = range(2, 7)
_GAIN = 0.6  # of an octave over the one before
_HALF_GUIDE = (5, 10, 20)  # steps at which 16 bits are looked at
_HALF_SIX = 0.5
_PLUME = 14.0  # the plume's extinction, over its box
_LIGHTS = 12
_WEIGHT_STEP = 1.0
_JITTER = 1.0
_PATHS = 64  # a pixel, on a GPU
_FEW_PATHS = 4


def make_cloud(n: int, device: str, seed: int = 0) -> torch.Tensor:
    """A billowing column: octaves of noise, cut off. The random numbers are the CPU's, so that all devices agree.

    Args:
        n: Voxels along an edge.
        device: Where it is made.
        seed: Of the noise.

    Returns:
        float32 [n, n, n], in [0, 1].
    """
    random = np.random.default_rng(seed)
    noise = torch.zeros((1, 1, n, n, n), device=device)
    for octave in _OCTAVES:
        k = min(2**octave + 1, n)
        coarse = torch.from_numpy(random.standard_normal((1, 1, k, k, k), np.float32)).to(device)
        noise += _GAIN**octave * interpolate(coarse, (n, n, n), mode="trilinear", align_corners=True)
    at = torch.linspace(-1.0, 1.0, n, device=device)
    x, y, z = torch.meshgrid(at, at, at, indexing="ij")
    radius = ((x - 0.2 * y) ** 2 + z**2).sqrt() / (0.35 + 0.125 * (y + 1.0))
    return ((1.5 * noise[0, 0] + 0.9 - radius).clamp(0.0, 1.0) * (y.abs() < 0.95)).contiguous()


def guide_rows(bench: SmokeBench) -> list[Row]:
    """Guiding maps by their step, with marches to the lights shared or each pixel's own, against a fine march."""
    bench.note("guide")
    sizes = bench.sizes
    volumes, camera = _cloud(bench)
    fine = guide(volumes["float32"], camera, March(sizes.exact, jitter=0.0, cutoff=0.0), shared=False)
    cases = {("shared", step, "float32"): volumes["float32"] for step in sizes.guide_shared}
    cases |= {("alone", step, "float32"): volumes["float32"] for step in sizes.guide_alone}
    cases |= {("shared", step, "float16"): volumes["float16"] for step in _HALF_GUIDE}
    calls = {
        (way, step, storage): partial(guide, volume, camera, March(float(step), jitter=_JITTER), shared=way == "shared")
        for (way, step, storage), volume in cases.items()
    }
    # Calls of seconds get fewer samples than those of milliseconds.
    long = {key: call for key, call in calls.items() if key[0] == "alone" and key[1] < 5}
    short = {key: call for key, call in calls.items() if key not in long}
    times = bench.time(short) | bench.time(long, few=True)
    # Python takes longer to launch it than it takes itself: in a frame that is one graph, this is its time.
    cuda = bench.device != "cpu"
    replays = bench.time({key: bench.replay(call) for key, call in short.items()}) if cuda else {}
    rows = []
    for key, volume in cases.items():
        way, step, storage = key
        shared = way == "shared"
        jittered = guide(volume, camera, March(float(step), jitter=_JITTER), shared=shared)
        still = guide(volume, camera, March(float(step), jitter=0.0), shared=shared)
        option = f"h {step:g}" + (", each pixel alone" if way == "alone" else "")
        option += ", float16" if storage == "float16" else ""
        row = bench.row(
            "guide",
            option,
            scene=_CLOUD,
            timing=times[key],
            replay_ms=replays[key].median_ms if key in replays else None,
            psnr=_psnr(jittered, fine),
            light_rms=_relative(jittered.light, fine.light),
            still_light_rms=_relative(still.light, fine.light),
            transparency_rms=_rms(jittered.transparency - fine.transparency),
            max_error=float((jittered.light - fine.light).abs().max()),
            voxels=sizes.cloud,
            pixels=sizes.resolution,
        )
        rows.append(row)
    return rows


def six_rows(bench: SmokeBench) -> list[Row]:
    """The fine march of six-way lightmaps by its step, with its own estimate of its error."""
    bench.note("six ways")
    sizes = bench.sizes
    volumes, camera = _cloud(bench)
    cases = {f"step {step:g}": (volumes["float32"], step) for step in sizes.six}
    cases[f"step {_HALF_SIX:g}, float16"] = (volumes["float16"], _HALF_SIX)
    calls = {name: partial(bake, volume, camera, step=step, estimate=False) for name, (volume, step) in cases.items()}
    times = bench.time(calls, few=True)
    finest = bake(volumes["float32"], camera, step=sizes.six[-1], estimate=False).lightmaps
    rows = []
    for name, (volume, step) in cases.items():
        six = bake(volume, camera, step=step)
        is_finest = step == sizes.six[-1]
        row = bench.row(
            "six ways",
            name,
            "the finest" if is_finest else "",
            scene=_CLOUD,
            timing=times[name],
            halving_rms=six.error.rms,
            finest_rms=None if is_finest else _relative(six.lightmaps, finest),
            max_error=six.error.largest,
            voxels=sizes.cloud,
            pixels=sizes.resolution,
        )
        rows.append(row)
    return rows


def weight_rows(bench: SmokeBench) -> list[Row]:
    """Rules that weight six lightmaps, against a march to each of some oblique lights, on the demo's plume."""
    bench.note("weights")
    volume = make_plume(hot=False, extinction=_PLUME, device=bench.device)
    size = volume.voxel * np.array(volume.shape)
    camera = make_camera(CameraSettings(resolution=bench.sizes.plume), volume.origin, size)
    six = bake(volume, camera, step=_WEIGHT_STEP, estimate=False)
    six = SixWay(six.lightmaps, None, camera=camera)
    lights = [tuple(map(float, toward)) for toward in _sphere(_LIGHTS)]
    exact = [lit(volume, camera, toward, step=_WEIGHT_STEP) for toward in lights]
    rows = []
    for rule in RULES:
        weighted = [six.shade([Light(toward)], rule=rule)[..., 0] for toward in lights]
        pairs = list(zip(weighted, exact, strict=True))
        bias = [float(w.double().mean() / e.double().mean()) - 1.0 for w, e in pairs]
        row = bench.row(
            "weights",
            rule,
            scene="plume",
            bias=float(np.mean(bias)),
            bias_min=min(bias),
            bias_max=max(bias),
            rms=_relative(torch.stack(weighted), torch.stack(exact)),
            worst_rms=max(_relative(w, e) for w, e in pairs),
            max_error=max(float((w - e).abs().max()) for w, e in pairs),
            lights=_LIGHTS,
        )
        rows.append(row)
    return rows


def frame_rows(bench: SmokeBench) -> list[Row]:
    """A frame of a scene by stages: the air alone, the whole simulation, the guiding map, shadows and shading; all that
    `wlm smoke run` does after the simulation; light of a point in the smoke, of fire, and of paths."""
    sizes, device = bench.sizes, bench.device
    scene = load_scene("jet-sphere").scaled(sizes.scale)
    scene = scene.model_copy(
        update={"camera": scene.camera.model_copy(update={"resolution": sizes.resolution}), "frames": sizes.frames + 1}
    )
    bench.note(f"frame: {sizes.frames} frames before it")
    steps = scene.steps // scene.smoke.substeps
    in_bricks = scene.model_copy(update={"smoke": scene.smoke.model_copy(update={"bricks": True})})
    dense, bricked, air = (make_solver(settings, device=device) for settings in (scene, in_bricks, scene))
    air.step(1)
    for solver in (dense, bricked):
        solver.step(steps * sizes.frames)
        solver.check()
    volume, camera = volume_of(scene, dense), make_camera(scene.camera, scene.grid.origin, scene.grid.size)
    # The smoke that the frame shows stays as it is while the simulation goes on.
    volume = DensityVolume(volume.density.clone(), volume.extinction, volume.voxel, volume.origin)
    bench.note("frame: its stages")
    surface = guide(volume, camera)
    six = bake(volume, camera, estimate=False)
    lights = [settings.light() for settings in scene.lights]
    corners, triangles, _ = obstacle_mesh(scene.obstacles, scene.time(sizes.frames))
    corners, triangles = (torch.from_numpy(part).to(device) for part in (corners, triangles))

    def shadows() -> list[Light]:
        return [
            Light(
                light.toward,
                light.irradiance,
                obstacle_visibility(surface.depth, camera, light.toward, corners, triangles),
            )
            for light in lights
        ]

    shadowed = shadows()

    def shading() -> torch.Tensor:
        return six.shade(shadowed, background=scene.background)

    calls = {
        "air alone": lambda: [air.lattice.step(scene.smoke.substeps) for _ in range(steps)],
        "simulation": lambda: dense.step(steps),
        "simulation, smoke in bricks": lambda: bricked.step(steps),
        "guide": lambda: guide(volume, camera),
        "obstacles' shadows": shadows,
        "weights and background": shading,
    }
    times = bench.time(calls, few=device == "cpu")
    march = partial(bake, volume, camera, step=_HALF_SIX, estimate=False)
    times |= bench.time({"six ways by march": march}, few=True)
    drawn = _drawn(scene, volume, camera, scene.time(sizes.frames), device)
    times |= bench.time({name: bench.replay(call) for name, call in drawn.items()}, few=device == "cpu")
    paths = _FEW_PATHS if device == "cpu" else _PATHS
    times |= bench.time(_traced(volume, camera, paths), few=True)
    air_cells, voxels = ("x".join(map(str, shape)) for shape in (scene.grid.cells, scene.grid.shape))
    pixels = f"{camera.width}x{camera.height}"
    of = {
        "air alone": f"{air_cells}, {scene.steps} steps",
        "simulation": f"{voxels}, {steps} steps of smoke",
        "simulation, smoke in bricks": f"{100 * bricked.active_cells / np.prod(bricked.shape):.3g}% of {voxels}",
        "guide": f"{pixels}, h 10",
        "obstacles' shadows": f"{len(lights)} lights",
        "weights and background": pixels,
        "six ways by march": f"{pixels}, step {_HALF_SIX:g}",
        **dict.fromkeys(drawn, f"{pixels}, a graph on a GPU"),
        **dict.fromkeys(_traced(volume, camera, paths), f"{pixels}, {paths} samples"),
    }
    rows = [bench.row("frame", name, of[name], scene="jet-sphere", timing=timing) for name, timing in times.items()]
    parts = ("simulation", "guide", "obstacles' shadows", "weights and background")
    total = sum(times[name].median_ms for name in parts)
    figures = {"time_ms": total, "frame_rate": 1e3 / total}
    notes = "simulation, guide, shadows, weights"
    return [*rows, bench.row("frame", "all but the network", notes, scene="jet-sphere", **figures)]


def _drawn(
    scene: Scene, volume: DensityVolume, camera: Camera, time: float, device: str
) -> dict[str, Callable[[], object]]:
    """What lights a frame, by its name: pictures with shadows and obstacles, and light that is found by diffusion."""
    lights = [settings.light() for settings in scene.lights]
    parts = {"background": scene.background, "obstacles": scene.obstacles}
    drawing = Drawing(camera, lights, albedo=scene.smoke.albedo, **parts, device=device)
    drawing.move(time)
    lamp = PointLight(tuple(map(float, volume.centre)))
    hot = replace(volume, temperature=volume.density, emission=1.0)
    six, every = SixWays(), AllOrders(scene.smoke.albedo)
    return {
        "six ways, drawn": lambda: drawing(six(volume, camera, lights)),
        "all orders, drawn": lambda: drawing(every(volume, camera, lights)),
        "all orders, no obstacle": lambda: every(volume, camera, lights).shade(background=scene.background),
        "all orders of a point light": lambda: scatter(volume, camera, [lamp], scene.smoke.albedo),
        "all orders of fire": lambda: scatter(hot, camera, [], scene.smoke.albedo),
    }


def _traced(volume: DensityVolume, camera: Camera, paths: int) -> dict[str, Callable[[], object]]:
    """Six planes by path tracing, under lights along the camera's axes."""
    six = [Light(tuple(map(float, sign * axis)), (4 * math.pi,) * 3) for axis in camera.axes for sign in (1.0, -1.0)]
    settings = {"samples": paths, "orders": 0}
    return {
        "six planes by paths, one order": lambda: trace(volume, camera, six, highest=1, **settings),
        "six planes by paths, all orders": lambda: trace(volume, camera, six, **settings),
    }


def _cloud(bench: SmokeBench) -> tuple[dict[str, DensityVolume], Camera]:
    """The cloud in both storages, and a camera that looks down on it from aside."""
    n, pixels = bench.sizes.cloud, bench.sizes.resolution
    density = make_cloud(n, bench.device)
    volumes = {
        name: DensityVolume(density.to(kind), extinction=_DEPTH / n)
        for name, kind in (("float32", torch.float32), ("float16", torch.float16))
    }
    centre = volumes["float32"].centre
    eye = centre + n * np.array([1.6, 0.9, 2.2])
    return volumes, Camera.look_at(eye, centre, extent=1.15 * n, height=pixels, width=pixels)


def _sphere(count: int) -> np.ndarray:
    """Directions spread evenly on a sphere, none along an axis: the points of Fibonacci's spiral, [count, 3]."""
    k = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    across = np.sqrt(1.0 - height**2)
    return np.stack([across * np.cos(turn), height, across * np.sin(turn)], -1)


def _rms(values: torch.Tensor) -> float:
    return float(values.double().square().mean().sqrt())


def _relative(values: torch.Tensor, exact: torch.Tensor) -> float:
    """The RMS difference over the RMS of the exact values."""
    return _rms(values.double() - exact.double()) / _rms(exact)


def _psnr(coarse: Guide, fine: Guide) -> float:
    """Of the light, whose greatest value is the peak."""
    return psnr_from_mse(_rms(coarse.light - fine.light) ** 2, float(fine.light.max()))
