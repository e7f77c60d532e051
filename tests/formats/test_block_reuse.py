"""Repeated blocks, by hand."""

import numpy as np

from wlm.formats.block_reuse import by_block, reuse_blocks


def strip(*values: float) -> np.ndarray:
    """Blocks of one value each, side by side: [4, 4 N, 1]."""
    return np.repeat(np.float32(values), 4)[None, :, None].repeat(4, axis=0)


def reused(decoded, target, loss: float, weight=None) -> list[int]:
    """The numbers of the blocks that stand for each."""
    weight = np.ones_like(target) if weight is None else weight
    images = (by_block(image) for image in (decoded, target, weight, weight * np.float32(loss) ** 2))
    numbers = np.arange(target.size // 16, dtype=np.uint8)[:, None].repeat(16, 1)
    return reuse_blocks(numbers, *images)[:, 0].tolist()


def test_a_block_takes_the_nearest_before_it_within_the_loss():
    target = strip(0.0, 1.0, 0.06, 0.98, 0.5, 0.52)
    for loss, expected in ((0.0, [0, 1, 2, 3, 4, 5]), (0.03, [0, 1, 2, 1, 4, 4]), (0.07, [0, 1, 0, 1, 4, 4])):
        assert reused(target, target, loss) == expected


def test_a_repeated_block_is_what_later_ones_see():
    # The second becomes the first, so that the third may not take what the second was.
    target = strip(0.0, 0.05, 0.1)
    assert reused(target, target, 0.06) == [0, 0, 2]


def test_the_blocks_own_error_is_free():
    decoded, target = strip(0.0, 0.2), strip(0.0, 0.1)
    assert reused(decoded, target, 0.0) == [0, 0]


def test_texels_without_weight_do_not_count():
    target = strip(0.3, 0.3)
    target[:, 6:] = 9.0
    weight = np.ones_like(target)
    weight[:, 6:] = 0.0
    assert reused(target, target, 0.01) == [0, 1]
    assert reused(target, target, 0.01, weight) == [0, 0]
    # What is left has no more room than its own share.
    target[:, 5] = 0.4
    assert reused(target, target, 0.04, weight) == [0, 1]


def test_of_equal_ones_the_nearest_is_taken():
    target = strip(0.5, 0.5, 0.9, 0.7)
    weight = np.ones_like(target)
    weight[:, 12:] = 0.0  # nobody sees the last
    assert reused(target, target, 0.0, weight) == [0, 0, 2, 2]


def test_blocks_go_row_by_row_and_one_is_kept():
    target = np.concatenate([strip(0.0, 1.0), strip(0.5, 1.0)])
    assert reused(target, target, 0.01) == [0, 1, 2, 1]
    assert reused(strip(0.5), strip(0.5), 1.0) == [0]
