"""Random pairs of points on a mesh."""

import numpy as np
import warp as wp

from kernels.compare import array
from wlm_kernels.atlas.surface import surface_points


def test_points_on_a_surface(device: str):
    """Each triangle gets its share of the area to within a point or two; those without area get none."""
    corner = np.array([[[0, 0], [9, 0], [0, 9]]] * 4 + [[[0, 0], [0, 0], [0, 0]], [[0, 0], [1, 0], [0, 1]]], np.float32)
    areas = np.array([0.0, 1.0, 3.0, 0.0, 2.0, 2.0])
    count, apart = 4000, 1.5

    def draw(step: int) -> tuple[np.ndarray, np.ndarray]:
        triangle = wp.zeros(2 * count, dtype=int, device=device)
        barycentric = wp.zeros(2 * count, dtype=wp.vec2, device=device)
        surface = array(np.cumsum(areas), wp.float64, device), array(corner, wp.vec2, device)
        count_of_steps = array(np.array([step]), int, device)
        surface_points(*surface, apart, 3, count_of_steps, triangle, barycentric)
        return triangle.numpy(), barycentric.numpy()

    triangle, weights = draw(0)
    first, second = weights[:count], weights[count:]
    np.testing.assert_array_equal(triangle[:count], triangle[count:])
    np.testing.assert_allclose(np.bincount(triangle[:count], minlength=6), areas / 8 * count, atol=2)
    assert (weights >= 0).all() and (weights.sum(1) <= 1.0).all()
    np.testing.assert_allclose(first.mean(0), 1 / 3, atol=0.02)
    large = np.isin(triangle[:count], [1, 2])
    moved = (first - second)[large]
    far = np.linalg.norm(moved @ (corner[1, :2] - corner[1, 2]), axis=1)
    near = far < 1e-6
    np.testing.assert_allclose(far[~near], apart, rtol=1e-4)
    assert 0 < near.mean() < 0.3
    assert (first == second)[~large].all(), "no room in the small one, no direction in the flat one"
    np.testing.assert_array_equal(draw(0)[1], weights)
    assert (draw(1)[1] != weights).any(1).mean() > 0.99
