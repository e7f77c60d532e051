"""A box of cells that is divided into slabs along x, one for each of several devices of a host.

All devices see the same arrays, at the same addresses; the memory of a slab's cells is on the slab's own device. Only
what a cell reads across the border of two slabs travels between devices, while the cells inside are computed. Each cell
is computed as on one device, so that results are the same, except for the rounding of sums over all cells.
"""

import ctypes
import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import warp as wp

from wlm.errors import WlmError
from wlm.interop import free_memory
from wlm_kernels.fluid.lattice_sets import Slab, launch_slab

# Bytes below which an array is on the first device alone: memory is divided in pages of 2 MiB.
_WHOLE = 1 << 22
# Advice for the driver's cuMemAdvise: where pages are, and which devices map them there.
_PREFERRED, _ACCESSED_BY = 3, 5


class Slabs:
    """The slabs of a box, of equal thickness up to a cell.

    Args:
        shape: Cells along x, y and z.
        devices: Names of devices, or one string with commas between them, such as "cuda:0,cuda:1".

    Attributes:
        home: The first device; what is not divided is there.
        name: The names of the devices.

    Raises:
        ValueError: There are more devices than cells along x, or GPUs and CPUs are mixed.
        WlmError: The GPUs cannot read each other's memory.
    """

    def __init__(self, shape: tuple[int, int, int], devices: str | Sequence[str]) -> None:
        names = devices.split(",") if isinstance(devices, str) else devices
        found, planes = [wp.get_device(name) for name in names], shape[0]
        if not 1 <= len(found) <= planes:
            raise ValueError(f"device: expected 1 to {planes}, the number of cells along x, got {len(found)} devices")
        if len({device.is_cuda for device in found}) > 1:
            raise ValueError(f"device: expected only GPUs or only CPUs, got {', '.join(names)}")
        self.name = ",".join(map(str, found))
        self.home, *self._others = self._devices = list({str(device): device for device in found}.values())
        for owner, reader in itertools.permutations(self._devices, 2):
            try:
                wp.set_peer_access_enabled(owner, reader, True)
                wp.set_mempool_access_enabled(owner, reader, True)
            except RuntimeError as error:
                raise WlmError(f"device: expected GPUs that read each other's memory: {error}") from error
        ends = [planes * (k + 1) // len(found) for k in range(len(found))]
        self._n, self._slabs = wp.vec3i(*shape), list(map(Slab, found, [0, *ends[:-1]], ends, range(len(ends))))

    def __iter__(self) -> Iterator[Slab]:
        return iter(self._slabs)

    def __len__(self) -> int:
        return len(self._slabs)

    @property
    def free(self) -> int:
        """Number of bytes that divided arrays can take in all."""
        planes = [sum(slab.end - slab.begin for slab in self if slab.device == device) for device in self._devices]
        return min(free_memory(device) * self._n[0] // n for device, n in zip(self._devices, planes, strict=True))

    def zeros(self, shape: int | tuple[int, ...], dtype: Any) -> wp.array:
        """Makes an array of zeros whose last or only axis, or whose first three axes, are cells: if it has two axes,
        the first is of rows that are divided one by one."""
        make = functools.partial(wp.zeros, shape, dtype=dtype, device=self.home)
        shape = (shape,) if isinstance(shape, int) else shape
        if len(self) == 1 or not self.home.is_cuda or math.prod(shape) * wp.types.type_size_in_bytes(dtype) < _WHOLE:
            return make()
        with wp.ScopedAllocator(self.home, _Divided(self, shape[0] if len(shape) == 2 else 1)):
            return make()

    def each(self, compute: Callable[[Slab], None]) -> None:
        """Calls a function for each slab, which queues work on its device; this work begins after all earlier work, and
        later work of the first device begins after it."""
        for device in self._others:
            device.stream.wait_stream(self.home.stream)
        for slab in self:
            compute(slab)
        for device in self._others:
            self.home.stream.wait_stream(device.stream)

    def launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        """Launches a kernel with one thread per cell, as `launch_slab`."""
        self.each(lambda slab: launch_slab(kernel, self._n, slab, inputs, outputs))


class _Divided(wp.CudaManagedAllocator):
    """Allocates memory of which each of a number of equal rows is divided among the devices of slabs."""

    def __init__(self, slabs: Slabs, rows: int) -> None:
        self._slabs, self._rows = slabs, rows

    def allocate(self, size_in_bytes: int) -> int:
        start = super().allocate(size_in_bytes)
        driver, slabs, row = ctypes.CDLL("libcuda.so.1"), list(self._slabs), size_in_bytes // self._rows
        for k, slab in itertools.product(range(self._rows), slabs):
            begin, end = (k * row + row * plane // slabs[-1].end for plane in (slab.begin, slab.end))
            part = ctypes.c_uint64(start + begin), ctypes.c_size_t(end - begin)
            driver.cuMemAdvise(*part, _PREFERRED, slab.device.ordinal)
            for other in slabs:
                driver.cuMemAdvise(*part, _ACCESSED_BY, other.device.ordinal)
            driver.cuMemPrefetchAsync(*part, slab.device.ordinal, None)
        return start
