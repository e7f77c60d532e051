"""Mixes the numbers of a decoder that depend on the time, for a time between two stored hours."""

from typing import Any

import warp as wp


@wp.kernel(enable_backward=False)
def _mix_hours(
    # in:
    hours: wp.array2d[float],
    before: int,
    after: int,
    share: float,
    # out:
    mixed: wp.array1d[Any],
):
    i = wp.tid()
    mixed[i] = mixed.dtype((1.0 - share) * hours[before, i] + share * hours[after, i])


def mix_hours(hours: wp.array, before: int, after: int, share: float, mixed: wp.array) -> None:
    """Interpolates linearly between two rows.

    Args:
        hours: float [T, P], a row for each stored hour.
        before, after: Indices of two rows.
        share: Weight of the row `after`, 0 to 1; the other row has the rest.
        mixed: float or float16 [P], written.
    """
    wp.launch(_mix_hours, mixed.shape, inputs=[hours, before, after, share], outputs=[mixed], device=mixed.device)
