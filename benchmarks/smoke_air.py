"""Air and smoke in motion: the lattice beside a copy, 16 bits, and the schemes that carry smoke."""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
import warp as wp

from benchmarks.rows import Row
from benchmarks.smoke_setup import SmokeBench
from wlm.fluid.lattice import Lattice
from wlm.interop import stream, to_warp
from wlm_kernels.fluid import advection, advection_places, advection_sources
from wlm_kernels.fluid.lattice_fields import voxelise_sphere
from wlm_kernels.fluid.lattice_sets import lattice as velocity_set

_SPEED = 0.1  # of the inlet, cells a step
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


def lattice_rows(bench: SmokeBench) -> list[Row]:
    """A copy, and steps of lattices in the same run: with each kind of boundary, storage and operator."""
    bench.note("lattice")
    cells, small = bench.sizes.lattice, bench.sizes.small
    cases = {
        "float32, periodic": (cells, {"faces": "periodic"}),
        "float32, six walls": (cells, {"faces": "walls"}),
        "float32, all boundaries": (cells, {}),
        "float32, all boundaries, BGK": (cells, {"operator": "bgk"}),
        "float32, all boundaries, D3Q27": (cells, {"lattice": "D3Q27"}),
        "float16, periodic": (cells, {"faces": "periodic", "storage": "float16"}),
        "float16, all boundaries": (cells, {"storage": "float16"}),
        f"float32, all boundaries, {small}³": (small, {}),
        f"float16, all boundaries, {small}³": (small, {"storage": "float16"}),
    }
    if not bench.sizes.every:
        del cases["float32, all boundaries, BGK"]
    chunk, calls = bench.sizes.chunk, {}
    floats = _COPIED[bench.device.split(":")[0]]
    source = torch.zeros(floats, device=bench.device)
    target = torch.ones_like(source)
    calls["copy"] = lambda: target.copy_(source)
    calls["kernel"] = lambda: torch.neg(source, out=target)
    for name, (size, settings) in cases.items():
        calls[name] = partial(_jet(bench, size, **settings).step, chunk)
    sphere = f"float32, moving sphere, {small}³"
    calls[sphere], moved = _moving(bench, small)
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
    figures = {"cells": small, "mlups": 1e-3 * small**3 * moved / times[sphere].median_ms}
    note = "marked anew each step"
    return [*rows, bench.row("lattice", sphere, note, scene="jet", timing=times[sphere], calls=moved, **figures)]


def storage_rows(bench: SmokeBench) -> list[Row]:
    """The error of 16 bits against 32, and the mass of both."""
    bench.note("lattice: 16 bits against 32")
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
    """Schemes and storages: the time of a step with and without solids, and the error after a ball's whole turn."""
    rows = []
    n = bench.sizes.coarse
    box, cells = _box(n), (_RATIO * n) ** 3
    for storage in advection.STORAGES:
        bench.note(f"advection: {storage}")
        fields = [_fields(torch.full((cells,), 0.5), storage, bench.device) for _ in range(3)]
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


def smoke_brick_rows(bench: SmokeBench) -> list[Row]:
    """Bricks of smoke: a step's time by the share of the box that has some."""
    bench.note("advection: bricks")
    n, rows = bench.sizes.coarse, []
    edge = _RATIO * n
    box, velocity = _box(n), _swirl(n, bench.device)
    walls = _walls(box, bench.device, 0.0)
    for scheme in _SCHEMES:
        dense = _carry(bench, scheme, box, velocity, walls, _cubes(bench, 1.0, scheme))
        calls, lists = {"dense": dense}, {}
        for fill in bench.sizes.fills:
            name = f"smoke in {100 * fill:g}%"
            calls[name], lists[name] = _carry_bricks(bench, scheme, fill, box, velocity, walls)
        times = bench.time(calls)
        for name, timing in times.items():
            figures = {"voxels": edge}
            if name != "dense":
                worked = int(lists[name].count.numpy()[0]) * advection_places.BRICK**3 / edge**3
                figures["worked_on"] = min(worked, 1.0)
                figures["speedup"] = times["dense"].median_ms / timing.median_ms
            rows.append(bench.row("advection bricks", f"{scheme}, {name}", scene="cube", timing=timing, **figures))
    return rows


# Lattices.


def _jet(bench: SmokeBench, size: int, faces: str = "all", **settings) -> Lattice:
    """Air in through a round inlet, past a sphere, out at the other end between walls; or at rest."""
    lattice = Lattice((size,) * 3, viscosity=_VISCOSITY, ramp=4 * size, device=bench.device, **settings)
    if faces != "periodic":
        for face in ("-x", "+x", "-y", "+y", "-z", "+z"):
            lattice.set_wall(face)
    if faces == "all":
        across = (np.indices((size, size)) + 0.5) / size - 0.5
        lattice.set_inlet("-x", (_SPEED, 0.0, 0.0), where=np.hypot(*across) < 0.15)
        lattice.set_outlet("+x")
        lattice.set_solid(_sphere(wp.zeros((size,) * 3, dtype=wp.uint8, device=bench.device), 0.0))
    return lattice


def _sphere(mask: wp.array, moved: float) -> wp.array:
    size = mask.shape[0]
    voxelise_sphere(mask, 1, (0.4 * size + moved, 0.5 * size, 0.5 * size), 0.12 * size)
    return mask


def _moving(bench: SmokeBench, size: int) -> tuple[Callable[[], None], int]:
    """Steps of a jet whose sphere goes to and fro, and how many they are."""
    lattice, speed, steps = _jet(bench, size), 0.05, 10
    mask = wp.zeros((size,) * 3, dtype=wp.uint8, device=bench.device)
    lattice.step(1)

    def go() -> None:
        for k in range(steps):
            there = k < steps // 2
            _sphere(mask, speed * (k if there else steps - k))
            lattice.set_solid(mask, (speed if there else -speed, 0.0, 0.0))
            lattice.step(1)

    return go, steps


def _bytes(lattice: str = "D3Q19", storage: str = "float32", faces: str = "all", **_) -> int:
    """Bytes of one cell that a step has to read and write: populations, and whether it is solid."""
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
    """Cells of a sphere in the middle, whose radius is a share of the edge; none for a radius of 0."""
    n = box.coarse[0]
    walls = wp.zeros(n**3 if radius else 0, dtype=wp.uint8, device=device)
    if radius:
        solid = wp.zeros((n,) * 3, dtype=wp.uint8, device=device)
        voxelise_sphere(solid, 1, (0.5 * n,) * 3, radius * n)
        advection_places.mark_walls(box, solid.flatten(), walls)
    return walls


def _swirl(n: int, device: str) -> wp.array:
    """Eddies of the size of the box, at the speed of air on a lattice."""
    at = 2 * np.pi * (np.arange(n) + 0.5) / n
    x, y, _ = np.meshgrid(at, at, at, indexing="ij")
    u = _SPEED * np.stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y), 0.5 * np.sin(x + y)], -1)
    return wp.array(u.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=device)


def _carry(bench: SmokeBench, scheme: str, box, velocity, walls, fields) -> Callable[[], None]:
    """A step that writes to a second field: replayed, it does the same again."""

    def step() -> None:
        advection.advect(box, velocity, walls, fields[0], fields[1], _SUBSTEPS)
        if scheme == "maccormack":
            advection.correct(box, velocity, walls, *fields, _SUBSTEPS)

    return bench.replay(step)


def _cubes(bench: SmokeBench, fill: float, scheme: str) -> list[advection.Fields]:
    """Smoke in a cube in the box's corner that is a share of the box."""
    edge = _RATIO * bench.sizes.coarse
    density = torch.zeros((edge,) * 3, device=bench.device)
    full = round(fill ** (1 / 3) * edge)
    density[:full, :full, :full] = 0.5
    return [_fields(density, "float32", bench.device) for _ in range(3 if scheme == "maccormack" else 2)]


def _carry_bricks(bench, scheme: str, fill: float, box, velocity, walls):
    """A step in bricks, their lists and the emptying of others; and the bricks."""
    fields = _cubes(bench, fill, scheme)
    rings = advection_places.rings_for(math.sqrt(1.0 / 3.0) * _SUBSTEPS * _RATIO)
    bricks = advection_places.make_bricks(box, rings, _THRESHOLD, bench.device)
    edge = box.n[0]
    at = torch.arange(edge**3, device=bench.device)
    brick = torch.zeros(bricks.busy.shape[0], dtype=torch.int32, device=bench.device)
    x, y, z = at // edge**2, at // edge % edge, at % edge
    size = advection_places.BRICK
    index = (x // size * box.bricks[1] + y // size) * box.bricks[2] + z // size
    brick[index[wp.to_torch(fields[0].density) > 0]] = 1
    busy = to_warp(brick)

    def step() -> None:
        wp.copy(bricks.busy, busy)
        advection_places.relist(box, bricks)
        for field in fields:
            advection_sources.empty_retired(box, bricks, field)
        advection.advect(box, velocity, walls, fields[0], fields[1], _SUBSTEPS, bricks=bricks)
        if scheme == "maccormack":
            advection.correct(box, velocity, walls, *fields, _SUBSTEPS, bricks=bricks)

    return bench.replay(step), bricks


def _turn(bench: SmokeBench, scheme: str, storage: str) -> dict[str, float]:
    """Turns a smooth ball once about the box's axis, after which it should be where it was.

    Returns:
        `rms`, over the ball's own RMS; `max_error`, where the ball's greatest density is 1; `smoke_gained`.
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
    nothing = wp.empty(0, dtype=wp.uint8, device=device)
    with stream(device):
        for _ in range(steps):
            advection.advect(box, velocity, nothing, fields[0], fields[1], 1.0)
            if scheme == "maccormack":
                advection.correct(box, velocity, nothing, *fields, 1.0)
                fields[1], fields[2] = fields[2], fields[1]
            fields[0], fields[1] = fields[1], fields[0]
        error = (wp.to_torch(fields[0].density).reshape(ball.shape).float() - ball).double()
        total = ball.double()
        return {
            "rms": float(error.square().mean().sqrt() / total.square().mean().sqrt()),
            "max_error": float(error.abs().max()),
            "smoke_gained": float(error.sum() / total.sum()),
        }
