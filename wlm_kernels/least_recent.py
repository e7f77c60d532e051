"""Choice of the rows of a pool that a frame gives to new contents: those that were not used for the longest time."""

import warp as wp


@wp.func
def least_recent(stamps: wp.array1d[int], size: int, frame: int, k: int, count: int, limit: int) -> int:
    """Returns the row with the lowest stamp below `limit`, the first of several, or -1.

    Rows are in groups of `size`. Item k of the `count` items of a frame takes from one group, another in each frame.
    There must be at least as many groups as items, so that no two items of a frame take from one group.
    """
    rows = stamps.shape[0]
    groups = (rows + size - 1) // size
    first = (frame % groups * count + k) % groups * size
    found = int(-1)
    oldest = int(limit)
    for i in range(first, wp.min(first + size, rows)):
        stamp = stamps[i]
        if stamp < oldest:
            oldest = stamp
            found = i
    return found
