"""A simulation of smoke: air on a lattice, and smoke carried by it on a finer grid, with sources and obstacles
(neural-six-way-lightmaps, section 5: 100^3 velocities, 400^3 densities).

Lengths are in cells of the lattice, times in its steps. A step of the solver is `substeps` of the lattice, in this
order: smoke accelerates the air (buoyancy), the air and the obstacles move, the air carries the smoke, sources add
smoke, and cells that obstacles cover lose theirs.
"""

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import warp as wp

from wlm.errors import WlmError
from wlm.fluid.bricks import INDEX_BYTES, BrickPool, require_memory
from wlm.fluid.faces import axis_ends
from wlm.fluid.forcing import CALM, Fire, Turbulence, Wind
from wlm.fluid.lattice import CHECK_EVERY, Lattice
from wlm.fluid.obstacles import Mesh, Obstacle
from wlm.fluid.volume import DensityVolume, gather, scatter
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.formats.parts import Part, check_part, check_parts
from wlm.interop import no_collection
from wlm_kernels.fluid import advection, advection_places, advection_sources, fire, forcing
from wlm_kernels.fluid.advection_places import DENSE
from wlm_kernels.fluid.lattice_links import WIND

SCHEMES = ("maccormack", "semi-lagrangian")

LEAST_HALF_LOSS = 2.0**-10
"""Smallest relative decay per step that half floats of 11 bits can represent; less would be lost to rounding."""

_SYSTEM = "smoke-checkpoint"
_EMITTED = ("density", "temperature", "fuel")
# The speed of sound in cells per step. The lattice treats faster air as an error, so that smoke moves at most this far.
_SOUND = math.sqrt(1.0 / 3.0)


@dataclass(frozen=True)
class Noise:
    """Smooth noise by which the values of a source vary, in the source's frame: Perlin noise in space and time (Perlin,
    "Improving noise", 2002).

    Attributes:
        amount: Largest change relative to the source's values, at least 0; values stay at least 0.
        size: Distance in cells over which it changes, above 0.
        phase: Time in units over which it changes; a constant one is noise at rest.
        seed: Number of the pattern.
    """

    amount: float
    size: float
    phase: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not (0.0 <= self.amount < math.inf and 0.0 < self.size < math.inf and math.isfinite(self.phase)):
            raise ValueError(f"noise: expected an amount of at least 0, a size above 0 and a phase, got {self}")


@dataclass(frozen=True)
class Source:
    """A region that emits smoke, in cells and steps of the lattice.

    Attributes:
        shape: "box", "sphere" (with three radii, an ellipsoid), "cylinder" along y, or a mesh, of which the path, the
            scale and the shell have no effect.
        centre: Centre, or origin of the mesh, in cells.
        size: Half edges of the box or cylinder, radii, or cells per unit of the mesh, along x, y and z; above 0.
        density: Density added per step of the lattice or, with `fixed`, the density to set.
        temperature: Temperature added per step or, with `fixed`, the temperature to set.
        fuel: Fuel, likewise.
        fixed: Whether density, temperature and fuel are set instead of added.
        turn: Unit quaternion (x, y, z, w) that turns the region about its centre.
        shell: Distance in cells from a mesh's surface within which smoke is emitted, too.
        noise: Variation of the values; None: none.
    """

    shape: str | Mesh
    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    density: float
    temperature: float = 0.0
    fixed: bool = False
    fuel: float = 0.0
    turn: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    shell: float = 0.0
    noise: Noise | None = None

    def __post_init__(self) -> None:
        if not (isinstance(self.shape, Mesh) or self.shape in advection_sources.SHAPES[:3]):
            names = ", ".join(map(repr, advection_sources.SHAPES[:3]))
            raise ValueError(f"shape: expected {names} or a mesh, got {self.shape!r}")
        for name, least in (("centre", -math.inf), ("size", 0.0)):
            value = getattr(self, name)
            if len(value) != 3 or not all(math.isfinite(v) and v > least for v in value):
                raise ValueError(f"{name}: expected three finite numbers{' above 0' * (name == 'size')}, got {value}")
        for name in (*_EMITTED, "shell"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name}: expected a finite number of at least 0, got {value}")
        if len(self.turn) != 4 or not abs(math.hypot(*self.turn) - 1.0) < 1e-3:
            raise ValueError(f"turn: expected a quaternion of length 1, got {self.turn}")

    def region(self, refinement: int, device: str) -> advection_sources.Region:
        """Returns the region in cells of smoke, with the mesh on a device."""
        centre, size = ([refinement * v for v in values] for values in (self.centre, self.size))
        how: dict[str, Any] = {"turn": self.turn}
        shape = self.shape
        if isinstance(shape, Mesh):
            how |= {"extent": shape.extent, "shell": refinement * self.shell}
            shape = shape.on(device)
        if (noise := self.noise) is not None:
            how |= {"noise": (noise.amount, refinement * noise.size, noise.phase), "seed": noise.seed}
        return advection_sources.make_region(shape, centre, size, **how)

    def steps(self, substeps: int) -> float:
        """Returns the factor of density and temperature in a step of the solver."""
        return 1.0 if self.fixed else float(substeps)


@dataclass(frozen=True)
class Buoyancy:
    """The acceleration of the air by smoke, linear in density and temperature.

    Attributes:
        lift: Upward acceleration at temperature 1, in cells of the lattice per step squared.
        weight: Downward acceleration at density 1, in the same unit.
        up: Unit vector against gravity.
    """

    lift: float
    weight: float = 0.0
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)

    def __post_init__(self) -> None:
        if not all(math.isfinite(v) for v in (self.lift, self.weight, *self.up)):
            raise ValueError("buoyancy: expected finite numbers, got NaN or infinity")
        if len(self.up) != 3 or abs(math.hypot(*self.up) - 1.0) > 1e-4:
            raise ValueError(f"up: expected a vector of length 1, got {self.up}")

    @property
    def by_density(self) -> list[float]:
        """The acceleration at density 1 and temperature 0, (3,)."""
        return [-self.weight * a for a in self.up]

    @property
    def by_temperature(self) -> list[float]:
        """The acceleration at temperature 1 and density 0, (3,)."""
        return [self.lift * a for a in self.up]


@dataclass(frozen=True, eq=False)
class SmokeSetup:
    """The settings of a solver, with a copy of its obstacles, for `wlm.fluid.gradients`.

    Attributes:
        shape: Cells of smoke along x, y and z.
        box: The domain.
        walls: uint8 [cells of the lattice], marks of solids; [0] without obstacles.
        scheme, storage, substeps, sources, buoyancy: As for `Solver`.
        temperature: Whether the smoke has a temperature.
        decay: Factors of density and temperature per step.
        bricks: Whether only bricks with smoke are computed.
        stirred: Whether confinement, turbulence or fire acts.
    """

    shape: tuple[int, int, int]
    box: advection_places.Box
    walls: wp.array
    scheme: str
    storage: str
    substeps: int
    sources: tuple[Source, ...]
    buoyancy: Buoyancy | None
    temperature: bool
    decay: tuple[float, float]
    bricks: bool
    stirred: bool


def bytes_needed(
    air: tuple[int, int, int],
    refinement: int,
    scheme: str,
    storage: str,
    temperature: bool,
    bricks: bool,
    fuel: bool = False,
) -> int:
    """Returns the memory that smoke and its traces take at the start, in bytes; arguments as for `Solver`, and the
    cells of air."""
    traces = ways_of(scheme) * math.prod(air) * wp.types.type_size_in_bytes(wp.vec3)
    if bricks:
        return traces + INDEX_BYTES * math.prod(-(-refinement * n // advection_places.BRICK) for n in air)
    voxels = refinement**3 * math.prod(air) * wp.types.type_size_in_bytes(advection.STORAGES[storage])
    return traces + voxels * _buffers(scheme) * (1 + temperature + fuel)


class Solver:
    """Simulates smoke in the air of a lattice.

    Set the faces of the lattice beforehand; the solver sets the bodies of the lattice and its force.

    Args:
        lattice: The air.
        refinement: Cells of smoke along an edge of a cell of the lattice.
        scheme: Advection scheme, one of `SCHEMES`.
        storage: "float32" or "float16", which halves the memory at the same speed but rounds to 11 bits at each step.
        temperature: Whether the smoke has a temperature.
        sources: Sources of smoke.
        obstacles: At most 255 obstacles.
        dissipation: Decay rate of the density: exp(-dissipation t) of it remains after t steps of the lattice.
        cooling: Decay rate of the temperature, in the same unit.
        buoyancy: Acceleration of the air by smoke; None: smoke does not move the air.
        confinement: Strength of the vorticity confinement per step of the lattice (Fedkiw, Stam and Jensen 2001: eps).
        turbulence: Random acceleration of all air.
        fire: How fuel burns, in steps; the smoke must have a temperature. None: there is no fuel.
        wind: Velocity of the wind at the lattice's faces for it, in cells per step at times in steps.
        substeps: Steps of the lattice per step of the solver. Above a speed of 1 / substeps smoke can jump over walls.
        bricks: Whether only bricks of 8^3 cells that contain smoke, and their neighbours, are stored and computed.
        threshold: With bricks, the largest value in a brick that counts as empty.
        duration: Duration of a step of the lattice, in any unit of time.

    Attributes:
        duration: Duration of a step; `change_step` and `load` change it.
        period: A CUDA graph must contain a multiple of this number of steps, see `step`.

    Raises:
        ValueError: An argument is wrong.
        WlmError: There is not enough memory.
    """

    period = 2

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
        confinement: float = 0.0,
        turbulence: Turbulence | None = None,
        fire: Fire | None = None,
        wind: Wind | None = None,
        substeps: int = 2,
        bricks: bool = False,
        threshold: float = 1e-6,
        duration: float = 1.0,
    ) -> None:
        for name, value, allowed in (("scheme", scheme, SCHEMES), ("storage", storage, tuple(advection.STORAGES))):
            if value not in allowed:
                raise ValueError(f"{name}: expected one of {', '.join(allowed)}, got {value!r}")
        for name, count in (("refinement", refinement), ("substeps", substeps)):
            if count < 1:
                raise ValueError(f"{name}: expected at least 1, got {count}")
        rates = {"dissipation": dissipation, "cooling": cooling, "threshold": threshold, "confinement": confinement}
        for name, rate in rates.items():
            if not (math.isfinite(rate) and rate >= 0.0):
                raise ValueError(f"{name}: expected a number of at least 0, got {rate}")
        # Steps after which smoke decays: only with float16 and a shortened step more than one.
        self._rates, self._decay_every = (dissipation * substeps, cooling * substeps), 1
        if storage == "float16" and any(0.0 < 1.0 - math.exp(-rate) < LEAST_HALF_LOSS for rate in self._rates):
            least = f"0, or a loss of at least {LEAST_HALF_LOSS:.2g} of the value per solver step"
            raise ValueError(f"dissipation, cooling: with float16 expected {least}, got less")
        if len(obstacles) > 255:
            raise ValueError(f"obstacles: expected at most 255, got {len(obstacles)}")
        if not temperature and (fire or cooling or (buoyancy and buoyancy.lift) or any(s.temperature for s in sources)):
            raise ValueError("temperature: expected True, since a source, buoyancy, fire or cooling uses it, got False")
        if fire is None and any(source.fuel for source in sources):
            raise ValueError("fuel: expected a fire, since a source emits fuel, got none")
        self.lattice, self.device, self.scheme, self.substeps = lattice, lattice.device, scheme, substeps
        self.sources, self.obstacles, self.buoyancy = tuple(sources), tuple(obstacles), buoyancy
        self.duration = duration
        self.shape = tuple(refinement * size for size in lattice.shape)
        self._stored = advection.STORAGES[storage]
        needed = bytes_needed(lattice.shape, refinement, scheme, storage, temperature, bricks, fire is not None)
        require_memory("smoke", self.shape, needed, lattice.slabs)
        if bricks and len(lattice.slabs.parts) > 1:
            raise ValueError("bricks: expected none on several devices, since a device computes all cells of its part")
        self._box = advection_places.make_box(lattice.shape, refinement, axis_ends(lattice.faces))
        self._kept = ""
        # The settings on which the arrays of a checkpoint depend.
        self._grids = {
            "lattice": list(lattice.shape),
            "refinement": refinement,
            "storage": storage,
            "temperature": temperature,
            "substeps": substeps,
            "obstacles": len(obstacles),
        } | ({} if fire is None else {"fuel": True})
        self._parts = ("density", *["temperature"] * temperature, *["fuel"] * (fire is not None))
        self._fire = fire
        self._threshold = threshold
        self._pool = self._make_pool() if bricks else None
        # Without a pool, the bricks that smoke may reach in a step; the cells of others need only be set to 0.
        self._near = DENSE if bricks else advection_places.make_bricks(self._box, self._rings, 0.0, str(self.device))
        self._near.workers = 0
        cells = math.prod(self.shape)
        self._fields = self._pool.fields if self._pool else [self._make_fields(cells) for _ in range(_buffers(scheme))]
        self._touched: tuple[Source, ...] = ()
        self._velocity = self._zeros(lattice.shape, wp.vec3)
        self._traces = self._zeros((ways_of(scheme), math.prod(lattice.shape)), wp.vec3).flatten()
        if wind is not None and not any((face.kind == WIND).any() for face in lattice.faces.values()):
            raise ValueError("wind: expected a lattice with a face for it (set_wind), got none")
        self._confinement, self._turbulence, self._wind = confinement, turbulence, wind
        self._modes = CALM if turbulence is None else turbulence.modes(str(self.device))
        self._stirred = confinement > 0.0 or turbulence is not None
        if fire is not None:
            self._growth = self._zeros(lattice.shape, float)
            lattice.set_growth(self._growth)
        self._force = None
        if buoyancy is not None or self._stirred:
            self._force = self._zeros(lattice.shape, wp.vec3)
            lattice.set_force(self._force)
        self._walls = [self._zeros((math.prod(lattice.shape) if obstacles else 0,), wp.uint8) for _ in range(2)]
        if obstacles:
            lattice.set_bodies(self.obstacles)
            advection_places.mark_walls(self._box, self.solid.flatten(), self._walls[0])
        self._done = 0
        # The settings of the last steps, and a graph of steps with them; None: these steps cannot be captured.
        graphs = self.device.is_cuda and substeps % lattice.period == 0 and wind is None
        graphs = graphs and (self._pool is None or self._pool.is_full)
        self._captures: tuple[tuple, wp.Graph | None] | None = ((), None) if graphs else None

    # Running.

    def step(self, steps: int = 1) -> None:
        """Advances air and smoke by a number of steps.

        During the capture of a CUDA graph it does not check the air: call `check` between replays of the graph. The
        number of steps, and the number of steps done before the capture, must then be multiples of `period`, `substeps`
        must be a multiple of the lattice's `period`. With bricks call `reserve` before.

        Raises:
            WlmError: The air blew up, an obstacle is too fast, or bricks do not fit into the memory.
        """
        if steps < 0:
            raise ValueError(f"steps: expected at least 0, got {steps}")
        capturing = self.device.is_cuda and self.device.is_capturing
        uneven = steps % self.period or self._done % self.period or self.substeps % self.lattice.period
        uneven = uneven or self._decay_every > 1 or not (self._pool is None or self._pool.is_full)
        if capturing and (uneven or not self._done or self._wind is not None):
            raise ValueError(
                f"steps: expected no wind, room for all bricks (`reserve`), substeps a multiple of "
                f"{self.lattice.period}, and a multiple of "
                f"{self.period} steps in the captured CUDA graph and before it; got {steps} after {self._done}"
            )
        while steps > 0:
            if not capturing and steps >= self.period and self._replay():
                steps -= self.period
                continue
            if self._wind is not None:
                self.lattice.blow(self._wind.at((self._done + 0.5) * self.substeps))
            self._step()
            self._done += 1
            steps -= 1

    def reserve(self) -> None:
        """Makes room for all bricks of the box, which is not needed without bricks.

        Raises:
            WlmError: There is not enough memory.
        """
        if self._pool is not None:
            self._pool.reserve(self._pool.most)

    def change_step(self, factor: float) -> None:
        """Changes the duration of a step by a factor, with all settings and the state: the flow goes on as it was.

        Speeds, accelerations and rates, also those of `sources` and `buoyancy`, are per step, and change accordingly.

        Args:
            factor: New duration over old one; `steps` divided by it must be a whole number.

        Raises:
            ValueError: There is no whole number of steps.
            WlmError: An inlet or a body becomes too fast.
        """
        done = round(self.steps / factor)
        if not math.isclose(done * factor, self.steps):
            raise ValueError(f"factor: expected one that divides {self.steps} steps into whole ones, got {factor}")
        self.lattice.change_step(factor)
        self._done = done
        wp.to_torch(self._velocity).mul_(factor)
        self._convert_settings(factor)

    def _convert_settings(self, factor: float) -> None:
        self.duration *= factor
        self._rates = (self._rates[0] * factor, self._rates[1] * factor)
        self._decay_every = 1
        if self._grids["storage"] == "float16":
            least = min((rate for rate in self._rates if rate), default=math.inf)
            while 1.0 - math.exp(-least * self._decay_every) < LEAST_HALF_LOSS:
                self._decay_every *= 2
        self.sources = tuple(
            source if source.fixed else replace(source, **{name: factor * getattr(source, name) for name in _EMITTED})
            for source in self.sources
        )
        if self.buoyancy is not None:
            square = factor * factor
            self.buoyancy = replace(
                self.buoyancy, lift=square * self.buoyancy.lift, weight=square * self.buoyancy.weight
            )
        self._confinement *= factor
        self._fire = self._fire and self._fire.scaled(factor)
        if self._wind is not None:
            self._wind = self._wind.scaled(factor)
        if self._turbulence is not None:
            self._turbulence = self._turbulence.scaled(factor)
            self._modes = self._turbulence.modes(str(self.device))

    @property
    def fastest(self) -> float:
        """Largest speed of the air that moved the smoke in the last step, cells per step; waits for the device."""
        return float(torch.linalg.vector_norm(wp.to_torch(self._velocity), dim=-1).max())

    @property
    def _decay(self) -> tuple[float, float]:
        """Factors of density and temperature in the next step."""
        if (self._done + 1) % self._decay_every:
            return 1.0, 1.0
        return math.exp(-self._rates[0] * self._decay_every), math.exp(-self._rates[1] * self._decay_every)

    def check(self) -> None:
        """Checks that the air has not blown up; waits for the device.

        Raises:
            WlmError: The air blew up; the message names step, cell, cause and the state that was saved or loaded last.
        """
        with self._naming_checkpoint():
            self.lattice.check()

    @property
    def steps(self) -> int:
        """Number of steps done, including replays of graphs; waits for the device."""
        return self.lattice.steps // self.substeps

    # Results.

    @property
    def density(self) -> wp.array:
        """The density, float or half [X, Y, Z] on the device; valid until the next step. With bricks it is a copy, made
        at each call."""
        return self._whole(self._fields[0].density)

    @property
    def temperature(self) -> wp.array | None:
        """The temperature, an array like the density; None if the smoke has none."""
        return self._whole(self._fields[0].temperature) if self._grids["temperature"] else None

    def bricks(self) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """Returns the bricks that have smoke, heat or fuel, as `wlm.fluid.volume.gather` does; a solver with bricks
        makes no array of all cells for it."""
        parts = self._fields[0].parts
        if self._pool is None:
            return gather([wp.to_torch(part.reshape(self.shape)) for part in parts])
        numbers = self._pool.numbers()
        values = [self._pool.values(part, numbers) for part in parts]
        some = torch.stack([(part != 0).flatten(1).any(1) for part in values]).any(0)
        return numbers[some], [part[some] for part in values]

    def _whole(self, field: wp.array) -> wp.array:
        if self._pool is None:
            return field.reshape(self.shape)
        numbers = self._pool.numbers()
        return wp.from_torch(scatter(numbers, self._pool.values(field, numbers), self.shape))

    @property
    def solid(self) -> wp.array:
        """Numbers of the obstacles, uint8 [cells of the lattice]; [0] without obstacles."""
        return self.lattice.solid

    @property
    def velocity(self) -> wp.array:
        """Velocity of the air that moved the smoke in the last step, vec3 [cells of the lattice], cells per step."""
        return self._velocity

    @property
    def active_cells(self) -> int:
        """Number of cells of smoke that the last step computed; without bricks all. Waits for the device."""
        bricks = None if self._pool is None else int(self._bricks.counts.numpy()[0])
        return math.prod(self.shape) if bricks is None else bricks * advection_places.CELLS

    @property
    def stored_bytes(self) -> int:
        """Memory of density and temperature with all buffers of a step, in bytes."""
        return sum(part.capacity for each in self._fields for part in each.parts)

    def frame(
        self,
        *,
        extinction: float = 1.0,
        emission: float = 1.0,
        cell: float = 1.0,
        origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> DensityVolume:
        """Returns the smoke as a volume, which shares the solver's memory and is valid until the next step.

        Args:
            extinction: Extinction per length of the world at density 1.
            emission: Light emitted per length of the world at temperature 1.
            cell: Edge of a cell of the lattice in the world's unit.
            origin: Corner of the domain in the world.
        """
        where: dict[str, Any] = {"voxel": cell * self._box.voxel, "origin": origin}
        shape = self.shape
        if self._pool is not None:
            shape = (-1, *[advection_places.BRICK] * 3)
            places = wp.to_torch(self._bricks.places).view(*self._box.bricks)
            where |= {"places": places, "cells": self.shape}
        density, *more = (wp.to_torch(part).view(shape) for part in self._fields[0].parts)
        heat = more[0] if self._grids["temperature"] else None
        return DensityVolume(density, extinction, temperature=heat, emission=emission, **where)

    def setup(self) -> SmokeSetup:
        """Returns the settings, with a copy of the obstacles' cells."""
        return SmokeSetup(
            shape=self.shape,
            box=self._box,
            walls=wp.clone(self._walls[0]),
            scheme=self.scheme,
            storage=self._grids["storage"],
            substeps=self.substeps,
            sources=self.sources,
            buoyancy=self.buoyancy,
            temperature=self._grids["temperature"],
            decay=self._decay,
            bricks=self._pool is not None,
            stirred=self._stirred or self._fire is not None,
        )

    # Checkpoints.

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the complete state to a checkpoint file, whole or not at all.

        Raises:
            WlmError: The air blew up, or the file cannot be written; an earlier file is kept.
        """
        self.check()
        air = self.lattice.state()
        tensors = {f"lattice.{name}": value for name, value in air.items()}
        # On a CPU .numpy() shares the array's memory; it is written before the next step changes it.
        numbers, values = self.bricks()
        tensors |= {"velocity": self._velocity.numpy(), "bricks": numbers.cpu().numpy()}
        tensors |= {name: part.cpu().numpy() for name, part in zip(self._parts, values, strict=True)}
        settings = self._grids | {"duration": self.duration}
        text = json.dumps(settings, sort_keys=True).encode()
        source = hashlib.blake2b(text, digest_size=16).hexdigest()
        write_artifact(path, _SYSTEM, settings, tensors, source)
        self._note_checkpoint(path, air["steps"])

    def load(self, path: str | os.PathLike[str]) -> None:
        """Continues from a checkpoint of a solver with the same grids and as many obstacles, in steps of its duration.

        With the same settings the following steps are the same as without the interruption: bit for bit on a CPU; on a
        GPU except for rounding, since outlets sum in any order. With bricks, the threshold allows small differences.
        Other sources, obstacles, rates and boundaries act from now on.

        Raises:
            WlmError: The file is damaged or of other grids; the message names the difference.
        """
        artifact = read_artifact(path, _SYSTEM)
        for name, value in self._grids.items():
            if (stored := artifact.settings.get(name)) != value:
                raise WlmError(f"{path}: {name}: expected {value}, found {stored}: a checkpoint of another simulation")
        duration = artifact.settings.get("duration")
        if not (isinstance(duration, float) and 1e-6 <= duration / self.duration <= 1e6):
            raise WlmError(f"{path}: duration: expected about {self.duration:.3g} for a step, found {duration}")
        state, edge = artifact.tensors, advection_places.BRICK
        table = {"velocity": Part(np.float32, (*self.lattice.shape, 3))}
        table["bricks"] = Part(np.int32, (None,), least=0, most=math.prod(self._box.bricks) - 1)
        air = {name.removeprefix("lattice."): v for name, v in state.items() if name.startswith("lattice.")}
        try:
            count = len(check_part(state, "bricks", table["bricks"]))
            for name in self._parts:
                table[name] = Part(wp.dtype_to_numpy(self._stored), (count, edge, edge, edge), least=0)
            parts = check_parts({name: v for name, v in state.items() if not name.startswith("lattice.")}, table)
        except ValueError as error:
            raise WlmError(f"{path}: {error}") from error
        try:
            self.lattice.load(air, duration / self.duration)
        except WlmError as error:
            raise WlmError(f"{error} (in {path})") from error
        self._convert_settings(duration / self.duration)
        device = wp.device_to_torch(self.device)
        numbers, *values = (torch.from_numpy(np.array(parts[name])).to(device) for name in ("bricks", *self._parts))
        if self._pool is None:
            for field, part in zip(self._fields[0].parts, values, strict=True):
                wp.to_torch(field).copy_(scatter(numbers, part, self.shape).flatten())
        else:
            self._pool, self._touched = self._make_pool(), ()
            self._pool.put(numbers, values)
            self._fields = self._pool.fields
        self._velocity.assign(parts["velocity"])
        self._done = self.steps
        if self.obstacles:
            before = wp.array(air["solid"], dtype=wp.uint8, device=self.device)
            advection_places.mark_walls(self._box, before, self._walls[0])
            # Obstacles of the file may have been elsewhere.
            self._change_walls()
        self._captures = self._captures and ((), None)
        self._note_checkpoint(path, air["steps"])

    def _note_checkpoint(self, path: str | os.PathLike[str], steps: np.ndarray) -> None:
        self._kept = f"; the state of step {int(steps)} is kept in {path}"

    @contextmanager
    def _naming_checkpoint(self) -> Iterator[None]:
        try:
            yield
        except WlmError as error:
            raise WlmError(f"{error}{self._kept}") from error

    # Within a step.

    def _replay(self) -> bool:
        """Does `period` steps by a CUDA graph, if that can be and the two steps before had the same settings; returns
        whether it did."""
        # Steps before a body is too fast are done one by one.
        if self._captures is None or self.lattice.too_fast:
            return False
        forces = (self.buoyancy, self._confinement, self._turbulence, self._fire)
        settings = (self.sources, self._rates, forces, self.lattice.changes)
        if self._done % self.period or self._decay_every > 1 or settings != self._captures[0]:
            if self._done % self.period == 0:
                self._captures = (settings, None)
            return False
        graph = self._captures[1]
        if graph is None:
            with no_collection(), wp.ScopedCapture(self.device) as capture:
                for _ in range(self.period):
                    self._step()
            graph = capture.graph
            self._captures = (settings, graph)
        wp.capture_launch(graph)
        self._done += self.period
        if self._done * self.substeps % CHECK_EVERY < self.period * self.substeps:
            self.check()
        return True

    def _change_walls(self) -> None:
        """Follows the obstacles: cells that they cover lose their smoke, cells that they leave get some from beside."""
        old, new = self._walls
        advection_places.mark_walls(self._box, self.solid.flatten(), new)
        if self._pool is not None:
            # A cell that an obstacle leaves gets smoke of its neighbours.
            self._pool.relist()
            self._pool.store(clear=False)
        for smoke in self._carried(self._fields[0]):
            advection_sources.change_solids(self._box, old, new, smoke, self._bricks)
        self._walls = [new, old]

    def _step(self) -> None:
        box, walls, bricks = self._box, self._walls[0], self._bricks
        if self._pool is not None:
            # A source keeps its bricks, but new ones are not stored yet.
            if self.sources != self._touched:
                self._emit(only_mark=True)
            self._touched = self.sources
            self._pool.relist()
        if self._fire is not None:
            where = [box, walls, bricks, self._burning(self._fire), self.lattice.clock, self._fields[0]]
            self._on_slabs(fire.burn, *where, self._growth.flatten())
        if self.buoyancy is not None:
            by = self.buoyancy.by_density, self.buoyancy.by_temperature
            where = [box, walls, self._fields[0], *by, self._force.flatten(), bricks]
            self._on_slabs(advection_sources.buoyancy, *where)
        if self._stirred:
            air = [box, self._velocity.flatten(), self.solid.flatten(), self._confinement, self._modes]
            air += [self.lattice.clock, self._force.flatten()]
            self._on_slabs(forcing.stir, *air, added=self.buoyancy is not None)
        with self._naming_checkpoint():
            self.lattice.step(self.substeps)
        self.lattice.velocity(out=self._velocity)
        if self._pool is not None:
            self._pool.store()
        self._carry()
        self._emit()
        if self.lattice.moving:
            self._change_walls()

    def _emit(self, only_mark: bool = False) -> None:
        for source in self.sources:
            steps = source.steps(self.substeps)
            region = source.region(self._box.refinement, str(self.device))
            values = (steps * source.density, steps * source.temperature), (steps * source.fuel, 0.0)
            for value, smoke in zip(values, self._carried(self._fields[0]), strict=False):
                where = [self._box, self._walls[0], region, value, smoke]
                advection_sources.add_source(*where, fixed=source.fixed, bricks=self._bricks, only_mark=only_mark)

    def _carry(self) -> None:
        air = [self._box, self._velocity.flatten(), self.substeps, self._traces]
        decays, where = (self._decay, (1.0, 1.0)), [self._box, self._traces, self._walls[0]]
        bricks = self._bricks
        if self._pool is not None:
            self._on_slabs(advection_places.trace, *air, bricks)
        for decay, buffers in zip(decays, zip(*map(self._carried, self._fields), strict=True), strict=False):
            now, predicted, out = buffers[0], buffers[1], buffers[-1]
            if self._pool is None:
                # Smoke and fuel are in other places, and so are their traces.
                bricks = self._near
                self._on_slabs(advection.mark_smoke, self._box, now, bricks)
                advection_places.choose(self._box, bricks)
                self._on_slabs(advection_places.trace, *air, bricks)
            if self.scheme == "maccormack":
                self._on_slabs(advection.advect, *where, now, predicted, bricks=bricks)
                self._on_slabs(advection.advect, *where, now, out, decay, bricks, predicted)
            else:
                self._on_slabs(advection.advect, *where, now, out, decay, bricks)
        self._fields[:] = self._fields[::-1]

    def _on_slabs(self, compute: Callable[..., None], *args, **settings) -> None:
        self.lattice.slabs.each(lambda slab: compute(*args, slab=slab, **settings))

    def _carried(self, fields: advection.Fields) -> list[advection.Fields]:
        """Returns what is moved separately: smoke with its temperature, and fuel."""
        return [fields] if self._fire is None else [fields, fields.burning]

    def _burning(self, settings: Fire) -> fire.Burning:
        out = fire.Burning()
        out.fuel, out.radiation = settings.rate * self.substeps, settings.radiation * self.substeps
        out.heat, out.smoke, out.ignition = settings.heat, settings.smoke, settings.ignition
        out.ratio, out.expansion = settings.flame / settings.ambient - 1.0, settings.expansion / self.substeps
        return out

    @property
    def _bricks(self) -> advection_places.Bricks:
        return DENSE if self._pool is None else self._pool.bricks

    @property
    def _rings(self) -> int:
        # Smoke also moves by a cell of the lattice when an obstacle leaves it.
        reach = max(_SOUND * self.substeps, float(bool(self.obstacles))) * self._box.refinement
        return advection_places.rings_for(reach)

    def _make_pool(self) -> BrickPool:
        return BrickPool(
            self._box, self._rings, self._threshold, self._make_fields, _buffers(self.scheme), self.lattice.slabs
        )

    def _make_fields(self, cells: int) -> advection.Fields:
        heat = cells if self._grids["temperature"] else 0
        fuel = None if self._fire is None else self._zeros((cells,), self._stored)
        return advection.Fields(self._zeros((cells,), self._stored), self._zeros((heat,), self._stored), fuel)

    def _zeros(self, shape: tuple[int, ...], dtype) -> wp.array:
        return self.lattice.slabs.zeros(shape, dtype)


def ways_of(scheme: str) -> int:
    """Returns 2 for a scheme that traces smoke back and ahead, 1 for one that traces it back alone."""
    return 2 if scheme == "maccormack" else 1


def _buffers(scheme: str) -> int:
    return 3 if scheme == "maccormack" else 2
