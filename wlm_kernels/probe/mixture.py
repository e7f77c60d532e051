"""Light at points as weighted sums of stored rows: a thread for each number of a point.

The twin to read first: `wlm.probe.kriging`, whose weights these are. All sums are
`(weight[:, :, None] * rows[index]).sum(1)`.
"""

import warp as wp


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


def mix(rows: wp.array, index: wp.array, weight: wp.array, out: wp.array) -> None:
    """Sums rows.

    Args:
        rows: float [N, D].
        index: int [M, K], below N.
        weight: float [M, K].
        out: float [M, D], written.
    """
    wp.launch(_mix, out.shape, inputs=[rows, index, weight], outputs=[out], device=out.device)
