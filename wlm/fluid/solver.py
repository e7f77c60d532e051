"""A simulation of smoke: air on a lattice, smoke carried by it on a finer grid, sources and obstacles
(neural-six-way-lightmaps, section 5: 100^3 velocities, 400^3 densities).

Lengths are cells of the lattice, times its steps. A step of the solver is ``substeps`` of the lattice, in this order:
obstacles move, hot smoke lifts the air, the air moves, it carries the smoke, sources give. Stated behaviours:

=====================================  ===================================================================
no smoke                               fine: the air moves, every density is 0
an obstacle that covers an inlet       nothing comes in where it lies
an obstacle or an inlet too fast       error of the lattice: the speed and its limit
air that blows up                      error of the lattice, within ``wlm.fluid.lattice.CHECK_EVERY`` of its
                                       steps: step, cell and cause, and the last good checkpoint, which stays
smoke in an obstacle                   none; what a moving one covers is lost, what it frees takes after the
                                       cells beside it
smoke at faces                         leaves through inlets and outlets, and clean air comes in; held at walls. A
                                       face with an inlet is open as a whole, beside the inlet too
a grid of one voxel                    fine
grids too large for the memory         error before any of smoke's is allocated: what they need and what there is;
                                       ``wlm.smoke.simulate.make_solver`` looks at those of air and smoke together
=====================================  ===================================================================
"""

import hashlib
import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import warp as wp

from wlm.errors import WlmError
from wlm.fluid import solver_lattice
from wlm.fluid.lattice import Lattice
from wlm.fluid.obstacles import Obstacle
from wlm.fluid.volume import DensityVolume
from wlm.formats.artifact import read_artifact, write_artifact
from wlm_kernels.fluid import advection, advection_places, advection_sources

__all__ = ["LEAST_HALF_LOSS", "SCHEMES", "Buoyancy", "Solver", "Source", "voxel_bytes"]

SCHEMES = ("maccormack", "semi-lagrangian")

_SYSTEM = "smoke-checkpoint"
# Air as fast as sound is air that blows up, cells a step: smoke moves no further between two looks.
_SOUND = math.sqrt(1.0 / 3.0)
LEAST_HALF_LOSS = 2.0**-10
"""The least part that half floats, of 11 bits, surely lose in a step: less would be rounded away each time."""


@dataclass(frozen=True)
class Source:
    """Where smoke comes from.

    Attributes:
        shape: "box" or "sphere".
        centre: Cells.
        size: Half edges, or radii, cells; above 0.
        density: A step of the lattice, or what it is held at.
        temperature: Likewise.
        fixed: Whether both are held, not added to.
    """

    shape: str
    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    density: float
    temperature: float = 0.0
    fixed: bool = False

    def __post_init__(self) -> None:
        if self.shape not in ("box", "sphere"):
            raise ValueError(f"shape: expected box or sphere, got {self.shape!r}")
        for name, least in (("centre", -math.inf), ("size", 0.0)):
            value = getattr(self, name)
            if len(value) != 3 or not all(math.isfinite(v) and v > least for v in value):
                raise ValueError(f"{name}: expected three finite numbers{' above 0' * (name == 'size')}, got {value}")
        for name in ("density", "temperature"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name}: expected a finite number of at least 0, got {value}")


@dataclass(frozen=True)
class Buoyancy:
    """What smoke does to the air, by the means over a cell of the lattice.

    Attributes:
        lift: Acceleration against gravity of temperature 1, cells a step, a step.
        weight: Acceleration along gravity of density 1, likewise.
        up: Unit vector against gravity.
    """

    lift: float
    weight: float = 0.0
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)

    def __post_init__(self) -> None:
        if not all(math.isfinite(v) for v in (self.lift, self.weight, *self.up)):
            raise ValueError("buoyancy: expected finite numbers")
        if len(self.up) != 3 or abs(math.hypot(*self.up) - 1.0) > 1e-4:
            raise ValueError(f"up: expected a vector of length 1, got {self.up}")


def voxel_bytes(scheme: str, storage: str, temperature: bool) -> int:
    """What a cell of smoke takes up in the memory, bytes; arguments as for ``Solver``."""
    fields = _buffers(scheme) * (2 if temperature else 1)
    return fields * wp.types.type_size_in_bytes(advection.STORAGES[storage])


class Solver:
    """Smoke in the air of a lattice.

    Faces are set on the lattice beforehand; its solids and its force are the solver's to set. A moving obstacle takes
    a sync with the device at each step.

    Args:
        lattice: The air. With ``buoyancy`` it must be a dense one: bricks of air at rest would feel no force.
        refinement: Cells of smoke along an edge of one of air.
        scheme: One of ``SCHEMES``.
        storage: "float32" or "float16": half the memory; 11 bits of a value are kept at each step.
        temperature: Whether smoke has one.
        sources: Where it comes from.
        obstacles: At most 255.
        dissipation: Rate at which density decays, a step of the lattice: exp(-dissipation t).
        cooling: Likewise of temperature.
        buoyancy: None for none.
        substeps: Steps of the lattice in one of the solver. A speed of 1 / substeps lets smoke jump over walls.
        bricks: Whether only bricks of 8^3 cells with smoke in them, and those beside them, are worked on.
        threshold: With bricks: the value up to which a brick counts as empty.
        checkpoint: The file of the last good state; None keeps none.
        checkpoint_every: Steps of the solver between two.

    Raises:
        ValueError: A wrong argument.
        WlmError: The memory isn't enough.
    """

    def __init__(
        self,
        lattice: Lattice,
        *,
        refinement: int = 4,
        scheme: str = "maccormack",
        storage: str = "float32",
        temperature: bool = False,
        sources: Sequence[Source] = (),
        obstacles: Sequence[Obstacle] = (),
        dissipation: float = 0.0,
        cooling: float = 0.0,
        buoyancy: Buoyancy | None = None,
        substeps: int = 2,
        bricks: bool = False,
        threshold: float = 1e-6,
        checkpoint: str | os.PathLike[str] | None = None,
        checkpoint_every: int = 50,
    ) -> None:
        for name, value, allowed in (("scheme", scheme, SCHEMES), ("storage", storage, tuple(advection.STORAGES))):
            if value not in allowed:
                raise ValueError(f"{name}: expected one of {', '.join(allowed)}, got {value!r}")
        for name, count in (("refinement", refinement), ("substeps", substeps), ("checkpoint_every", checkpoint_every)):
            if count < 1:
                raise ValueError(f"{name}: expected at least 1, got {count}")
        for name, rate in (("dissipation", dissipation), ("cooling", cooling), ("threshold", threshold)):
            if not (math.isfinite(rate) and rate >= 0.0):
                raise ValueError(f"{name}: expected a number of at least 0, got {rate}")
        self._share = (math.exp(-dissipation * substeps), math.exp(-cooling * substeps))
        if storage == "float16" and any(0.0 < 1.0 - s < LEAST_HALF_LOSS for s in self._share):
            raise ValueError(f"dissipation, cooling: expected 0 or {LEAST_HALF_LOSS:.2g} a step and more with float16")
        if len(obstacles) > 255:
            raise ValueError(f"obstacles: expected at most 255, got {len(obstacles)}")
        if buoyancy is not None and solver_lattice.has_bricks(lattice):
            raise ValueError("buoyancy: expected a lattice without bricks: those at rest would feel no force")
        if not temperature and (cooling or (buoyancy and buoyancy.lift) or any(s.temperature for s in sources)):
            raise ValueError("temperature: expected True, since something asks for one")
        self.lattice, self.device, self.scheme, self.substeps = lattice, lattice.device, scheme, substeps
        self.sources, self.obstacles, self.buoyancy = tuple(sources), tuple(obstacles), buoyancy
        self.shape = tuple(refinement * size for size in lattice.shape)
        stored = advection.STORAGES[storage]
        solver_lattice.require_memory(self.shape, voxel_bytes(scheme, storage, temperature), self.device)
        self._box = advection_places.make_box(lattice.shape, refinement, solver_lattice.ends(lattice))
        self._threshold, self._checkpoint, self._every, self._kept = threshold, checkpoint, checkpoint_every, ""
        self._fields = [
            advection.Fields(self._zeros(self.shape, stored), self._zeros(self.shape if temperature else (0,), stored))
            for _ in range(_buffers(scheme))
        ]
        coarse = lattice.shape
        self._velocity = self._zeros(coarse, wp.vec3)
        self._force = None
        if buoyancy is not None:
            self._force = self._zeros(coarse, wp.vec3)
            lattice.set_force(self._force)
        self._solid = self._zeros(coarse if obstacles else (0,), wp.uint8)
        self._walls = [self._zeros((self._solid.size,), wp.uint8) for _ in range(2)]
        self._placed = np.full((len(obstacles), 2, 3), np.nan)
        self._bricks = None
        if bricks:
            rings = advection_places.rings_for(_SOUND * substeps * refinement)
            self._bricks = advection_places.make_bricks(self._box, rings, str(self.device))
        self._settings = {
            "lattice": list(coarse),
            "refinement": refinement,
            "scheme": scheme,
            "storage": storage,
            "temperature": temperature,
            "sources": [asdict(source) for source in self.sources],
            "obstacles": [obstacle.describe() for obstacle in self.obstacles],
            "dissipation": dissipation,
            "cooling": cooling,
            "buoyancy": None if buoyancy is None else asdict(buoyancy),
            "substeps": substeps,
            "bricks": bricks,
            "threshold": threshold,
        }
        # As JSON gives it back, which has no tuples.
        self._settings: dict[str, Any] = json.loads(json.dumps(self._settings))
        self._done = 0

    # What happens.

    def step(self, steps: int = 1) -> None:
        """Goes on by some steps, and keeps a checkpoint where one is due.

        Within the capture of a CUDA graph nothing is looked at or kept: call ``check`` between replays. Their number,
        and that of the steps done before, must be a multiple of ``period`` there, ``substeps`` of the lattice's own,
        and obstacles must rest.

        Raises:
            WlmError: The air blew up, an obstacle is too fast, or the checkpoint can't be written.
        """
        if steps < 0:
            raise ValueError(f"steps: expected at least 0, got {steps}")
        capturing = self.device.is_cuda and self.device.is_capturing
        uneven = steps % self.period or self._done % self.period or self.substeps % self.lattice.period
        if capturing and (uneven or not self._done or any(obstacle.path.moves for obstacle in self.obstacles)):
            raise ValueError(
                f"steps: expected, in a graph, a multiple of {self.period} after eager ones, substeps that are one of"
                f" {self.lattice.period} and obstacles at rest"
            )
        for _ in range(steps):
            if not capturing:
                self._place_obstacles()
            self._step()
            self._done += 1
            if self._checkpoint is not None and not capturing and self._done % self._every == 0:
                self.save(self._checkpoint)

    def check(self) -> None:
        """Looks whether the air is still air; syncs with the device.

        Raises:
            WlmError: It blew up; the line names step, cell, cause and the checkpoint saved or loaded last.
        """
        with solver_lattice.adding(lambda: self._kept):
            self.lattice.check()

    @property
    def period(self) -> int:
        """Steps after which all buffers are where they were: what a graph may hold."""
        return 2

    @property
    def steps(self) -> int:
        """Steps done, by replays of a graph too; syncs with the device."""
        return self.lattice.steps // self.substeps

    # What comes out.

    @property
    def density(self) -> wp.array:
        """float or half [X, Y, Z] on the device; good until the next step."""
        return self._fields[0].density

    @property
    def temperature(self) -> wp.array | None:
        """Likewise; None without one."""
        return self._fields[0].heat if self._fields[0].heat.size else None

    @property
    def solid(self) -> wp.array:
        """uint8 [cells of the lattice], the obstacles' numbers; [0] without any."""
        return self._solid

    @property
    def velocity(self) -> wp.array:
        """vec3 [cells of the lattice], cells a step: what carried the smoke in the last step."""
        return self._velocity

    @property
    def active_cells(self) -> int:
        """Cells of smoke worked on in the last step, to the brick; all without bricks. Syncs with the device."""
        if self._bricks is None:
            return math.prod(self.shape)
        return int(self._bricks.count.numpy()[0]) * advection_places.BRICK**3

    def frame(
        self,
        *,
        extinction: float = 1.0,
        emission: float = 1.0,
        cell: float = 1.0,
        origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> DensityVolume:
        """The smoke as it is, to render; it shares the solver's memory and is good until the next step.

        Args:
            extinction: Per length of the world, of density 1.
            emission: Light given off per length of the world at temperature 1.
            cell: Edge of a cell of the lattice in the world's unit.
            origin: Corner of the domain in the world.
        """
        hot = None if self.temperature is None else wp.to_torch(self.temperature)
        return DensityVolume(
            density=wp.to_torch(self.density),
            extinction=extinction,
            voxel=cell * self._box.share,
            origin=origin,
            temperature=hot,
            emission=emission,
        )

    # Checkpoints.

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes all of the state, whole or not at all.

        Raises:
            WlmError: The air blew up, or the file can't be written; what was there before stays.
        """
        self.check()
        air = self.lattice.state()
        tensors = {f"lattice.{name}": value for name, value in air.items()}
        # On a CPU .numpy() is the array itself; it is written before the next step changes it.
        tensors |= {"density": self.density.numpy(), "placed": self._placed}
        if self.temperature is not None:
            tensors["temperature"] = self.temperature.numpy()
        text = json.dumps(self._settings, sort_keys=True).encode()
        source = hashlib.blake2b(text, digest_size=16).hexdigest()
        write_artifact(path, _SYSTEM, self._settings, tensors, source)
        self._keep(path, air["steps"])

    def load(self, path: str | os.PathLike[str]) -> None:
        """Goes on from a checkpoint of a solver and a lattice of the same settings.

        On a CPU to the same last bit; on a GPU as far as the atomic sums of its outlets come out alike. A lattice of
        bricks goes on the same to its tolerance, smoke in bricks to its threshold.

        Raises:
            WlmError: The file is damaged, or of another simulation; the line names what differs.
        """
        artifact = read_artifact(path, _SYSTEM)
        for name, value in self._settings.items():
            if (found := artifact.settings.get(name)) != value:
                raise WlmError(f"{path}: {name}: expected {value}, found {found}: a checkpoint of another simulation")
        state, now = artifact.tensors, self._fields[0]
        expected = {"density": now.density.numpy(), "placed": self._placed}
        if self.temperature is not None:
            expected["temperature"] = now.heat.numpy()
        for name, like in expected.items():
            got = state.get(name)
            if got is None or got.shape != like.shape or got.dtype != like.dtype:
                raise WlmError(f"{path}: {name}: expected {like.dtype} {like.shape}, found {_named(got)}")
        parts = {name.removeprefix("lattice."): v for name, v in state.items() if name.startswith("lattice.")}
        with solver_lattice.adding(lambda: f" (in {path})"):
            self.lattice.load(parts)
        for fields in self._fields[1:]:
            fields.density.zero_()
            fields.heat.zero_()
        now.density.assign(state["density"])
        if self.temperature is not None:
            now.heat.assign(state["temperature"])
        self._placed = np.array(state["placed"])
        self._done = self.steps
        if self.obstacles:
            # The lattice of a state before the first step has no solid yet.
            if parts["solid"].size:
                self._solid.assign(np.array(parts["solid"]).reshape(self._solid.shape))
            else:
                self._solid.zero_()
            advection_places.mark_walls(self._box, self._solid.flatten(), self._walls[0])
        if self._bricks is not None:
            self._bricks.busy.fill_(1)
        self._keep(path, parts["steps"])

    # Within a step.

    def _keep(self, path: str | os.PathLike[str], steps: np.ndarray) -> None:
        """Notes for the line of an error where a state is kept; in the lattice's steps, as that line is."""
        self._kept = f"; the state of step {int(steps)} is kept in {path}"

    def _place_obstacles(self) -> None:
        """Puts obstacles where they will be in the middle of the step; nothing if they are there and at rest."""
        begin = float(self._done * self.substeps)
        placed = np.empty_like(self._placed)
        for k, obstacle in enumerate(self.obstacles):
            at = [obstacle.path.at(begin + t * self.substeps) for t in (0.0, 0.5, 1.0)]
            placed[k] = at[1], (at[2] - at[0]) / self.substeps
        if np.array_equal(placed, self._placed):
            return
        for k, obstacle in enumerate(self.obstacles):
            obstacle.cover(self._solid, k + 1, placed[k, 0])
        with solver_lattice.adding(lambda: self._kept):
            self.lattice.set_solid(self._solid, placed[:, 1])
        old, new = self._walls
        advection_places.mark_walls(self._box, self._solid.flatten(), new)
        where = [self._bricks, self._threshold]
        advection_sources.change_solids(self._box, old, new, self._flat(0), *where)
        self._walls = [new, old]
        self._placed = placed

    def _step(self) -> None:
        box, walls, bricks = self._box, self._walls[0], self._bricks
        if bricks is not None:
            advection_places.relist(box, bricks)
            for fields in self._fields:
                advection_sources.rest(box, bricks, fields.density.flatten())
                if fields.heat.size:
                    advection_sources.rest(box, bricks, fields.heat.flatten())
        if self.buoyancy is not None:
            fall = [-self.buoyancy.weight * a for a in self.buoyancy.up]
            rise = [self.buoyancy.lift * a for a in self.buoyancy.up]
            advection_sources.buoyancy(box, walls, self._flat(0), fall, rise, self._force.flatten(), bricks)
        with solver_lattice.adding(lambda: self._kept):
            self.lattice.step(self.substeps)
        self.lattice.velocity(out=self._velocity)
        how = [box, self._velocity.flatten(), walls, self._flat(0), self._flat(1)]
        where = {"bricks": bricks, "threshold": self._threshold}
        if self.scheme == "maccormack":
            advection.advect(*how, self.substeps, **where)
            advection.correct(*how, self._flat(2), self.substeps, self._share, **where)
            self._fields[0], self._fields[2] = self._fields[2], self._fields[0]
        else:
            advection.advect(*how, self.substeps, self._share, **where)
            self._fields[0], self._fields[1] = self._fields[1], self._fields[0]
        for source in self.sources:
            kind = advection_sources.BOX if source.shape == "box" else advection_sources.SPHERE
            times = 1.0 if source.fixed else float(self.substeps)
            centre, half = ([box.ratio * v for v in each] for each in (source.centre, source.size))
            value = (times * source.density, times * source.temperature)
            fixed = {"fixed": source.fixed, **where}
            advection_sources.add_source(box, walls, kind, centre, half, value, self._flat(0), **fixed)

    def _flat(self, k: int) -> advection.Fields:
        return advection.Fields(self._fields[k].density.flatten(), self._fields[k].heat.flatten())

    def _zeros(self, shape: tuple[int, ...], dtype) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self.device)


def _buffers(scheme: str) -> int:
    return 3 if scheme == "maccormack" else 2


def _named(array: np.ndarray | None) -> str:
    return "none" if array is None else f"{array.dtype} {array.shape}"
