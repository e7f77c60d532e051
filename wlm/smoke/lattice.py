"""A lattice Boltzmann solver of smoke's air: the velocity that carries the density (neural-six-way-lightmaps,
section 5).

Inside, lengths are cells, times are steps, and the density of air at rest is 1; ``Domain`` converts. Arrays are
[X, Y, Z], cell centres at half integers. Stated behaviours:

===================================  =================================================================
a flow that blows up                 error within ``CHECK_EVERY`` steps: the first step and cell, and why
a wall, body or inlet too fast       error: the speed and ``MAX_SPEED``
a body over an inlet                 nothing comes in where it lies; with all covered, nothing at all
a body over everything               nothing moves
a grid of one voxel                  fine, as is any axis of one cell
a domain too large for the memory    error before anything is allocated: what it needs and what there is
a cell freed with no fluid about it  at rest at density 1
===================================  =================================================================
"""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from wlm.errors import WlmError
from wlm.smoke import lattice_faces
from wlm_kernels import lattice_bricks, lattice_links, lattice_solids
from wlm_kernels.lattice import QUIET, Spec, eddy_factor, fluid_kernels, step_kernel, trouble_of
from wlm_kernels.lattice_sets import BRICK_CELLS, STORAGES, brick_shape, lattice, tables

__all__ = ["CHECK_EVERY", "MAX_SPEED", "Domain", "Lattice"]

CHECK_EVERY = 48
"""Steps between two looks at whether a cell went wrong; a multiple of what a graph holds."""

MAX_SPEED = 0.3
"""The fastest wall, body or inlet, cells a step: half the speed of sound, where errors of Ma^2 reach a quarter."""

_BODIES = 256
# A graph is worth its capture for a run of this many steps.
_GRAPH_FROM = 16
# Groups of threads that share the list of bricks: enough to fill any GPU.
_WORKERS = 2048


@dataclass(frozen=True)
class Domain:
    """The size of a cell and of a step, to convert from and to SI units.

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
        """The step at which ``speed`` (m/s) is ``lattice_speed`` (cells a step)."""
        return cls(cell, lattice_speed * cell / speed)

    def speed(self, metres_a_second: float) -> float:
        """Cells a step."""
        return metres_a_second * self.step / self.cell

    def viscosity(self, square_metres_a_second: float) -> float:
        """Square cells a step."""
        return square_metres_a_second * self.step / self.cell**2

    def acceleration(self, metres_a_second2: float) -> float:
        """Cells a step, a step."""
        return metres_a_second2 * self.step**2 / self.cell


@dataclass(eq=False)
class _Links:
    """Links on the device, those of faces first; see ``lattice_links``. ``last``: int [1], how many are in use."""

    cell: wp.array
    code: wp.array
    term: wp.array
    value: wp.array
    last: wp.array
    faces: int


def _free_memory(device: wp.Device) -> int:
    """Bytes that can be allocated."""
    if device.is_cuda:
        return device.free_memory
    return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


class Lattice:
    """A box of air, all of it at rest at first, periodic along every axis until a face is set.

    Order: faces, then ``set_flow`` if the air moves at first, then steps; bodies and forces at any time.

    Args:
        shape: Cells along x, y and z.
        viscosity: Kinematic, square cells a step; above 0.
        operator: "bgk", "regularised" or "recursive", see ``wlm_kernels.lattice``.
        smagorinsky: C of the eddy viscosity; 0 is none. With it the default operator is stable at 1e-6.
        storage: "float32" or "float16": half the memory and traffic; see docs/results.md for what it costs in error.
        lattice: "D2Q9" (Z = 1), "D3Q19" or "D3Q27".
        device: As ``wlm.interop.check_device`` returns it.
        bricks: Whether only bricks of 512 cells with flow in them, and those beside them, are worked on.
        tolerance: With bricks: momentum or density, as a deviation from rest, below which air counts as at rest.

    Raises:
        ValueError: A wrong argument.
        WlmError: The memory isn't enough.
    """

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
        bricks: bool = False,
        tolerance: float = 1e-6,
    ) -> None:
        self.shape = _shape(shape)
        for name, value, least in (("viscosity", viscosity, 1e-12), ("smagorinsky", smagorinsky, 0.0)):
            if not (math.isfinite(value) and value >= least):
                raise ValueError(f"{name}: expected a number of at least {least:g}, got {value}")
        if bricks and not (math.isfinite(tolerance) and tolerance >= 0.0):
            raise ValueError(f"tolerance: expected a number of at least 0, got {tolerance}")
        self._settings: dict[str, Any] = {
            "lattice": lattice,
            "operator": operator,
            "storage": storage,
            "eddies": smagorinsky > 0.0,
            "bricks": bricks,
        }
        Spec(**self._settings)
        self._set = _velocity_set(lattice, self.shape)
        self.device = wp.get_device(device)
        self._n = wp.vec3i(*self.shape)
        self._cells = math.prod(self.shape)
        stored = STORAGES[storage][0]
        self._require_memory(2 * len(self._set.c) * self._cells * wp.types.type_size_in_bytes(stored))
        size = (len(self._set.c), self._cells)
        self._f = [wp.zeros(size, dtype=stored, device=self.device) for _ in range(2)]
        self._tau, self._eddy, self._quiet = 0.5 + 3.0 * viscosity, eddy_factor(smagorinsky), tolerance**2
        self._clock = self._zeros(2, int)
        self._trouble = wp.full(1, QUIET, dtype=wp.int64, device=self.device)
        self._sums = self._zeros(2, wp.float64)
        self._solid = self._zeros(0, wp.uint8)
        self._bodies = lattice_solids.Bodies()
        for field in ("velocity", "spin", "centre"):
            setattr(self._bodies, field, self._zeros(_BODIES, wp.vec3))
        self._push, self._pushes = wp.vec3(), self._zeros(0, wp.vec3)
        self._force = "none"
        self._faces: dict[str, lattice_faces.Face] = {}
        self._links: _Links | None = None
        self._steps = 0
        self._flows = False
        self._graph: wp.Graph | None = None
        brick = brick_shape(self.shape)
        grid = lattice_bricks.make(self.shape, brick, str(self.device)) if bricks else None
        self._bricks: lattice_bricks.Bricks | None = grid
        self._relist = bricks
        # On a CPU a thread a brick; there they are done one after the other.
        total = 1 if grid is None else grid.busy.shape[0]
        self._workers = min(total, _WORKERS) if self.device.is_cuda else total
        self._nothing = self._zeros(0, int)

    # What the domain holds.

    def set_wall(self, face: str, velocity=(0.0, 0.0, 0.0), *, slip: bool = False) -> None:
        """Closes a face.

        Args:
            face: One of ``wlm.smoke.lattice_faces.FACES``, "-x" for example.
            velocity: Of the wall, cells a step, along it; (3,) or [A, B, 3] for the face's cells.
            slip: Without friction; it has no velocity then.
        """
        self._set_face(face, lattice_faces.wall(self.shape, face, velocity, slip))

    def set_inlet(self, face: str, velocity, where=None) -> None:
        """Lets air in through a face, or a part of it.

        Args:
            face: As for ``set_wall``.
            velocity: Cells a step; (3,) or [A, B, 3] for the face's cells.
            where: bool [A, B], None: the whole face. The rest is a wall.
        """
        self._set_face(face, lattice_faces.inlet(self.shape, face, velocity, where))

    def set_outlet(self, face: str, density: float | None = None) -> None:
        """Lets air out through a face.

        Args:
            face: As for ``set_wall``.
            density: None: as much leaves, through all such outlets together, as comes in elsewhere, so that the
                mass stays what it is. A number: the density is held there, and the mass finds its own level.
        """
        self._set_face(face, lattice_faces.outlet(self.shape, face, density))

    def set_solid(self, mask, velocity=(0.0, 0.0, 0.0), *, spin=(0.0, 0.0, 0.0), centre=(0.0, 0.0, 0.0)) -> None:
        """Says which cells are solid, and how they move; to be called again when they have moved.

        Cells that are no longer solid get the equilibrium of the mean of their neighbours. It takes a sync with the
        device, and isn't for graphs.

        Args:
            mask: bool, or integers 0 (fluid) to 255 for many bodies, [X, Y, Z]; an array of NumPy or a Warp array of
                uint8 on the device, see ``wlm_kernels.lattice_solids``.
            velocity: Of the bodies' centres, cells a step; (3,) for body 1 or [K, 3] for bodies 1 to K.
            spin: Radians a step, likewise.
            centre: Cells, likewise; used where a body spins.

        Raises:
            WlmError: A surface is faster than ``MAX_SPEED``.
        """
        new = self._mask(mask)
        for field, value in (("velocity", velocity), ("spin", spin), ("centre", centre)):
            rows = np.zeros((_BODIES, 3), np.float32)
            given = np.atleast_2d(np.asarray(value, np.float32))
            if given.ndim != 2 or given.shape[1] != 3 or len(given) >= _BODIES or not np.isfinite(given).all():
                raise ValueError(f"{field}: expected finite numbers of shape (3,) or [K, 3], K < {_BODIES}")
            rows[1 : len(given) + 1] = given
            getattr(self._bodies, field).assign(rows)
        self._prepare()
        if self._solid.shape[0] == 0:
            self._solid = self._zeros(self._cells, wp.uint8)
            self._graph = None
        kernels, t = self._fluid_kernels, self._tables
        now, spare = self._buffers
        common = [t, self._n, self._bounded]
        self._launch(kernels.neighbours, self._cells, [*common, now, self._solid, new], [spare])
        self._launch(kernels.uncover, self._cells, [*common, self._solid, new], [spare, now])
        wp.copy(self._solid, new)
        self._find_links()
        self._apply(self._links.faces, now)

    def set_force(self, force) -> None:
        """Sets the force on the air.

        Args:
            force: An acceleration, cells a step a step: (3,) for all cells, or [X, Y, Z, 3]; a Warp array of vec3
                [X, Y, Z] on the device is used as it is, so that it may change between steps. None: no force.
        """
        self._push, self._pushes, self._force = wp.vec3(), self._zeros(0, wp.vec3), "none"
        self._graph = None
        if force is None:
            return
        if isinstance(force, wp.array):
            if force.shape != self.shape or force.dtype != wp.vec3 or force.device != self.device:
                raise ValueError(f"force: expected vec3 {self.shape} on {self.device}")
            self._pushes, self._force = force.flatten(), "field"
            return
        given = np.asarray(force, np.float32)
        if given.shape not in ((3,), (*self.shape, 3)) or not np.isfinite(given).all():
            raise ValueError(f"force: expected finite numbers of shape (3,) or {(*self.shape, 3)}, got {given.shape}")
        if given.ndim == 1:
            self._push, self._force = wp.vec3(*given.tolist()), "uniform"
        else:
            self._pushes = wp.array(given.reshape(-1, 3), dtype=wp.vec3, device=self.device)
            self._force = "field"

    def set_flow(self, velocity=(0.0, 0.0, 0.0), density=1.0) -> None:
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
        now, spare = self._buffers
        now.zero_()
        spare.zero_()
        moved = wp.array(np.ascontiguousarray(u), dtype=wp.vec3, device=self.device)
        inputs = [self._tables, self._n, self._bounded, wp.array(drho, device=self.device), moved]
        self._launch(self._fluid_kernels.start, self._cells, inputs, [now])
        self._apply(self._links.faces, now)
        self._flows = True
        self._wake()

    # What happens.

    def step(self, steps: int = 1) -> None:
        """Goes on by some steps, and looks every ``CHECK_EVERY`` whether the flow is still one.

        Within the capture of a CUDA graph it doesn't look: call ``check`` between replays; the number of steps must
        be a multiple of ``period`` there, and so must be those done before.

        Raises:
            WlmError: As ``check``.
        """
        if steps < 0:
            raise ValueError(f"steps: expected at least 0, got {steps}")
        if self.device.is_cuda and self.device.is_capturing:
            if steps % self.period or self._steps % self.period or self._links is None:
                raise ValueError(f"steps in a graph: expected a multiple of {self.period}, after as many eager ones")
            self._run(steps)
            return
        self._prepare()
        graphs = self.device.is_cuda and (self._graph is not None or steps >= _GRAPH_FROM)
        while steps > 0:
            chunk = min(steps, CHECK_EVERY)
            self._run_in_graphs(chunk) if graphs else self._run(chunk)
            steps -= chunk
            self.check()

    @property
    def period(self) -> int:
        """Steps after which the buffers, and with bricks the lists, are as they were: what a graph may hold."""
        return lattice_bricks.EVERY if self._bricks is not None else 2

    @property
    def steps(self) -> int:
        """Steps done; it syncs with the device, since replays of a graph count too."""
        return int(self._clock.numpy()[self._steps % 2])

    def check(self) -> None:
        """Looks whether a cell went wrong so far, which every step notes on the device; syncs with it.

        Raises:
            WlmError: One did; the line names the first step, the cell and the cause.
        """
        key = int(self._trouble.numpy()[0])
        if key == QUIET:
            return
        step, cell, cause = trouble_of(key)
        place = tuple(int(a) for a in np.unravel_index(cell, self.shape))
        raise WlmError(
            f"lattice: blew up in step {step} at cell {place}: {cause}; expected speeds below {MAX_SPEED} and a"
            f" viscosity that the operator bears: use a shorter time step, a larger viscosity or smagorinsky=0.17"
        )

    # What comes out.

    def velocity(self, out: wp.array | None = None) -> wp.array:
        """The velocity, vec3 [X, Y, Z], cells a step; in a solid cell the body's."""
        out = wp.empty(self.shape, dtype=wp.vec3, device=self.device) if out is None else out
        self._fields(self._zeros(0, float), out.flatten())
        return out

    def excess_density(self, out: wp.array | None = None) -> wp.array:
        """The density less 1, float [X, Y, Z], which float32 holds more exactly; 0 in a solid cell."""
        out = wp.empty(self.shape, dtype=float, device=self.device) if out is None else out
        self._fields(out.flatten(), self._zeros(0, wp.vec3))
        return out

    def density(self) -> np.ndarray:
        """The density, float64 [X, Y, Z]; 1 in a solid cell. Pressure is a third of it."""
        return 1.0 + self.excess_density().numpy().astype(np.float64)

    def mass(self) -> float:
        """Of all fluid cells, summed in float64."""
        fluid = self._cells if self._solid.shape[0] == 0 else int((self._solid.numpy() == 0).sum())
        return fluid + float(self.excess_density().numpy().sum(dtype=np.float64))

    def force_on_solid(self, body: int = 1) -> np.ndarray:
        """The force of the air on a body in the last step, by momentum exchange, float64 (3,).

        The push of air at rest at density 1 is left out; on a body that the air surrounds it is zero anyway.
        """
        self._prepare()
        total = self._zeros(_BODIES, wp.vec3d)
        links = self._links
        inputs = [self._tables, self._n, links.faces, links.last, self._solid, links.cell, links.code, links.term]
        size = links.cell.shape[0] - links.faces
        if size > 0:
            self._launch(self._link_kernels.force, size, [*inputs, self._buffers[0]], [total])
        return total.numpy()[body]

    @property
    def active_cells(self) -> int:
        """Cells worked on in a step: all without bricks."""
        if self._bricks is None:
            return self._cells
        return int(self._bricks.count.numpy()[0]) * BRICK_CELLS

    def state(self) -> dict[str, np.ndarray]:
        """What ``load`` takes: populations as stored, solid cells and their motion, steps done."""
        bodies = [getattr(self._bodies, field).numpy() for field in ("velocity", "spin", "centre")]
        return {
            "populations": self._buffers[0].numpy(),
            "solid": self._solid.numpy(),
            "bodies": np.stack(bodies),
            "steps": np.array(self.steps, np.int64),
        }

    def load(self, state: Mapping[str, np.ndarray]) -> None:
        """Goes on from a state of a lattice of the same settings and faces, to the same last bit.

        Raises:
            WlmError: The state is of another shape, lattice or storage.
        """
        want = {
            "populations": (tuple(self._f[0].shape), self._f[0].numpy().dtype),
            "bodies": ((3, _BODIES, 3), np.dtype(np.float32)),
        }
        for name in ("populations", "solid", "bodies", "steps"):
            if name not in state:
                raise WlmError(f"lattice state: {name}: missing")
        for name, (shape, dtype) in want.items():
            got = state[name]
            if got.shape != shape or got.dtype != dtype:
                raise WlmError(f"lattice state: {name}: expected {dtype} {shape}, found {got.dtype} {got.shape}")
        if state["solid"].shape not in ((0,), (self._cells,)):
            raise WlmError(f"lattice state: solid: expected 0 or {self._cells} cells, found {state['solid'].shape}")
        self._prepare()
        done = int(state["steps"])
        self._solid = wp.array(state["solid"].astype(np.uint8), dtype=wp.uint8, device=self.device)
        for field, rows in zip(("velocity", "spin", "centre"), state["bodies"], strict=True):
            getattr(self._bodies, field).assign(rows)
        self._steps, self._flows, self._graph = done, True, None
        self._clock.fill_(done)
        self._trouble.fill_(QUIET)
        now, spare = self._buffers
        now.assign(state["populations"])
        spare.zero_()
        self._find_links()
        self._wake()

