"""The cases of `benchmarks.kernels`: calls of a frame or a fit, with the work that each cannot avoid.

Work is counted from the algorithm and not from the code: bytes of inputs read once and of outputs written once,
operations of networks and interpolation, exponentials of activations, and atomic additions. Addresses and conversions
count nothing. A case can be faster than its floor where it approximates exponentials or sums before it adds, as it does
on a CPU, or where it skips bricks without smoke.

"smoke, guide" is what a guide adds to a frame, whose marches share the marks of bricks with smoke; "smoke, guide and
marks" makes them, too, as "smoke, six ways" and "smoke, all orders" do.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
import warp as wp

from benchmarks.atlas import make_square
from benchmarks.lightmap import ALL, view_of_all_pages
from benchmarks.lightmap_run_time import random_sheet
from benchmarks.ops import make_sphere
from benchmarks.probe_speed import many_probes
from benchmarks.rivals.lightmap_torch import dynamic_targets
from benchmarks.rivals.whole_tiles import fast_decoder
from benchmarks.smoke import make_cloud
from wlm import interop, ops
from wlm.atlas.decode import Decoder as AtlasDecoder
from wlm.atlas.fit import compress as compress_atlas
from wlm.atlas.model import Profile as AtlasProfile
from wlm.fluid.lattice import Lattice
from wlm.fluid.solver import ways_of
from wlm.fluid.volume import DensityVolume
from wlm.lightmap.data import from_arrays
from wlm.lightmap.model import LightmapModel, Sheet
from wlm.lightmap.profile import Profile as LightmapProfile
from wlm.lightmap.profile import TimeAxis
from wlm.lightmap.tiles import TILE
from wlm.lightmap.trainer import Trainer as LightmapTrainer
from wlm.lightmap.virtual.texture import VirtualTexture
from wlm.probe.fit import compress as compress_probes
from wlm.probe.gaussian.trainer import Trainer as ProbeTrainer
from wlm.probe.model import Profile as ProbeProfile
from wlm.smoke.camera import Camera
from wlm.smoke.codec import open_network
from wlm.smoke.decode import Decoder as NetworkDecoder
from wlm.smoke.march.launch import in_bricks
from wlm.smoke.march.six_way import bake_coarse, coarse_march, guide
from wlm.smoke.scene import load_scene, make_camera
from wlm.smoke.shading import Light
from wlm.smoke.transport.orders import scatter
from wlm.view.smoke import Drawing
from wlm_kernels.fluid import advection, advection_places
from wlm_kernels.lightmap.features import INPUTS
from wlm_kernels.smoke.settings import March


@dataclass(frozen=True)
class Work:
    """The work that one repetition of a call cannot avoid.

    Attributes:
        bytes: Read once and written once.
        fma: Operations in float32, two for a multiply-add.
        tensor: Operations of matrix products that tensor cores can do.
        special: Exponentials, or functions as costly.
        atomics: Atomic additions of float32.
    """

    bytes: float = 0.0
    fma: float = 0.0
    tensor: float = 0.0
    special: float = 0.0
    atomics: float = 0.0

    def amounts(self) -> dict[str, float]:
        """Returns the amount of each kind of work, by the name of its ceiling."""
        return {"copy": self.bytes, "fma": self.fma, "tensor": self.tensor, "special": self.special} | {
            "atomics": self.atomics
        }


@dataclass(frozen=True)
class Case:
    """A call at several sizes.

    Attributes:
        make: Returns for a device and a size the call and its work.
        unit: What the size counts.
        sizes, quick: Sizes of a whole and of a quick run, rising.
        calls: Repetitions in one call.
        replayed: Whether the call is captured as a CUDA graph here; else it makes graphs of its own.
    """

    make: Callable[[str, int], tuple[Callable[[], object], Work]]
    unit: str
    sizes: tuple[int, ...]
    quick: tuple[int, ...]
    calls: int = 1
    replayed: bool = True


_HOURS = 26
_STEPS = 50  # of a fit or a lattice in one call, as many as a fit repeats in a CUDA graph
_SPEED = 0.1


# ---- lightmaps ----


def _network_work(profile: LightmapProfile) -> tuple[float, float]:
    """Returns operations and activations of the network at one texel."""
    hidden = profile.hidden
    return 2.0 * (INPUTS * hidden + hidden * hidden + 3 * hidden), 2.0 * hidden


def _lightmap(name: str, side: int) -> tuple[LightmapModel, float]:
    profile = LightmapProfile.load(name)
    times = np.linspace(0.0, 24.0, _HOURS, endpoint=False)
    sheet = random_sheet(side, times, 0, profile)
    return LightmapModel("random", "0123456789abcdef", sheet.profile, {Sheet(): sheet}), float(sheet.memory_bytes)


def _lightmap_map(profile: str) -> Callable[[str, int], tuple[Callable[[], object], Work]]:
    def make(device: str, texels: int) -> tuple[Callable[[], object], Work]:
        side = math.isqrt(texels)
        model, stored = _lightmap(profile, side)
        decoder = fast_decoder(model.light, device)
        decoder.set_time(9.3)
        operations, activations = _network_work(model.profile)
        # Of all slices of a tile over time two are read, which is at most everything.
        work = Work(bytes=stored + 4.0 * texels, tensor=operations * texels, special=activations * texels)
        return decoder.decode, work

    return make


def _lightmap_pages(device: str, pages: int) -> tuple[Callable[[], object], Work]:
    side = TILE * math.isqrt(pages)
    model, stored = _lightmap("M", side)
    texture = VirtualTexture(model, device, budget=ALL, decodes=pages, tolerance=1e-6)
    texture.frame(9.3, *view_of_all_pages(texture))
    # A texel of a coarser page is the mean of all texels of the map below it.
    levels = texture.layout.place[:, 1]
    written = len(levels) * (TILE + 2.0 * texture.layout.border) ** 2
    texels = float((4.0**levels).sum()) * TILE**2
    operations, activations = _network_work(model.profile)
    work = Work(bytes=stored + 4.0 * written, tensor=operations * texels, special=activations * texels)
    return texture.stages["decode"], work


def _lightmap_step(device: str, tiles: int) -> tuple[Callable[[], object], Work]:
    side = math.isqrt(tiles)
    random = np.random.default_rng(0)
    times = np.linspace(0.0, 24.0, _HOURS, endpoint=False)
    light = random.random((_HOURS, TILE * side, TILE * (tiles // side), 3), np.float32)
    profile = LightmapProfile.load("M").for_times(_HOURS)
    day = from_arrays(light, times, period=24.0)
    targets = dynamic_targets(day.light, profile)
    trainer = LightmapTrainer(profile, TimeAxis(day.times, day.period, profile.time_axis), targets, 0, device)
    operations, activations = _network_work(profile)
    samples = float(profile.samples * tiles)
    # Adam reads and writes a parameter and its two moments, and reads its gradient, in float32.
    parameters = float(trainer.maps.numel() + trainer.hidden.numel() + trainer.output.numel())
    # A sample adds to 8 endpoints and a weight of the first map; in two slices of the second one to 4 weights and to
    # the endpoints of the blocks that its corners lie in, 25 / 16 on average; and to 16 numbers of planes.
    work = Work(
        bytes=28.0 * parameters,
        tensor=3.0 * operations * samples,
        special=activations * samples,
        atomics=(9.0 + 2.0 * (4.0 + 8.0 * 25.0 / 16.0) + 16.0) * samples,
    )
    return lambda: trainer.run(_STEPS), work


# ---- probes ----


@cache
def _probes(count: int):
    return many_probes(count)


@cache
def _probe_model(device: str):
    profile = ProbeProfile.load("standard").override({"method": "gaussians", "steps": 30})
    return compress_probes(_probes(13_810), profile, device=device)


def _probe_network(model) -> tuple[float, float]:
    content = model.content
    inputs, hidden = content.latent + 3, content.hidden
    return 2.0 * (inputs * hidden + hidden * hidden + hidden * (model.outputs + 1)), 2.0 * hidden


def _probe_decode(device: str, points: int) -> tuple[Callable[[], object], Work]:
    model = _probe_model(device)
    decoder = model.decoder(device)
    position = model.origin + np.random.default_rng(0).random((points, 3)) * model.extent * model.size
    uploaded = decoder.points(position)
    operations, activations = _probe_network(model)
    content = (12.0 + 4.0 * model.outputs) * points + model.content.nbytes
    work = Work(bytes=content, tensor=operations * points, special=activations * points)
    return lambda: decoder.run(uploaded), work


def _probe_step(device: str, count: int) -> tuple[Callable[[], object], Work]:
    probes = _probes(count)
    profile = ProbeProfile.load("standard").override({"method": "gaussians"})
    x = (probes.position - probes.position.min(0)) / np.ptp(probes.position, axis=0)
    trainer = ProbeTrainer(x.astype(np.float32), probes.values, profile, 0, device)
    inputs, hidden = profile.latent + 3, profile.hidden
    operations = 2.0 * (inputs * hidden + hidden * hidden + hidden * (probes.values.shape[1] + 1))
    work = Work(
        bytes=(12.0 + 4.0 * probes.values.shape[1]) * count,
        tensor=3.0 * operations * count,
        special=2.0 * hidden * count,
    )
    return lambda: trainer.run(_STEPS), work


# ---- atlases ----


@cache
def _atlas_model(device: str):
    profile = AtlasProfile.load("standard").override({"views": 1, "budget": 1.0})
    return compress_atlas(make_square(1), profile, device=device)


def _atlas_read(device: str, points: int) -> tuple[Callable[[], object], Work]:
    decoder = AtlasDecoder(_atlas_model(device), device)
    uv = torch.rand(points, 2, generator=torch.Generator().manual_seed(0)).to(device)
    out = torch.empty(points, 3, device=device)
    wrapped = interop.to_warp(uv, wp.vec2)
    return lambda: decoder.run(wrapped, out), Work(bytes=20.0 * points)


def _rasterize(device: str, pixels: int) -> tuple[Callable[[], object], Work]:
    clip, triangle = (torch.from_numpy(array).to(device) for array in make_sphere(64))
    side = math.isqrt(pixels)
    # The index of a triangle, two barycentrics and a depth.
    return lambda: ops.rasterize(clip, triangle, side, side), Work(bytes=16.0 * pixels)


# ---- air and smoke ----


def _lattice(storage: str, walls: bool) -> Callable[[str, int], tuple[Callable[[], object], Work]]:
    def make(device: str, cells: int) -> tuple[Callable[[], object], Work]:
        edge = round(cells ** (1 / 3))
        lattice = Lattice((edge,) * 3, viscosity=1e-6, storage=storage, device=device, ramp=4 * edge)
        if walls:
            for face in ("-y", "+y", "-z", "+z"):
                lattice.set_wall(face)
            lattice.set_inlet("-x", (_SPEED, 0.0, 0.0))
            lattice.set_outlet("+x")
            solid = np.zeros((edge,) * 3, bool)
            third = edge // 3
            solid[third : 2 * third, third : 2 * third, third : 2 * third] = True
            lattice.set_solid(solid)
        size = 2 if storage == "float16" else 4
        # Moments, collision and equilibrium take about 400 operations.
        work = Work(bytes=(2.0 * 19 * size + walls) * edge**3, fma=400.0 * edge**3)
        return lambda: lattice.step(_STEPS), work

    return make


def _advection(scheme: str) -> Callable[[str, int], tuple[Callable[[], object], Work]]:
    def make(device: str, voxels: int) -> tuple[Callable[[], object], Work]:
        n = round(voxels ** (1 / 3)) // 4
        ends = (advection_places.OPEN,) * 2
        box = advection_places.make_box((n, n, n), 4, (ends,) * 3)
        smoke = torch.rand(64 * n**3, generator=torch.Generator().manual_seed(0)).to(device)
        nothing = wp.empty(0, dtype=float, device=device)
        fields = [advection.Fields(interop.to_warp(smoke.clone()), nothing) for _ in range(3)]
        velocity = wp.array(np.random.default_rng(0).normal(0, 0.05, (n**3, 3)), dtype=wp.vec3, device=device)
        walls = wp.zeros(0, dtype=wp.uint8, device=device)
        traces = wp.empty(ways_of(scheme) * n**3, dtype=wp.vec3, device=device)

        def step() -> None:
            advection_places.trace(box, velocity, 2, traces)
            advection.advect(box, traces, walls, fields[0], fields[1])
            if scheme == "maccormack":
                advection.advect(box, traces, walls, fields[0], fields[2], predicted=fields[1])

        passes = 2 if scheme == "maccormack" else 1
        # Smoke once in and once out; two passes read the prediction, too. 8 corners of smoke and of three velocities.
        count = 64.0 * n**3
        work = Work(bytes=4.0 * (2 + 3 * (passes - 1)) * count + 12.0 * n**3, fma=60.0 * passes * count)
        return step, work

    return make


@cache
def _cloud(device: str, edge: int) -> DensityVolume:
    return DensityVolume(make_cloud(edge, device), extinction=8.0 / edge)


def _marched(name: str, smoke_edge: int) -> Callable[[str, int], tuple[Callable[[], object], Work]]:
    def make(device: str, pixels: int) -> tuple[Callable[[], object], Work]:
        edge, side = min(smoke_edge, 48) if device == "cpu" else smoke_edge, math.isqrt(pixels)
        volume = _cloud(device, edge)
        camera = Camera.around((volume.origin, np.full(3, float(edge))), toward=(1.0, 0.5, 1.0), pixels=side)
        light = Light((0.3, 1.0, 0.2))
        known = in_bricks(volume)
        calls: dict[str, tuple[Callable[[], object], int]] = {
            "guide": (lambda: guide(known, camera, March(10.0)), 3),
            "guide and marks": (lambda: guide(in_bricks(volume), camera, March(10.0)), 3),
            "six ways": (lambda: bake_coarse(volume, camera, coarse_march(volume)), 9),
            "all orders": (lambda: scatter(volume, camera, [light]), 6),
        }
        call, planes = calls[name]
        return call, Work(bytes=4.0 * edge**3 + 4.0 * planes * pixels)

    return make


def _shadows(device: str, pixels: int) -> tuple[Callable[[], object], Work]:
    """Shadows of jet-sphere's obstacle under its two lights, on a plane through the box's centre."""
    scene, side = load_scene("jet-sphere"), math.isqrt(pixels)
    settings = scene.camera.model_copy(update={"resolution": side})
    camera = make_camera(settings, scene.grid.origin, scene.grid.size)
    lights = [each.light() for each in scene.lights]
    drawing = Drawing(camera, lights, obstacles=scene.obstacles, device=device)
    away = np.subtract(camera.position, scene.grid.origin + 0.5 * scene.grid.size) @ camera.toward
    surface = torch.full((side, side), float(away), device=device)
    return lambda: drawing.draw_shadows(surface), Work(bytes=4.0 * (1 + len(lights)) * pixels)


def _network(device: str, pixels: int) -> tuple[Callable[[], object], Work]:
    side = math.isqrt(pixels)
    model = open_network()
    decoder = NetworkDecoder(model, device, height=side, width=side)
    encoded = torch.rand_like(decoder._guide[0].float())
    multiplied = [0.0]

    def count(module: torch.nn.Module, inputs: tuple[torch.Tensor, ...], output: torch.Tensor) -> None:
        weights = module.weight.numel() / module.weight.shape[0]
        multiplied[0] += 2.0 * weights * output[0].numel()

    network = model.network.to("cpu")
    hooks = [each.register_forward_hook(count) for each in network.modules() if isinstance(each, torch.nn.Conv2d)]
    with torch.no_grad():
        network(torch.zeros(1, encoded.shape[0], 64, 64))
    for hook in hooks:
        hook.remove()
    operations = multiplied[0] * pixels / 64**2
    return lambda: decoder(encoded), Work(bytes=4.0 * (encoded.shape[0] + 8) * pixels, tensor=operations)


_SQUARES = tuple(side**2 for side in (128, 256, 512, 1024, 2048))
_FEW_SQUARES = (128**2, 256**2)
_CUBES = tuple(edge**3 for edge in (64, 100, 160, 256))
_FEW_CUBES = (16**3, 32**3)

CASES: dict[str, Case] = {
    "lightmap M, a map": Case(_lightmap_map("M"), "texels", _SQUARES, _FEW_SQUARES),
    "lightmap standard, a map": Case(_lightmap_map("standard"), "texels", _SQUARES, _FEW_SQUARES),
    "lightmap M, pages": Case(_lightmap_pages, "pages", (4, 16, 64, 256), (4,)),
    "lightmap M, a step of the fit": Case(_lightmap_step, "tiles", (4, 16, 64), (1, 4), _STEPS, False),
    "probes, decode": Case(_probe_decode, "points", (1000, 15_000, 100_000, 1_000_000), (100, 1000)),
    "probes, a step of the fit": Case(_probe_step, "probes", (1000, 4000, 15_000), (200, 1000), _STEPS, False),
    "atlas, read": Case(_atlas_read, "points", (10_000, 100_000, 1_000_000, 10_000_000), (1000, 10_000)),
    "rasterize": Case(_rasterize, "pixels", _SQUARES[1:], _FEW_SQUARES, 1, False),
    "lattice float32, periodic": Case(_lattice("float32", False), "cells", _CUBES, _FEW_CUBES, _STEPS, False),
    "lattice float16, periodic": Case(_lattice("float16", False), "cells", _CUBES, _FEW_CUBES, _STEPS, False),
    "lattice float16, all boundaries": Case(_lattice("float16", True), "cells", _CUBES, _FEW_CUBES, _STEPS, False),
    "advection, semi-lagrangian": Case(
        _advection("semi-lagrangian"), "voxels", (64**3, 128**3, 256**3, 400**3), _FEW_CUBES
    ),
    "advection, maccormack": Case(_advection("maccormack"), "voxels", (64**3, 128**3, 256**3, 400**3), _FEW_CUBES),
    "smoke, guide": Case(_marched("guide", 400), "pixels", _SQUARES[:4], (32**2, 64**2)),
    "smoke, guide and marks": Case(_marched("guide and marks", 400), "pixels", _SQUARES[:4], (32**2, 64**2)),
    "smoke, six ways": Case(_marched("six ways", 400), "pixels", _SQUARES[:4], (32**2, 64**2)),
    "smoke, all orders": Case(_marched("all orders", 400), "pixels", _SQUARES[:4], (32**2, 64**2)),
    "smoke, shadows of two lights": Case(_shadows, "pixels", _SQUARES[:4], (32**2, 64**2)),
    "smoke, network fast": Case(_network, "pixels", _SQUARES[:4], (32**2, 64**2), 1, False),
}
"""The cases by name."""
