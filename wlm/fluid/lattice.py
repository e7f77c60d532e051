"""A lattice Boltzmann solver of air (neural-six-way-lightmaps, section 5).

Lengths are in cells, times in steps, and the density of air at rest is 1; `Domain` converts from SI units. Arrays are
[X, Y, Z]; the centres of cells are at half integers.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from wlm.errors import WlmError
from wlm.fluid.faces import Face, bounded_axes, face_links, inlet_rows, make_face, walled_axes
from wlm.fluid.obstacles import Bodies, Obstacle
from wlm.fluid.slabs import Slabs
from wlm.formats.parts import Part, check_parts
from wlm.interop import no_collection
from wlm_kernels.fluid import lattice_bodies, lattice_links
from wlm_kernels.fluid.fire import expand_kernel
from wlm_kernels.fluid.lattice import QUIET, Spec, eddy_factor, step_kernel, trouble_of
from wlm_kernels.fluid.lattice_fields import FluidKernels, fluid_kernels
from wlm_kernels.fluid.lattice_links import BOUNCE, INLET, OUTLET, PRESSURE, SLIP, WIND
from wlm_kernels.fluid.lattice_sets import NARROW, STORAGES, Layout, Slab, Tables, make_layout, tables
from wlm_kernels.fluid.lattice_sets import lattice as velocity_set

BODIES = 256
"""Number of bodies that uint8 can index, including the fluid."""

CHECK_EVERY = 48
"""Steps between two checks for a flow that blew up; a multiple of the steps in a graph."""

MAX_SPEED = 0.3
"""Largest speed of walls, bodies and inlets, cells per step: half the speed of sound, at which the error of order Ma^2
is a quarter."""

_MOST_STEPS = 2**31 - 1  # limit of the device's counter
# Steps in a graph, a multiple of the period, and the least number of steps for which capturing one saves time.
_GRAPH_STEPS, _GRAPH_FROM = 8, 16
# Cells of a lattice with two arrays from which on a thread computes one cell.
_PAIRED = 1 << 25
# A mark of no cell in `Lattice._fresh`.
_STALE = 3


@dataclass(frozen=True, eq=False)
class Setup:
    """The settings of a lattice of N cells, with copies of its L links, solids and force, for `wlm.fluid.gradients`.

    `spec` are those for which the kernel of a step is specialised; `layout` has the layout of populations of parity 0;
    `tau` is the relaxation time, `eddy` the factor of the eddy viscosity, `ramp` the number of steps in which inlets
    rise to their velocity. `inlet`, int [L], is the cell of an inlet that decides a link, or -1, of `inlets` cells in
    the order of `FACES`; `outlets` says whether there are outlets. `solid`, uint8 [N], is the number of the body of
    each cell, [0] without solids; `bodies` their motion; `forces`, vec3 [N], the force, [0] without.
    """

    shape: tuple[int, int, int]
    spec: Spec
    tables: Tables
    layout: Layout
    tau: float
    eddy: float
    ramp: int
    links: lattice_links.Links
    inlet: wp.array
    inlets: int
    outlets: bool
    link_kernels: lattice_links.LinkKernels
    fluid_kernels: FluidKernels
    solid: wp.array
    bodies: lattice_bodies.Motion
    forces: wp.array


def blown_up(key: int, shape: tuple[int, int, int]) -> WlmError:
    """Returns the error of a flow that blew up; `key` is that of `wlm_kernels.fluid.lattice.trouble_of`."""
    step, cell, cause = trouble_of(key)
    indices = tuple(int(a) for a in np.unravel_index(cell, shape))
    return WlmError(
        f"lattice: blew up in step {step} at cell {indices}: {cause}; expected speeds below {MAX_SPEED} and a"
        f" viscosity at which the flow is stable: use a shorter step, such as by a larger air.speed, a larger"
        " viscosity or smagorinsky=0.17"
    )


class Lattice:
    """A box of air, initially at rest, periodic along every axis without faces.

    Set the faces first, then call `set_flow` unless the air begins at rest, then step. Bodies and forces can be set at
    any time.

    Args:
        shape: Cells along x, y and z.
        viscosity: Kinematic viscosity in square cells per step.
        smagorinsky: C of the eddy viscosity; 0: none. With 0.17 the flow is stable at viscosity 0.
        storage: "float32" or "float16", which halves memory and traffic. With float16 the velocities of a jet differ
            by less than 0.2% of its speed (RMS, before the chaotic flows diverge), and the total mass drifts by about
            3e-5 in 5,000 steps.
        lattice: "D2Q9" (Z = 1), "D3Q19" or "D3Q27".
        device: "cpu" or "cuda:N", or several GPUs that read each other's memory, such as "cuda:0,cuda:1", among which
            the cells are divided along x. Results are the same up to rounding.
        save_memory: Whether steps work in place, which needs half the memory and gives the same flow, but takes longer
            (docs/notes/fluid-speed.md), and has no gradients.
        ramp: Number of steps in which inlets rise to their velocity. A sudden start causes a sound wave, which walls
            and mass-conserving outlets reflect; with a ramp of four times the cells of the longest axis it is weak.

    Attributes:
        slabs: The division among devices.
        device: The first device.
        period: A CUDA graph must contain a multiple of this number of steps, see `step`.
        changes: Number of times that a captured graph of steps has become invalid.

    Raises:
        ValueError: An argument is wrong.
        WlmError: There is not enough memory.
    """

    period = 2  # the populations are then where they were

    def __init__(
        self,
        shape: tuple[int, int, int],
        *,
        viscosity: float,
        smagorinsky: float = 0.17,
        storage: str = "float32",
        lattice: str = "D3Q19",
        device: str | Sequence[str] = "cpu",
        save_memory: bool = False,
        ramp: int = 0,
    ) -> None:
        self.shape = _checked_shape(shape, lattice)
        for name, value in (("viscosity", viscosity), ("smagorinsky", smagorinsky)):
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name}: expected a number of at least 0, got {value}")
        if ramp < 0:
            raise ValueError(f"ramp: expected at least 0 steps, got {ramp}")
        self.slabs = Slabs(self.shape, device)
        self.device = self.slabs.home
        spec = Spec(lattice, storage, eddies=smagorinsky > 0.0, in_place=save_memory)
        needed = self.bytes_needed(self.shape, storage, lattice, save_memory)
        self.slabs.require("lattice", self.shape, needed, "fewer cells, storage='float16' or save_memory=True")
        self._n, self._cells = wp.vec3i(*self.shape), math.prod(self.shape)
        self._set, self._tables = velocity_set(lattice), tables(lattice, str(self.device))
        size = (len(self._set.c), self._cells)
        # The settings for which the kernel of a step is specialised.
        # In two arrays, two cells a thread are slower at 400^3 (docs/notes/fluid-speed.md).
        paired = storage == "float16" and self.shape[2] % 2 == 0 and (save_memory or self._cells < _PAIRED)
        self._spec = replace(spec, wide=math.prod(size) > NARROW, group=2 if paired else 1)
        self._arrays = [self._zeros(size, STORAGES[storage][0]) for _ in range(1 if save_memory else 2)]
        self._parity = 0  # of the clock and, in place, of the populations; else the array that has them
        # A ramp of one step is no ramp: inflow begins after it.
        self._tau, self._eddy, self._rise = 0.5 + 3.0 * viscosity, eddy_factor(smagorinsky), 1.0 / max(ramp, 1)
        # The counter of steps and the first error, see `wlm_kernels.fluid.lattice.step_kernel`.
        self._clock, self._sums = self._zeros(2, int), self._zeros(2 * len(self.slabs.parts), wp.float64)
        self._trouble = wp.full(1, QUIET, dtype=wp.int64, device=self.device)
        # The number of the body of each cell, 0 for fluid; of size 0 while no cell has ever been solid.
        self._solid = self._zeros(0, wp.uint8)
        self._motion, self._bodies = lattice_bodies.make_motion(self.device), None
        # The cells that bodies have just left, and the duration of a step in the unit of the bodies' paths.
        self._fresh, self._pace = self._zeros(0, wp.uint8), 1.0
        self._growth: wp.array | None = None
        self._forces, self._wind = self._zeros(0, wp.vec3), self._zeros(1, wp.vec3)
        self._faces: dict[str, Face] = {}
        self._links: lattice_links.Links | None = None
        self.changes = 0
        self._graph = None
        # Steps that this object launched itself; replays of a user's CUDA graph are counted only by the clock.
        self._done, self._unchecked, self._begun = 0, 0, False

    @staticmethod
    def bytes_needed(
        shape: tuple[int, int, int], storage: str = "float32", lattice: str = "D3Q19", save_memory: bool = False
    ) -> int:
        """Returns the memory in bytes that a lattice takes, without small arrays; arguments as for `Lattice`."""
        size = wp.types.type_size_in_bytes(STORAGES[storage][0])
        return (1 if save_memory else 2) * len(velocity_set(lattice).c) * math.prod(shape) * size

    # Setting up.

    def set_wall(self, face: str, velocity: ArrayLike = (0.0, 0.0, 0.0), *, slip: bool = False) -> None:
        """Closes a face by a wall.

        Args:
            face: One of `wlm.fluid.faces.FACES`, "-x" for example.
            velocity: Tangential velocity of the wall in cells per step; (3,), or [A, B, 3] for each cell of the face.
            slip: Whether the wall has no friction, and therefore no velocity.
        """
        self._set_face(face, SLIP if slip else BOUNCE, velocity)

    def set_inlet(self, face: str, velocity: ArrayLike, where: ArrayLike | None = None) -> None:
        """Makes a face, or a part of it, an inlet.

        Args:
            face: As for `set_wall`.
            velocity: Velocity of the air in cells per step; (3,), or [A, B, 3] for each cell of the face.
            where: bool [A, B], true in the open part of the face; elsewhere it is a wall. None: the whole face is open.
        """
        self._set_face(face, INLET, velocity, where=where)

    def set_wind(self, face: str) -> None:
        """Makes a face (see `set_wall`) one through which the wind of `blow` comes or leaves; first there is none."""
        self._set_face(face, WIND)

    def blow(self, velocity: ArrayLike) -> None:
        """Sets the velocity of the wind from now on, (3,) in cells per step; raises a WlmError above `MAX_SPEED`."""
        wind = np.asarray(velocity, np.float32).reshape(1, 3)
        _check_speed(float(np.linalg.norm(wind)), "the wind")
        self._wind.assign(wind)

    def set_outlet(self, face: str, density: float | None = None) -> None:
        """Makes a face an outlet.

        Args:
            face: As for `set_wall`.
            density: Density to which the air relaxes at the outlet, slowly enough to let sound out; mass is then not
                conserved. None: the outflow through all outlets without a density equals the inflow, so that mass is
                conserved.
        """
        self._set_face(face, OUTLET if density is None else PRESSURE, density=density)

    def set_bodies(self, obstacles: Sequence[Obstacle]) -> None:
        """Sets the solid bodies, in place of earlier ones; each step moves and turns those whose paths do.

        A step is done with the bodies where they are in its middle, and places them for the next. Cells that they leave
        get the mean density and velocity of the fluid beside them. A body at rest keeps its cells where a moving one
        reaches it; parts outside the box are without effect. `change_step` changes the pace, not the paths.

        Args:
            obstacles: At most 255 obstacles, bodies 1, 2 and so on; lengths and times of their paths are in cells and
                steps.

        Raises:
            ValueError: There are more obstacles.
            WlmError: In `step`, before a body's surface is faster than `MAX_SPEED`.
        """
        if len(obstacles) >= BODIES:
            raise ValueError(f"obstacles: expected at most {BODIES - 1}, got {len(obstacles)}")
        self._prepare()
        self._bodies = Bodies(obstacles, self.shape, self.device) if obstacles else None
        self._motion = self._bodies.motion if obstacles else lattice_bodies.make_motion(self.device)
        self._fresh = self._zeros(self._cells if self.moving else 0, wp.uint8)
        self._place()

    def set_solid(self, mask: ArrayLike | wp.array, velocity: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Sets which cells are solid and how they move, in place of earlier bodies; must be called again after they
        have moved.

        Cells that become fluid get the mean density and velocity of their neighbours. The call waits for the device
        and cannot be captured in a CUDA graph.

        Args:
            mask: [X, Y, Z], true where a cell is solid; or the number of the body that covers each cell, 1 to 255, and
                0 for fluid. A NumPy array, or a Warp array of uint8 on the lattice's device.
            velocity: Velocity of the bodies, cells per step; (3,) for body 1, or [K, 3] for bodies 1 to K. For bodies
                that turn see `set_bodies`.

        Raises:
            WlmError: A body is faster than `MAX_SPEED`.
        """
        new, vectors = self._mask(mask), np.atleast_2d(np.asarray(velocity, np.float32))
        if vectors.ndim != 2 or vectors.shape[1] != 3 or len(vectors) >= BODIES or not np.isfinite(vectors).all():
            shapes = f"(3,) or [K, 3] for at most {BODIES - 1} bodies"
            raise ValueError(
                f"velocity: expected finite numbers of shape {shapes}, got NaN or shape {np.shape(velocity)}"
            )
        _check_speed(float(np.linalg.norm(vectors, axis=1).max(initial=0.0)), "a body")
        rows = np.zeros((BODIES, 3), np.float32)
        rows[1 : len(vectors) + 1] = vectors
        if self._bodies is not None:
            self.set_bodies(())
        self._motion.velocity.assign(rows)
        self._prepare()
        self._cover(new)

    def _place(self) -> None:
        """Places the bodies for the next step, whichever cells were solid before."""
        solid = self._zeros(self._cells, wp.uint8)
        if self._bodies is not None:
            solid = self._bodies.cover(self._clock, self._pace)
        self._fresh.zero_()
        self._graph = None
        self._cover(solid)

    def _cover(self, new: wp.array) -> None:
        """Makes the cells of a mask, uint8 [N], solid, and the others fluid."""
        if self._solid.shape[0] == 0:
            self._solid, self._graph = self._zeros(self._cells, wp.uint8), None
        else:
            where = [self._tables, self._layout]
            means = self._zeros((4, self._cells), self._f.dtype) if self._spec.in_place else self._spare
            self._launch(self._fluid_kernels.neighbours, self._cells, [*where, self._f, self._solid, new], [means])
            self._launch(self._fluid_kernels.uncover, self._cells, [*where, self._solid, new, means], [self._f])
        self._spec = replace(self._spec, solids=True)
        wp.copy(self._solid, new)
        self._find_links()
        self._apply_links(self._links.faces)

    def set_force(self, force: ArrayLike | wp.array | None) -> None:
        """Sets the force on the air.

        Args:
            force: Acceleration in cells per step squared: (3,) for all cells, or [X, Y, Z, 3]. A Warp array, vec3
                [X, Y, Z] on the lattice's device, is not copied, and its values may change between steps. None: no
                force.
        """
        forces = self._zeros(0, wp.vec3)
        if isinstance(force, wp.array):
            if force.shape != self.shape or force.dtype != wp.vec3 or force.device != self.device:
                found = f"{force.dtype.__name__} {force.shape} on {force.device}"
                raise ValueError(f"force: expected an array of vec3 {self.shape} on {self.device}, got {found}")
            forces = force.flatten()
        elif force is not None:
            forces = self._vectors("force", force)
        self._spec, self._forces, self._graph = replace(self._spec, forced=force is not None), forces, None

    def set_flow(self, velocity: ArrayLike = (0.0, 0.0, 0.0), density: ArrayLike = 1.0) -> None:
        """Sets all air to the equilibrium of a velocity and a density.

        Args:
            velocity: Velocity in cells per step; (3,) for all cells, or [X, Y, Z, 3].
            density: Density, one number or [X, Y, Z]; 1 is the density of air at rest.
        """
        self._prepare()
        drho = (np.broadcast_to(np.asarray(density, np.float64), self.shape) - 1.0).astype(np.float32).ravel()
        if not np.isfinite(drho).all():
            raise ValueError("density: expected finite numbers, got NaN or infinity")
        fields = [wp.array(drho, device=self.device), self._vectors("velocity", velocity)]
        self._spare.zero_()
        self._sums.zero_()
        self._launch(self._fluid_kernels.start, self._cells, [self._tables, self._layout, *fields], [self._f])
        self._apply_links(0)
        self._begun = True

    @property
    def faces(self) -> dict[str, Face]:
        """The faces that have been set, by name; an axis without faces is periodic."""
        return dict(self._faces)

    def set_growth(self, growth: wp.array) -> None:
        """Lets the air expand: `growth`, float [X, Y, Z] on the device, is the share of its volume that a cell gains
        in a step. It is not copied, and its values may change between steps. A face needs an outlet with a density.
        """
        self._growth, self._graph = growth.flatten(), None

    @property
    def clock(self) -> wp.array:
        """Counters, int [2] on the device, of which the larger is the number of steps done."""
        return self._clock

    # Running.

    def step(self, steps: int = 1) -> None:
        """Advances the air by a number of steps, and runs `check` after every `CHECK_EVERY` of them, also of several
        calls.

        During the capture of a CUDA graph it does not check: call `check` between replays of the graph. The number of
        steps, and the number of steps done before the capture, must then be multiples of `period`.

        Raises:
            WlmError: As for `check`.
        """
        if steps < 0:
            raise ValueError(f"steps: expected at least 0, got {steps}")
        if self.device.is_cuda and self.device.is_capturing:
            if not self._begun or steps % self.period or self._done % self.period:
                found = f"got {steps} in the graph and {self._done} before it"
                raise ValueError(f"steps: expected a multiple of {self.period} in a CUDA graph and before it, {found}")
            self._require_slow(math.inf)
            self._run(steps)
            return
        self._prepare()
        self._begun = True
        run = self._run_in_graphs if self.device.is_cuda and steps >= _GRAPH_FROM else self._run
        while steps > 0:
            chunk = min(steps, CHECK_EVERY - self._unchecked)
            self._require_slow(chunk)
            run(chunk)
            steps, self._unchecked = steps - chunk, self._unchecked + chunk
            if self._unchecked == CHECK_EVERY:
                self.check()

    def _require_slow(self, steps: float) -> None:
        """Checks the speed of the bodies in the next steps."""
        if self.moving:
            begin = self._done * self._pace
            _check_speed(self._pace * self._bodies.fastest(begin, begin + steps * self._pace), "a body")

    @property
    def steps(self) -> int:
        """Number of steps done, including replays of graphs; waits for the device."""
        return int(self._clock.numpy()[self._parity])

    def check(self) -> None:
        """Checks that the flow has not blown up, which every step records on the device; waits for the device.

        Raises:
            WlmError: The flow has blown up; the message names the first step, the cell and the cause.
        """
        key, self._unchecked = int(self._trouble.numpy()[0]), 0
        if key == QUIET:
            return
        raise blown_up(key, self.shape)

    @property
    def _graph(self) -> wp.Graph | None:
        return self._captured

    @_graph.setter
    def _graph(self, graph: wp.Graph | None) -> None:
        self._captured = graph
        self.changes += graph is None

    # Results.

    @property
    def moving(self) -> bool:
        """Whether one of the bodies of `set_bodies` moves or turns."""
        return self._bodies is not None and bool(self._bodies.moving)

    @property
    def too_fast(self) -> bool:
        """Whether a body of `set_bodies` becomes faster than `MAX_SPEED`, at any time of its path."""
        return self.moving and self._pace * self._bodies.fastest(-math.inf, math.inf) > MAX_SPEED

    @property
    def solid(self) -> wp.array:
        """The number of the body in each cell, uint8 [X, Y, Z], 0 for fluid; [0] while no cell has ever been solid."""
        return self._solid.reshape(self.shape) if self._solid.size else self._solid

    def velocity(self, out: wp.array | None = None) -> wp.array:
        """Returns the velocity, vec3 [X, Y, Z], in cells per step; in a solid cell it is the velocity of the body."""
        self._prepare()
        out = self._zeros(self.shape, wp.vec3) if out is None else out
        self._write_fields(self._zeros(0, float), out.flatten())
        return out

    def excess_density(self, out: wp.array | None = None) -> wp.array:
        """Returns the density minus 1, float [X, Y, Z], which float32 resolves better; 0 in a solid cell."""
        self._prepare()
        out = self._zeros(self.shape, float) if out is None else out
        self._write_fields(out.flatten(), self._zeros(0, wp.vec3))
        return out

    def density(self) -> np.ndarray:
        """Returns the density, float64 [X, Y, Z]; 1 in a solid cell. The pressure is a third of it."""
        return 1.0 + self.excess_density().numpy().astype(np.float64)

    def mass(self) -> float:
        """Returns the mass of all fluid cells, summed in float64."""
        solid = int(np.count_nonzero(self._solid.numpy()))
        return self._cells - solid + float(self.excess_density().numpy().sum(dtype=np.float64))

    def force_on_solid(self, body: int = 1) -> np.ndarray:
        """Returns the force of the air on a body in the last step, by momentum exchange, float64 (3,).

        The pressure of air at rest at density 1 is excluded; on a body that air surrounds its sum is 0.
        """
        if not 0 < body < BODIES:
            raise ValueError(f"body: expected 1 to {BODIES - 1}, got {body}")
        self._prepare()
        total = self._zeros(BODIES, wp.vec3d)
        if self._solid.shape[0] > 0:
            links = self._links
            if self.moving:
                links = self._with_solids(self._make_links(0), every=True)
            inputs = [self._tables, self._layout, links, self._solid, self._f]
            self._launch(self._link_kernels.force, links.cell.shape[0], inputs, [total])
        return total.numpy()[body]

    def state(self) -> dict[str, np.ndarray]:
        """Returns the state, for `load`: populations that have left cells, solids and their motion, number of steps."""
        self._prepare()
        # On a CPU .numpy() shares the array's memory, which the next step modifies.
        return {
            "populations": np.stack([row.numpy() for row in self._rows()]),
            "solid": self._solid.numpy().copy(),
            "bodies": self._motion.velocity.numpy().copy(),
            "steps": np.array(self.steps, np.int64),
        }

    def load(self, state: Mapping[str, np.ndarray], factor: float = 1.0) -> None:
        """Continues from the state of a lattice with the same settings, faces and force, and a step that is `factor`
        times as long, to which the settings of this lattice are converted.

        The following steps are the same as without the interruption: bit for bit on a CPU; on a GPU except for
        rounding, since outlets sum in any order. The bodies of `set_bodies` are then placed where they should be.

        Raises:
            WlmError: The state has another shape, lattice or storage, or contains NaN or infinity.
        """
        table = {
            "populations": Part(wp.dtype_to_numpy(self._f.dtype), self._f.shape),
            # Empty while no cell has ever been solid.
            "solid": Part(np.uint8, (0 if np.shape(state.get("solid")) == (0,) else self._cells,)),
            "bodies": Part(np.float32, (BODIES, 3)),
            "steps": Part(np.int64, (), least=0, most=_MOST_STEPS),
        }
        try:
            state = check_parts(state, table)
        except ValueError as error:
            raise WlmError(f"lattice state: {error}") from error
        self._convert_settings(factor)
        self._motion.velocity.assign(state["bodies"])
        self._begun, self._done, self._parity, self._graph = True, int(state["steps"]), 0, None
        self._clock.fill_(self._done)
        self._trouble.fill_(QUIET)
        self._solid = self._zeros(len(state["solid"]), wp.uint8)
        self._solid.assign(state["solid"])
        self._spec = replace(self._spec, solids=len(state["solid"]) > 0)
        self._spare.zero_()
        self._f.assign(state["populations"])
        self._find_links()
        if self._bodies is not None:
            self._place()

    def change_step(self, factor: float) -> None:
        """Changes the duration of a step by a factor, between two steps, with all settings and the state.

        Velocity, pressure and viscous stress stay the same in SI units, up to rounding. The force and the motion of
        bodies are converted with the state; a caller of `set_force` and `set_solid` must set converted ones from then
        on.

        Args:
            factor: New duration over old one; `steps` divided by it must be a whole number.

        Raises:
            ValueError: The factor is not above 0, or there is no whole number of steps.
            WlmError: An inlet, a wall or a body becomes faster than `MAX_SPEED`.
        """
        done = round(self.steps / factor) if math.isfinite(factor) and factor > 0.0 else -1
        if done < 0 or not math.isclose(done * factor, self.steps):
            raise ValueError(f"factor: expected one that divides {self.steps} steps into whole ones, got {factor}")
        self._prepare()
        inputs = [self._tables, self._layout, self._solid, self._forces, self._tau, self._eddy, factor]
        self._launch(self._fluid_kernels.convert, self._cells, inputs, [self._f])
        self._done, self._graph = done, None
        self._clock.fill_(done)
        velocity = factor * self._motion.velocity.numpy()
        _check_speed(float(np.linalg.norm(velocity, axis=1).max()), "a body")
        self._motion.velocity.assign(velocity)
        self._convert_settings(factor)
        if self._bodies is not None:
            self._place()

    def _convert_settings(self, factor: float) -> None:
        self._pace *= factor
        self._tau, self._rise = 0.5 + factor * (self._tau - 0.5), self._rise * factor
        for name, face in self._faces.items():
            fastest = factor * float(np.linalg.norm(face.velocity, axis=-1).max())
            _check_speed(fastest, f"face {name!r}")
            self._faces[name] = replace(face, velocity=factor * face.velocity, excess=factor**2 * face.excess)
        self._links = None if factor != 1.0 else self._links
        self._prepare()

    def setup(self) -> Setup:
        """Returns the settings with copies of the links, solids and force, which no later change affects."""
        self._prepare()
        links = lattice_links.Links()
        links.faces = self._links.faces
        for name in ("cell", "code", "term", "value", "used"):
            setattr(links, name, wp.clone(getattr(self._links, name)))
        bodies = lattice_bodies.Motion()
        for name in ("centre", "turn", "velocity", "spin", "moving"):
            setattr(bodies, name, wp.clone(getattr(self._motion, name)))
        inlet = np.full(links.cell.shape[0], -1, np.int32)
        rows = inlet_rows(self._faces)
        inlet[: links.faces] = rows[self._decides] if len(rows) else -1
        inlet[links.code.numpy() >> 5 != INLET] = -1
        kinds = {int(kind) for face in self._faces.values() for kind in np.unique(face.kind)}
        return Setup(
            shape=self.shape,
            spec=self._spec,
            tables=self._tables,
            layout=self._layouts[0],
            tau=self._tau,
            eddy=self._eddy,
            ramp=round(1.0 / self._rise),
            links=links,
            inlet=wp.array(inlet, dtype=int, device=self.device),
            inlets=int(rows.max(initial=-1)) + 1,
            outlets=bool(kinds & {OUTLET, PRESSURE}),
            link_kernels=self._link_kernels,
            fluid_kernels=self._fluid_kernels,
            solid=wp.clone(self._solid),
            bodies=bodies,
            forces=wp.clone(self._forces),
        )

    def populations(self) -> wp.array:
        """Returns a copy of the populations that have left the cells, [Q, X, Y, Z], see `state`."""
        self._prepare()
        out = wp.empty_like(self._f)
        for q, row in enumerate(self._rows()):
            wp.copy(out[q], row)
        return out.reshape((len(self._set.c), *self.shape))

    # Checked arguments.

    def _vectors(self, name: str, value: ArrayLike) -> wp.array:
        """Returns vectors, (3,) for all cells or [X, Y, Z, 3], as a vec3 [N] on the device."""
        vectors = np.asarray(value, np.float32)
        if vectors.shape not in ((3,), (*self.shape, 3)) or not np.isfinite(vectors).all():
            shapes = f"(3,) or {(*self.shape, 3)}"
            raise ValueError(f"{name}: expected finite numbers of shape {shapes}, got NaN or shape {vectors.shape}")
        vectors = np.ascontiguousarray(np.broadcast_to(vectors, (*self.shape, 3)).reshape(-1, 3))
        out = self._zeros(self._cells, wp.vec3)
        out.assign(vectors)
        return out

    def _set_face(self, name: str, kind: int, *args, **settings) -> None:
        face = make_face(self.shape, name, kind, *args, **settings)
        _check_speed(float(np.linalg.norm(face.velocity, axis=-1).max()), f"face {name!r}")
        if name not in self._faces and self._begun:
            raise ValueError(f"face {name!r}: expected this face to be set before set_flow and before the first step")
        self._faces[name] = face
        self._links = self._graph = None

    def _mask(self, mask) -> wp.array:
        if isinstance(mask, wp.array):
            if mask.shape != self.shape or mask.dtype != wp.uint8 or mask.device != self.device:
                found = f"{mask.dtype.__name__} {mask.shape} on {mask.device}"
                raise ValueError(f"mask: expected an array of uint8 {self.shape} on {self.device}, got {found}")
            return mask.flatten()
        mask = np.asarray(mask)
        if mask.shape != self.shape or mask.dtype.kind not in "biu":
            raise ValueError(f"mask: expected bool or integers {self.shape}, got {mask.dtype} {mask.shape}")
        if mask.min() < 0 or mask.max() >= BODIES:
            raise ValueError(f"mask: expected 0 (fluid) or a body, 1 to {BODIES - 1}, got {mask.min()} to {mask.max()}")
        return wp.array(mask.astype(np.uint8).ravel(), dtype=wp.uint8, device=self.device)

    # On the device.

    @property
    def _f(self) -> wp.array:
        """The populations."""
        return self._arrays[self._parity % len(self._arrays)]

    @property
    def _spare(self) -> wp.array:
        """The array that the next step writes; in place the populations themselves."""
        return self._arrays[(self._parity + 1) % len(self._arrays)]

    @property
    def _layout(self) -> Layout:
        return self._layouts[self._parity if self._spec.in_place else 0]

    def _rows(self) -> Iterator[wp.array]:
        """Gives each population that has left the cells, [N]: a copy of all of them would double the memory."""
        for q, velocity in enumerate(self._set.c):
            out = self._f[q]
            if self._layout.parity:
                out = self._zeros(self._cells, out.dtype)
                inputs = [self._layout, q, wp.vec3i(*velocity), self._f]
                self._launch(self._fluid_kernels.unpack, self._cells, inputs, [out])
            yield out

    def _prepare(self) -> None:
        """Chooses kernels and lists links for the faces, if they have changed since the last call."""
        if self._links is not None:
            return
        self._bounded = wp.vec3i(*bounded_axes(self._faces))
        walls = walled_axes(self._faces)
        self._spec = replace(self._spec, walls=walls)
        self._layouts = [make_layout(self.shape, self._bounded, walls, parity) for parity in range(2)]
        kinds = {int(kind) for face in self._faces.values() for kind in np.unique(face.kind)}
        sets = self._spec.lattice, self._spec.storage
        self._link_kernels = lattice_links.link_kernels(*sets, OUTLET in kinds, self._spec.wide, self._spec.in_place)
        self._fluid_kernels = fluid_kernels(*sets, walls, self._spec.in_place)
        links = face_links(self.shape, self._set, self._faces)
        # The links of one slab after those of the other.
        ends = [slab.end * math.prod(self.shape[1:]) for slab in self.slabs.parts]
        owner = np.searchsorted(ends, links[0], side="right")
        order = np.argsort(owner, kind="stable")
        *self._face_columns, self._decides = (column[order] for column in links)
        self._parts = np.searchsorted(owner[order], np.arange(len(ends))).tolist()
        self._links = self._make_links(0)
        self._find_links()

    def _find_links(self) -> None:
        """Lists the populations that solids at rest and those of `set_solid` send back (see `lattice_links`)."""
        before = self._links
        self._links = self._with_solids(before, every=False)
        self._graph = self._graph if self._links is before else None

    def _with_solids(self, links: lattice_links.Links, every: bool) -> lattice_links.Links:
        """Lists the links of solids (`every`: of moving ones too) after those of faces; in larger arrays if needed."""
        # The count is also set without solids: the state before may have had some.
        count = 0
        if self._solid.shape[0] > 0:
            where = [self._tables, self._n, self._bounded, self._solid, self._motion, every]
            count = int(lattice_links.find_links(*where, links).numpy()[0])
            if count > links.cell.shape[0] - links.faces:
                # Spare elements: the number of links of a moving body varies.
                links = self._make_links(count + count // 4)
                lattice_links.find_links(*where, links)
        links.used.fill_(links.faces + count)
        return links

    def _make_links(self, room: int) -> lattice_links.Links:
        """Makes the links of the faces, with room for those of solids."""
        links = lattice_links.Links()
        links.faces = len(self._face_columns[0])
        dtypes = {"cell": np.int32, "code": np.uint8, "term": np.float32}
        for (name, dtype), column in zip(dtypes.items(), self._face_columns, strict=True):
            padded = np.zeros(links.faces + room, dtype)
            padded[: links.faces] = column
            setattr(links, name, self._zeros(len(padded), wp.dtype_from_numpy(dtype)))
            getattr(links, name).assign(padded)
        links.value, links.wind = self._zeros(links.faces + room, float), self._wind
        links.used = wp.full(1, links.faces, dtype=int, device=self.device)
        return links

    def _run(self, steps: int) -> None:
        """Queues steps on the device and returns without waiting."""
        for _ in range(steps):
            inputs = [self._n, self._f, self._solid, self._tau, self._eddy, self._forces, self._parity]
            outputs = [self._clock, self._trouble, self._sums, self._spare]
            # Small blocks are faster with solids, large ones without (docs/notes/fluid-speed.md).
            block_dim = 128 if self._spec.solids else 256
            self.slabs.launch(step_kernel(self._spec), inputs, outputs, block_dim, self._spec.group)
            self._parity = 1 - self._parity
            if self._growth is not None:
                expand = expand_kernel(self._spec.lattice, self._spec.storage, self._spec.in_place)
                self.slabs.launch(expand, [self._tables, self._layout, self._growth], [self._f])
            stamp = 1 + self._done % 2
            if self.moving:
                self._bodies.move(self._clock, self._pace, self._solid, self._fresh, stamp)
            self._apply_links(0, stamp)
            self._done += 1

    def _run_in_graphs(self, steps: int) -> None:
        """Queues steps as replays of a CUDA graph of `_GRAPH_STEPS` steps, and remaining steps without the graph."""
        while steps > 0:
            if steps < _GRAPH_STEPS or self._done % self.period or self._graph is None:
                # The first steps load the kernels' modules, which is not allowed during a capture.
                eager = min(steps, self.period - self._done % self.period)
                self._run(eager)
                steps -= eager
                if self._graph is None and self._done % self.period == 0 and steps >= _GRAPH_STEPS:
                    with no_collection(), wp.ScopedCapture(self.device) as capture:
                        self._run(_GRAPH_STEPS)
                    self._graph, self._done = capture.graph, self._done - _GRAPH_STEPS
            else:
                wp.capture_launch(self._graph)
                self._done += _GRAPH_STEPS
                steps -= _GRAPH_STEPS

    def _write_fields(self, drho: wp.array, u: wp.array) -> None:
        """Writes the density minus 1 of each cell to `drho` and the velocity to `u`; an array of size 0 is skipped."""
        inputs = [self._layout, self._f, self._solid, self._motion, self._forces]
        self.slabs.launch(self._fluid_kernels.fields, inputs, [drho, u])

    def _apply_links(self, first: int, stamp: int = _STALE) -> None:
        """Applies the boundary conditions from link `first` on; cells that bodies have left have the mark `stamp`."""
        for window in self._bodies.moving if self.moving else ():
            where = [self._tables, self._layout, window, self._motion, stamp, self._solid, self._fresh]
            lattice_links.bounce(self._link_kernels, *where, self._f, self._sums)
        links = self._links
        if first == links.cell.shape[0]:
            return
        # The links of solids are the last slab's.
        ends = [*self._parts, links.cell.shape[0]]
        where = [self._layout, links, self._solid, self._clock, self._rise, self._f, self._sums]

        def apply(slab: Slab, *, writing: bool) -> None:
            of = tables(self._spec.lattice, str(slab.device)), slab
            span = max(ends[slab.number], first), ends[slab.number + 1]
            lattice_links.apply(self._link_kernels, *of, *span, *where, writing=writing)

        for writing in (False, True):
            self.slabs.each(partial(apply, writing=writing))

    def _launch(self, kernel, size: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self.device)

    def _zeros(self, size: int | tuple[int, ...], dtype) -> wp.array:
        return self.slabs.zeros(size, dtype)


def _checked_shape(shape, lattice: str) -> tuple[int, int, int]:
    x, y, z = (int(size) for size in shape)
    if min(x, y, z) < 1:
        raise ValueError(f"shape: expected at least one cell along each axis, got {(x, y, z)}")
    if lattice == "D2Q9" and z != 1:
        raise ValueError(f"shape: expected one cell along z for D2Q9, got {z}")
    if x * y * z >= 2**31:
        raise WlmError(f"lattice: {x} x {y} x {z} cells: expected fewer than 2^31 cells in all")
    return x, y, z


def _check_speed(speed: float, what: str) -> None:
    if speed > MAX_SPEED:
        raise WlmError(
            f"lattice: {what} moves at {speed:.3g} cells per step: expected at most {MAX_SPEED}: use a shorter step"
        )
