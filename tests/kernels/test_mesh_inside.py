"""Points in the solid of a mesh against winding numbers and distances in float64."""

import numpy as np
import pytest
import warp as wp
from trimesh.creation import icosphere
from trimesh.triangles import closest_point

from wlm_kernels.fluid.mesh_inside import contains


def _winding(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Sum of the solid angles of triangles, float64 [F, 3, 3], over 4 pi (Van Oosterom and Strackee, 1983)."""
    a, b, c = (corners[None, :, k] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(each, axis=-1) for each in (a, b, c))
    top = (a * np.cross(b, c)).sum(-1)
    below = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return (2 * np.arctan2(top, below)).sum(1) / (4 * np.pi)


@pytest.mark.parametrize(("cut", "shell"), [(-1.0, 0.0), (-0.9, 0.0), (0.0, 0.25), (0.7, 0.3)])
def test_points_in_a_mesh(cut: float, shell: float, device: str):
    """A ball, with a small hole below, half of it, and a cap; each with its shell."""
    ball = icosphere(subdivisions=2)
    kept = ball.triangles_center[:, 1] > cut
    corners = np.asarray(ball.triangles, np.float64)[kept]
    points = np.random.default_rng(0).uniform(-1.6, 1.6, (2000, 3))
    winding = _winding(corners, points)
    places = np.repeat(points, len(corners), 0)
    nearest = closest_point(np.tile(corners, (len(points), 1, 1)), places)
    away = np.linalg.norm(nearest - places, axis=1).reshape(len(points), -1).min(1)
    # Warp's winding numbers are approximate far from triangles.
    sure = (np.abs(winding - 0.5) > 0.05) & (np.abs(away - shell) > 1e-4) & (away > 1e-4)
    assert sure.mean() > 0.95
    places = wp.array(corners.reshape(-1, 3), dtype=wp.vec3, device=device)
    indices = wp.array(np.arange(3 * len(corners)), dtype=int, device=device)
    got = contains(wp.Mesh(places, indices, support_winding_number=True), points, shell)
    expected = (winding > 0.5) | (away < shell)
    assert 50 < expected.sum() < 1500
    np.testing.assert_array_equal(got[sure], expected[sure])
