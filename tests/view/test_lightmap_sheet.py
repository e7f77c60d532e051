"""The contact sheet: which times it shows, what its pictures hold, and what it refuses."""

import numpy as np
import pytest
from PIL import Image

from wlm.errors import WlmError
from wlm.view.pictures import before_after_error

HEIGHT, WIDTH = 12, 16


@pytest.fixture(scope="module")
def reference() -> np.ndarray:
    return np.random.default_rng(0).uniform(0.1, 1.0, (9, HEIGHT, WIDTH, 3)).astype(np.float32)


MASK = np.ones((HEIGHT, WIDTH), bool)


def _pixels(path) -> np.ndarray:
    with Image.open(path) as image:
        assert image.format == "PNG"
        return np.asarray(image.convert("RGB")).astype(int)


def _share(pixels: np.ndarray, colour: tuple[int, int, int], within: int = 2) -> float:
    return float((np.abs(pixels - np.array(colour)) <= within).all(axis=2).mean())


def test_even_times_and_the_worst(tmp_path, reference):
    decoded = reference + np.float32(1e-3)
    decoded[3] += 0.1
    shown = before_after_error(tmp_path / "a.png", reference, decoded, MASK, np.arange(9.0), columns=3)
    assert shown == (0, 3, 8)
    decoded[3] = reference[3]
    decoded[8] += 0.1
    assert before_after_error(tmp_path / "a.png", reference, decoded, MASK, np.arange(9.0), columns=3) == (
        0,
        4,
        8,
    )


def test_all_times_where_they_fit(tmp_path, reference):
    shown = before_after_error(tmp_path / "a.png", reference[:4], reference[:4], MASK, [0, 6, 12, 18])
    assert shown == (0, 1, 2, 3)
    assert 1000 < _pixels(tmp_path / "a.png").shape[1] <= 2000


def test_gaps_are_grey_and_exact_copies_have_a_black_error(tmp_path, reference):
    mask = MASK.copy()
    mask[:, : WIDTH // 2] = False
    spoilt = reference[:1].copy()
    spoilt[:, ~mask] = np.nan  # gaps may hold anything
    before_after_error(tmp_path / "a.png", spoilt, spoilt, mask, [0.0])
    before_after_error(tmp_path / "b.png", reference[:1], reference[:1], MASK, [0.0])
    half, full = _pixels(tmp_path / "a.png"), _pixels(tmp_path / "b.png")
    assert half.shape == full.shape
    # Half of three pictures is grey, and half of the third black.
    black = (0, 0, 0)
    assert _share(full, black) > 0.1 and _share(full, (128, 128, 128)) < 0.01
    assert _share(half, black) == pytest.approx(_share(full, black) / 2, rel=0.1)
    assert _share(half, (128, 128, 128)) == pytest.approx(1.5 * _share(full, black), rel=0.1)


def test_exposure_is_that_of_the_reference(tmp_path):
    flat = np.full((1, HEIGHT, WIDTH, 3), 3.0, np.float32)
    before_after_error(tmp_path / "a.png", flat, flat / 4, MASK, [0.0])
    shown = 137  # sRGB of a quarter
    assert _share(_pixels(tmp_path / "a.png"), (shown, shown, shown)) > 0.1


def test_larger_error_is_a_brighter_picture(tmp_path, reference):
    decoded = reference[:2].copy()
    decoded[0] += 0.01
    decoded[1] += 0.1
    before_after_error(tmp_path / "a.png", reference[:2], decoded, MASK, [0.0, 1.0])
    pixels = _pixels(tmp_path / "a.png")
    rows = len(pixels)
    errors = pixels[int(rows * 0.75) : int(rows * 0.95)]
    left, right = errors[:, -500:-350], errors[:, -200:-50]
    assert right.mean() > left.mean() + 50


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (300, 1)])
def test_any_shape_and_a_black_time(tmp_path, shape):
    black = np.zeros((2, *shape, 3), np.float32)
    assert before_after_error(tmp_path / "a.png", black, black, np.ones(shape, bool), [0, 1]) == (0, 1)
    rows, columns = _pixels(tmp_path / "a.png").shape[:2]
    assert 200 < rows < 8000 and 200 < columns <= 2000


def test_refuses(tmp_path, reference):
    path, times = tmp_path / "a.png", np.arange(9.0)
    spoilt = reference.copy()
    spoilt[4, 2, 3] = np.nan
    cases = [
        ((path, reference, reference[:8], MASK, times), "one shape"),
        ((path, reference[..., :1], reference[..., :1], MASK, times), "one shape"),
        ((path, reference, reference, MASK.T, times), "mask"),
        ((path, reference, reference, MASK, times[:3]), "times"),
        ((path, reference, reference, ~MASK, times), "empty"),
        ((path, reference, reference, MASK, times, 7), "columns"),
        ((path, reference, reference, MASK, times, 0), "columns"),
        ((path, reference, spoilt, MASK, times), "NaN"),
        ((tmp_path / "no" / "a.png", reference, reference, MASK, times), "does not exist"),
    ]
    for arguments, text in cases:
        with pytest.raises(WlmError, match=text):
            before_after_error(*arguments)
    assert not list(tmp_path.iterdir())
