"""Which bricks of a lattice are worked on: those with flow, those beside them, and those where a link moves fluid.

Populations are deviations from rest, so that fluid at rest at density 1 is all zero, and a brick that isn't listed is
just that: its neighbours read zeros from it. Nothing moves by more than a cell in a step: where the list is made anew
every ``EVERY`` steps, from all bricks that were busy since, with the ring of bricks around them, what leaves a busy
brick never gets further than into a listed one. What is lost is what stays below the level that counts as busy.
"""

import functools
from dataclasses import dataclass

import warp as wp

from wlm_kernels.fluid.lattice_sets import BRICK_CELLS, STORAGES, cell_in_brick, index_of, memory_functions

__all__ = ["EVERY", "Bricks", "make", "relist"]

wp.set_module_options({"enable_backward": False})

EVERY = 8
"""Steps between two lists; the shortest edge of a brick."""


@dataclass(frozen=True)
class Bricks:
    """The bricks of a domain, on a device.

    Attributes:
        shape: Cells of a brick along x, y and z.
        grid: Bricks along x, y and z.
        busy: int [B], 1 where a brick wasn't at rest since the last list.
        pinned: int [B], 1 where it is always listed.
        active: int [B], 1 where it is listed.
        listed: int [B], the numbers of those that are, in any order; ``count`` int [1] of them.
        retired: int [B], those that just ceased to be; ``left`` int [1] of them.
    """

    shape: wp.vec3i
    grid: wp.vec3i
    busy: wp.array
    pinned: wp.array
    active: wp.array
    listed: wp.array
    count: wp.array
    retired: wp.array
    left: wp.array


def make(shape: tuple[int, int, int], brick: tuple[int, int, int], device: str) -> Bricks:
    """Bricks over a domain, all of them busy, none of them listed yet."""
    grid = tuple(-(-size // edge) for size, edge in zip(shape, brick, strict=True))
    total = grid[0] * grid[1] * grid[2]
    pinned, active, listed, retired = (wp.zeros(total, dtype=int, device=device) for _ in range(4))
    count, left = (wp.zeros(1, dtype=int, device=device) for _ in range(2))
    busy = wp.ones(total, dtype=int, device=device)
    return Bricks(wp.vec3i(*brick), wp.vec3i(*grid), busy, pinned, active, listed, count, retired, left)


@wp.kernel
def _list(
    # in:
    grid: wp.vec3i,
    busy: wp.array1d[int],
    pinned: wp.array1d[int],
    # in, out:
    active: wp.array1d[int],
    # out:
    listed: wp.array1d[int],
    count: wp.array1d[int],
    retired: wp.array1d[int],
    left: wp.array1d[int],
):
    b = wp.tid()
    x = b // (grid[1] * grid[2])
    y = b // grid[2] % grid[1]
    z = b % grid[2]
    needed = pinned[b]
    for k in range(27):
        # As if periodic: at worst a brick too many.
        nx = (x + k // 9 - 1 + grid[0]) % grid[0]
        ny = (y + k // 3 % 3 - 1 + grid[1]) % grid[1]
        nz = (z + k % 3 - 1 + grid[2]) % grid[2]
        needed = wp.max(needed, busy[(nx * grid[1] + ny) * grid[2] + nz])
    if needed != 0:
        listed[wp.atomic_add(count, 0, 1)] = b
    elif active[b] != 0:
        retired[wp.atomic_add(left, 0, 1)] = b
    active[b] = needed


@functools.cache
def rest_kernel(lattice_name: str, storage: str) -> wp.Kernel:
    """Builds (once) the kernel that puts retired bricks to rest, over all cells of all bricks."""
    stored = STORAGES[storage][0]
    store = memory_functions(lattice_name, storage, (False, False, False)).store

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def rest(
        # in:
        n: wp.vec3i,
        brick: wp.vec3i,
        retired: wp.array1d[int],
        left: wp.array1d[int],
        workers: int,
        # out:
        f: wp.array2d[stored],
        spare: wp.array2d[stored],
    ):
        i = wp.tid()
        for k in range(i // BRICK_CELLS, left[0], workers):
            p = cell_in_brick(n, brick, retired[k], i % BRICK_CELLS)
            if p[0] < n[0] and p[1] < n[1] and p[2] < n[2]:
                # Among these are places of links of other cells; but the ring about them, to which the far side of
                # the domain counts too, was at rest as well.
                for q in range(f.shape[0]):
                    store(f, q, index_of(n, p), 0.0)
                    store(spare, q, index_of(n, p), 0.0)

    return rest


def relist(bricks: Bricks, lattice_name: str, storage: str, n, f, spare, workers: int) -> None:
    """Lists the bricks to work on for the next ``EVERY`` steps, and puts to rest those that no longer are.

    Args:
        bricks: Changed.
        lattice_name, storage: Of the populations.
        n: Cells along x, y and z.
        f, spare: [Q, N], both buffers.
        workers: Groups of ``BRICK_CELLS`` threads that share the list.
    """
    device = f.device
    bricks.count.zero_()
    bricks.left.zero_()
    outputs = [bricks.active, bricks.listed, bricks.count, bricks.retired, bricks.left]
    wp.launch(_list, bricks.busy.shape, [bricks.grid, bricks.busy, bricks.pinned], outputs, device=device)
    bricks.busy.zero_()
    inputs = [n, bricks.shape, bricks.retired, bricks.left, workers]
    threads = workers * BRICK_CELLS
    wp.launch(rest_kernel(lattice_name, storage), threads, inputs=inputs, outputs=[f, spare], device=device)
