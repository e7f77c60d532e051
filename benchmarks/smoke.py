"""Speed and error of smoke simulation and lighting, against memory copies, exact solutions and finer ray marches.

Each method has a table of its own:

- "lattice": a copy of an array, and steps of the lattice Boltzmann solver with each storage and
  kind of boundary. The bytes that a step must move, over its time, are stated as a share of the copy's bandwidth.
  "moving sphere" also moves the sphere, which crosses 5 cells in 100 steps and returns.
- "lattice storage": difference of velocities stored in 16 and in 32 bits, relative to the speed of a jet's inlet, and
  the relative drift of the mass.
- "advection": a step that moves random smoke in eddies, with and without a solid sphere; and the error of a smooth ball
  after a full rotation: RMS error over the RMS of the ball, largest error (the ball's peak is 1), and smoke gained.
- "advection mass": smoke gained in a closed box in two seconds after its source of hot smoke stopped, with and
  without a sphere that crosses it.
- "advection bricks": the same step with sparse storage, where only a cube in a corner contains smoke.
- "guide": guiding maps (coarse lightmaps for the network) against a march in steps of half a voxel with no jitter and
  no cutoff. PSNR is of the light; its peak is the largest value.
- "six ways": the fine ray march of six-way lightmaps, with its own estimate of its error by halving its step.
- "weights": six lightmaps weighted for twelve lights, against a ray march for each of these lights.
- "frame": the stages of a frame of the scene `jet-sphere`, except the network that makes lightmaps of the guiding map,
  which `smoke_network` measures; the ray march that the network replaces is measured too.
- "devices": steps of air, and of the simulation of `jet-sphere`, on all GPUs of the host; the speedup over one, and the
  largest difference of velocities. A CPU computes both halves, one after the other.

A largest error has the unit of the compared quantity: cells per step, light, or density. Times are of the calls that a
user makes. On CUDA the lattice itself replays graphs where it does many steps, and steps of advection are replayed as
graphs, so that gaps between launches do not count.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
import warp as wp
from torch.nn.functional import interpolate

from benchmarks.plot import Panel
from benchmarks.rows import Row
from benchmarks.runner import Bench, Note
from benchmarks.smoke_tracing import trace
from demos.plume import make_plume
from wlm.fluid.bricks import BrickPool
from wlm.fluid.faces import FACES
from wlm.fluid.lattice import Lattice
from wlm.fluid.obstacles import Sphere, Trajectory, cells_of
from wlm.fluid.slabs import Slabs
from wlm.fluid.volume import DensityVolume, gather
from wlm.interop import stream, to_warp
from wlm.metrics import psnr_from_mse
from wlm.smoke.camera import RULES, Camera
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.six_way import Guide, bake, guide
from wlm.smoke.scene import CameraSettings, Scene, load_scene, make_camera
from wlm.smoke.shading import Light, PointLight
from wlm.smoke.simulation import advance, make_solver, volume_of
from wlm.smoke.transport.lighting import light_smoke
from wlm.smoke.transport.orders import scatter
from wlm.view.smoke import Drawing
from wlm.view.smoke_run import Lighting
from wlm_kernels.fluid import advection, advection_places
from wlm_kernels.fluid.lattice_sets import lattice as velocity_set
from wlm_kernels.smoke.settings import March

PANELS = (Panel("time_ms", "psnr", ("guide",)), Panel("time_ms", "max_error", ("guide", "six ways")))
"""The panels of a plot: PSNR and error of guiding maps and of the fine march against their time."""

_SPEED = 0.1  # speed of the inlet in cells per step
_PLACES = 2000  # positions of a sphere that moves to and fro, 100 steps apart
_VISCOSITY = 1e-6
_COPIED = {"cpu": 1 << 24, "cuda": 1 << 28}  # floats: far more than caches hold
_RATIO = 4
_SUBSTEPS = 2
_THRESHOLD = 1e-6
# Steps of a whole turn of the ball for each voxel along the box's edge: its centre then goes 0.63 voxels a step.
_TURN = 2
_BALL = (0.68, 0.2)  # its centre along x and its radius, of the box's edge
_SCHEMES = ("semi-lagrangian", "maccormack")
# Floats that a cell has to be read and written at the least: each pass takes its fields once, and leaves one.
_PASSES = {"semi-lagrangian": 2, "maccormack": 2 + 3}
_FILLED = 5  # frames in which smoke enters the closed box
_CROSSING = {"radius": 0.12, "path": [[0.6, 0.15, 0.5, 0.5], [2.5, 0.85, 0.5, 0.5]]}
_CLOUD = "cloud"
_DEPTH = 8.0  # optical, through the cloud's box at density 1
_OCTAVES = range(2, 7)
_GAIN = 0.6  # amplitude of an octave over that of the octave before
_HALF_GUIDE = (5, 10, 20)  # steps at which 16 bits are looked at
_HALF_SIX = 0.5
_PLUME = 14.0  # the plume's extinction, over its box
_LIGHTS = 12
_WEIGHT_STEP = 1.0
_JITTER = 1.0
_PATHS = 64  # a pixel, on a GPU
_FEW_PATHS = 4


@dataclass(frozen=True)
class Sizes:
    """Grid sizes, step sizes and numbers of repeats. The defaults are the grids of the paper, for a GPU."""

    lattice: int = 256  # cells along an edge of the large lattice
    small: int = 100  # cells along an edge of the small lattice
    chunk: int = 48  # steps of a lattice that are timed as one
    compared: tuple[int, ...] = (500, 1000)  # steps after which velocities of 16 and 32 bits are compared
    drift: int = 5000  # steps after which the drift of the mass is measured
    fills: tuple[float, ...] = (0.0, 0.05, 0.1, 0.25, 0.5, 0.75, 1.0)  # shares of the domain that contain smoke
    coarse: int = 100  # cells of velocity along an edge, each four voxels of smoke along its edge
    cloud: int = 400  # voxels along an edge of the cloud
    resolution: int = 512  # pixels along an edge of its image
    exact: float = 0.5  # step in voxels of the march that guiding maps are compared with
    guide_shared: tuple[float, ...] = (2, 3, 5, 10, 15, 20)  # steps of guiding maps whose pixels share marches
    guide_alone: tuple[float, ...] = (1, 2, 3, 5, 10, 15, 20)  # steps of guiding maps with marches for each pixel
    six: tuple[float, ...] = (20.0, 15.0, 10.0, 7.0, 5.0, 3.0, 2.0, 1.0, 0.5, 0.25)  # steps of the six-way march
    plume: int = 64  # pixels along an edge of the image of the plume
    scale: float = 1.0  # factor on the number of cells of the scene
    frames: int = 40  # frames of the scene before the timed frame
    warmup: int = 3  # calls before the first that is timed
    repeats: int = 12  # samples of a time
    few: int = 3  # samples of a time that is long
    every: bool = True  # include slow-to-compile cases of minor interest


QUICK = Sizes(
    lattice=48,
    small=24,
    chunk=8,
    compared=(100, 200),
    drift=300,
    fills=(0.0, 0.25, 1.0),
    coarse=12,
    cloud=48,
    resolution=48,
    guide_alone=(2, 5, 10, 20),
    six=(1.0, 0.5, 0.25),
    plume=24,
    scale=0.12,
    frames=12,
    warmup=1,
    repeats=5,
    few=1,
    every=False,
)
"""Sizes for a CPU."""


class SmokeBench(Bench):
    """The benchmark of the smoke system on one device, with its grid sizes.

    Attributes:
        bandwidth: Bytes per second that a memory copy reads and writes; NaN until it is measured.
    """

    def __init__(self, device: str, sizes: Sizes, progress: Note | None = None) -> None:
        timing = {"warmup": sizes.warmup, "repeats": sizes.repeats, "few": sizes.few}
        super().__init__("smoke", device, progress, clock="time_ms", **timing)
        self.sizes, self.bandwidth = sizes, math.nan

    def of_copy(self, bytes_moved: float, ms: float) -> float:
        """Returns the bandwidth of moving bytes in `ms` milliseconds, as a fraction of a memory copy's bandwidth."""
        return bytes_moved / (1e-3 * ms) / self.bandwidth


def lattice_rows(bench: SmokeBench) -> list[Row]:
    """Times a memory copy, and steps of the fluid solver with each boundary and storage."""
    bench.note("timing the fluid solver")
    cells, small = bench.sizes.lattice, bench.sizes.small
    cases = {
        "float32, periodic": (cells, {"faces": "periodic"}),
        "float32, six walls": (cells, {"faces": "walls"}),
        "float32, all boundaries": (cells, {}),
        "float32, all boundaries, D3Q27": (cells, {"lattice": "D3Q27"}),
        "float16, periodic": (cells, {"faces": "periodic", "storage": "float16"}),
        "float16, all boundaries": (cells, {"storage": "float16"}),
        f"float32, all boundaries, {small}³": (small, {}),
        f"float16, all boundaries, {small}³": (small, {"storage": "float16"}),
    }
    chunk, calls = bench.sizes.chunk, {}
    floats = _COPIED[bench.device.split(":")[0]]
    source = torch.zeros(floats, device=bench.device)
    target = torch.ones_like(source)
    calls["copy"] = lambda: target.copy_(source)
    calls["kernel"] = lambda: torch.neg(source, out=target)
    for name, (size, settings) in cases.items():
        calls[name] = partial(_jet(bench, size, **settings).step, chunk)
    moving = {f"{storage}, moving sphere, {small}³": storage for storage in ("float32", "float16")}
    for name, storage in moving.items():
        lattice = _jet(bench, small, storage=storage)
        lattice.set_bodies([_sphere(small, moves=True)])
        cases[name] = (small, {"storage": storage})
        calls[name] = partial(lattice.step, chunk)
    times = bench.time(calls)
    # The faster of a memcpy and a kernel: devices differ.
    copy = min((times.pop("copy"), times.pop("kernel")), key=lambda timing: timing.median_ms)
    bench.bandwidth = 8 * floats / (1e-3 * copy.median_ms)
    rows = [bench.row("lattice", "a copy", scene="jet", timing=copy, bandwidth=1e-9 * bench.bandwidth)]
    for name, (size, settings) in cases.items():
        timing = times[name]
        ms = timing.median_ms / chunk
        figures = {"mlups": 1e-3 * size**3 / ms, "of_copy": bench.of_copy(_bytes(**settings) * size**3, ms)}
        rows.append(bench.row("lattice", name, scene="jet", timing=timing, calls=chunk, cells=size, **figures))
    return rows


def storage_rows(bench: SmokeBench) -> list[Row]:
    """Measures the error of the fluid solver with 16-bit storage against 32 bits, and the mass drift of both."""
    bench.note("comparing 16-bit and 32-bit storage of the fluid solver")
    sizes = bench.sizes
    exact, half = (_jet(bench, sizes.small, storage=storage) for storage in ("float32", "float16"))
    before = exact.mass(), half.mass()
    rows = []
    for steps in sizes.compared:
        for lattice in (exact, half):
            lattice.step(steps - lattice.steps)
        a, b = (wp.to_torch(lattice.velocity()).double() for lattice in (exact, half))
        rms = float((a - b).square().sum(-1).mean().sqrt()) / _SPEED
        largest = float((a - b).abs().max()) / _SPEED
        figures = {"cells": sizes.small, "rms": rms, "largest": largest}
        rows.append(bench.row("lattice storage", f"float16, {steps:,} steps", scene="jet", **figures))
    for name, lattice, mass in (("float32", exact, before[0]), ("float16", half, before[1])):
        lattice.step(sizes.drift - lattice.steps)
        figures = {"cells": sizes.small, "mass_drift": lattice.mass() / mass - 1.0}
        rows.append(bench.row("lattice storage", f"{name}, {sizes.drift:,} steps", scene="jet", **figures))
    return rows


def advection_rows(bench: SmokeBench) -> list[Row]:
    """Measures each scheme and storage of advection: time with and without a solid, error after a ball's full turn."""
    rows = []
    n = bench.sizes.coarse
    box, cells = _box(n), (_RATIO * n) ** 3
    for storage in advection.STORAGES:
        bench.note(f"measuring advection in {storage}")
        # MacCormack corrects nothing in uniform smoke.
        smoke = torch.rand(cells, generator=torch.Generator().manual_seed(0))
        fields = [_fields(smoke, storage, bench.device) for _ in range(3)]
        velocity = _swirl(n, bench.device)
        calls = {}
        for solid, radius in (("", 0.0), (", a sphere", 0.12)):
            if solid and storage == "float16" and not bench.sizes.every:
                continue
            walls = _walls(box, bench.device, radius)
            for scheme in _SCHEMES:
                option = f"{scheme}, {storage}{solid}"
                calls[option] = _carry(bench, scheme, box, velocity, walls, fields)
        times = bench.time(calls)
        for option, timing in times.items():
            scheme = option.split(",")[0]
            moved = cells * _PASSES[scheme] * (2 if storage == "float16" else 4)
            figures = {
                "voxels": _RATIO * n,
                "voxel_rate": 1e-3 * cells / timing.median_ms,
                "of_copy": bench.of_copy(moved, timing.median_ms),
            }
            if not option.endswith("sphere"):
                figures |= _turn(bench, scheme, storage)
            rows.append(bench.row("advection", option, scene="ball", timing=timing, **figures))
    return rows


def mass_rows(bench: SmokeBench) -> list[Row]:
    """Measures the smoke that a closed box of 1 m gains while hot smoke rises in it, without sources or outlets."""
    bench.note("measuring the mass of smoke in a closed box")
    rows, n = [], bench.sizes.small
    for solid, obstacles in (("", []), (", a sphere crosses", [_CROSSING])):
        for scheme, storage in itertools.product(_SCHEMES, advection.STORAGES):
            if solid and storage == "float16" and not bench.sizes.every:
                continue
            settings = {
                "name": "closed box",
                "grid": {"cells": [n] * 3, "cell": 1.0 / n, "refine": 2, "faces": dict.fromkeys(FACES, "wall")},
                "smoke": {"buoyancy": 5.0, "scheme": scheme, "storage": storage},
                "sources": [{"centre": [0.5, 0.2, 0.5], "radius": 0.1, "temperature": 1, "stop": 0.1 * _FILLED}],
                "obstacles": obstacles,
                "frames": 5 * _FILLED,
                "rate": 10.0,
            }
            scene = Scene.model_validate(settings)
            solver, mass = make_solver(scene, device=bench.device), {}
            for frame in range(1, scene.frames + 1):
                advance(scene, solver, frame)
                mass[frame] = float(volume_of(scene, solver).density.double().sum())
            figures = {"smoke_gained": mass[scene.frames] / mass[_FILLED] - 1.0, "voxels": 2 * n}
            rows.append(bench.row("advection mass", f"{scheme}, {storage}{solid}", scene="closed box", **figures))
    return rows


def smoke_brick_rows(bench: SmokeBench) -> list[Row]:
    """Times an advection step in sparse bricks, with smoke in several shares of the box."""
    bench.note("timing advection in sparse bricks")
    n, rows = bench.sizes.coarse, []
    edge = _RATIO * n
    box, velocity = _box(n), _swirl(n, bench.device)
    walls = _walls(box, bench.device, 0.0)
    for scheme in _SCHEMES:
        fields = [_fields(_cube(bench, 1.0), "float32", bench.device) for _ in range(3)]
        dense = _carry(bench, scheme, box, velocity, walls, fields)
        calls, lists = {"dense": dense}, {}
        for fill in bench.sizes.fills:
            name = f"smoke in {100 * fill:g}%"
            calls[name], lists[name] = _carry_bricks(bench, scheme, fill, box, velocity, walls)
        times = bench.time(calls)
        for name, timing in times.items():
            figures = {"voxels": edge}
            if name != "dense":
                worked = int(lists[name].bricks.counts.numpy()[0]) * advection_places.CELLS / edge**3
                figures["worked_on"] = min(worked, 1.0)
                figures["speedup"] = times["dense"].median_ms / timing.median_ms
            rows.append(bench.row("advection bricks", f"{scheme}, {name}", scene="cube", timing=timing, **figures))
    return rows


# Lattices.


def _jet(bench: SmokeBench, size: int, faces: str = "all", **settings) -> Lattice:
    """Makes a fluid lattice with a round inlet, a sphere, an outlet and walls, or a lattice of air at rest."""
    lattice = Lattice((size,) * 3, viscosity=_VISCOSITY, ramp=4 * size, **{"device": bench.device} | settings)
    if faces != "periodic":
        for face in ("-x", "+x", "-y", "+y", "-z", "+z"):
            lattice.set_wall(face)
    if faces == "all":
        across = (np.indices((size, size)) + 0.5) / size - 0.5
        lattice.set_inlet("-x", (_SPEED, 0.0, 0.0), where=np.hypot(*across) < 0.15)
        lattice.set_outlet("+x")
        lattice.set_bodies([_sphere(size)])
    return lattice


def _sphere(size: int, moves: bool = False) -> Sphere:
    """Makes a sphere in a box of `size` cells; it may move to and fro, at 0.05 cells per step."""
    places = np.full((_PLACES if moves else 1, 3), 0.5 * size)
    places[:, 0] = 0.4 * size + 5.0 * (np.arange(len(places)) % 2)
    return Sphere(Trajectory.of(places, 100.0 * np.arange(len(places))), 0.12 * size)


def _bytes(lattice: str = "D3Q19", storage: str = "float32", faces: str = "all", **_) -> int:
    """Returns how many bytes a step must read and write for each cell: its populations and its solid flag."""
    return 2 * len(velocity_set(lattice).c) * (2 if storage == "float16" else 4) + int(faces == "all")


# Smoke.


def _box(n: int) -> advection_places.Box:
    ends = (advection_places.OPEN,) * 2
    return advection_places.make_box((n, n, n), _RATIO, (ends,) * 3)


def _fields(density: torch.Tensor, storage: str, device: str) -> advection.Fields:
    kind = torch.float16 if storage == "float16" else torch.float32
    nothing = wp.empty(0, dtype=advection.STORAGES[storage], device=device)
    return advection.Fields(to_warp(density.to(device, kind).flatten().clone()), nothing)


def _walls(box: advection_places.Box, device: str, radius: float) -> wp.array:
    """Marks the cells of a central sphere; `radius` is a share of the box's edge, and 0 gives an empty array."""
    n = box.coarse[0]
    walls = wp.zeros(n**3 if radius else 0, dtype=wp.uint8, device=device)
    if radius:
        solid = cells_of([Sphere(Trajectory.of((0.5 * n,) * 3), radius * n)], (n,) * 3, device)
        advection_places.mark_walls(box, solid.flatten(), walls)
    return walls


def _swirl(n: int, device: str) -> wp.array:
    """Makes a velocity field [cells, 3] of eddies as large as the box, in cells per step."""
    at = 2 * np.pi * (np.arange(n) + 0.5) / n
    x, y, _ = np.meshgrid(at, at, at, indexing="ij")
    u = _SPEED * np.stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y), 0.5 * np.sin(x + y)], -1)
    return wp.array(u.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=device)


def _traces(velocity: wp.array) -> wp.array:
    return wp.empty(2 * velocity.size, dtype=wp.vec3, device=velocity.device)


def _carry(bench: SmokeBench, scheme: str, box, velocity, walls, fields) -> Callable[[], None]:
    """Returns a call that does one advection step into a second field, so that each replay does the same work."""
    traces = _traces(velocity)

    def step() -> None:
        advection_places.trace(box, velocity, _SUBSTEPS, traces)
        advection.advect(box, traces, walls, fields[0], fields[1])
        if scheme == "maccormack":
            advection.advect(box, traces, walls, fields[0], fields[2], predicted=fields[1])

    return bench.replay(step)


def _cube(bench: SmokeBench, fill: float) -> torch.Tensor:
    """Makes a density with a cube of smoke in a corner; `fill` is the cube's volume as a share of the box."""
    edge = _RATIO * bench.sizes.coarse
    density = torch.zeros((edge,) * 3, device=bench.device)
    full = round(fill ** (1 / 3) * edge)
    density[:full, :full, :full] = 0.5
    return density


def _carry_bricks(bench, scheme: str, fill: float, box, velocity, walls):
    """Returns a call that does one advection step in sparse bricks, including their lists, and returns the bricks."""
    rings = advection_places.rings_for(math.sqrt(1.0 / 3.0) * _SUBSTEPS * _RATIO)

    def make(cells: int) -> advection.Fields:
        return _fields(torch.zeros(cells), "float32", bench.device)

    buffers = 3 if scheme == "maccormack" else 2
    pool = BrickPool(box, rings, _THRESHOLD, make, buffers, Slabs(tuple(box.coarse), bench.device))
    # A graph has no pool that grows.
    pool.reserve(pool.most)
    pool.put(*gather([_cube(bench, fill)]))
    busy, bricks, fields, traces = wp.clone(pool.bricks.busy), pool.bricks, pool.fields, _traces(velocity)

    def step() -> None:
        wp.copy(bricks.busy, busy)
        pool.relist()
        pool.store()
        advection_places.trace(box, velocity, _SUBSTEPS, traces)
        advection.advect(box, traces, walls, fields[0], fields[1], bricks=bricks)
        if scheme == "maccormack":
            advection.advect(box, traces, walls, fields[0], fields[2], bricks=bricks, predicted=fields[1])

    return bench.replay(step), pool


def _turn(bench: SmokeBench, scheme: str, storage: str) -> dict[str, float]:
    """Moves a smooth ball of smoke by a full rotation about the box's axis, after which it should be as at the start.

    Returns:
        `rms`, RMS error over the ball's RMS; `max_error`, where the ball's peak is 1; `smoke_gained`, over all smoke.
    """
    n, device = bench.sizes.coarse, bench.device
    edge, box = _RATIO * n, _box(n)
    steps = _TURN * edge
    at = np.arange(n) + 0.5 - 0.5 * n
    x, y, z = np.meshgrid(at, at, at, indexing="ij")
    u = 2 * np.pi / steps * np.stack([-y, x, np.zeros_like(z)], -1)
    velocity = wp.array(u.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=device)
    places = (torch.arange(edge, device=device) + 0.5) / edge
    centre, radius = _BALL
    x, y, z = torch.meshgrid(places - centre, places - 0.5, places - 0.5, indexing="ij")
    distance = (x * x + y * y + z * z).sqrt() / radius
    ball = torch.where(distance < 1.0, 0.5 + 0.5 * torch.cos(math.pi * distance), 0.0)
    fields = [_fields(ball, storage, device) for _ in range(3)]
    nothing, traces = wp.empty(0, dtype=wp.uint8, device=device), _traces(velocity)
    with stream(device):
        advection_places.trace(box, velocity, 1.0, traces)
        for _ in range(steps):
            advection.advect(box, traces, nothing, fields[0], fields[1])
            if scheme == "maccormack":
                advection.advect(box, traces, nothing, fields[0], fields[2], predicted=fields[1])
                fields[1], fields[2] = fields[2], fields[1]
            fields[0], fields[1] = fields[1], fields[0]
        error = (wp.to_torch(fields[0].density).reshape(ball.shape).float() - ball).double()
        total = ball.double()
        return {
            "rms": float(error.square().mean().sqrt() / total.square().mean().sqrt()),
            "max_error": float(error.abs().max()),
            "smoke_gained": float(error.sum() / total.sum()),
        }


def make_cloud(n: int, device: str, seed: int = 0) -> torch.Tensor:
    """Makes a billowing column of smoke from octaves of noise. Random numbers are drawn on the CPU for any device.

    Args:
        n: Voxels along an edge.
        device: Device of the result.
        seed: Seed of the noise.

    Returns:
        The density, float32 [n, n, n] in [0, 1].
    """
    noise = make_noise(np.random.default_rng(seed), n, _OCTAVES, _GAIN, device)
    at = torch.linspace(-1.0, 1.0, n, device=device)
    x, y, z = torch.meshgrid(at, at, at, indexing="ij")
    radius = ((x - 0.2 * y) ** 2 + z**2).sqrt() / (0.35 + 0.125 * (y + 1.0))
    return ((1.5 * noise + 0.9 - radius).clamp(0.0, 1.0) * (y.abs() < 0.95)).contiguous()


def make_noise(
    random: np.random.Generator, n: int, octaves: Iterable[int], gain: float, device: str = "cpu"
) -> torch.Tensor:
    """Sums octaves of noise, float32 [n, n, n]: octave o is normal noise at 2^o + 1 nodes an edge, times gain^o."""
    noise = torch.zeros((1, 1, n, n, n), device=device)
    for octave in octaves:
        k = min(2**octave + 1, n)
        coarse = torch.from_numpy(random.standard_normal((1, 1, k, k, k), np.float32)).to(device)
        noise += gain**octave * interpolate(coarse, (n, n, n), mode="trilinear", align_corners=True)
    return noise[0, 0]


def guide_rows(bench: SmokeBench) -> Iterator[Row]:
    """Compares guiding maps with a fine march, at each step size; pixels share light marches or have their own."""
    bench.note("measuring guiding maps")
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
    for key, volume in cases.items():
        way, step, storage = key
        shared = way == "shared"
        jittered = guide(volume, camera, March(float(step), jitter=_JITTER), shared=shared)
        still = guide(volume, camera, March(float(step), jitter=0.0), shared=shared)
        option = f"h {step:g}" + (", each pixel alone" if way == "alone" else "")
        option += ", float16" if storage == "float16" else ""
        yield bench.row(
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


def six_rows(bench: SmokeBench) -> Iterator[Row]:
    """Measures the fine ray march of six-way lightmaps at each step size, and the march's own estimate of its error."""
    bench.note("measuring the fine ray march")
    sizes = bench.sizes
    volumes, camera = _cloud(bench)
    cases = {f"step {step:g}": (volumes["float32"], step) for step in sizes.six}
    cases[f"step {_HALF_SIX:g}, float16"] = (volumes["float16"], _HALF_SIX)
    calls = {name: partial(bake, volume, camera, step=step, estimate=False) for name, (volume, step) in cases.items()}
    times = bench.time(calls, few=True)
    finest = bake(volumes["float32"], camera, step=sizes.six[-1], estimate=False).lightmaps
    for name, (volume, step) in cases.items():
        six = bake(volume, camera, step=step)
        is_finest = step == sizes.six[-1]
        yield bench.row(
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


def weight_rows(bench: SmokeBench) -> Iterator[Row]:
    """Compares six lightmaps weighted for oblique lights, by each rule, with a ray march for each light, on a plume."""
    bench.note("measuring the weights of six lightmaps")
    volume = make_plume(hot=False, extinction=_PLUME, device=bench.device)
    size = volume.voxel * np.array(volume.shape)
    camera = make_camera(CameraSettings(resolution=bench.sizes.plume), volume.origin, size)
    six = bake(volume, camera, step=_WEIGHT_STEP, estimate=False)
    six = SixWay(six.lightmaps, None, camera=camera)
    lights = [tuple(map(float, toward)) for toward in _directions(_LIGHTS)]
    march = March(_WEIGHT_STEP, spacing=_WEIGHT_STEP / 2, jitter=0.0)
    exact = list(light_smoke(volume, camera, [Light(toward) for toward in lights], march).planes)
    for rule in RULES:
        weighted = [six.shade([Light(toward)], rule=rule)[..., 0] for toward in lights]
        pairs = list(zip(weighted, exact, strict=True))
        bias = [float(w.double().mean() / e.double().mean()) - 1.0 for w, e in pairs]
        yield bench.row(
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


def frame_rows(bench: SmokeBench) -> list[Row]:
    """Times the stages of a frame: air alone, whole simulation, guiding map, shadows and shading. Also times all that
    `wlm smoke run` does after the simulation, multiple scattering of a point light and of fire, and path tracing."""
    sizes, device = bench.sizes, bench.device
    scene = load_scene("jet-sphere").scaled(sizes.scale)
    scene = scene.model_copy(
        update={"camera": scene.camera.model_copy(update={"resolution": sizes.resolution}), "frames": sizes.frames + 1}
    )
    bench.note(f"simulating {sizes.frames} frames before the timed one")
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
    bench.note("timing the stages of a frame")
    surface = guide(volume, camera)
    six = bake(volume, camera, estimate=False)
    lights = [settings.light() for settings in scene.lights]
    drawing = Drawing(camera, lights, obstacles=scene.obstacles, device=device)

    def shadows() -> None:
        drawing.move(scene.time(sizes.frames))
        drawing.draw_shadows(surface.depth)

    def shading() -> torch.Tensor:
        return six.shade(lights, background=scene.background)

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


def device_rows(bench: SmokeBench) -> list[Row]:
    """Times the air and a simulation on one device and on several."""
    sizes, cuda = bench.sizes, bench.device != "cpu"
    names = [str(device) for device in wp.get_cuda_devices()] if cuda else ["cpu", "cpu"]
    rows, edge = [], _RATIO * sizes.coarse
    cases = {
        "float32, periodic": {"faces": "periodic"},
        "float32, all boundaries": {},
        "float16, all boundaries": {"storage": "float16"},
    }
    scene = load_scene("jet-sphere").scaled(sizes.scale)
    for name in (*cases, "jet-sphere") if len(names) > 1 else ():
        bench.note(f"timing {name} on {len(names)} devices")
        settings = cases.get(name)
        one, several = (
            make_solver(scene, device=of) if settings is None else _jet(bench, edge, device=of, **settings)
            for of in (bench.device, ",".join(names))
        )
        count = scene.steps // scene.smoke.substeps if settings is None else sizes.chunk
        times = bench.time({"one": partial(one.step, count), "several": partial(several.step, count)})
        velocities = [wp.to_torch(each.velocity if settings is None else each.velocity()) for each in (one, several)]
        figures = {
            "cells": scene.grid.cells[0] if settings is None else edge,
            "speedup": times["one"].median_ms / times["several"].median_ms,
            "max_error": float((velocities[0] - velocities[1]).abs().max()),
        }
        option, notes = f"{name}, {len(names)}", f"{times['one'].median_ms / count:.4g} ms on one"
        rows.append(bench.row("devices", option, notes, scene="jet", timing=times["several"], calls=count, **figures))
    return rows


def _drawn(
    scene: Scene, volume: DensityVolume, camera: Camera, time: float, device: str
) -> dict[str, Callable[[], object]]:
    """Returns calls that light a frame, by name: pictures with shadows and obstacles, and multiple scattering."""
    lights = [settings.light() for settings in scene.lights]
    parts = {"background": scene.background, "obstacles": scene.obstacles}
    drawing = Drawing(camera, lights, albedo=scene.smoke.albedo, **parts, device=device)
    drawing.move(time)
    lamp = PointLight(tuple(map(float, volume.centre)))
    hot = replace(volume, temperature=volume.density, emission=1.0)
    six, every = Lighting(None), Lighting(scene.smoke.albedo)
    return {
        "six ways, drawn": lambda: drawing(six(volume, camera, lights)),
        "all orders, drawn": lambda: drawing(every(drawing.among(volume), camera, lights)),
        "all orders, no obstacle": lambda: every(volume, camera, lights).shade(background=scene.background),
        "all orders of a point light": lambda: scatter(volume, camera, [lamp], scene.smoke.albedo),
        "all orders of fire": lambda: scatter(hot, camera, [], scene.smoke.albedo),
    }


def _traced(volume: DensityVolume, camera: Camera, paths: int) -> dict[str, Callable[[], object]]:
    """Returns calls that path-trace six lightmaps, one for each of six lights along the camera's axes."""
    six = [Light(tuple(map(float, sign * axis)), (4 * math.pi,) * 3) for axis in camera.axes for sign in (1.0, -1.0)]
    settings = {"samples": paths, "orders": 0}
    return {
        "six planes by paths, one order": lambda: trace(volume, camera, six, highest=1, **settings),
        "six planes by paths, all orders": lambda: trace(volume, camera, six, **settings),
    }


def _cloud(bench: SmokeBench) -> tuple[dict[str, DensityVolume], Camera]:
    """Makes a cloud stored in float32 and in float16, and a camera that looks at it obliquely from above."""
    n, pixels = bench.sizes.cloud, bench.sizes.resolution
    density = make_cloud(n, bench.device)
    volumes = {
        name: DensityVolume(density.to(kind), extinction=_DEPTH / n)
        for name, kind in (("float32", torch.float32), ("float16", torch.float16))
    }
    centre = volumes["float32"].centre
    eye = centre + n * np.array([1.6, 0.9, 2.2])
    return volumes, Camera.look_at(eye, centre, extent=1.15 * n, height=pixels, width=pixels)


def _directions(count: int) -> np.ndarray:
    """Returns evenly distributed unit vectors [count, 3]: points of a Fibonacci spiral on the sphere."""
    k = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    across = np.sqrt(1.0 - height**2)
    return np.stack([across * np.cos(turn), height, across * np.sin(turn)], -1)


def _rms(values: torch.Tensor) -> float:
    return float(values.double().square().mean().sqrt())


def _relative(values: torch.Tensor, exact: torch.Tensor) -> float:
    return _rms(values.double() - exact.double()) / _rms(exact)


def _psnr(coarse: Guide, fine: Guide) -> float:
    """Returns the PSNR of the light of a guiding map against a finer one, whose largest value is the peak."""
    return psnr_from_mse(_rms(coarse.light - fine.light) ** 2, float(fine.light.max()))


# The lattice comes first: it measures the copy that others are compared with.
_PARTS: tuple[Callable[[SmokeBench], Iterable[Row]], ...] = (
    lattice_rows,
    storage_rows,
    advection_rows,
    mass_rows,
    smoke_brick_rows,
    guide_rows,
    six_rows,
    weight_rows,
    frame_rows,
    device_rows,
)


def run(*, quick: bool = False, device: str, sizes: Sizes | None = None, progress: Note | None = None) -> list[Row]:
    """Measures the simulation and the lighting of smoke.

    Args:
        quick: Whether to use the sizes `QUICK`, for a minute on a CPU, instead of the grids of the paper, which need a
            GPU with 40 GB.
        device: "cpu" or "cuda:0".
        sizes: Sizes to use whatever `quick` is; None: `QUICK` or the default sizes.
        progress: Called with a line before each part of the work.

    Returns:
        The rows of each method, in the order in which the module's docstring lists them.

    Raises:
        WlmError: The device does not exist, or has too little memory.
    """
    bench = SmokeBench(device, sizes or (QUICK if quick else Sizes()), progress)
    return [row for part in _PARTS for row in part(bench)]


def plotted(rows: Sequence[Row]) -> list[Row]:
    """Returns the rows that a plot shows: those of a method that a panel of `PANELS` shows."""
    methods = {method for panel in PANELS for method in panel.methods}
    return [row for row in rows if row.method in methods]
