"""Pictures of probes: which way is up, what the colours mean, and what is refused."""

import sys

import numpy as np
import pytest
from PIL import Image

from wlm.errors import WlmError
from wlm.probe.sphere import basis
from wlm.view import rendering, spheres
from wlm.view.spheres import render_probes

GREY = 128
X, Y, Z = np.eye(3)
WHITE = np.ones(3)
RED, GREEN, BLUE = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])


@pytest.fixture
def opengl():
    pytest.importorskip("pyvista")
    try:
        rendering.require_opengl("spheres")
    except WlmError as error:
        pytest.skip(str(error))


def from_direction(direction, colour=WHITE, coefficients=9):
    """A probe [D] lit by a far light."""
    return (basis(direction[None], coefficients)[0][:, None] * colour).ravel()


def from_everywhere(*radiances, coefficients=9):
    """Probes [N, D] of constant light."""
    values = np.zeros((len(radiances), 3 * coefficients))
    values[:, :3] = np.array(radiances)[:, None] * np.sqrt(4 * np.pi)
    return values


def panels(path, width=900):
    """The three pictures below their titles, int [H, W, 3] each."""
    with Image.open(path) as image:
        assert image.format == "PNG" and image.size[0] == width
        pixels = np.asarray(image.convert("RGB")).astype(int)
    return np.split(pixels[spheres._TITLE_PIXELS :], 3, axis=1)


def inside(picture):
    """Where a sphere is, bool [H, W]; right only where its light is not the background's grey."""
    return np.abs(picture - GREY).max(2) > 2


def title_pixels(path):
    """How much of the first title's strip is white."""
    with Image.open(path) as image:
        return (np.asarray(image.convert("L"))[: spheres._TITLE_PIXELS, :300] > 180).sum()


def centre(where):
    return np.argwhere(where).mean(0)


def halves(picture):
    """Mean brightness of the upper, lower, left and right half of what is seen."""
    where = inside(picture)
    rows, columns = np.nonzero(where.any(1))[0], np.nonzero(where.any(0))[0]
    crop = picture[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].mean(2)
    h, w = crop.shape
    return crop[: h // 2].mean(), crop[-(h // 2) :].mean(), crop[:, : w // 2].mean(), crop[:, -(w // 2) :].mean()


@pytest.mark.parametrize(("up", "axis", "right", "left"), [("y", Y, X, Z), ("z", Z, Y, -Y)])
def test_light_from_above_lights_the_upper_halves(opengl, tmp_path, up, axis, right, left):
    place = np.zeros((1, 3))

    def lit(direction):
        values = from_direction(direction)[None]
        render_probes(tmp_path / "a.png", place, values, values, up=up, width=900)
        return halves(panels(tmp_path / "a.png")[0])

    above, below, _, _ = lit(axis)
    assert above > below + 60
    above, below, _, _ = lit(-axis)
    assert below > above + 40  # the camera looks down
    assert lit(right)[3] > lit(right)[2] + 30
    assert lit(left)[2] > lit(left)[3] + 30


# To the right and downwards in the picture; what is nearer to the eye is lower in a view from above.
@pytest.mark.parametrize(
    ("up", "sides"), [("y", ((X, 1, 1), (Z, -1, 1))), ("z", ((X, 1, 1), (Y, 1, -1)))], ids=["y", "z"]
)
def test_probes_stand_where_they_are(opengl, tmp_path, up, sides):
    position = [np.zeros(3), 4 * (Y if up == "y" else Z), *(4 * axis for axis, _, _ in sides)]
    values = np.array([from_everywhere(1.0)[0] * np.tile(colour, 9) for colour in (WHITE, GREEN, RED, BLUE)])
    render_probes(tmp_path / "a.png", position, values, values, up=up, radius=0.5, width=900)
    original, decoded, _ = panels(tmp_path / "a.png")
    np.testing.assert_allclose(original, decoded, atol=2)  # an edge falls on other parts of a pixel
    origin, upper, *others = (
        centre((np.abs(original - 255 * colour) < 9).all(2)) for colour in (WHITE, GREEN, RED, BLUE)
    )
    assert upper[0] < origin[0] - 50 and abs(upper[1] - origin[1]) < 2
    for place, (_, right, down) in zip(others, sides, strict=True):
        rows, columns = place - origin
        assert columns * right > 50 and rows * down > 20


def test_the_pictures_share_one_exposure(opengl, tmp_path):
    original, decoded = from_everywhere(3.0), from_everywhere(1.5)
    render_probes(tmp_path / "a.png", [[0, 0, 0]], original, decoded, error_gain=0.5, width=900)
    middles = [picture[picture.shape[0] // 2, picture.shape[1] // 2] for picture in panels(tmp_path / "a.png")]
    # sRGB of 1, 1/2 and 1/4.
    for middle, expected in zip(middles, (255, 188, 137), strict=True):
        assert np.abs(middle - expected).max() <= 1


def test_an_exact_copy_has_a_black_error_and_a_gain_makes_it_brighter(opengl, tmp_path):
    position, original = np.array([[0.0, 0, 0], [1, 0, 0]]), from_everywhere(1.0, 2.0)
    brightness = []
    for decoded, gain in ((original, 8), (original * 0.98, 4), (original * 1.02, 16)):
        render_probes(tmp_path / "a.png", position, original, decoded, error_gain=gain, width=900)
        error = panels(tmp_path / "a.png")[2]
        brightness.append(error[inside(error)].mean())
    assert brightness[0] < 8, "but for the edge"
    assert brightness[0] + 20 < brightness[1] < brightness[2] - 20


def test_a_band_that_no_surface_sees_is_seen_as_radiance(opengl, tmp_path):
    values = from_everywhere(1.0, coefficients=16)
    values[0, 27:] = 0.5
    spread = []
    for shade in ("irradiance", "radiance"):
        render_probes(tmp_path / "a.png", [[0, 0, 0]], values, values, shade=shade, width=900)
        picture = panels(tmp_path / "a.png")[0]
        middle = picture[picture.shape[0] // 2 - 60 : picture.shape[0] // 2 + 60, 90:210]
        spread.append(np.ptp(middle))
    assert spread[0] == 0 and spread[1] > 100


def test_few_probes_are_rounder_than_many(opengl, tmp_path, monkeypatch):
    # The silhouette of one sphere against the disc's area, pi / 4 of the square about it.
    fill = []
    for levels in (spheres._SUBDIVISIONS, ((64, 1),)):
        monkeypatch.setattr(spheres, "_SUBDIVISIONS", levels)
        render_probes(tmp_path / "a.png", [[0, 0, 0]], from_everywhere(1.0), from_everywhere(1.0), width=900)
        where = inside(panels(tmp_path / "a.png")[0])
        fill.append(where.sum() / (where.any(0).sum() * where.any(1).sum()))
    assert fill[0] == pytest.approx(np.pi / 4, abs=0.01)
    assert fill[1] != fill[0]


def test_of_too_many_a_fixed_choice_is_shown(opengl, tmp_path, monkeypatch):
    rng = np.random.default_rng(1)
    position, values = rng.uniform(size=(40, 3)), rng.uniform(size=(40, 12))
    assert render_probes(tmp_path / "all.png", position, values, values, width=900) == 40
    monkeypatch.setattr(spheres, "MAX_PROBES", 10)
    for name in ("a.png", "b.png"):
        assert render_probes(tmp_path / name, position, values, values, width=900) == 10
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    covered = [inside(panels(tmp_path / name)[2]).sum() for name in ("a.png", "all.png")]
    assert covered[0] > 0 and covered[1] > 0
    # The number is in the title.
    title, plain = (title_pixels(tmp_path / name) for name in ("a.png", "all.png"))
    assert title > 2 * plain > 0


CORNER = np.array(spheres._VIEW)


@pytest.mark.parametrize(
    "position",
    [
        [[5.0, 5, 5]],
        [[1.0, 2, 3]] * 4,
        [[0.0, 0, 0], [0, 0, 0], [1, 0, 0]],
        [CORNER, 2 * CORNER, 3 * CORNER],  # behind each other
        [[0.0, 0, 0], [0, 9, 0]],
        [[1e9, 0, 0], [1e9 + 1e-3, 0, 0], [1e9, 1e-3, 0]],
        [[0.0, 0, 0], [1, 0, 0], [1e6, 0, 0]],
        [[-8e307, 0, 0], [8e307, 0, 0]],
        [[0.0, 0, 0], [1e-300, 0, 0]],
    ],
)
def test_any_place_is_seen_whole(opengl, tmp_path, position):
    values = from_everywhere(*[1.0] * len(position))
    assert render_probes(tmp_path / "a.png", position, values, values, width=900) == len(position)
    for picture in panels(tmp_path / "a.png"):
        where = inside(picture)
        assert where.any() and not (where[[0, -1]].any() or where[:, [0, -1]].any())
    assert panels(tmp_path / "a.png")[0].shape[0] >= 180


@pytest.mark.parametrize("radius", [1e-300, 0.01, 10.0, 1e300])
def test_any_radius(opengl, tmp_path, radius):
    values = from_everywhere(1.0, 1.0)
    render_probes(tmp_path / "a.png", [[0, 0, 0], [1, 0, 0]], values, values, radius=radius, width=900)
    assert inside(panels(tmp_path / "a.png")[0]).any() == (radius > 1e-6)


def test_dark_and_bright_light(opengl, tmp_path):
    position, black = [[0, 0, 0]], from_everywhere(0.0)
    for original, decoded, expected in (
        (black, black, (0, 0, 0)),
        (-from_everywhere(1.0), black, (0, 0, 255)),  # light below zero is black; its error is not
        (from_everywhere(1e18), black, (255, 0, 255)),
        (from_everywhere(1e-30), black, (255, 0, 255)),
    ):
        render_probes(tmp_path / "a.png", position, original, decoded, width=900)
        middles = [picture[picture.shape[0] // 2, picture.shape[1] // 2, 0] for picture in panels(tmp_path / "a.png")]
        np.testing.assert_allclose(middles, expected, atol=1)


def test_a_folder_that_is_not_there_is_one_line(opengl, tmp_path):
    with pytest.raises(WlmError, match="does not exist"):
        render_probes(tmp_path / "no" / "a.png", [[0, 0, 0]], from_everywhere(1.0), from_everywhere(1.0), width=300)
    assert not list(tmp_path.iterdir())


def test_refuses(tmp_path):
    position, values = np.zeros((3, 3)), np.ones((3, 27))
    position[2] = 1.0
    spoilt, lost = values.copy(), position.copy()
    spoilt[1, 4], lost[2, 0] = np.nan, np.inf
    far = np.array([[-1e308, 0, 0], [1e308, 0, 0], [0, 0, 0]])
    for arguments, options, text in (
        ((position[:, :2], values, values), {}, r"positions \[N, 3\]"),
        ((position[:0], values[:0], values[:0]), {}, "at least one probe"),
        ((position, values, values[:2]), {}, "of one shape"),
        ((position, values[:2], values[:2]), {}, "expected 3 original and decoded"),
        ((position, values[:, :26], values[:, :26]), {}, "got 26"),
        ((position, spoilt, values), {}, "original of probe 1"),
        ((position, values, spoilt), {}, "decoded of probe 1"),
        ((position, values, values * 1e39), {}, "decoded of probe 0 is NaN or infinite"),
        ((lost, values, values), {}, "position of probe 2"),
        ((far, values, values), {}, "span more"),
        ((position, values, values), {"up": "x"}, "up: expected y or z, got 'x'"),
        ((position, values, values), {"shade": "flat"}, "shade: expected irradiance or radiance"),
        ((position, values, values), {"radius": 0.0}, "radius: expected a finite number above 0"),
        ((position, values, values), {"error_gain": np.inf}, "error_gain: expected a finite number above 0"),
        ((position, values, values), {"width": 299}, "width: expected 300 to 7680"),
    ):
        with pytest.raises(WlmError, match=text):
            render_probes(tmp_path / "a.png", *arguments, **options)
    assert not list(tmp_path.iterdir())


def test_without_the_extra_it_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(WlmError, match=r"pip install 'wlm\[view\]'"):
        render_probes(tmp_path / "a.png", [[0, 0, 0]], from_everywhere(1.0), from_everywhere(1.0))


@pytest.mark.parametrize("trial", ["import os; os.abort()", "raise SystemExit(1)", "import time; time.sleep(9)"])
def test_a_machine_without_opengl_is_one_line_and_no_crash(tmp_path, monkeypatch, trial):
    pytest.importorskip("pyvista")
    monkeypatch.setattr(rendering, "_TRIAL", trial)
    monkeypatch.setattr(rendering, "_TRIAL_SECONDS", 1.0)
    rendering.require_opengl.cache_clear()
    with pytest.raises(WlmError, match="found no OpenGL that works") as error:
        render_probes(tmp_path / "a.png", [[0, 0, 0]], from_everywhere(1.0), from_everywhere(1.0))
    assert "\n" not in str(error.value) and not list(tmp_path.iterdir())
