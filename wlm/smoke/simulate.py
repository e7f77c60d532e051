"""A scene in motion: the solver that it describes, and a folder with a volume for each of its frames."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
import warp as wp

from wlm.errors import WlmError
from wlm.fluid import obstacles as bodies
from wlm.fluid import solver as smoke
from wlm.fluid.faces import FACES
from wlm.fluid.lattice import Domain, Lattice
from wlm.fluid.volume import DensityVolume, save_volume
from wlm.interop import free_memory
from wlm.smoke.data import CHECKPOINT, Frames, frame_file
from wlm.smoke.scene import Inlet, Scene

__all__ = ["KEPT_EVERY", "make_solver", "simulate", "volume_of"]

KEPT_EVERY = 10
"""Frames between two checkpoints."""

# Cells by which smoke at an inlet reaches into the box: what is carried on from there is whole.
_INLET_DEPTH = 1.0
# Steps in which inlets open, over the cells of the longest axis: makes little of the sound of their start.
_RAMP = 4


def make_solver(scene: Scene, *, device: str = "cpu") -> smoke.Solver:
    """Builds what simulates a scene.

    Args:
        scene: The scene.
        device: As `wlm.interop.check_device` returns it.

    Raises:
        WlmError: The memory isn't enough for air and smoke, before any is allocated, or an inlet is too fast for the
            time step.
    """
    look = scene.smoke
    _require_memory(scene, device)
    try:
        lattice = _make_lattice(scene, device)
        return smoke.Solver(
            lattice,
            refinement=scene.grid.refine,
            scheme=look.scheme,
            storage=look.storage,
            temperature=look.hot,
            sources=[source for source, _ in _sources(scene)],
            obstacles=_obstacles(scene),
            dissipation=look.dissipation * scene.step,
            cooling=look.cooling * scene.step if look.hot else 0.0,
            buoyancy=_buoyancy(scene),
            substeps=look.substeps,
            bricks=look.bricks,
        )
    except ValueError as error:
        # Settings that are right each alone, and too small or too large together.
        raise WlmError(f"{scene.name}: {error}") from error


def volume_of(scene: Scene, solver: smoke.Solver) -> DensityVolume:
    """The smoke as it is; it shares the solver's memory and is good until the next step."""
    look, grid = scene.smoke, scene.grid
    return solver.frame(extinction=look.extinction, emission=look.emission, cell=grid.cell, origin=grid.origin)


def simulate(
    frames: Frames,
    *,
    solver: smoke.Solver | None = None,
    device: str = "cpu",
    resume: bool = False,
    progress: Callable[[int, dict[str, float]], None] | None = None,
) -> int:
    """Runs a scene and writes its frames.

    The state is kept in the folder every `KEPT_EVERY` frames, after the frame itself, and when `progress` raises
    KeyboardInterrupt. Going on from it gives the same frames: on the CPU to the last bit, on a GPU as far as its
    atomic sums come out alike, and with smoke in bricks to their threshold.

    Args:
        frames: The folder, as `frames.open_frames` gives it.
        solver: What `make_solver` made of the scene, as it was made; None: it is made here, on `device`. Whoever makes
            it before the folder is opened knows by then that it can be, and loses no earlier frames if not.
        device: As `wlm.interop.check_device` returns it.
        resume: Whether to go on from the state that is kept there, if there is one. One past the last frame asked for
            stays there.
        progress: Called after each frame with its number and `smoke`, the density's integral over the box, and
            `seconds` that it took.

    Returns:
        The number of the first frame that was simulated; one more than there are if all were there.

    Raises:
        WlmError: As `make_solver`; an obstacle is too fast; the air blew up; a file is damaged or can't be written; a
            frame before the state that is kept is missing.
    """
    scene, checkpoint = frames.scene, frames.folder / CHECKPOINT
    missing = sorted(set(range(1, scene.frames + 1)) - set(frames.numbers))
    kept = resume and checkpoint.exists()
    if resume and not kept and not missing:
        return scene.frames + 1
    if solver is None:
        solver = make_solver(scene, device=device)
    per_frame = scene.steps // scene.smoke.substeps
    done = 0
    if kept:
        solver.load(checkpoint)
        done = solver.steps // per_frame
        if missing and missing[0] <= done:
            raise WlmError(
                f"{frames.folder}: expected {frame_file(missing[0])}, since the state that is kept is of frame {done},"
                " found none; start anew without --resume"
            )
    timed = _sources(scene)
    for frame in range(done + 1, scene.frames + 1):
        begin = time.perf_counter()
        for step in range(per_frame):
            now = (frame - 1 + step / per_frame) / scene.rate
            solver.sources = tuple(source for source, active in timed if active(now))
            solver.step()
        solver.check()
        volume = volume_of(scene, solver)
        save_volume(frames.folder / frame_file(frame), volume)
        # Only now: a state whose frame isn't there would be resumed past it.
        if frame % KEPT_EVERY == 0:
            solver.save(checkpoint)
        if progress is None:
            continue
        figures = {"smoke": float(volume.density.double().sum()) * volume.voxel**3}
        try:
            progress(frame, figures | {"seconds": time.perf_counter() - begin})
        except KeyboardInterrupt:
            solver.save(checkpoint)
            raise
    if done <= scene.frames:
        checkpoint.unlink(missing_ok=True)
    return min(done, scene.frames) + 1


def _require_memory(scene: Scene, device: str) -> None:
    """Looks, before either is allocated, whether air and smoke fit into the memory together."""
    grid, look = scene.grid, scene.smoke
    voxel = smoke.voxel_bytes(look.scheme, look.storage, look.hot)
    needed = Lattice.bytes_needed(grid.cells, scene.air.storage) + voxel * math.prod(grid.shape)
    warp_device = wp.get_device(device)
    free = free_memory(warp_device)
    if needed > free:
        air, dense = (" x ".join(map(str, shape)) for shape in (grid.cells, grid.shape))
        raise WlmError(
            f"{scene.name}: {air} cells of air and {dense} of smoke need {needed / 2**30:.1f} GiB on {device}: expected"
            f" at most the {free / 2**30:.1f} GiB that are free: use fewer cells, a lower refine or storage: float16"
        )
    # More than can be numbered.
    smoke.require_memory(grid.shape, voxel, warp_device)


def _make_lattice(scene: Scene, device: str) -> Lattice:
    grid, air = scene.grid, scene.air
    domain = Domain(grid.cell, scene.step)
    lattice = Lattice(
        grid.cells,
        viscosity=domain.viscosity(air.viscosity),
        operator=air.operator,
        smagorinsky=air.smagorinsky,
        storage=air.storage,
        device=device,
        ramp=_RAMP * max(grid.cells),
    )
    _set_faces(lattice, scene, domain)
    return lattice


def _buoyancy(scene: Scene) -> smoke.Buoyancy | None:
    look, domain = scene.smoke, Domain(scene.grid.cell, scene.step)
    if not (look.buoyancy or look.weight):
        return None
    up = np.array(look.up) / np.linalg.norm(look.up)
    lift, weight = (domain.acceleration(value) for value in (look.buoyancy, look.weight))
    return smoke.Buoyancy(lift, weight, tuple(map(float, up)))


def _set_faces(lattice: Lattice, scene: Scene, domain: Domain) -> None:
    grid = scene.grid
    for name in FACES:
        inlets = [(i, inlet) for i, inlet in enumerate(scene.inlets) if inlet.face == name]
        kind = grid.face(name)
        if inlets:
            _set_inlets(lattice, scene, domain, name, inlets)
        elif kind in ("wall", "slip"):
            lattice.set_wall(name, slip=kind == "slip")
        elif kind == "open":
            # With inlets as much has to leave as comes in; without, air comes and goes as it is drawn.
            lattice.set_outlet(name, density=None if scene.inlets else 1.0)


def _set_inlets(lattice: Lattice, scene: Scene, domain: Domain, name: str, inlets: list[tuple[int, Inlet]]) -> None:
    """A face with inlets; where two overlap the later one counts."""
    grid = scene.grid
    across = [axis for axis in range(3) if axis != FACES.index(name) // 2]
    places = [grid.origin[axis] + grid.cell * (np.arange(grid.cells[axis]) + 0.5) for axis in across]
    first, second = np.meshgrid(*places, indexing="ij")
    velocity, opened = np.zeros((*first.shape, 3)), np.zeros(first.shape, bool)
    for number, inlet in inlets:
        here = np.ones(first.shape, bool)
        if inlet.radius is not None:
            here = np.hypot(first - inlet.centre[across[0]], second - inlet.centre[across[1]]) <= inlet.radius
        if not here.any():
            raise WlmError(f"{scene.name}: inlets.{number}: expected a cell's centre within its radius, found none")
        velocity[here] = [domain.speed(v) for v in inlet.velocity]
        opened |= here
    lattice.set_inlet(name, velocity, opened)


def _sources(scene: Scene) -> list[tuple[smoke.Source, Callable[[float], bool]]]:
    """Where smoke is held at a value, in cells, and whether at a time."""
    grid, hot = scene.grid, scene.smoke.hot
    found = []
    for inlet in scene.inlets:
        axis, high = divmod(FACES.index(inlet.face), 2)
        centre = (np.asarray(inlet.centre) - grid.origin) / grid.cell
        if inlet.radius is None:
            shape, centre, size = "box", 0.5 * np.array(grid.cells, float), 0.5 * np.array(grid.cells, float)
        else:
            shape, size = "sphere", np.full(3, inlet.radius / grid.cell)
        centre[axis] = grid.cells[axis] * high
        size[axis] = _INLET_DEPTH
        found.append((shape, centre, size, inlet, lambda time: True))
    for ball in scene.sources:
        centre = (np.asarray(ball.centre) - grid.origin) / grid.cell
        found.append(("sphere", centre, np.full(3, ball.radius / grid.cell), ball, ball.active))
    return [
        (
            smoke.Source(
                shape,
                tuple(map(float, centre)),
                tuple(map(float, size)),
                given.density,
                given.temperature if hot else 0.0,
                fixed=True,
            ),
            active,
        )
        for shape, centre, size, given, active in found
    ]


def _obstacles(scene: Scene) -> list[bodies.Obstacle]:
    grid = scene.grid
    made: list[bodies.Obstacle] = []
    for obstacle in scene.obstacles:
        keys = np.array(obstacle.path)
        path = bodies.Trajectory.of((keys[:, 1:] - grid.origin) / grid.cell, keys[:, 0] / scene.step)
        if obstacle.shape == "sphere":
            made.append(bodies.Sphere(path, obstacle.radius / grid.cell))
        else:
            points, triangles = obstacle.mesh()
            mesh = points.astype(np.float32), triangles.astype(np.int32)
            made.append(bodies.Mesh(path, *mesh, scale=1.0 / grid.cell))
    return made
