"""Smoke as it is seen: guiding maps, six-way lightmaps and their weights, each against a finer march, and a frame."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch.nn.functional import interpolate

from wlm.bench.runner import Row
from wlm.bench.smoke_setup import Bench, percent, row
from wlm.fluid.volume import DensityVolume
from wlm.interop import StepGraph
from wlm.smoke.baking import bake, lit
from wlm.smoke.camera import RULES, Camera
from wlm.smoke.guiding import Guide, guide
from wlm.smoke.learn.synthetic import make_plume
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.scene import CameraSettings, load_scene, make_camera, obstacle_mesh
from wlm.smoke.shading import Light, obstacle_visibility
from wlm.smoke.simulation import make_solver, volume_of
from wlm_kernels.smoke.settings import March

__all__ = ["frame_rows", "guide_rows", "make_cloud", "six_rows", "weight_rows"]

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


def guide_rows(bench: Bench) -> list[Row]:
    """Guiding maps by their step, with marches to the lights shared or each pixel's own, against a fine march."""
    bench.note("guide")
    sizes = bench.sizes
    volumes, camera = _cloud(bench)
    fine = guide(volumes["float32"], camera, March(sizes.exact, jitter=0.0, cutoff=0.0), shared=False)
    cases = {("shared", step, "float32"): volumes["float32"] for step in sizes.guide_shared}
    cases |= {("alone", step, "float32"): volumes["float32"] for step in sizes.guide_alone}
    cases |= {("shared", step, "float16"): volumes["float16"] for step in _HALF_GUIDE}
    calls = {
        key: _guide_call(volume, camera, step=float(key[1]), shared=key[0] == "shared") for key, volume in cases.items()
    }
    # What takes a second is not to be waited for as often as what takes a millisecond.
    dear = {key: call for key, call in calls.items() if key[0] == "alone" and key[1] < 5}
    times = bench.time({key: call for key, call in calls.items() if key not in dear})
    times |= bench.time(dear, few=True)
    # What Python takes to launch it is more than it takes itself: in a frame that is one graph, this is its time.
    replays = {key: StepGraph(call, bench.device, warmup=1) for key, call in calls.items() if key not in dear}
    alone = {} if bench.device == "cpu" else bench.time(replays)
    rows = []
    for key, volume in cases.items():
        way, step, storage = key
        shared = way == "shared"
        found = guide(volume, camera, March(float(step), jitter=_JITTER), shared=shared)
        still = guide(volume, camera, March(float(step), jitter=0.0), shared=shared)
        off = (found.light - fine.light).double()
        figures = {
            "voxels": f"{sizes.cloud}³",
            "pixels": f"{sizes.resolution}²",
            "light RMS": percent(_relative(found.light, fine.light)),
            "without jitter": percent(_relative(still.light, fine.light)),
            "transparency RMS": f"{_rms(found.transparency - fine.transparency):.3g}",
        }
        if key in alone:
            figures["replayed, ms"] = f"{alone[key].median_ms:.3g}"
        option = f"h {step:g}" + (", each pixel alone" if way == "alone" else "")
        option += ", float16" if storage == "float16" else ""
        scores = {"psnr": _psnr(found, fine), "max_error": float(off.abs().max())}
        rows.append(row(_CLOUD, "guide", option, figures, timing=times[key], **scores))
    return rows


def six_rows(bench: Bench) -> list[Row]:
    """The fine march of six-way lightmaps by its step, with what it says of its own error."""
    bench.note("six ways")
    sizes = bench.sizes
    volumes, camera = _cloud(bench)
    cases = {f"step {step:g}": (volumes["float32"], step) for step in sizes.six}
    cases[f"step {_HALF_SIX:g}, float16"] = (volumes["float16"], _HALF_SIX)
    calls = {name: _six_call(*case, camera) for name, case in cases.items()}
    times = bench.time(calls, few=True)
    finest = bake(volumes["float32"], camera, step=sizes.six[-1], estimate=False).lightmaps
    rows = []
    for name, (volume, step) in cases.items():
        made = bake(volume, camera, step=step)
        figures = {
            "voxels": f"{sizes.cloud}³",
            "pixels": f"{sizes.resolution}²",
            "RMS by halving": percent(made.error.rms),
        }
        note = ""
        if step != sizes.six[-1]:
            figures["RMS from the finest"] = percent(_relative(made.lightmaps, finest))
        else:
            note = "the finest"
        rows.append(row(_CLOUD, "six ways", name, figures, note, timing=times[name], max_error=made.error.largest))
    return rows


def weight_rows(bench: Bench) -> list[Row]:
    """Rules that weigh six lightmaps, against a march to each of some oblique lights, on the demo's plume."""
    bench.note("weights")
    volume = make_plume(hot=False, extinction=_PLUME, device=bench.device)
    size = volume.voxel * np.array(volume.shape)
    camera = make_camera(CameraSettings(resolution=bench.sizes.plume), volume.origin, size)
    six = bake(volume, camera, step=_WEIGHT_STEP, estimate=False)
    six = SixWay(six.lightmaps, None, camera=camera)
    lights = [tuple(map(float, toward)) for toward in _round(_LIGHTS)]
    exact = [lit(volume, camera, toward, step=_WEIGHT_STEP) for toward in lights]
    rows = []
    for rule in RULES:
        weighed = [six.shade([Light(toward)], rule=rule)[..., 0] for toward in lights]
        bias = [float(w.double().mean() / e.double().mean()) - 1.0 for w, e in zip(weighed, exact, strict=True)]
        each = [_relative(w, e) for w, e in zip(weighed, exact, strict=True)]
        figures = {
            "lights": str(_LIGHTS),
            "bias": f"{100 * float(np.mean(bias)):+.1f}%",
            "least": f"{100 * min(bias):+.1f}%",
            "most": f"{100 * max(bias):+.1f}%",
            "RMS": percent(_relative(torch.stack(weighed), torch.stack(exact))),
            "worst light's RMS": percent(max(each)),
        }
        off = max(float((w - e).abs().max()) for w, e in zip(weighed, exact, strict=True))
        rows.append(row("plume", "weights", rule, figures, max_error=off))
    return rows


def frame_rows(bench: Bench) -> list[Row]:
    """A frame of a scene by stages: the air alone, the whole simulation, the guiding map, shadows and shading."""
    sizes, device = bench.sizes, bench.device
    scene = load_scene("jet-sphere").scaled(sizes.scale)
    scene = scene.model_copy(
        update={"camera": scene.camera.model_copy(update={"resolution": sizes.resolution}), "frames": sizes.frames + 1}
    )
    bench.note(f"frame: {sizes.frames} frames before it")
    steps = scene.steps // scene.smoke.substeps
    in_bricks = scene.model_copy(update={"smoke": scene.smoke.model_copy(update={"bricks": True})})
    dense, bricked, air = (make_solver(one, device=device) for one in (scene, in_bricks, scene))
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
    lights = [given.light() for given in scene.lights]
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
    times |= bench.time({"six ways by march": _six_call(volume, _HALF_SIX, camera)}, few=True)
    air_cells, voxels = ("x".join(map(str, shape)) for shape in (scene.grid.cells, scene.grid.shape))
    pixels = f"{camera.width}x{camera.height}"
    sizes_of = {
        "air alone": f"{air_cells}, {scene.steps} steps",
        "simulation": f"{voxels}, {steps} steps of smoke",
        "simulation, smoke in bricks": f"{percent(bricked.active_cells / np.prod(bricked.shape))} of {voxels}",
        "guide": f"{pixels}, h 10",
        "obstacles' shadows": f"{len(lights)} lights",
        "weights and background": pixels,
        "six ways by march": f"{pixels}, step {_HALF_SIX:g}",
    }
    rows = [row("jet-sphere", "frame", name, {"of": sizes_of[name]}, timing=timing) for name, timing in times.items()]
    parts = ("simulation", "guide", "obstacles' shadows", "weights and background")
    total = sum(times[name].median_ms for name in parts)
    figures = {"of": "simulation, guide, shadows, weights", "frames/s": f"{1e3 / total:.3g}"}
    return [*rows, row("jet-sphere", "frame", "all but the network", figures, decode_ms=total)]


def _cloud(bench: Bench) -> tuple[dict[str, DensityVolume], Camera]:
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


def _guide_call(volume: DensityVolume, camera: Camera, step: float, shared: bool) -> Callable[[], Guide]:
    return lambda: guide(volume, camera, March(step, jitter=_JITTER), shared=shared)


def _six_call(volume: DensityVolume, step: float, camera: Camera) -> Callable[[], SixWay]:
    return lambda: bake(volume, camera, step=step, estimate=False)


def _round(count: int) -> np.ndarray:
    """Directions evenly round a sphere, none along an axis: the points of a spiral (Fibonacci's), [count, 3]."""
    k = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    across = np.sqrt(1.0 - height**2)
    return np.stack([across * np.cos(turn), height, across * np.sin(turn)], -1)


def _rms(values: torch.Tensor) -> float:
    return float(values.double().square().mean().sqrt())


def _relative(found: torch.Tensor, exact: torch.Tensor) -> float:
    """The RMS difference over the RMS of what is exact."""
    return _rms(found.double() - exact.double()) / _rms(exact)


def _psnr(found: Guide, fine: Guide) -> float:
    """Of the light, whose greatest value is the peak."""
    return 20.0 * float(np.log10(float(fine.light.max()) / _rms(found.light - fine.light)))
