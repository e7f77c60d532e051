"""Air and smoke in motion: the lattice beside a copy, 16 bits, and the schemes that carry smoke."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
import warp as wp

from wlm.bench.runner import Row
from wlm.bench.smoke_setup import Bench, number, percent, row
from wlm.fluid.lattice import Lattice
from wlm.interop import StepGraph, stream, to_warp
from wlm_kernels.fluid import advection, advection_places, advection_sources
from wlm_kernels.fluid.lattice_sets import lattice as velocity_set
from wlm_kernels.fluid.lattice_solids import voxelise_sphere

__all__ = ["advection_rows", "lattice_rows", "smoke_brick_rows", "storage_rows"]

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


def lattice_rows(bench: Bench) -> list[Row]:
    """A copy, and steps of lattices in the same run: with each kind of boundary, storage and operator."""
    bench.note("lattice")
    cells, small = bench.sizes.lattice, bench.sizes.small
    cases = {
        "float32, periodic": (cells, {"faces": "periodic"}),
        "float32, six walls": (cells, {"faces": "walls"}),
        "float32, all boundaries": (cells, {}),
        "float32, all boundaries, BGK": (cells, {"operator": "bgk"}),
        "float32, all boundaries, D3Q27 recursive": (cells, {"lattice": "D3Q27", "operator": "recursive"}),
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
        calls[name] = _stepper(_jet(bench, size, **settings), chunk)
    sphere = f"float32, moving sphere, {small}³"
    calls[sphere], moved = _moving(bench, small)
    times = bench.time(calls)
    # Whichever moves more: what a copy is done by isn't the same everywhere.
    copy = min((times.pop("copy"), times.pop("kernel")), key=lambda timing: timing.median_ms)
    bench.bandwidth = 8 * floats / (1e-3 * copy.median_ms)
    rows = [row("jet", "lattice", "a copy", {"GB/s": f"{1e-9 * bench.bandwidth:.4g}"}, timing=copy)]
    for name, (size, settings) in cases.items():
        timing = times[name]
        ms = timing.median_ms / chunk
        bytes_moved = _bytes(**settings) * size**3
        figures = {
            "cells": f"{size}³",
            "MLUPS": number(1e-3 * size**3 / ms),
            "of the copy": bench.of_copy(bytes_moved, ms),
        }
        rows.append(row("jet", "lattice", name, figures, timing=timing, calls=chunk))
    figures = {"cells": f"{small}³", "MLUPS": number(1e-3 * small**3 * moved / times[sphere].median_ms)}
    rows.append(row("jet", "lattice", sphere, figures, "put anew each step", timing=times[sphere], calls=moved))
    return rows


def storage_rows(bench: Bench) -> list[Row]:
    """What 16 bits get wrong against 32, and the mass of both."""
    bench.note("lattice: 16 bits against 32")
    sizes = bench.sizes
    exact, half = (_jet(bench, sizes.small, storage=storage) for storage in ("float32", "float16"))
    before = exact.mass(), half.mass()
    rows = []
    for steps in sizes.compared:
        for lattice in (exact, half):
            lattice.step(steps - lattice.steps)
        a, b = (wp.to_torch(lattice.velocity()).double() for lattice in (exact, half))
        figures = {
            "cells": f"{sizes.small}³",
            "RMS": percent(float((a - b).square().sum(-1).mean().sqrt()) / _SPEED),
            "largest": percent(float((a - b).abs().max()) / _SPEED),
        }
        rows.append(row("jet", "lattice storage", f"float16, {steps:,} steps", figures))
    for name, lattice, mass in (("float32", exact, before[0]), ("float16", half, before[1])):
        lattice.step(sizes.drift - lattice.steps)
        figures = {"cells": f"{sizes.small}³", "mass drift": f"{lattice.mass() / mass - 1.0:.2g}"}
        rows.append(row("jet", "lattice storage", f"{name}, {sizes.drift:,} steps", figures))
    return rows


def advection_rows(bench: Bench) -> list[Row]:
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
                calls[option] = _carry(bench, scheme, box, velocity, walls, fields, _SUBSTEPS)
        times = bench.time(calls)
        for option, timing in times.items():
            scheme = option.split(",")[0]
            moved = cells * _PASSES[scheme] * (2 if storage == "float16" else 4)
            figures = {
                "voxels": f"{_RATIO * n}³",
                "M voxels/s": number(1e-3 * cells / timing.median_ms),
                "of the copy": bench.of_copy(moved, timing.median_ms),
            }
            off = None
            if not option.endswith("sphere"):
                found, off, kept = _turn(bench, scheme, storage)
                figures |= {"RMS": percent(found), "smoke gained": f"{100.0 * (kept - 1.0):+.2g}%"}
            rows.append(row("ball", "advection", option, figures, timing=timing, max_error=off))
    return rows


def smoke_brick_rows(bench: Bench) -> list[Row]:
    """Bricks of smoke: a step's time by the share of the box that has some."""
    bench.note("advection: bricks")
    n, rows = bench.sizes.coarse, []
    edge = _RATIO * n
    box, velocity = _box(n), _swirl(n, bench.device)
    walls = _walls(box, bench.device, 0.0)
    for scheme in _SCHEMES:
        dense = _carry(bench, scheme, box, velocity, walls, _cubes(bench, 1.0, scheme), _SUBSTEPS)
        calls, lists = {"dense": dense}, {}
        for fill in bench.sizes.fills:
            name = f"smoke in {percent(fill)}"
            calls[name], lists[name] = _carry_bricks(bench, scheme, fill, box, velocity, walls)
        times = bench.time(calls)
        for name, timing in times.items():
            figures = {"voxels": f"{edge}³"}
            if name != "dense":
                worked = int(lists[name].count.numpy()[0]) * advection_places.BRICK**3 / edge**3
                figures |= {
                    "worked on": percent(min(worked, 1.0)),
                    "speedup": f"{times['dense'].median_ms / timing.median_ms:.2f}",
                }
            rows.append(row("cube", "advection bricks", f"{scheme}, {name}", figures, timing=timing))
    return rows


# Lattices.


def _jet(bench: Bench, size: int, faces: str = "all", **settings) -> Lattice:
    """Air in through a round inlet, past a sphere, out at the other end between walls; or at rest."""
    made = Lattice((size,) * 3, viscosity=_VISCOSITY, ramp=4 * size, device=bench.device, **settings)
    if faces != "periodic":
        for face in ("-x", "+x", "-y", "+y", "-z", "+z"):
            made.set_wall(face)
    if faces == "all":
        across = (np.indices((size, size)) + 0.5) / size - 0.5
        made.set_inlet("-x", (_SPEED, 0.0, 0.0), where=np.hypot(*across) < 0.15)
        made.set_outlet("+x")
        made.set_solid(_sphere(wp.zeros((size,) * 3, dtype=wp.uint8, device=bench.device), 0.0))
    return made


def _sphere(mask: wp.array, moved: float) -> wp.array:
    size = mask.shape[0]
    voxelise_sphere(mask, 1, (0.4 * size + moved, 0.5 * size, 0.5 * size), 0.12 * size)
    return mask


def _moving(bench: Bench, size: int) -> tuple[Callable[[], None], int]:
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


def _stepper(lattice: Lattice, steps: int) -> Callable[[], None]:
    return lambda: lattice.step(steps)


def _bytes(lattice: str = "D3Q19", storage: str = "float32", faces: str = "all", **_) -> int:
    """That a step has to read and write of a cell: populations, and whether it is solid."""
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
    """Where a sphere in the middle is, of a radius of a share of the edge; none of 0."""
    n = box.coarse[0]
    walls = wp.zeros(n**3 if radius else 0, dtype=wp.uint8, device=device)
    if radius:
        solid = wp.zeros((n,) * 3, dtype=wp.uint8, device=device)
        voxelise_sphere(solid, 1, (0.5 * n,) * 3, radius * n)
        advection_places.mark_walls(box, solid.flatten(), walls)
    return walls


def _swirl(n: int, device: str) -> wp.array:
    """Eddies of the size of the box, as fast as air on a lattice is."""
    at = 2 * np.pi * (np.arange(n) + 0.5) / n
    x, y, _ = np.meshgrid(at, at, at, indexing="ij")
    u = _SPEED * np.stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y), 0.5 * np.sin(x + y)], -1)
    return wp.array(u.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=device)


def _carry(bench, scheme: str, box, velocity, walls, fields, dt: float, **where) -> Callable[[], None]:
    """A step that leaves what it carries as it was: replayed, it does the same again."""

    def step() -> None:
        advection.advect(box, velocity, walls, fields[0], fields[1], dt, **where)
        if scheme == "maccormack":
            advection.correct(box, velocity, walls, *fields, dt, **where)

    return StepGraph(step, bench.device, warmup=1)


def _cubes(bench: Bench, fill: float, scheme: str) -> list[advection.Fields]:
    """Smoke in a cube in the box's corner, of a share of the box."""
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

    return StepGraph(step, bench.device, warmup=1), bricks


def _turn(bench: Bench, scheme: str, storage: str) -> tuple[float, float, float]:
    """Turns a smooth ball once about the box's axis, after which it should be where it was.

    Returns:
        The RMS difference over the ball's own RMS, the largest difference, where the ball's greatest density is 1, and
        what is left of all smoke.
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
        off = (wp.to_torch(fields[0].density).reshape(ball.shape).float() - ball).double()
        total = ball.double()
        rms = float(off.square().mean().sqrt() / total.square().mean().sqrt())
        return rms, float(off.abs().max()), float(1.0 + off.sum() / total.sum())
