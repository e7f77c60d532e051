"""A lattice Boltzmann solver of air (neural-six-way-lightmaps, section 5).

Lengths are in cells, times in steps, and the density of air at rest is 1; `Domain` converts. Arrays are [X, Y, Z],
cell centres at half integers. Stated behaviours:

====================================  =================================================================
a flow that blows up                  error within `CHECK_EVERY` steps: the first step and cell, and why
a wall, body or inlet too fast        error: the speed and `MAX_SPEED`
a body over an inlet                  nothing comes in where it lies; with all covered, nothing at all
a body over everything                nothing moves
a grid of one voxel                   fine, as is any axis of one cell
a domain too large for the memory     error before anything is allocated: what it needs and what there is
a cell freed with no fluid around it  at rest at density 1
====================================  =================================================================
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from wlm.errors import WlmError
from wlm.fluid import faces as fluid_faces
from wlm.fluid.engine import BODIES, PERIOD, Engine, require_free
from wlm.formats.parts import Part, check_parts
from wlm_kernels.fluid.lattice import QUIET, Spec, eddy_factor, trouble_of

CHECK_EVERY = 48
"""Steps between two checks for a flow that blew up; a multiple of what a graph holds."""

MAX_SPEED = 0.3
"""Limit of the speed of walls, bodies and inlets, cells a step: half the speed of sound, where the error of order Ma^2
reaches a quarter."""

_MOST_STEPS = 2**31 - 1  # that a device counts
_MOTION = ("velocity", "spin", "centre")
# From this many steps on a graph repays its capture.
_GRAPH_FROM = 16


@dataclass(frozen=True)
class Domain:
    """The size of a cell and of a step, which converts SI units to those of a lattice.

    Attributes:
        cell: Metres.
        step: Seconds.
    """

    cell: float
    step: float

    def __post_init__(self) -> None:
        for name in ("cell", "step"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name}: expected a positive number, got {value}")

    @classmethod
    def of_speed(cls, cell: float, speed: float, lattice_speed: float = 0.1) -> "Domain":
        """The domain in which `speed` (m/s) is `lattice_speed` (cells a step)."""
        return cls(cell, lattice_speed * cell / speed)

    def speed(self, value: float) -> float:
        """A speed in m/s as cells a step."""
        return value * self.step / self.cell

    def viscosity(self, value: float) -> float:
        """A kinematic viscosity in m^2/s as square cells a step."""
        return value * self.step / self.cell**2

    def acceleration(self, value: float) -> float:
        """An acceleration in m/s^2 as cells a step squared."""
        return value * self.step**2 / self.cell


class Lattice:
    """A box of air, at rest at first, periodic along every axis without faces.

    Set faces first, then `set_flow` unless the air begins at rest, then step; bodies and forces at any time.

    Args:
        shape: Cells along x, y and z.
        viscosity: Kinematic, square cells a step; above 0.
        operator: Of collision: "bgk", "regularised" or "recursive", see `wlm_kernels.fluid.lattice`.
        smagorinsky: C of the eddy viscosity; 0 is none. With 0.17 the default operator is stable at viscosity 1e-6.
        storage: "float32" or "float16": half the memory and traffic; a jet's velocity then differs by less than 0.2% of
            its speed (RMS, until chaos separates the two), and its mass drifts by some 3e-5 in 5,000 steps.
        lattice: "D2Q9" (Z = 1), "D3Q19" or "D3Q27".
        device: "cpu" or "cuda:N".
        ramp: Steps in which inlets rise to their velocity. A sudden start sends a sound wave through the box, which
            walls and outlets that conserve mass reflect: four times the longest axis makes it weak.

    Attributes:
        period: Steps after which a CUDA graph of them can be replayed, see `step`.

    Raises:
        ValueError: A wrong argument.
        WlmError: The memory isn't enough.
    """

    period = PERIOD

    def __init__(
        self,
        shape: tuple[int, int, int],
        *,
        viscosity: float,
        operator: str = "regularised",
        smagorinsky: float = 0.17,
        storage: str = "float32",
        lattice: str = "D3Q19",
        device: str = "cpu",
        ramp: int = 0,
    ) -> None:
        self.shape = _checked_shape(shape, lattice)
        for name, value, least in (("viscosity", viscosity, 1e-12), ("smagorinsky", smagorinsky, 0.0)):
            if not (math.isfinite(value) and value >= least):
                raise ValueError(f"{name}: expected a number of at least {least:g}, got {value}")
        if ramp < 0:
            raise ValueError(f"ramp: expected at least 0 steps, got {ramp}")
        self.device = wp.get_device(device)
        spec = Spec(lattice, operator, storage, eddies=smagorinsky > 0.0)
        needed = self.bytes_needed(self.shape, storage, lattice)
        require_free("lattice", self.shape, needed, self.device, "fewer cells or storage='float16'")
        tau, eddy = 0.5 + 3.0 * viscosity, eddy_factor(smagorinsky)
        # A ramp of one step is none: the first air comes in after it.
        self._engine = Engine(self.shape, spec, tau, eddy, 1.0 / max(ramp, 1), self.device)
        self._faces: dict[str, fluid_faces.Face] = {}
        self._begun = False

    @staticmethod
    def bytes_needed(shape: tuple[int, int, int], storage: str = "float32", lattice: str = "D3Q19") -> int:
        """Memory of a lattice without its small parts, bytes; arguments as for the class."""
        return Engine.bytes_needed(math.prod(shape), lattice, storage)

    # Setting up.

    def set_wall(self, face: str, velocity: ArrayLike = (0.0, 0.0, 0.0), *, slip: bool = False) -> None:
        """Closes a face.

        Args:
            face: One of `wlm.fluid.faces.FACES`, "-x" for example.
            velocity: Of the wall, cells a step, along it; (3,) or [A, B, 3] for the face's cells.
            slip: Whether it is without friction, and so without a velocity.
        """
        self._set_face(face, fluid_faces.wall(self.shape, face, velocity, slip))

    def set_inlet(self, face: str, velocity: ArrayLike, where: ArrayLike | None = None) -> None:
        """Lets air in through a face, or a part of it.

        Args:
            face: As for `set_wall`.
            velocity: Cells a step; (3,) or [A, B, 3] for the face's cells.
            where: bool [A, B], the part that is open; None: the whole face. The rest is a wall.
        """
        self._set_face(face, fluid_faces.inlet(self.shape, face, velocity, where))

    def set_outlet(self, face: str, density: float | None = None) -> None:
        """Lets air out through a face.

        Args:
            face: As for `set_wall`.
            density: None: as much leaves, through all such outlets together, as comes in elsewhere, which conserves
                mass. A number: the density relaxes to it, slowly enough to let sound out, and mass isn't conserved.
        """
        self._set_face(face, fluid_faces.outlet(self.shape, face, density))

    def set_solid(
        self,
        mask: ArrayLike | wp.array,
        velocity: ArrayLike = (0.0, 0.0, 0.0),
        *,
        spin: ArrayLike = (0.0, 0.0, 0.0),
        centre: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        """Sets which cells are solid and how they move; call it again when they have moved.

        Cells that are no longer solid get the equilibrium of the mean of their neighbours. It syncs with the device and
        can't be captured in a graph.

        Args:
            mask: bool, or the bodies' numbers 1 to 255 and 0 for fluid, [X, Y, Z]; a NumPy array, or a Warp array of
                uint8 on the device as `wlm_kernels.fluid.lattice_fields` makes it.
            velocity: Of the bodies' centres, cells a step; (3,) for body 1 or [K, 3] for bodies 1 to K.
            spin: Angular velocity, radians a step, likewise.
            centre: Cells, likewise; used where a body spins.

        Raises:
            WlmError: A surface is faster than `MAX_SPEED`.
        """
        new, bodies = self._mask(mask), self._engine.bodies
        for field, value in (("velocity", velocity), ("spin", spin), ("centre", centre)):
            vectors = np.atleast_2d(np.asarray(value, np.float32))
            if vectors.ndim != 2 or vectors.shape[1] != 3 or len(vectors) >= BODIES or not np.isfinite(vectors).all():
                raise ValueError(f"{field}: expected finite numbers of shape (3,) or [K, 3], K < {BODIES}")
            rows = np.zeros((BODIES, 3), np.float32)
            rows[1 : len(vectors) + 1] = vectors
            getattr(bodies, field).assign(rows)
        self._prepare()
        _check_speed(self._engine.cover(new), "a solid's surface")

    def set_force(self, force: ArrayLike | wp.array | None) -> None:
        """Sets the force on the air.

        Args:
            force: An acceleration, cells a step squared: (3,) for all cells, or [X, Y, Z, 3]; a Warp array of vec3
                [X, Y, Z] on the device isn't copied, so that it may change between steps. None: no force.
        """
        if force is None:
            self._engine.set_force(None, None)
            return
        if isinstance(force, wp.array):
            if force.shape != self.shape or force.dtype != wp.vec3 or force.device != self.device:
                raise ValueError(f"force: expected vec3 {self.shape} on {self.device}")
            self._engine.set_force(None, force.flatten())
            return
        vectors = np.asarray(force, np.float32)
        if vectors.shape not in ((3,), (*self.shape, 3)) or not np.isfinite(vectors).all():
            raise ValueError(f"force: expected finite numbers of shape (3,) or {(*self.shape, 3)}, got {vectors.shape}")
        if vectors.ndim == 1:
            self._engine.set_force(wp.vec3(*vectors.tolist()), None)
        else:
            self._engine.set_force(None, wp.array(vectors.reshape(-1, 3), dtype=wp.vec3, device=self.device))

    def set_flow(self, velocity: ArrayLike = (0.0, 0.0, 0.0), density: ArrayLike = 1.0) -> None:
        """Sets all air to the equilibrium of a velocity and a density.

        Args:
            velocity: Cells a step; (3,) or [X, Y, Z, 3].
            density: A number or [X, Y, Z]; 1 is at rest.
        """
        self._prepare()
        u = np.broadcast_to(np.asarray(velocity, np.float32), (*self.shape, 3)).reshape(-1, 3)
        drho = (np.broadcast_to(np.asarray(density, np.float64), self.shape) - 1.0).astype(np.float32).ravel()
        if not (np.isfinite(u).all() and np.isfinite(drho).all()):
            raise ValueError("velocity, density: expected finite numbers")
        u = wp.array(np.ascontiguousarray(u), dtype=wp.vec3, device=self.device)
        self._engine.start(wp.array(drho, device=self.device), u)
        self._begun = True

    @property
    def faces(self) -> dict[str, fluid_faces.Face]:
        """The faces that were set, by their names; an axis without any is periodic."""
        return dict(self._faces)

    # Running.

    def step(self, steps: int = 1) -> None:
        """Runs some steps, and `check` after every `CHECK_EVERY` of them.

        Within the capture of a CUDA graph it doesn't check: call `check` between replays. The number of steps must
        be a multiple of `period` there, and so must be those done before.

        Raises:
            WlmError: As `check`.
        """
        if steps < 0:
            raise ValueError(f"steps: expected at least 0, got {steps}")
        engine = self._engine
        if self.device.is_cuda and self.device.is_capturing:
            if not self._begun or steps % PERIOD or engine.done % PERIOD:
                raise ValueError(f"steps: expected, in a graph, a multiple of {PERIOD} after eager ones, got {steps}")
            engine.run(steps)
            return
        self._prepare()
        self._begun = True
        graphs = self.device.is_cuda and steps >= _GRAPH_FROM
        while steps > 0:
            chunk = min(steps, CHECK_EVERY)
            if graphs:
                engine.run_in_graphs(chunk)
            else:
                engine.run(chunk)
            steps -= chunk
            self.check()

    @property
    def steps(self) -> int:
        """Steps done, by replays of a graph too; syncs with the device."""
        return int(self._engine.clock.numpy()[self._engine.done % 2])

    def check(self) -> None:
        """Checks that the flow hasn't blown up, which every step records on the device; syncs with it.

        Raises:
            WlmError: It has; the line names the first step, the cell and the cause.
        """
        key = int(self._engine.trouble.numpy()[0])
        if key == QUIET:
            return
        step, cell, cause = trouble_of(key)
        indices = tuple(int(a) for a in np.unravel_index(cell, self.shape))
        raise WlmError(
            f"lattice: blew up in step {step} at cell {indices}: {cause}; expected speeds below {MAX_SPEED} and a"
            f" viscosity that the operator bears: use a shorter time step, a larger viscosity or smagorinsky=0.17"
        )

    # Results.

    def velocity(self, out: wp.array | None = None) -> wp.array:
        """The velocity, vec3 [X, Y, Z], cells a step; in a solid cell the body's."""
        self._prepare()
        out = wp.empty(self.shape, dtype=wp.vec3, device=self.device) if out is None else out
        self._engine.fields(self._engine.zeros(0, float), out.flatten())
        return out

    def excess_density(self, out: wp.array | None = None) -> wp.array:
        """The density less 1, float [X, Y, Z], which float32 resolves better; 0 in a solid cell."""
        self._prepare()
        out = wp.empty(self.shape, dtype=float, device=self.device) if out is None else out
        self._engine.fields(out.flatten(), self._engine.zeros(0, wp.vec3))
        return out

    def density(self) -> np.ndarray:
        """The density, float64 [X, Y, Z]; 1 in a solid cell. Pressure is a third of it."""
        return 1.0 + self.excess_density().numpy().astype(np.float64)

    def mass(self) -> float:
        """The mass of all fluid cells, summed in float64."""
        solid = int(np.count_nonzero(self._engine.solid.numpy()))
        return self._engine.cells - solid + float(self.excess_density().numpy().sum(dtype=np.float64))

    def force_on_solid(self, body: int = 1) -> np.ndarray:
        """The force of the air on a body in the last step, by momentum exchange, float64 (3,).

        The pressure of air at rest at density 1 is left out; on a body that the air surrounds it sums to zero anyway.
        """
        if not 0 < body < BODIES:
            raise ValueError(f"body: expected 1 to {BODIES - 1}, got {body}")
        self._prepare()
        return self._engine.force_on_bodies()[body]

    def state(self) -> dict[str, np.ndarray]:
        """The state, for `load`: scaled populations, solid cells and their motion, steps done."""
        engine = self._engine
        # On a CPU .numpy() shares the array's memory, which the next step changes.
        return {
            "populations": engine.buffers[0].numpy().copy(),
            "solid": engine.solid.numpy().copy(),
            "bodies": np.stack([getattr(engine.bodies, field).numpy() for field in _MOTION]),
            "steps": np.array(self.steps, np.int64),
        }

    def load(self, state: Mapping[str, np.ndarray]) -> None:
        """Continues from the state of a lattice of the same settings, faces and force.

        On a CPU the steps that follow are bit for bit the same; on a GPU but for the order of its outlets' atomic sums.

        Raises:
            WlmError: The state is of another shape, lattice or storage, or holds NaN or infinity.
        """
        engine = self._engine
        now = engine.buffers[0]
        table = {
            "populations": Part(wp.dtype_to_numpy(now.dtype), now.shape),
            # Empty before the first step.
            "solid": Part(np.uint8, (0 if np.shape(state.get("solid")) == (0,) else engine.cells,)),
            "bodies": Part(np.float32, (len(_MOTION), BODIES, 3)),
            "steps": Part(np.int64, (), least=0, most=_MOST_STEPS),
        }
        try:
            state = check_parts(state, table)
        except ValueError as error:
            raise WlmError(f"lattice state: {error}") from error
        self._prepare()
        for field, rows in zip(_MOTION, state["bodies"], strict=True):
            getattr(engine.bodies, field).assign(rows)
        self._begun = True
        fastest = engine.restore(state["populations"], state["solid"], int(state["steps"]))
        _check_speed(fastest, "a solid's surface")

    def _set_face(self, name: str, face: fluid_faces.Face) -> None:
        _check_speed(float(np.linalg.norm(face.velocity, axis=-1).max()), f"face {name!r}")
        if name not in self._faces and self._begun:
            raise ValueError(f"face {name!r}: expected to be set before the flow")
        self._faces[name] = face
        self._engine.set_faces(self._faces)

    def _prepare(self) -> None:
        _check_speed(self._engine.prepare(), "a solid's surface")

    def _mask(self, mask) -> wp.array:
        if isinstance(mask, wp.array):
            if mask.shape != self.shape or mask.dtype != wp.uint8 or mask.device != self.device:
                raise ValueError(f"mask: expected uint8 {self.shape} on {self.device}")
            return mask.flatten()
        mask = np.asarray(mask)
        if mask.shape != self.shape or mask.dtype.kind not in "biu":
            raise ValueError(f"mask: expected bool or integers {self.shape}, got {mask.dtype} {mask.shape}")
        if mask.min() < 0 or mask.max() >= BODIES:
            raise ValueError(f"mask: expected numbers from 0 to {BODIES - 1}")
        return wp.array(mask.astype(np.uint8).ravel(), dtype=wp.uint8, device=self.device)


def _checked_shape(shape, lattice: str) -> tuple[int, int, int]:
    x, y, z = (int(size) for size in shape)
    if min(x, y, z) < 1:
        raise ValueError(f"shape: expected at least one cell along each axis, got {(x, y, z)}")
    if lattice == "D2Q9" and z != 1:
        raise ValueError(f"shape: expected one cell along z for D2Q9, got {z}")
    if x * y * z >= 2**31:
        raise WlmError(f"lattice: {x} x {y} x {z} cells: expected fewer than 2^31")
    return x, y, z


def _check_speed(speed: float, what: str) -> None:
    if speed > MAX_SPEED:
        raise WlmError(
            f"lattice: {what} moves at {speed:.3g} cells a step: expected at most {MAX_SPEED}: use a shorter time step"
        )
