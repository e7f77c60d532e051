"""Rounds the weights of networks to 8-bit levels with one kernel launch; torch would need about forty.

Read `tests/reference/levels.py` first; it computes bitwise identical results in torch.
"""

import warp as wp

LEVELS = 127

_MOST = wp.constant(float(LEVELS))


@wp.func
def _half(value: float) -> float:
    return float(wp.float16(value))


@wp.func
def _column_on_levels(
    values: wp.array3d[float], n: int, first: int, rows: int, j: int, part: int, parts: int, out: wp.array3d[float]
):
    """Rounds part `part` of the `rows` weights of unit j (column j, from row `first`), and copies its bias, which
    follows them."""
    end = first + rows
    most = float(0.0)
    for row in range(first, end):
        most = wp.max(most, wp.abs(values[n, row, j]))
    level = _half(most) / _MOST
    divisor = wp.where(level > 0.0, level, 1.0)
    for row in range(first + part, end, parts):
        whole = wp.clamp(wp.rint(values[n, row, j] / divisor), -_MOST, _MOST)
        out[n, row, j] = _half(whole * level)
    if part == 0:
        out[n, end, j] = values[n, end, j]


@wp.kernel(enable_backward=False)
def _put_on_levels(
    # in:
    hidden: wp.array3d[float],
    output: wp.array3d[float],
    parts: int,
    # out:
    hidden_out: wp.array3d[float],
    output_out: wp.array3d[float],
):
    n, part, unit = wp.tid()
    width = hidden.shape[2]
    inputs = hidden.shape[1] - width - 2
    if unit < width:
        _column_on_levels(hidden, n, 0, inputs, unit, part, parts, hidden_out)
    elif unit < 2 * width:
        _column_on_levels(hidden, n, inputs + 1, width, unit - width, part, parts, hidden_out)
    else:
        _column_on_levels(output, n, 0, width, unit - 2 * width, part, parts, output_out)


def put_on_levels(hidden: wp.array, output: wp.array, hidden_out: wp.array, output_out: wp.array) -> None:
    """Rounds the weights of N networks to 8-bit levels, -127 to 127 times a scale for each unit; copies the biases.

    Args:
        hidden: float [N, I + H + 2, H], hidden layers with I inputs and H units, see `wlm_kernels.mlp`.
        output: float [N, H + 1, 3], output layers.
        hidden_out, output_out: Arrays of the same shapes, written.
    """
    # On a GPU many threads divide the weights of a unit, and each of them looks for the largest one.
    parts = 8 if hidden.device.is_cuda else 1
    shape = (hidden.shape[0], parts, 2 * hidden.shape[2] + 3)
    wp.launch(
        _put_on_levels,
        shape,
        inputs=[hidden, output, parts],
        outputs=[hidden_out, output_out],
        device=hidden.device,
        block_dim=64,
    )
