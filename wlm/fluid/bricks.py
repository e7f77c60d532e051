"""The memory of smoke that is stored in bricks: a pool on the device that follows the smoke, and grows when it is full.

The pool never becomes smaller. It grows by a quarter more than is needed, for which the host must know how many bricks
a step needs: it reads this number while the air moves. On a GPU of which a full pool would take at most a sixteenth of
the free memory, the pool is full from the start, so that the host need not know it.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch
import warp as wp

from wlm.errors import WlmError
from wlm.fluid.slabs import Slabs
from wlm_kernels.fluid import advection_places, advection_sources
from wlm_kernels.fluid.advection import Fields
from wlm_kernels.fluid.advection_places import CELLS, Box

INDEX_BYTES = 16
"""Memory of a brick that is not stored."""

_MARGIN = 64  # bricks by which the pool grows at least


def require_memory(name: str, shape: tuple[int, int, int], needed: int, slabs: Slabs) -> None:
    """Checks that cells of smoke can be indexed, and `needed` bytes for them allocated; `name` is for the message."""
    x, y, z = shape
    if x * y * z >= 2**31:
        raise WlmError(f"{name}: {x} x {y} x {z} cells: expected fewer than 2^31 cells in all: use a lower refinement")
    remedy = "a lower refinement, bricks, storage='float16' or the scheme 'semi-lagrangian'"
    slabs.require(name, shape, needed, remedy)


class BrickPool:
    """The stored bricks of a domain.

    Attributes:
        box: The domain.
        bricks: The lists of bricks on the device, as kernels take them.
        fields: The smoke and the other buffers of a step, whose order the caller changes; the first is kept when the
            pool grows.
        most: Number of bricks of the domain.
    """

    def __init__(
        self, box: Box, rings: int, threshold: float, make: Callable[[int], Fields], buffers: int, slabs: Slabs
    ):
        """`make` allocates a buffer of a number of cells, all 0, and `buffers` is their number."""
        self._slabs, device = slabs, slabs.home
        self.box, self.bricks = box, advection_places.make_bricks(box, rings, threshold, str(device))
        self.fields = [make(CELLS) for _ in range(buffers)]
        self._make, self._device = make, device
        self.most, self._size = self.bricks.busy.size, 1
        self._needed = wp.zeros(2, dtype=int, device="cpu", pinned=device.is_cuda)
        self._read: wp.Event | None = None
        if device.is_cuda and (self.most + 1) * self._brick_bytes * buffers <= device.free_memory // 16:
            self.reserve(self.most)

    @property
    def is_full(self) -> bool:
        """Whether the pool has room for all bricks of the domain, so that it never grows."""
        return self._size > self.most

    def relist(self) -> None:
        """Lists the bricks of the next step; `store` must follow."""
        advection_places.relist(self.box, self.bricks)
        if not self.is_full:
            wp.copy(self._needed, self.bricks.counts)
            self._read = self._device.stream.record_event() if self._device.is_cuda else None

    def store(self, clear: bool = True) -> None:
        """Stores the listed bricks, in a larger pool if there are too many; waits until `relist` is done. With `clear`
        no brick is busy then. Raises a WlmError if there is not enough memory."""
        if not self.is_full:
            if self._read is not None:
                wp.synchronize_event(self._read)
            self.reserve(int(self._needed.numpy()[0]))
        advection_sources.store(self.bricks, self.fields[0], clear)

    def reserve(self, count: int) -> None:
        """Makes room for a number of bricks. Raises a WlmError if there is not enough memory."""
        if count < self._size:
            return
        size = min(count + max(count // 4, _MARGIN), self.most) + 1
        now, old = self.fields[0], self._size
        # The other buffers are empty between two steps, and the kept one is copied.
        buffers = len(self.fields)
        more = (size * buffers - old * (buffers - 1)) * self._brick_bytes
        require_memory("bricks of smoke", (size, CELLS, 1), more, self._slabs)
        self.fields[1:] = []
        grown = self._make(size * CELLS)
        for to, part in zip(grown.parts, now.parts, strict=True):
            wp.copy(to, part, count=part.size)
        del now, part
        self.fields[:] = [grown]
        self.fields += [self._make(size * CELLS) for _ in range(buffers - 1)]
        bricks = self.bricks
        kept = bricks.free.numpy()[: int(bricks.depth.numpy()[0])]
        places = np.concatenate([kept, np.arange(old, size)])
        bricks.depth.fill_(len(places))
        bricks.free = wp.array(np.resize(places, size), dtype=int, device=self._device)
        self._size = size

    @property
    def _brick_bytes(self) -> int:
        parts = self.fields[0].parts
        return CELLS * len(parts) * wp.types.type_size_in_bytes(parts[0].dtype)

    def numbers(self) -> torch.Tensor:
        """Returns the indices of the stored bricks, int32 [N], increasing; waits for the device."""
        return torch.nonzero(wp.to_torch(self.bricks.places))[:, 0].int()

    def values(self, field: wp.array, numbers: torch.Tensor) -> torch.Tensor:
        """Returns a field in the stored bricks with the indices `numbers`, [N, 8, 8, 8]."""
        return _cubes(field)[wp.to_torch(self.bricks.places)[numbers.long()].long()]

    def put(self, numbers: torch.Tensor, values: Sequence[torch.Tensor]) -> None:
        """Stores the density, temperature and fuel that there are, each [N, 8, 8, 8], in the bricks with the indices
        `numbers`, int32 [N], and marks these as busy; the pool must be new."""
        wp.to_torch(self.bricks.busy)[numbers.long()] = 1
        self.relist()
        self.store(clear=False)
        places = wp.to_torch(self.bricks.places)[numbers.long()].long()
        for field, part in zip(self.fields[0].parts, values, strict=True):
            _cubes(field)[places] = part


def _cubes(field: wp.array) -> torch.Tensor:
    edge = advection_places.BRICK
    return wp.to_torch(field).view(-1, edge, edge, edge)
