"""Light at points as weighted sums of stored rows: a thread for each number of a point, or for nine of them.

The twin to read first: `wlm.probe.kriging`, whose weights these are. All sums are
`(weight[:, :, None] * rows[index]).sum(1)`.
"""

import warp as wp

_GROUP = 9  # numbers of a thread: index and weight are read once for all, and L2 in RGB has three groups


@wp.kernel(enable_backward=False)
def _mix(
    # in:
    rows: wp.array2d[float],
    index: wp.array2d[int],
    weight: wp.array2d[float],
    # out:
    out: wp.array2d[float],
):
    point, number = wp.tid()
    total = float(0.0)
    for i in range(index.shape[1]):
        # At a stored row all weights but one are zero.
        if weight[point, i] != 0.0:
            total += weight[point, i] * rows[index[point, i], number]
    out[point, number] = total


@wp.kernel(enable_backward=False)
def _mix_groups(
    # in:
    rows: wp.array2d[float],
    index: wp.array2d[int],
    weight: wp.array2d[float],
    # out:
    out: wp.array2d[float],
):
    point, group = wp.tid()
    total = wp.vector(dtype=float, length=_GROUP)
    for i in range(index.shape[1]):
        share = weight[point, i]
        if share != 0.0:
            row = index[point, i]
            for j in range(_GROUP):
                total[j] += share * rows[row, _GROUP * group + j]
    for j in range(_GROUP):
        out[point, _GROUP * group + j] = total[j]


def mix(rows: wp.array, index: wp.array, weight: wp.array, out: wp.array) -> None:
    """Sums rows.

    Args:
        rows: float [N, D].
        index: int [M, K], below N.
        weight: float [M, K].
        out: float [M, D], written.
    """
    points, numbers = out.shape
    kernel, threads = (_mix, numbers) if numbers % _GROUP else (_mix_groups, numbers // _GROUP)
    wp.launch(kernel, (points, threads), inputs=[rows, index, weight], outputs=[out], device=out.device)
