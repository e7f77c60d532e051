"""A box of cells that is divided into slabs along x, one for each of several devices of a host.

All devices see the same arrays, at the same addresses; the memory of a slab's cells is on the slab's own device. Only
what a cell reads across the border of two slabs travels between devices, while the cells inside are computed. Each cell
is computed as on one device, so that results are the same, except for the rounding of sums over all cells.
"""

import ctypes
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import warp as wp

from wlm.errors import WlmError
from wlm.interop import free_memory
from wlm_kernels.fluid.lattice_sets import Slab, launch_slab

# Bytes below which an array is on the first device alone. What all cells read, such as marks of solids, must be divided
# even if it is small: the memory of another device is not cached.
_WHOLE = 1 << 16
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
        parts: The slabs.

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
        self.home, *self._others = devices = list({str(device): device for device in found}.values())
        for owner, reader in itertools.permutations(devices, 2):
            try:
                wp.set_peer_access_enabled(owner, reader, True)
                wp.set_mempool_access_enabled(owner, reader, True)
            except RuntimeError as error:
                raise WlmError(f"device: expected GPUs that read each other's memory: {error}") from error
        ends = [planes * (k + 1) // len(found) for k in range(len(found))]
        self._n, self.parts = wp.vec3i(*shape), list(map(Slab, found, [0, *ends[:-1]], ends, range(len(ends))))

    @property
    def free(self) -> int:
        """Number of bytes that divided arrays can take in all."""
        planes = dict.fromkeys(self.name.split(","), 0)
        for slab in self.parts:
            planes[str(slab.device)] += slab.end - slab.begin
        return min(free_memory(wp.get_device(name)) * self._n[0] // count for name, count in planes.items())

    def require(self, name: str, shape: tuple[int, int, int], needed: int, remedy: str) -> None:
        """Checks that `needed` bytes for a grid are free; `name` and `remedy` are words for the error message."""
        if needed > (free := self.free):
            cells = " x ".join(map(str, shape))
            raise WlmError(
                f"{name}: {cells} cells need {needed / 2**30:.1f} GiB on {self.name}: expected at most the"
                f" {free / 2**30:.1f} GiB that are free: use {remedy}"
            )

    def zeros(self, shape: int | tuple[int, ...], dtype: Any) -> wp.array:
        """Makes an array of zeros whose last or only axis, or whose first three axes, are cells: if it has two axes,
        the first is of rows that are divided one by one."""
        make = functools.partial(wp.zeros, shape, dtype=dtype, device=self.home)
        sizes = (shape,) if isinstance(shape, int) else shape
        small = math.prod(sizes) * wp.types.type_size_in_bytes(dtype) < _WHOLE
        if small or len(self.parts) == 1 or not self.home.is_cuda:
            return make()
        with wp.ScopedAllocator(self.home, _Divided(self.parts, sizes[0] if len(sizes) == 2 else 1)):
            return make()

    def each(self, compute: Callable[[Slab], None]) -> None:
        """Calls a function for each slab, which queues work on its device; this work begins after all earlier work, and
        later work of the first device begins after it, also in a CUDA graph that is captured on the first device."""
        for device in self._others:
            device.stream.wait_stream(self.home.stream)
        for slab in self.parts:
            compute(slab)
        for device in self._others:
            self.home.stream.wait_stream(device.stream)

    def launch(self, kernel: wp.Kernel, inputs: list, outputs: list, block_dim: int = 256, group: int = 1) -> None:
        """Launches a kernel for all cells, as `launch_slab`."""
        self.each(lambda slab: launch_slab(kernel, self._n, slab, inputs, outputs, block_dim, group))


class _Divided(wp.CudaManagedAllocator):
    """Allocates memory of which each of a number of equal rows is divided among the devices of slabs."""

    def __init__(self, slabs: Sequence[Slab], rows: int) -> None:
        self._slabs, self._rows = slabs, rows

    def allocate(self, size_in_bytes: int) -> int:
        start = super().allocate(size_in_bytes)
        driver, row, planes = ctypes.CDLL("libcuda.so.1"), size_in_bytes // self._rows, self._slabs[-1].end
        for k, slab in itertools.product(range(self._rows), self._slabs):
            begin, end = (k * row + row * plane // planes for plane in (slab.begin, slab.end))
            part = ctypes.c_uint64(start + begin), ctypes.c_size_t(end - begin)
            driver.cuMemAdvise(*part, _PREFERRED, slab.device.ordinal)
            for other in self._slabs:
                driver.cuMemAdvise(*part, _ACCESSED_BY, other.device.ordinal)
            driver.cuMemPrefetchAsync(*part, slab.device.ordinal, None)
        return start
