"""The arrays of a lattice on its device, and the launches that a step is made of; ``lattice`` checks what goes in."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from wlm.fluid.faces import Face, bounded_axes, face_links, walled_axes
from wlm.interop import no_collection
from wlm_kernels.fluid import lattice_bricks, lattice_links, lattice_solids
from wlm_kernels.fluid.lattice import QUIET, Spec, step_kernel
from wlm_kernels.fluid.lattice_fields import fluid_kernels
from wlm_kernels.fluid.lattice_sets import BRICK_CELLS, NARROW, STORAGES, brick_shape, tables
from wlm_kernels.fluid.lattice_sets import lattice as velocity_set

__all__ = ["BODIES", "Engine"]

BODIES = 256
"""Bodies that uint8 can number, the fluid counted in."""

# Groups of threads that share the list of bricks. With a group for each brick of 256^3 a full list takes as long as the
# dense step, with 2,048 half as long again; groups that find no work cost little.
_WORKERS = 32768


@dataclass(eq=False)
class _Links:
    """Links on the device, those of ``faces`` first; see ``lattice_links``. ``last``: int [1], how many are in use."""

    cell: wp.array
    code: wp.array
    term: wp.array
    value: wp.array
    last: wp.array
    faces: int


class Engine:
    """A lattice on a device.

    Attributes:
        spec: What changes the code of a step.
        device: The device.
        cells: X Y Z.
        done: Steps done by this object's own launches; replays of a graph that another made are in ``clock`` alone.
        clock, trouble: See ``wlm_kernels.fluid.lattice.step_kernel``.
        solid: uint8 [N], or [0] as long as no cell was ever solid.
        bodies: How the solids move.
        bricks: None for a dense domain.
    """

    def __init__(
        self, shape: tuple[int, int, int], spec: Spec, tau: float, eddy: float, quiet: float, rise: float, device
    ) -> None:
        self.device, self._shape, self._n = device, shape, wp.vec3i(*shape)
        self._set = velocity_set(spec.lattice)
        self._tables = tables(spec.lattice, str(device))
        self.cells = math.prod(shape)
        stored = STORAGES[spec.storage][0]
        size = (len(self._set.c), self.cells)
        self.spec = replace(spec, wide=math.prod(size) > NARROW)
        self._f = [wp.zeros(size, dtype=stored, device=device) for _ in range(2)]
        self._tau, self._eddy, self._quiet, self._rise = tau, eddy, quiet, rise
        self.clock = self.zeros(2, int)
        self.trouble = wp.full(1, QUIET, dtype=wp.int64, device=device)
        self._sums = self.zeros(2, wp.float64)
        self.solid = self.zeros(0, wp.uint8)
        self.bodies = lattice_solids.Bodies()
        for field in ("velocity", "spin", "centre"):
            setattr(self.bodies, field, self.zeros(BODIES, wp.vec3))
        self._push, self._pushes = wp.vec3(), self.zeros(0, wp.vec3)
        self.set_faces({})
        self.done = 0
        # A step of a dense domain takes these and looks at none of them.
        self.bricks = lattice_bricks.make(shape, brick_shape(shape), str(device)) if spec.bricks else None
        self._nobricks = lattice_bricks.make((0, 0, 0), brick_shape(shape), str(device))
        self._stale = spec.bricks
        # On a CPU a worker a brick; there they are done one after the other.
        total = self.bricks.busy.shape[0] if self.bricks else 0
        self._workers = min(total, _WORKERS) if device.is_cuda else total

    @staticmethod
    def bytes_needed(cells: int, lattice: str, storage: str) -> int:
        """Of the populations, by far the most of all."""
        size = wp.types.type_size_in_bytes(STORAGES[storage][0])
        return 2 * len(velocity_set(lattice).c) * cells * size

    @property
    def buffers(self) -> tuple[wp.array, wp.array]:
        """What the next step reads, and what it writes."""
        return self._f[self.done % 2], self._f[1 - self.done % 2]

    @property
    def period(self) -> int:
        """Steps after which buffers and lists are where they were."""
        return lattice_bricks.EVERY if self.bricks else 2

    def zeros(self, size: int, dtype) -> wp.array:
        return wp.zeros(size, dtype=dtype, device=self.device)

    # Setting up.

    def set_faces(self, faces: Mapping[str, Face]) -> None:
        """Sets what lies at the domain's faces; links are made of it by ``prepare``."""
        self._faces = dict(faces)
        self._links: _Links | None = None
        self._graph: wp.Graph | None = None

    def set_force(self, push: wp.vec3 | None, pushes: wp.array | None) -> None:
        """Sets one force for all cells, or one for each, or none."""
        kind = "uniform" if push is not None else "field" if pushes is not None else "none"
        self.spec = replace(self.spec, force=kind)
        self._push = wp.vec3() if push is None else push
        self._pushes = self.zeros(0, wp.vec3) if pushes is None else pushes
        self._graph = None

    def prepare(self) -> float:
        """Makes what the faces, set anew, ask for; gives the speed of the fastest solid."""
        if self._links is not None:
            return 0.0
        self._bounded = wp.vec3i(*bounded_axes(self._faces))
        walls = walled_axes(self._faces)
        self.spec = replace(self.spec, walls=walls)
        self._walled = wp.vec3i(*(int(wall) for wall in walls))
        kinds = {int(kind) for face in self._faces.values() for kind in np.unique(face.kind)}
        balance = lattice_links.OUTLET in kinds
        self._link_kernels = lattice_links.link_kernels(self.spec.lattice, self.spec.storage, balance)
        self._fluid_kernels = fluid_kernels(self.spec.lattice, self.spec.storage, walls)
        columns = face_links(self._shape, self._set, self._faces)
        self._links = self._make_links(columns, len(columns[0]))
        return self.find_links()

    def start(self, drho: wp.array, u: wp.array) -> None:
        """Sets all air to an equilibrium."""
        now, spare = self.buffers
        spare.zero_()
        self._sums.zero_()
        self.wake()
        self._launch(self._fluid_kernels.start, self.cells, [self._tables, drho, u], [now])
        self._apply(0, now)

    def cover(self, new: wp.array) -> float:
        """Makes other cells solid, uint8 [N]; gives the speed of the fastest."""
        if self.solid.shape[0] == 0:
            self.solid = self.zeros(self.cells, wp.uint8)
            self._graph = None
        self.spec = replace(self.spec, solids=True)
        now, spare = self.buffers
        common = [self._tables, self._n, self._bounded]
        inputs = [*common, now, self.solid, new]
        self._launch(self._fluid_kernels.neighbours, self.cells, inputs, [spare])
        inputs = [*common, self._walled, self.solid, new, spare]
        self._launch(self._fluid_kernels.uncover, self.cells, inputs, [now])
        wp.copy(self.solid, new)
        fastest = self.find_links()
        self._apply(self._links.faces, now)
        return fastest

    def restore(self, populations: np.ndarray, solid: np.ndarray, done: int) -> float:
        """Goes on from a stored state, the bodies' motion set already; gives the speed of the fastest solid."""
        self.done, self._graph = done, None
        self.clock.fill_(done)
        self.trouble.fill_(QUIET)
        self.solid = wp.array(solid, dtype=wp.uint8, device=self.device)
        self.spec = replace(self.spec, solids=len(solid) > 0)
        now, spare = self.buffers
        now.assign(populations)
        spare.zero_()
        fastest = self.find_links()
        self.wake()
        return fastest

    def wake(self) -> None:
        """Counts all bricks as busy."""
        if self.bricks:
            self.bricks.busy.fill_(1)
            self._stale = True

    def find_links(self) -> float:
        """Lists the links of solids, with more places if there are too few; gives the speed of the fastest."""
        fastest = 0.0
        if self.solid.shape[0] > 0:
            count, fastest = self._search()
            links = self._links
            if count > links.cell.shape[0] - links.faces:
                columns = [array.numpy()[: links.faces] for array in (links.cell, links.code, links.term)]
                # Some room: a body that moves has now more links, now fewer.
                self._links = self._make_links(columns, links.faces + count + count // 4)
                self._graph = None
                self._search()
            self._links.last.fill_(self._links.faces + count)
        else:
            # A state without solids may follow one that had some.
            self._links.last.fill_(self._links.faces)
        if self.bricks:
            self.bricks.pinned.zero_()
            lattice_links.pin(self._n, self.bricks.shape, self._links, self.bricks.pinned)
            self._stale = True
        return fastest

    def _make_links(self, columns, size: int) -> _Links:
        """Puts the links of faces on the device, with places for ``size`` in all."""
        faces, made = len(columns[0]), []
        for column, dtype in zip(columns, (np.int32, np.uint8, np.float32), strict=True):
            padded = np.zeros(size, dtype)
            padded[:faces] = column
            made.append(wp.array(padded, device=self.device))
        return _Links(*made, self.zeros(size, float), wp.full(1, faces, dtype=int, device=self.device), faces)

    def _search(self) -> tuple[int, float]:
        links, found, fastest = self._links, self.zeros(1, int), self.zeros(1, float)
        lattice_solids.find_links(
            self._tables,
            self._n,
            self._bounded,
            self.solid,
            self.bodies,
            links.faces,
            found,
            fastest,
            links.cell,
            links.code,
            links.term,
        )
        return int(found.numpy()[0]), float(fastest.numpy()[0])

    # Running.

    def run(self, steps: int) -> None:
        """Queues some steps."""
        for _ in range(steps):
            self._step()

    def run_in_graphs(self, steps: int) -> None:
        """Does the same by replays of a CUDA graph of ``period`` steps, and eagerly what is left."""
        while steps > 0:
            if steps < self.period or self.done % self.period or self._stale or self._graph is None:
                # The first steps load the kernels' modules, which a capture must not.
                eager = min(steps, self.period - self.done % self.period)
                self.run(eager)
                steps -= eager
                if self._graph is None and self.done % self.period == 0:
                    with no_collection(), wp.ScopedCapture(self.device) as capture:
                        self.run(self.period)
                    self._graph, self.done = capture.graph, self.done - self.period
            else:
                wp.capture_launch(self._graph)
                self.done += self.period
                steps -= self.period

    def fields(self, drho: wp.array, u: wp.array) -> None:
        """Writes the density's deviation from 1 and the velocity, each unless its array is empty."""
        inputs = [self._n, self.buffers[0], self.solid, self.bodies, self._push, self._pushes]
        self._launch(self._fluid_kernels.fields, self.cells, inputs, [drho, u])

    def force(self) -> np.ndarray:
        """The force on every body in the last step, float64 [BODIES, 3]."""
        total = self.zeros(BODIES, wp.vec3d)
        links = self._links
        inputs = [self._tables, self._n, self._bounded, links.last, self.solid, links.cell, links.code, links.term]
        if self.solid.shape[0] > 0:
            self._launch(self._link_kernels.force, links.cell.shape[0], [*inputs, self.buffers[0]], [total])
        return total.numpy()

    def _step(self) -> None:
        bricks, (now, out) = self.bricks or self._nobricks, self.buffers
        if self.bricks and (self._stale or self.done % lattice_bricks.EVERY == 0):
            at = [self._n, now, out, self._workers]
            lattice_bricks.relist(self.bricks, self.spec.lattice, self.spec.storage, *at)
            self._stale = False
        where = [bricks.shape, bricks.listed, bricks.count, self._workers, self._quiet]
        how = [self._tau, self._eddy, self._push, self._pushes]
        inputs = [self._n, now, self.solid, *how, *where, self.done % 2]
        threads = self._workers * BRICK_CELLS if self.bricks else self.cells
        outputs = [self.clock, self.trouble, bricks.busy, self._sums, out]
        self._launch(step_kernel(self.spec), threads, inputs, outputs)
        self._apply(0, out)
        self.done += 1

    def _apply(self, first: int, f: wp.array) -> None:
        where = [self._tables, self._n, self._bounded, first, self._links, self.solid]
        lattice_links.apply(self._link_kernels, *where, self.clock, self._rise, f, self._sums)

    def _launch(self, kernel, size: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self.device)
