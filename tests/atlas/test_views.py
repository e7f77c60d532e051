"""Views: cameras on the sphere, their field of view, the surface point at each pixel, and visibility in UV space."""

import dataclasses

import numpy as np
import pytest
import torch
from builders.lit_cube import DIRECTIONS, HEIGHT, WIDTH, corners, lit_cube, waves

from wlm.atlas.data import from_arrays
from wlm.atlas.views import visibility, visible_uv
from wlm.errors import WlmError
from wlm.ops.views import View, clip_positions, normalised, sphere_views


def _drawn(mesh, direction, resolution=48, device="cpu"):
    (drawn,) = visible_uv(mesh, [View.of(direction)], resolution, device)
    return [tensor.cpu().numpy() for tensor in drawn]


def test_even_views_are_spread_all_around():
    views = sphere_views(50)
    eyes = np.stack([view.axes[2] for view in views])
    np.testing.assert_allclose(np.linalg.norm(eyes, axis=1), 1.0, rtol=1e-12)
    assert np.abs(eyes.mean(axis=0)).max() < 0.02
    cosine = eyes @ eyes.T - 2.0 * np.eye(50)
    nearest = np.degrees(np.arccos(cosine.max(axis=1)))
    assert nearest.min() > 20.0 and nearest.max() < 33.0  # 50 circles that just touch would be 31 degrees apart
    assert sphere_views(0) == [] and len(sphere_views(1)) == 1
    with pytest.raises(ValueError, match="got -1"):
        sphere_views(-1)


def test_random_views_by_their_seed():
    first, again, second = (np.stack([v.axes for v in sphere_views(2000, seed)]) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert (first != second).any(axis=(1, 2)).all()
    eyes = first[:, 2]
    # Uniform: mean 0, each coordinate squared 1/3; four deviations of 2000 samples.
    assert np.abs(eyes.mean(axis=0)).max() < 4.0 * (1 / 3 / 2000) ** 0.5
    assert np.abs((eyes**2).mean(axis=0) - 1 / 3).max() < 4.0 * (4 / 45 / 2000) ** 0.5
    generator = np.random.default_rng(7)
    assert not np.array_equal(sphere_views(1, generator)[0].axes, sphere_views(1, generator)[0].axes)


@pytest.mark.parametrize(
    "direction", [[0, 1, 0], [0, -1, 0], [1e-9, 1, 1e-9], [1, 2, 3], [0, 0, -1e-200], [1e300, 0, 0]]
)
def test_axes_also_at_the_poles(direction):
    axes = View.of(direction).axes
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    unit = np.array(direction) / np.abs(direction).max()
    np.testing.assert_allclose(axes[2], unit / np.linalg.norm(unit), atol=1e-12)


@pytest.mark.parametrize("direction", [[0, 0, 0], [np.nan, 1, 0], [np.inf, 0, 0], [1, 0]])
def test_what_is_no_direction(direction):
    with pytest.raises(ValueError, match="direction"):
        View.of(direction)


def test_the_picture_just_holds_the_sphere():
    """A tangent from the camera touches the sphere of radius sqrt 3 where p . d = 1: at corners of the cube."""
    mesh = lit_cube(1)
    position = normalised(mesh.sheets[0].position, mesh.sheets[0].triangle)
    clip = clip_positions(position, View.of([1, 0, 0]))
    assert clip.shape == (24, 4) and clip.dtype == np.float32
    touching = mesh.sheets[0].position[:, 0] == 1.0
    radius = np.hypot(clip[:, 0], clip[:, 1]) / clip[:, 3]
    np.testing.assert_allclose(radius[touching], 1.0, rtol=1e-6)
    assert (radius[~touching] < 0.9).all()
    for view in sphere_views(40):
        x, y, z, w = clip_positions(position, view).T
        assert (np.hypot(x, y) <= w * (1 + 1e-6)).all() and (np.abs(z) <= w * (1 + 1e-6)).all()
    z, w = clip_positions(position, View.of([1, 1, 1]))[:, 2:].T
    assert (z / w).min() == pytest.approx(-1.0, abs=1e-6) and (z / w).max() == pytest.approx(1.0, abs=1e-6)


def test_normalised_whatever_the_place_and_size():
    position, triangle, uv = corners(1)
    for scale, shift in ((1.0, 0.0), (1e-6, 0.0), (250.0, [3.0, -7.0, 1000.0])):
        mesh = from_arrays(position * [1.0, 0.5, 0.25] * scale + shift, triangle, uv, waves())
        np.testing.assert_allclose(
            normalised(mesh.sheets[0].position, mesh.sheets[0].triangle), position * [1.0, 0.5, 0.25], atol=1e-6
        )


def test_each_face_from_its_own_side(device):
    mesh = lit_cube(2)
    for number, direction in enumerate(DIRECTIONS):
        visible, barycentric, uv = _drawn(mesh, direction, 48, device)
        hit = visible >= 0
        assert visible.dtype == np.int32 and barycentric.shape == (48, 48, 2) and uv.shape == (48, 48, 2)
        assert set(np.unique(visible[hit])) == set(range(8 * number, 8 * number + 8))
        weight = np.concatenate([barycentric, 1.0 - barycentric.sum(-1, keepdims=True)], -1)[hit][..., None]
        corner = mesh.sheets[0].triangle[visible[hit]]
        np.testing.assert_allclose(uv[hit], (mesh.sheets[0].uv[corner] * weight).sum(1), atol=1e-6)
        place = (mesh.sheets[0].position[corner] * weight).sum(1)
        np.testing.assert_allclose(place @ direction, 1.0, atol=1e-5)
        # Seen upright: rows go down, columns to the right.
        row, column = np.nonzero(hit)
        right, up, _ = View.of(direction).axes
        half = 48 / 2 * np.sqrt(2.0) / 2.0  # pixels a unit at the face, which is 2 from the camera
        np.testing.assert_allclose(place @ right, (column - 23.5) / half, atol=1e-4)
        np.testing.assert_allclose(place @ up, (23.5 - row) / half, atol=1e-4)
        assert not uv[~hit].any() and not barycentric[~hit].any()


def test_inactive_triangles_hide_and_are_not_seen():
    """Two sheets one behind the other; half of the front one has no area in UV."""
    sheet = np.array([[-1, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]], np.float64)
    position = np.concatenate([sheet + [0, 0, 0.5], sheet - [0, 0, 0.5]])
    triangle = np.array([[0, 1, 2], [2, 1, 3], [4, 5, 6], [6, 5, 7]])
    uv = np.array([[0, 0], [1, 0], [0, 1], [0.5, 0.5], [0, 0], [1, 0], [0, 1], [1, 1]], np.float64)
    mesh = from_arrays(position, triangle, uv, waves())
    assert mesh.sheets[0].active.tolist() == [True, False, True, True]
    visible, barycentric, at = _drawn(mesh, [0, 0, 1])
    assert set(np.unique(visible)) == {-1, 0}
    assert not barycentric[visible < 0].any() and not at[visible < 0].any()
    whole = dataclasses.replace(mesh.sheets[0], active=np.array([True, True, True, True]))
    flat = dataclasses.replace(mesh, sheets=(whole,))
    assert set(np.unique(_drawn(flat, [0, 0, 1])[0])) == {-1, 0, 1}
    assert set(np.unique(_drawn(mesh, [0, 0, -1])[0])) == {-1, 2, 3}


def test_visibility_counts_every_covered_pixel_once(device):
    mesh, views = lit_cube(2), sphere_views(9, seed=1)
    pixels = sum(int((visible >= 0).sum()) for visible, _, _ in visible_uv(mesh, views, 64, device))
    count = visibility(mesh, views, 64, HEIGHT, WIDTH, device).cpu().numpy()
    assert count.dtype == np.float64 and count.shape == (HEIGHT, WIDTH) and count.sum() == pixels > 5000
    np.testing.assert_array_equal(count, visibility(mesh, views, 64, HEIGHT, WIDTH, device).cpu())
    fine = visibility(mesh, views, 64, 2 * HEIGHT, 2 * WIDTH, device).cpu().numpy()
    np.testing.assert_array_equal(fine.reshape(HEIGHT, 2, WIDTH, 2).sum(axis=(1, 3)), count)
    assert (count[mesh.sheets[0].mask] > 0).mean() > 0.7 and not count[~mesh.sheets[0].mask].any()


def test_visibility_of_one_side_and_of_none():
    mesh = lit_cube(1)
    count = visibility(mesh, [View.of(DIRECTIONS[4])], 64, HEIGHT, WIDTH, "cpu").numpy()
    chart = np.zeros((HEIGHT, WIDTH), bool)
    chart[HEIGHT // 2 :, WIDTH // 3 : 2 * WIDTH // 3] = True
    assert count[chart].sum() > 500 and not count[~chart].any()
    assert not visibility(mesh, [], 64, 4, 4, "cpu").any()


def test_a_uv_at_the_end_is_in_the_last_cell():
    position = np.array([[-1, -1, 0], [1, -1, 0], [-1, 1, 0]], np.float64)
    mesh = from_arrays(position, np.array([[0, 1, 2]]), np.array([[1 - 1e-7, 1], [1, 1], [1, 1 - 1e-7]]), waves())
    count = visibility(mesh, [View.of([0, 0, 1])], 32, 8, 8, "cpu").numpy()
    assert count[7, 7] == count.sum() > 50


def test_what_is_refused():
    mesh, views = lit_cube(1), sphere_views(1)
    with pytest.raises(ValueError, match="at least 1"):
        visibility(mesh, views, 16, 0, 4, "cpu")
    with pytest.raises(WlmError, match="gpu"):
        visibility(mesh, views, 16, 4, 4, "gpu")
    with pytest.raises(ValueError, match="16,?384|height"):
        list(visible_uv(mesh, views, 0, "cpu"))
    for tensor in next(visible_uv(mesh, views, 16, "cpu")):
        assert isinstance(tensor, torch.Tensor) and not tensor.requires_grad
