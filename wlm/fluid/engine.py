"""The data of a lattice of air on its device, and the launches of a step; `wlm.fluid.lattice` validates the input."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import warp as wp

from wlm.errors import WlmError
from wlm.fluid.faces import Face, bounded_axes, face_links, walled_axes
from wlm.interop import free_memory, no_collection
from wlm_kernels.fluid import lattice_links
from wlm_kernels.fluid.lattice import QUIET, Spec, step_kernel
from wlm_kernels.fluid.lattice_fields import fluid_kernels
from wlm_kernels.fluid.lattice_sets import NARROW, STORAGES, tables
from wlm_kernels.fluid.lattice_sets import lattice as velocity_set

BODIES = 256
"""Number of bodies that uint8 can index, including the fluid."""

PERIOD = 2
"""Steps after which the two buffers have swapped back; a CUDA graph must contain a multiple of it."""


def require_free(name: str, shape: tuple[int, int, int], needed: int, device: wp.Device, remedy: str) -> None:
    """Checks that `needed` bytes for a grid are free; `name` and `remedy` are words for the error message.

    Raises:
        WlmError: There is not enough; the message names the grid, the required and free memory, and the remedy.
    """
    free = free_memory(device)
    if needed > free:
        cells = " x ".join(map(str, shape))
        raise WlmError(
            f"{name}: {cells} cells need {needed / 2**30:.1f} GiB on {device}: expected at most the"
            f" {free / 2**30:.1f} GiB that are free: use {remedy}"
        )


class Engine:
    """A lattice of air on a device.

    Attributes:
        spec: The settings for which the kernel of a step is specialised.
        device: The device.
        cells: Number N of cells.
        done: Steps that this object launched itself; replays of a user's CUDA graph are counted only in `clock`.
        clock, trouble: Step counter and first error, see `wlm_kernels.fluid.lattice.step_kernel`.
        solid: uint8 [N], number of the body of each cell, 0 for fluid; [0] while no cell has ever been solid.
        velocity: vec3 [BODIES], velocity of each body in cells per step; element 0 is not used.
    """

    def __init__(self, shape: tuple[int, int, int], spec: Spec, tau: float, eddy: float, rise: float, device) -> None:
        self.device, self._shape, self._n = device, shape, wp.vec3i(*shape)
        self._set = velocity_set(spec.lattice)
        self._tables = tables(spec.lattice, str(device))
        self.cells = math.prod(shape)
        stored = STORAGES[spec.storage][0]
        size = (len(self._set.c), self.cells)
        self.spec = replace(spec, wide=math.prod(size) > NARROW)
        self._f = [wp.zeros(size, dtype=stored, device=device) for _ in range(2)]
        self._tau, self._eddy, self._rise = tau, eddy, rise
        self.clock = self.zeros(2, int)
        self.trouble = wp.full(1, QUIET, dtype=wp.int64, device=device)
        self._sums = self.zeros(2, wp.float64)
        self.solid = self.zeros(0, wp.uint8)
        self.velocity = self.zeros(BODIES, wp.vec3)
        self._forces = self.zeros(0, wp.vec3)
        self.set_faces({})
        self.done = 0

    @staticmethod
    def bytes_needed(cells: int, lattice: str, storage: str) -> int:
        """Returns the bytes of both arrays of populations for `cells` cells, by far the largest part of the memory."""
        size = wp.types.type_size_in_bytes(STORAGES[storage][0])
        return 2 * len(velocity_set(lattice).c) * cells * size

    @property
    def buffers(self) -> tuple[wp.array, wp.array]:
        """The array of populations that the next step reads, and the array that it writes."""
        return self._f[self.done % 2], self._f[1 - self.done % 2]

    def zeros(self, size: int, dtype) -> wp.array:
        return wp.zeros(size, dtype=dtype, device=self.device)

    # Setting up.

    def set_faces(self, faces: Mapping[str, Face]) -> None:
        """Sets the boundary conditions at the domain's faces, by the faces' names; `prepare` then applies them."""
        self._faces = dict(faces)
        self._links: lattice_links.Links | None = None
        self._graph: wp.Graph | None = None

    def set_force(self, forces: wp.array | None) -> None:
        """Sets a force per cell, vec3 [N], or no force."""
        self.spec = replace(self.spec, forced=forces is not None)
        self._forces = self.zeros(0, wp.vec3) if forces is None else forces
        self._graph = None

    def prepare(self) -> float:
        """Applies new boundary conditions, and returns the speed of the fastest solid in cells per step."""
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
        """Sets each cell to equilibrium at the density 1 + `drho`, float [N], and the velocity `u`, vec3 [N]."""
        now, spare = self.buffers
        spare.zero_()
        self._sums.zero_()
        self._launch(self._fluid_kernels.start, self.cells, [self._tables, drho, u], [now])
        self._apply_links(0, now)

    def cover(self, new: wp.array) -> float:
        """Sets which cells are solid, uint8 [N], and returns the speed of the fastest solid in cells per step."""
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
        self._apply_links(self._links.faces, now)
        return fastest

    def restore(self, populations: np.ndarray, solid: np.ndarray, done: int) -> float:
        """Sets a stored state and returns the speed of the fastest solid in cells per step; the velocities of the
        bodies must be set before."""
        self.done, self._graph = done, None
        self.clock.fill_(done)
        self.trouble.fill_(QUIET)
        self.solid = wp.array(solid, dtype=wp.uint8, device=self.device)
        self.spec = replace(self.spec, solids=len(solid) > 0)
        now, spare = self.buffers
        now.assign(populations)
        spare.zero_()
        return self.find_links()

    def find_links(self) -> float:
        """Lists the populations that solids send back (see `lattice_links`), and returns the speed of the fastest solid
        in cells per step."""
        # The count is also set without solids: the state before may have had some.
        count, fastest = 0, 0.0
        if self.solid.shape[0] > 0:
            count, fastest = self._search()
            links = self._links
            if count > links.cell.shape[0] - links.faces:
                columns = [array.numpy()[: links.faces] for array in (links.cell, links.code, links.term)]
                # Spare elements: the number of links of a moving body varies.
                self._links = self._make_links(columns, links.faces + count + count // 4)
                self._graph = None
                self._search()
        self._links.used.fill_(self._links.faces + count)
        return fastest

    def _make_links(self, columns, size: int) -> lattice_links.Links:
        links = lattice_links.Links()
        links.faces = len(columns[0])
        dtypes = {"cell": np.int32, "code": np.uint8, "term": np.float32}
        for (name, dtype), column in zip(dtypes.items(), columns, strict=True):
            padded = np.zeros(size, dtype)
            padded[: links.faces] = column
            setattr(links, name, wp.array(padded, device=self.device))
        links.value = self.zeros(size, float)
        links.used = wp.full(1, links.faces, dtype=int, device=self.device)
        return links

    def _search(self) -> tuple[int, float]:
        where = [self._tables, self._n, self._bounded, self.solid, self.velocity, self._links]
        count, fastest = lattice_links.find_links(*where)
        return int(count.numpy()[0]), float(fastest.numpy()[0])

    # Running.

    def run(self, steps: int) -> None:
        """Queues steps on the device and returns without waiting."""
        for _ in range(steps):
            self._step()

    def run_in_graphs(self, steps: int) -> None:
        """Queues steps as replays of a CUDA graph of `PERIOD` steps, and remaining steps without the graph."""
        while steps > 0:
            if steps < PERIOD or self.done % PERIOD or self._graph is None:
                # The first steps load the kernels' modules, which is not allowed during a capture.
                eager = min(steps, PERIOD - self.done % PERIOD)
                self.run(eager)
                steps -= eager
                if self._graph is None and self.done % PERIOD == 0:
                    with no_collection(), wp.ScopedCapture(self.device) as capture:
                        self.run(PERIOD)
                    self._graph, self.done = capture.graph, self.done - PERIOD
            else:
                wp.capture_launch(self._graph)
                self.done += PERIOD
                steps -= PERIOD

    def fields(self, drho: wp.array, u: wp.array) -> None:
        """Writes the density minus 1 of each cell to `drho` and the velocity to `u`; an array of size 0 is skipped."""
        inputs = [self._n, self.buffers[0], self.solid, self.velocity, self._forces]
        self._launch(self._fluid_kernels.fields, self.cells, inputs, [drho, u])

    def force_on_bodies(self) -> np.ndarray:
        """Returns the force on every body in the last step, float64 [BODIES, 3]."""
        total = self.zeros(BODIES, wp.vec3d)
        if self.solid.shape[0] > 0:
            inputs = [self._tables, self._n, self._bounded, self._links, self.solid, self.buffers[0]]
            self._launch(self._link_kernels.force, self._links.cell.shape[0], inputs, [total])
        return total.numpy()

    def _step(self) -> None:
        now, out = self.buffers
        inputs = [self._n, now, self.solid, self._tau, self._eddy, self._forces, self.done % 2]
        self._launch(step_kernel(self.spec), self.cells, inputs, [self.clock, self.trouble, self._sums, out])
        self._apply_links(0, out)
        self.done += 1

    def _apply_links(self, first: int, f: wp.array) -> None:
        where = [self._tables, self._n, self._bounded, first, self._links, self.solid]
        lattice_links.apply(self._link_kernels, *where, self.clock, self._rise, f, self._sums)

    def _launch(self, kernel, size: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self.device)
