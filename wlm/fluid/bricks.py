"""The memory of smoke that is stored in bricks: a pool on the device that follows the smoke, and grows when it is full.

The pool never becomes smaller. It grows by a quarter more than is needed, for which the host must know how many bricks
a step needs: it reads this number while the air moves, so that neither waits for the other.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch
import warp as wp

from wlm.errors import WlmError
from wlm.interop import free_memory
from wlm_kernels.fluid import advection_places, advection_sources
from wlm_kernels.fluid.advection import Fields
from wlm_kernels.fluid.advection_places import CELLS, Box

INDEX_BYTES = 16
"""Memory of a brick that is not stored."""

_MARGIN = 64  # bricks by which the pool grows at least


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
        self, box: Box, rings: int, threshold: float, make: Callable[[int], Fields], buffers: int, device: wp.Device
    ):
        """`make` allocates a buffer of a number of cells, all 0, and `buffers` is their number."""
        self.box, self.bricks = box, advection_places.make_bricks(box, rings, threshold, str(device))
        self.fields = [make(CELLS) for _ in range(buffers)]
        self._make, self._device = make, device
        self.most, self._size = self.bricks.busy.size, 1
        self._needed = wp.zeros(2, dtype=int, device="cpu", pinned=device.is_cuda)
        self._read: wp.Event | None = None

    @property
    def is_full(self) -> bool:
        """Whether the pool has room for all bricks of the domain, so that it never grows."""
        return self._size > self.most

    @property
    def count(self) -> int:
        """Number of listed bricks; waits for the device."""
        return int(self.bricks.counts.numpy()[0])

    @property
    def nbytes(self) -> int:
        """Memory of the pool and of the lists on the device."""
        pool = sum(part.capacity for each in self.fields for part in (each.density, each.temperature))
        return pool + INDEX_BYTES * self.most + self.bricks.free.capacity

    def relist(self) -> None:
        """Lists the bricks of the next step; `store` must follow."""
        advection_places.relist(self.box, self.bricks)
        if not self.is_full:
            wp.copy(self._needed, self.bricks.counts)
            self._read = self._device.stream.record_event() if self._device.is_cuda else None

    def store(self, clear: bool = True) -> None:
        """Stores the listed bricks, in a larger pool if there are too many; waits until `relist` is done. With `clear`
        no brick is busy then.

        Raises:
            WlmError: There is not enough memory.
        """
        if not self.is_full:
            if self._read is not None:
                wp.synchronize_event(self._read)
            self.reserve(int(self._needed.numpy()[0]))
        advection_sources.store(self.bricks, self.fields[0], clear)

    def reserve(self, count: int) -> None:
        """Makes room for a number of bricks.

        Raises:
            WlmError: There is not enough memory.
        """
        if count < self._size:
            return
        size = min(count + max(count // 4, _MARGIN), self.most) + 1
        now, old = self.fields[0], self._size
        brick = sum(
            wp.types.type_size_in_bytes(part.dtype) * CELLS for part in (now.density, now.temperature) if part.size
        )
        # The other buffers are empty between two steps, and the kept one is copied.
        buffers, free = len(self.fields), free_memory(self._device) + old * brick * (len(self.fields) - 1)
        if (need := size * brick * buffers) > free or size * CELLS >= 2**31:
            raise WlmError(
                f"smoke: {count} bricks of 8^3 cells need {need / 2**30:.1f} GiB on {self._device}: expected at most "
                f"2^31 cells, and the {free / 2**30:.1f} GiB that are free: use a lower refinement or storage='float16'"
            )
        self.fields[1:] = []
        grown = self._make(size * CELLS)
        for name in ("density", "temperature"):
            part = getattr(now, name)
            wp.copy(getattr(grown, name), part, count=part.size)
        del now
        self.fields[:] = [grown]
        self.fields += [self._make(size * CELLS) for _ in range(buffers - 1)]
        bricks = self.bricks
        kept = bricks.free.numpy()[: int(bricks.depth.numpy()[0])]
        places = np.concatenate([kept, np.arange(old, size)])
        bricks.depth.fill_(len(places))
        bricks.free = wp.array(np.resize(places, size), dtype=int, device=self._device)
        self._size = size

    def numbers(self) -> torch.Tensor:
        """Returns the indices of the stored bricks, int32 [N], increasing; waits for the device."""
        return torch.nonzero(wp.to_torch(self.bricks.places))[:, 0].int()

    def values(self, field: wp.array, numbers: torch.Tensor) -> torch.Tensor:
        """Returns a field in the stored bricks with the indices `numbers`, [N, 8, 8, 8]."""
        return _cubes(field)[wp.to_torch(self.bricks.places)[numbers.long()].long()]

    def put(self, numbers: torch.Tensor, values: Sequence[torch.Tensor]) -> None:
        """Stores bricks in the first buffer, and marks them as busy; the pool must be new.

        Args:
            numbers: Indices of bricks, int32 [N] on the device.
            values: The density and, of smoke that has one, the temperature, each [N, 8, 8, 8].
        """
        wp.to_torch(self.bricks.busy)[numbers.long()] = 1
        self.relist()
        self.store(clear=False)
        places = wp.to_torch(self.bricks.places)[numbers.long()].long()
        now = self.fields[0]
        for field, part in zip((now.density, now.temperature), values, strict=False):
            _cubes(field)[places] = part


def _cubes(field: wp.array) -> torch.Tensor:
    edge = advection_places.BRICK
    return wp.to_torch(field).view(-1, edge, edge, edge)
