"""Light that vanishes where PSNR, whose peak it is, stays high."""

import numpy as np

from wlm.metrics import LostLight, psnr_from_mse


def lines(reference, decoded, where="") -> list[str]:
    lost = LostLight()
    lost.add(np.asarray(reference, np.float32), np.asarray(decoded, np.float32), where)
    return lost.warnings("set", "texel", "its tile")


def wall(count: int = 16384) -> np.ndarray:
    return np.random.default_rng(0).uniform(0.5, 1.0, (count, 3))


def test_a_firefly_that_vanishes_behind_a_good_mean():
    reference = wall()
    reference[77] = 0.7, 6961.0, 0.7
    decoded = np.minimum(reference, 0.7)
    assert psnr_from_mse(np.square(reference - decoded).mean(), 6961.0) > 46.0
    assert lines(reference, decoded, "tile 3 at 5") == [
        "set: 1 texel among the brightest of its tile lost more than half of the light; the largest of 6961 decodes to "
        "0.7 (tile 3 at 5)"
    ]


def test_the_others_that_vanish_beside_a_firefly():
    reference = wall()
    reference[77] = 1e4
    decoded = np.where(reference > 1.0, reference, 3.0)
    assert psnr_from_mse(np.square(reference - decoded).mean(), 1e4) > 60.0
    (line,) = lines(reference, decoded)
    assert "16383 texels, most of its tile, are off by more than half" in line


def test_nothing_is_said_of_light_that_is_kept():
    reference = wall()
    noisy = reference * np.random.default_rng(1).uniform(0.6, 1.4, reference.shape)
    reference[77] = noisy[77] = 1e4
    for decoded in (reference, noisy):
        assert lines(reference, decoded) == []
    # Of the dark texels beside it a third may be off.
    third = np.arange(len(reference)) % 3 == 0
    third[77] = False
    assert lines(reference, np.where(third[:, None], 0.0, reference)) == []
    assert lines(np.zeros((9, 3)), np.ones((9, 3))) == lines(np.zeros((0, 3)), np.zeros((0, 3))) == []


def test_losses_of_several_groups_are_added():
    lost, other = LostLight(), LostLight()
    for own, light in ((lost, 3.0), (other, 8.0), (other, 5.0)):
        own.add(np.array([[light], [light]]), np.array([[0.0], [light]]), f"at {light:g}")
    lost.merge(other)
    assert (lost.count, lost.worst, lost.hidden) == (3, (8.0, 0.0, "at 8"), 0)


def test_negative_numbers_count_by_their_size():
    assert len(lines([[-4.0, 1.0]], [[-1.0, 1.0]])) == 1
