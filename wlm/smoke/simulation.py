"""Simulates a scene: makes its solver, and writes a folder with a volume of smoke per frame."""

import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from wlm.errors import WlmError
from wlm.fluid import solver as fluid
from wlm.fluid.black_body import black_body_light
from wlm.fluid.bricks import require_memory
from wlm.fluid.faces import FACES
from wlm.fluid.forcing import EDDY
from wlm.fluid.lattice import Lattice
from wlm.fluid.obstacles import SHELL, Mesh, Obstacle, Sphere, Trajectory
from wlm.fluid.slabs import Slabs
from wlm.fluid.units import Domain
from wlm.fluid.volume import DensityVolume, save_bricks, save_volume
from wlm.formats.checkpoint import EVERY, Pace
from wlm.formats.lock import locked
from wlm.smoke.data import CHECKPOINT, Frames
from wlm.smoke.scene import MOST_STEPS, Body, Inlet, Scene, SourceSettings
from wlm.system import Meter, OnProgress
from wlm_kernels.fluid.mesh_inside import contains

# Depth in cells of the smoke at an inlet, so that the air carries smoke of full density into the box.
_INLET_DEPTH = 1.0
# Steps in which inlets open, per cell of the longest axis: a sudden start causes a sound wave.
_RAMP = 4
# Speed of air in cells per step above which the step is halved, and air steps between two looks at it.
_FAST, _LOOK = 0.25, 8
# After so many durations noise repeats, so that float32 resolves its time.
_NOISE_PERIOD = 4096
# Times at which sources and inlets inside obstacles are looked for.
_LOOKS_AT_OBSTACLES = 17


def make_solver(scene: Scene, *, device: str = "cpu") -> fluid.Solver:
    """Builds the solver of a scene on a device, or on several as for `Lattice`."""
    smoke, air = scene.smoke, scene.air
    try:
        _require_memory(scene, Slabs(scene.grid.cells, device))
        lattice = _make_lattice(scene, device)
        return fluid.Solver(
            lattice,
            refinement=scene.grid.refine,
            scheme=smoke.scheme,
            storage=smoke.storage,
            temperature=smoke.hot,
            sources=sources_at(scene),
            obstacles=_obstacles(scene),
            dissipation=smoke.dissipation * scene.step,
            cooling=smoke.cooling * scene.step if smoke.hot else 0.0,
            buoyancy=_buoyancy(scene),
            confinement=air.confinement * scene.step,
            turbulence=air.turbulence and air.turbulence.scaled(scene.step, scene.grid.cell),
            fire=smoke.fire and smoke.fire.scaled(scene.step),
            wind=air.wind and air.wind.scaled(scene.step, scene.grid.cell),
            substeps=smoke.substeps,
            bricks=smoke.bricks,
            duration=scene.step,
        )
    except ValueError as error:
        # Each setting is within its range, but together they are too small or too large.
        raise WlmError(f"{scene.name}: {error}") from error


def warnings_of(scene: Scene) -> list[str]:
    """Returns a line for each inlet, source and obstacle that has no effect or another one than its picture."""
    grid, warnings, end = scene.grid, [], scene.time(scene.frames)
    low, high = np.asarray(grid.origin), grid.origin + grid.size
    corners = (", ".join(f"{number:g}" for number in corner) for corner in (low, high))
    box = f"it is outside the box from ({') to ('.join(corners)})"
    for i, inlet in enumerate(scene.inlets):
        points = _opening(scene, inlet)
        cells = set(map(tuple, points))
        others = [each for each in scene.inlets[i + 1 :] if each.face == inlet.face or inlet.density]
        over = {each.face == inlet.face for each in others if cells <= set(map(tuple, _opening(scene, each)))}
        if over or all(_is_hidden(scene, points, time) for time in _looks(scene, 0.0, end)):
            effect = "its smoke is replaced" if over == {False} else "it is closed"
            warnings.append(f"inlets.{i}: {'a later inlet' if over else 'an obstacle'} covers it, so that {effect}")
    for i, body in enumerate(scene.sources):
        duration = scene.step * scene.smoke.substeps
        spans = [(max(start, 0.0), end if stop is None else min(stop, end)) for start, stop in body.spans]
        spans = [(start, stop) for start, stop in spans if math.ceil(start / duration) * duration < stop]
        looks = [time for span in spans for time in _looks(scene, *span, body)]
        seen = [(points, time) for time in looks if len(points := _voxels(scene, body, grid.refine, time))]
        if not spans:
            warnings.append(f"sources.{i}: it is not active at a step between 0 and {end:g} s, and emits no smoke")
        elif not seen:
            reason = box if _is_outside(scene, body, looks) else "it reaches no voxel's centre"
            warnings.append(f"sources.{i}: {reason}, and emits no smoke")
        elif all(_is_hidden(scene, *each) for each in seen):
            warnings.append(f"sources.{i}: it is inside an obstacle, and emits no smoke")
        elif not (body.density or scene.smoke.hot) and body.temperature:
            warnings.append(f"sources.{i}: temperature has no effect without smoke.buoyancy and smoke.emission")
        elif (share := _share(body, grid.voxel)) < 1.0:
            warnings.append(
                f"sources.{i}: it is smaller than a voxel of {grid.voxel:g} m, and is simulated as large as one at "
                f"{share:.2g} of its density"
            )
    for i, obstacle in enumerate(scene.obstacles):
        times = obstacle.eased.times
        if _is_outside(scene, obstacle, [0.0, *times[(times > 0.0) & (times < end)], end]):
            warnings.append(f"obstacles.{i}: {box}")
        elif not obstacle.eased.moves and not len(_voxels(scene, obstacle, 1, 0.0)):
            warnings.append(f"obstacles.{i}: it reaches no cell's centre in the box, and stops no air")
        elif _is_thin(obstacle, grid.cell):
            warnings.append(
                f"obstacles.{i}: it is thinner than a cell of {grid.cell:g} m, and is simulated as a cell thick"
            )
    if (stirring := scene.air.turbulence) is not None and stirring.size < EDDY * grid.cell:
        warnings.append(f"air.turbulence: its size is below {EDDY} cells, and is simulated as {EDDY * grid.cell:g} m")
    fuel = any(each.fuel for each in (*scene.inlets, *scene.sources))
    if fuel != (scene.smoke.fire is not None):
        warnings.append("smoke.fire, fuel: only together they burn; one of them has no effect")
    if not (scene.sources or scene.inlets):
        warnings.append("sources, inlets: there are none, and thus there is no smoke")
    return [f"{scene.name}: {warning}" for warning in warnings]


def _opening(scene: Scene, inlet: Inlet) -> np.ndarray:
    """Returns the centres of the faces of cells through which an inlet's air comes, [N, 3] in cells."""
    axis, high = divmod(FACES.index(inlet.face), 2)
    counts = [1 if a == axis else n for a, n in enumerate(scene.grid.cells)]
    points = np.stack(np.meshgrid(*[np.arange(n) + 0.5 for n in counts], indexing="ij"), -1).reshape(-1, 3)
    points[:, axis] = scene.grid.cells[axis] - 0.5 if high else 0.5
    if inlet.radius is not None:
        away = points - (np.asarray(inlet.centre) - scene.grid.origin) / scene.grid.cell
        points = points[np.linalg.norm(np.delete(away, axis, 1), axis=1) <= inlet.radius / scene.grid.cell]
    return points


def _looks(scene: Scene, start: float, stop: float, body: SourceSettings | None = None) -> np.ndarray:
    """Returns times in seconds at which an inlet, or a source, is looked for in obstacles."""
    still = not scene.obstacles and (body is None or not body.eased.moves)
    return np.linspace(start, stop, 1 if still else _LOOKS_AT_OBSTACLES)


def _around(body: Body, bounds: np.ndarray, time: float) -> np.ndarray:
    """Returns the lowest and the highest corner of the box, [2, 3] in metres, around bounds of a body at a time."""
    turn = body.eased.turn(time)
    middle, half = turn @ bounds.mean(0) + body.eased.at(time), np.abs(turn) @ (0.5 * (bounds[1] - bounds[0]))
    return np.stack([middle - half, middle + half])


def _is_outside(scene: Scene, body: Body, times: Iterable[float]) -> bool:
    boxes = np.array([_around(body, body.bounds, time) for time in times])
    high = scene.grid.origin + scene.grid.size
    return bool((boxes[:, 1].max(0) <= scene.grid.origin).any() or (boxes[:, 0].min(0) >= high).any())


def _voxels(scene: Scene, body: Body, refine: int, time: float) -> np.ndarray:
    """Returns centres of voxels, `refine` along a cell, in a body and the box, [N, 3] in cells; of a large body some of
    them."""
    grid, edge, shape = scene.grid, scene.grid.cell / refine, refine * np.array(scene.grid.cells)
    low, high = (_around(body, _bounds(body, edge), time) - grid.origin) / edge
    begin, end = np.ceil(np.maximum(low, 0.0) - 0.5), np.floor(np.minimum(high, shape) - 0.5)
    axes = [np.unique(np.linspace(*ends, 16).round()) for ends in zip(begin, np.maximum(begin, end), strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3) + 0.5
    if body.surface is not None:
        # A thin shell may be between these points.
        corners, triangles = body.mesh()
        middles = corners[triangles[:: -(-len(triangles) // 4096)]].mean(1) @ body.eased.turn(time).T
        points = np.concatenate([points, np.floor((middles + body.eased.at(time) - grid.origin) / edge) + 0.5])
    points = points[((points > 0.0) & (points < shape)).all(1)]
    return points[_covers(body, edge, grid.origin + edge * points, time)] / refine


def _is_hidden(scene: Scene, points: np.ndarray, time: float) -> bool:
    """Tests whether obstacles cover the cells of all points, [N, 3] in cells, at a time in seconds."""
    cell = scene.grid.cell
    places = scene.grid.origin + cell * (np.floor(points) + 0.5)
    covered = [np.zeros(len(points), bool), *(_covers(each, cell, places, time) for each in scene.obstacles)]
    return bool(np.any(covered, axis=0).all())


def _covers(body: Body, edge: float, places: np.ndarray, time: float) -> np.ndarray:
    """Tests which places, [N, 3] in metres, are in a body as it is simulated in cells of an edge: bool [N]."""
    away = (places - body.eased.at(time)) @ body.eased.turn(time)
    if body.surface is not None:
        return contains(body.solid.on("cpu"), away, _shell(body, edge))
    away = np.abs(away - body.offset) / body.half_extents(edge)
    across, along = np.hypot(away[:, 0], away[:, 2]), away[:, 1]
    reach = {"sphere": np.hypot(across, along), "cylinder": np.maximum(across, along), "box": away.max(1)}
    return reach[body.shape] < 1.0


def volume_of(scene: Scene, solver: fluid.Solver, *, kelvin: bool = False) -> DensityVolume:
    """Returns the solver's smoke, in the solver's memory if there are no bricks, and valid until the next step. The
    temperature of fire becomes the light of black bodies or, with `kelvin`, kelvins."""
    smoke, grid = scene.smoke, scene.grid
    volume = solver.frame(extinction=smoke.extinction, emission=smoke.emission, cell=grid.cell, origin=grid.origin)
    if smoke.fire is None:
        return volume
    hot = smoke.fire.kelvin(volume.temperature)
    return replace(volume, temperature=hot if kelvin else black_body_light(hot))


def simulate(
    frames: Frames,
    *,
    solver: fluid.Solver | None = None,
    device: str = "cpu",
    resume: bool = False,
    checkpoint_every: float = EVERY,
    volumes: Literal["vdb", "nvdb", "nvdb-raw"] | None = None,
    progress: OnProgress | None = None,
) -> int:
    """Simulates a scene and writes its frames.

    The state is saved in the folder every `checkpoint_every` seconds, also within a frame, and when `progress` raises
    KeyboardInterrupt. A resumed simulation gives the same frames: on the CPU to the bit, on a GPU up to the order of
    atomic sums, and with the setting `bricks` up to the threshold below which a brick counts as empty.

    Args:
        frames: The folder, prepared by `wlm.smoke.data.open_frames`.
        solver: Solver from `make_solver`, before its first step; None: made on `device`. If a caller makes it before
            opening the folder, a failure leaves earlier frames in the folder.
        device: As for `make_solver`.
        resume: Whether to continue from a saved state, if there is one. A state past the last requested frame is kept.
        volumes: Format in which each frame is written, too, with the velocity of the air in metres per second:
            `frame_0001.vdb`, or `frame_0001.nvdb`, compressed or as a GPU holds it (nvdb-raw). None: no second file.
        checkpoint_every: Seconds between two saves of the state; 0: after every step.
        progress: Called after each frame, with the figures `smoke m³`, the integral of the density over the box, and
            `frame s`, the seconds of the frame; and about twice a second within a frame, without figures.

    Returns:
        Number of the first frame that was simulated; if all frames existed already, the number after the last frame.

    Raises:
        WlmError: As `make_solver`; an obstacle is too fast; the air blew up; a file is damaged or cannot be written; a
            frame before the saved state, or its copy in the format of `volumes`, is missing; or another process is
            writing the folder.
    """
    with locked(frames.path):
        scene, checkpoint = frames.scene, frames.path / CHECKPOINT
        missing = sorted(set(range(1, scene.frames + 1)) - set(frames.numbers))
        saved = resume and checkpoint.exists()
        suffix, _, raw = (volumes or "").partition("-")
        if resume and not saved and not missing:
            _require_copies(frames, scene.frames, suffix)
            return scene.frames + 1
        if solver is None:
            solver = make_solver(scene, device=device)
        frame, begun = 1, 0
        if saved:
            solver.load(checkpoint)
            begun = solver.steps
            frame += begun // _steps_per_frame(scene, solver)
        if saved and missing and missing[0] < frame:
            raise WlmError(
                f"{frames.path}: cannot resume after frame {frame - 1}: {frames.file(missing[0]).name} is missing;"
                " start anew without --resume"
            )
        _require_copies(frames, frame - 1, suffix)
        first, meter, pace = frame, Meter(progress, "simulate", scene.frames), Pace(checkpoint_every)
        for frame in range(first, scene.frames + 1):
            begin = time.perf_counter()
            for last in _frame_steps(scene, solver, frame):
                if last:
                    solver.check()
                    if volumes is not None:
                        velocity = solver.velocity.numpy() * (scene.grid.cell / solver.duration)
                        copy = frames.file(frame).with_suffix(f".{suffix}")
                        save_volume(
                            copy,
                            volume_of(scene, solver, kelvin=True),
                            velocity=velocity,
                            codec="none" if raw else "zip",
                        )
                    # Written before the state: a state without its frame could not be resumed.
                    numbers, values = solver.bricks()
                    if scene.smoke.fire is not None:
                        values = [values[0], scene.smoke.fire.kelvin(values[1])]
                    place = (solver.shape, scene.grid.voxel, scene.grid.origin)
                    save_bricks(frames.file(frame), numbers, values, *place)
                if pace.due():
                    with pace.saving():
                        solver.save(checkpoint)
                try:
                    if last and progress is not None:
                        mass = float(values[0].sum(dtype=torch.float64)) * scene.grid.voxel**3
                        meter.report(frame, **{"smoke_m³": mass, "frame_s": time.perf_counter() - begin})
                    elif meter.due(frame - 1):
                        meter.report(frame - 1)
                except KeyboardInterrupt:
                    solver.save(checkpoint)
                    raise
        if first <= scene.frames or begun == scene.frames * _steps_per_frame(scene, solver):
            checkpoint.unlink(missing_ok=True)
        return min(first, scene.frames + 1)


def _require_copies(frames: Frames, last: int, suffix: str) -> None:
    """Checks that the finished frames up to a last one also exist in the format of a suffix, "" for none: the velocity
    of their air is lost."""
    copies = [frames.file(frame).with_suffix(f".{suffix}") for frame in range(1, last + 1) if suffix]
    if (missing := next((copy for copy in copies if not copy.exists()), None)) is not None:
        raise WlmError(
            f"{frames.path}: cannot resume with --volumes {suffix}: {missing.name} of a finished frame is missing; "
            "start anew without --resume, or resume without --volumes"
        )


def advance(scene: Scene, solver: fluid.Solver, frame: int) -> None:
    """Advances a solver from the previous frame to the frame with number `frame`; frames count from 1."""
    for _ in _frame_steps(scene, solver, frame):
        pass


def _steps_per_frame(scene: Scene, solver: fluid.Solver) -> int:
    return round(1.0 / (scene.rate * solver.duration * solver.substeps))


def _frame_steps(scene: Scene, solver: fluid.Solver, frame: int) -> Iterator[bool]:
    """Advances a solver to the end of a frame, by one or a few steps at a time; yields after them whether it is there.
    The time step is halved while air is faster than `_FAST`."""
    every = max(_LOOK // solver.substeps, 1)
    count, longest = _steps_per_frame(scene, solver), scene.steps // solver.substeps
    step = solver.steps - (frame - 1) * count
    if step == 0 and count % longest:
        # The state is of a scene with other steps.
        solver.change_step(count / longest)
        count = longest
    # Other sources are those of `make_solver` at every step.
    changes = any(body.eased.moves or body.noise or body.spans != [(0.0, None)] for body in scene.sources)
    while step < count:
        while step % every == 0 and (speed := solver.fastest) > _FAST:
            if 2 * count * solver.substeps > MOST_STEPS:
                metres = speed * scene.grid.cell / solver.duration
                raise WlmError(
                    f"{scene.name}: frame {frame}: the air moves at {metres:.3g} m/s, {speed:.3g} cells per step: "
                    f"expected at most {_FAST} with at most {MOST_STEPS:,} steps per frame"
                )
            solver.change_step(0.5)
            step, count = 2 * step, 2 * count
        if changes:
            solver.sources = tuple(sources_at(scene, (frame - 1 + step / count) / scene.rate))
        ahead, pair = 1, solver.period
        if solver.device.is_cuda and step % pair == every % pair == 0 and step + pair <= count:
            # On a GPU a pair of steps with the same sources is a graph.
            later = changes and tuple(sources_at(scene, (frame - 1 + (step + 1) / count) / scene.rate))
            ahead = 1 if changes and later != solver.sources else pair
        solver.step(ahead)
        step += ahead
        yield step == count


def _require_memory(scene: Scene, slabs: Slabs) -> None:
    """Checks before the allocation that air and smoke fit into the free memory; raises a WlmError if not."""
    grid, smoke = scene.grid, scene.smoke
    smoke_bytes = fluid.bytes_needed(
        grid.cells, grid.refine, smoke.scheme, smoke.storage, smoke.hot, smoke.bricks, smoke.fire is not None
    )
    needed = Lattice.bytes_needed(grid.cells, scene.air.storage, save_memory=scene.air.save_memory) + smoke_bytes
    if needed > (free := slabs.free):
        air, dense = (" x ".join(map(str, shape)) for shape in (grid.cells, grid.shape))
        raise WlmError(
            f"{scene.name}: {air} cells of air and {dense} voxels of smoke need {needed / 2**30:.1f} GiB on "
            f"{slabs.name}, but only {free / 2**30:.1f} GiB are free: use fewer cells, a lower refine, bricks, "
            "storage: float16, or air.save_memory"
        )
    # A grid may also have more voxels than can be indexed.
    require_memory("smoke", grid.shape, smoke_bytes, slabs)


def _make_lattice(scene: Scene, device: str) -> Lattice:
    grid, air = scene.grid, scene.air
    domain = Domain(grid.cell, scene.step)
    lattice = Lattice(
        grid.cells,
        viscosity=domain.viscosity(air.viscosity),
        smagorinsky=air.smagorinsky,
        storage=air.storage,
        save_memory=air.save_memory,
        device=device,
        ramp=_RAMP * max(grid.cells),
    )
    balanced = (scene.inlets or scene.windy) and not (scene.smoke.fire and scene.smoke.fire.expansion)
    for name in FACES:
        inlets = [(i, inlet) for i, inlet in enumerate(scene.inlets) if inlet.face == name]
        kind = grid.face(name)
        if name in scene.windy:
            lattice.set_wind(name)
        elif inlets:
            _set_inlets(lattice, scene, domain, name, inlets)
        elif kind in ("wall", "slip"):
            lattice.set_wall(name, slip=kind == "slip")
        elif kind == "open":
            # With inlets, the outflow equals the inflow; without, or if gas expands, the outside is at rest.
            lattice.set_outlet(name, density=None if balanced else 1.0)
    return lattice


def _buoyancy(scene: Scene) -> fluid.Buoyancy | None:
    smoke, domain = scene.smoke, Domain(scene.grid.cell, scene.step)
    if not (smoke.buoyancy or smoke.weight):
        return None
    up = np.array(smoke.up) / np.linalg.norm(smoke.up)
    lift, weight = (domain.acceleration(value) for value in (smoke.buoyancy, smoke.weight))
    return fluid.Buoyancy(lift, weight, tuple(map(float, up)))


def _set_inlets(lattice: Lattice, scene: Scene, domain: Domain, name: str, inlets: list[tuple[int, Inlet]]) -> None:
    """Sets the inlets of a face; where two inlets overlap, the later one applies."""
    axis = FACES.index(name) // 2
    shape = tuple(np.delete(scene.grid.cells, axis).tolist())
    velocity, opened = np.zeros((*shape, 3)), np.zeros(shape, bool)
    for number, inlet in inlets:
        here = tuple(np.delete(_opening(scene, inlet), axis, 1).astype(int).T)
        if not len(here[0]):
            raise WlmError(f"{scene.name}: inlets.{number}: its circle covers no cell's centre: use a larger radius")
        velocity[here] = [domain.speed(v) for v in inlet.velocity]
        opened[here] = True
    lattice.set_inlet(name, velocity, opened)


def sources_at(scene: Scene, time: float | None = None) -> list[fluid.Source]:
    """Returns the smoke sources at inlets and in the box, in cells: at their places at a time in seconds those that are
    active then; None: all, at time 0."""
    sources: list[fluid.Source] = []

    def add(shape: str | Mesh, centre: np.ndarray, size: np.ndarray, values: Inlet | SourceSettings, **how) -> None:
        place, share = (tuple(map(float, centre)), tuple(map(float, size))), how.pop("share", 1.0)
        heat, fuel = (
            share * values.temperature if scene.smoke.hot else 0.0,
            share * values.fuel if scene.smoke.fire else 0.0,
        )
        sources.append(fluid.Source(shape, *place, share * values.density, heat, fixed=True, fuel=fuel, **how))

    grid = scene.grid
    half = 0.5 * np.array(grid.cells, float)
    for inlet in scene.inlets:
        axis, high = divmod(FACES.index(inlet.face), 2)
        if inlet.radius is None:
            shape, centre, size = "box", half.copy(), half.copy()
        else:
            shape, centre = "sphere", (np.asarray(inlet.centre) - grid.origin) / grid.cell
            # An ellipsoid that has the inlet's radius at the first voxels' centres, so that each open cell gets smoke.
            size = np.full(3, inlet.radius / grid.cell / math.sqrt(1.0 - (0.5 / grid.refine / _INLET_DEPTH) ** 2))
        centre[axis] = grid.cells[axis] * high
        size[axis] = _INLET_DEPTH
        add(shape, centre, size, inlet)
    for body in scene.sources:
        if time is not None and not body.active(time):
            continue
        now, how = time or 0.0, {"share": _share(body, grid.voxel), "shell": _shell(body, grid.voxel) / grid.cell}
        turn, centre = body.eased.turn(now), body.eased.at(now)
        if body.eased.turns or len(body.turn):
            how["turn"] = tuple(map(float, Rotation.from_matrix(turn).as_quat()))
        if (noise := body.noise) is not None:
            phase = now / noise.duration % _NOISE_PERIOD
            how["noise"] = fluid.Noise(noise.amount, max(noise.size, grid.voxel) / grid.cell, phase, noise.seed)
        if body.surface is None:
            shape, size, centre = body.shape, body.half_extents(grid.voxel), centre + turn @ body.offset
        else:
            shape, size = body.solid, np.ones(3)
        add(shape, (centre - grid.origin) / grid.cell, size / grid.cell, body, **how)
    return sources


def _obstacles(scene: Scene) -> list[Obstacle]:
    obstacles: list[Obstacle] = []
    grid = scene.grid
    for body in scene.obstacles:
        eased = body.eased
        path = Trajectory.of((eased.positions - grid.origin) / grid.cell, eased.times / scene.step, eased.rotations)
        if body.shape == "sphere" and not any(body.offset):
            obstacles.append(Sphere(path, float(body.half_extents(grid.cell)[0]) / grid.cell))
            continue
        points, triangles = body.mesh(grid.cell)
        how = {"scale": 1.0 / grid.cell, "shell": _shell(body, grid.cell) / grid.cell}
        obstacles.append(Mesh(path, points.astype(np.float32), triangles.astype(np.int32), **how))
    return obstacles


def _is_thin(body: Body, edge: float) -> bool:
    """Tests whether a body is simulated thicker than it is in cells of an edge in metres."""
    if (surface := body.surface) is None:
        return bool((body.half_extents(edge) > body.radius).any())
    return surface.thickness * body.scale < edge


def _shell(body: Body, edge: float) -> float:
    """Returns the thickness in metres of the shell around a mesh in cells of an edge; 0: none."""
    if body.surface is None:
        return 0.0
    only = body.surface.is_open if body.shell is None else body.shell
    return SHELL * edge if only or _is_thin(body, edge) else 0.0


def _bounds(body: Body, edge: float) -> np.ndarray:
    """Returns the bounds of a body as it is simulated in cells of an edge, [2, 3] in metres around its origin."""
    more = _shell(body, edge) if body.surface else body.half_extents(edge) - body.radius
    return body.bounds + np.multiply.outer((-1.0, 1.0), np.broadcast_to(more, 3))


def _share(source: SourceSettings, edge: float) -> float:
    """Returns the share of its density at which a source that is smaller than a voxel emits as much smoke."""
    return 1.0 if source.surface else float(np.prod(np.broadcast_to(source.radius, 3) / source.half_extents(edge)))
