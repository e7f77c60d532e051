"""Reading a cascade: values and gradients against float64, borders, NaN, and the points and losses of tuning."""

import numpy as np
import pytest
import torch
import warp as wp
from reference import cascade as reference

from kernels.compare import array, close, exact
from wlm_kernels.atlas import cascade

# Sides of T_p and of T_c, None: there is no T_c.
SHAPES = [((7, 5), (6, 9)), ((4, 8), None), ((1, 6), (3, 1)), ((6, 1), (1, 4)), ((1, 1), (1, 1)), ((12, 12), (2, 2))]


class Reading:
    """A cascade read at points, on a device."""

    def __init__(self, colour: np.ndarray, lut: np.ndarray | None, uv: np.ndarray, device: str):
        self.device = device
        self.uv = array(uv, wp.vec2, device)
        self.colour = array(colour, float, device)
        self.lut = wp.zeros((0, 0, 2), dtype=float, device=device) if lut is None else array(lut, float, device)

    def forward(self) -> np.ndarray:
        out = wp.full((self.uv.shape[0], 3), 7.0, dtype=float, device=self.device)
        cascade.sample(self.colour, self.lut, self.uv, out)
        return out.numpy()

    def backward(self, toward: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        grads = wp.zeros_like(self.colour), wp.zeros_like(self.lut)
        cascade.sample_backward(self.colour, self.lut, self.uv, array(toward, float, self.device), *grads)
        return grads[0].numpy(), grads[1].numpy()


def _case(shape: tuple, lut_shape: tuple | None, spread: float, count: int = 400):
    """Textures, points inside and outside, and a direction for gradients; T_c reaches `spread` periods away.

    Points whose slope float32 may tell otherwise than float64 (at a texel's centre or the end of a wave) are left out.
    """
    random = np.random.default_rng(sum(shape))
    colour = random.normal(size=(*shape, 3)).astype(np.float32)
    uv = random.uniform(-0.2, 1.2, (count, 2)).astype(np.float32)
    lut, at = None, uv.clip(0.0, 1.0)
    if lut_shape is not None:
        lut = random.uniform(-spread, 1.0 + spread, (*lut_shape, 2)).astype(np.float32)
        at = reference.wave(reference.bilinear(exact(lut), exact(uv))).numpy()
    cell = np.abs(at * [shape[1], shape[0]] - 0.5)
    clear = (np.abs(cell - np.rint(cell)) > 1e-4).all(1) & (np.minimum(at, 1.0 - at) > 1e-5).all(1)
    assert clear.mean() > 0.5 or lut_shape is None
    uv = uv[clear | (lut_shape is None)]
    return colour, lut, uv, random.normal(size=(len(uv), 3)).astype(np.float32)


@pytest.mark.parametrize("spread", [0.0, 3.0])
@pytest.mark.parametrize(("shape", "lut_shape"), SHAPES)
def test_against_reference(device: str, shape: tuple, lut_shape: tuple | None, spread: float):
    """Eq. 7 and both its gradients; T_c within [0, 1], and some periods of the wave away."""
    colour, lut, uv, toward = _case(shape, lut_shape, spread)
    leaves = [exact(colour, grad=True), None if lut is None else exact(lut, grad=True)]
    want = reference.sample(*leaves, exact(uv))
    want.backward(exact(toward))
    reading = Reading(colour, lut, uv, device)
    close(reading.forward(), want, 1e-4, "value")
    grad_colour, grad_lut = reading.backward(toward)
    close(grad_colour, leaves[0].grad, 1e-4, "T_p")
    if lut is not None:
        close(grad_lut, leaves[1].grad, 1e-4, "T_c")


def test_gradients_against_finite_differences(device: str):
    """Central differences in directions of both textures, within one linear piece of T_p."""
    random = np.random.default_rng(1)
    colour = random.normal(size=(3, 3, 3)).astype(np.float32)
    lut = random.uniform(0.25, 0.4, (4, 5, 2)).astype(np.float32)  # between the centres at 1/6 and 1/2
    uv = random.uniform(0.0, 1.0, (60, 2)).astype(np.float32)
    toward = random.normal(size=(60, 3)).astype(np.float32)
    grads = Reading(colour, lut, uv, device).backward(toward)
    size = 2.0**-6
    for which, grad in enumerate(grads):
        way = random.uniform(-1.0, 1.0, grad.shape).astype(np.float32)
        ends = []
        for sign in (-size, size):
            textures = [colour, lut]
            textures[which] = textures[which] + np.float32(sign) * way
            ends.append(float((Reading(*textures, uv, device).forward().astype(np.float64) * toward).sum()))
        close(np.array((ends[1] - ends[0]) / (2 * size)), np.array((grad.astype(np.float64) * way).sum()), 1e-3)


def test_nothing_to_read(device: str):
    """Points that are NaN read NaN and give nothing; so does T_c where it is NaN; no point is no work."""
    colour, lut, _, _ = _case((4, 4), (3, 3), 0.0)
    uv = np.array([[np.nan, 0.5], [0.5, np.nan]], np.float32)
    reading = Reading(colour, lut, uv, device)
    assert np.isnan(reading.forward()).all()
    assert not any(grad.any() for grad in reading.backward(np.ones((2, 3), np.float32)))
    lost = Reading(colour, np.full_like(lut, np.nan), uv * 0 + 0.5, device)
    assert np.isnan(lost.forward()).all()
    assert not lost.backward(np.ones((2, 3), np.float32))[0].any()
    assert Reading(colour, lut, uv[:0], device).forward().shape == (0, 3)


def test_wrong_shapes(device: str):
    uv = np.zeros((1, 2), np.float32)
    with pytest.raises(ValueError, match=r"colour: expected shape .* sides above 0, got \(2, 2, 4\)"):
        Reading(np.zeros((2, 2, 4)), None, uv, device).forward()
    with pytest.raises(ValueError, match=r"lut: expected shape .* \[0, 0, 2\] for none, got \(2, 2, 3\)"):
        Reading(np.zeros((2, 2, 3)), np.zeros((2, 2, 3)), uv, device).forward()


def test_points_of_corners(device: str):
    corner = np.array([[[0, 0], [1, 0], [0, 1]], [[2, 2], [4, 2], [2, 6]]], np.float32)
    weights = array(np.array([[1, 0], [0.25, 0.5], [0.5, 0.5]]), wp.vec2, device)
    uv = wp.zeros(3, dtype=wp.vec2, device=device)
    cascade.corner_points(array(np.array([0, 1, -1]), int, device), weights, array(corner, wp.vec2, device), uv)
    np.testing.assert_array_equal(uv.numpy(), [[0, 0], [3, 3], [np.nan, np.nan]])


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
        cascade.surface_points(*surface, apart, 3, count_of_steps, triangle, barycentric)
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


@pytest.mark.parametrize("weight", [0.0, 0.7])
@pytest.mark.parametrize("shape", [(5, 7, 3), (1, 4, 3), (1, 1, 3)])
def test_image_loss(device: str, shape: tuple, weight: float):
    """Its gradient by autograd; NaN is 0, and a difference of exactly 0 pulls nowhere."""
    random = np.random.default_rng(4)
    difference = random.normal(size=shape).astype(np.float32)
    difference[0, 0] = 0.0
    empty = random.uniform(size=shape[:2]) < 0.3
    difference[empty] = np.nan
    leaf = exact(np.nan_to_num(difference), grad=True)
    reference.image_loss(leaf, weight).backward()
    grad = wp.full(shape, 7.0, dtype=float, device=device)
    cascade.image_loss(array(difference, float, device), weight, grad)
    close(grad, torch.where(torch.tensor(empty)[..., None], 0.0, leaf.grad), 1e-6)


def test_pair_loss(device: str):
    random = np.random.default_rng(5)
    difference = random.normal(size=(10, 3)).astype(np.float32)
    difference[2] = difference[7]
    leaf = exact(difference, grad=True)
    reference.pair_loss(leaf, 0.7).backward()
    grad = wp.full((10, 3), 7.0, dtype=float, device=device)
    cascade.pair_loss(array(difference, float, device), 0.7, grad)
    close(grad, leaf.grad, 1e-6)
