"""Rasterizing: coverage, barycentrics, depth, backward passes, and triangles without area, place or front."""

import numpy as np
import pytest
import torch
import warp as wp
from reference import raster as reference

from benchmarks import plain
from kernels.compare import array, close, exact
from wlm_kernels.raster import gradient as raster_gradient
from wlm_kernels.raster.edges import exact_sign
from wlm_kernels.raster.rasterize import Raster, Rasterizer

# None: as the device does; 1: every triangle is cut into tiles.
SPLITS = [None, 1]


def _run(position: np.ndarray, triangle: np.ndarray, height: int, width: int, device: str, **options) -> Raster:
    space = "uv" if position.shape[1] == 2 else "clip"
    triangle = array(np.reshape(triangle, (-1, 3)).astype(np.int32), int, device)
    drawing = Rasterizer(triangle, height, width, space=space, coverage=True, derivative=True, **options)
    return drawing.run(array(position.astype(np.float32), float, device))


def _scene(kind: str, count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Random triangles: flat, in perspective, reaching behind the viewer, or in UV space."""
    random = np.random.default_rng(len(kind))
    triangle = np.arange(3 * count).reshape(-1, 3)
    middle = random.uniform(-1.2, 1.2, (count, 1, 2))
    xy = (middle + random.normal(scale=0.4, size=(count, 3, 2))).reshape(-1, 2)
    z = random.uniform(-1, 1, (3 * count, 1))
    w = {"flat": np.ones_like(z), "perspective": random.uniform(0.3, 3.0, z.shape)}
    w["behind"] = random.uniform(-1.0, 1.0, z.shape)
    if kind == "uv":
        return ((xy + 1) / 2).astype(np.float32), triangle
    return np.concatenate([xy * np.abs(w[kind]), z, w[kind]], 1).astype(np.float32), triangle


def _grid(cells: int, jitter: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A square from -1 to 1 of triangles with random windings: [V, 2], [F, 3]."""
    random = np.random.default_rng(cells)
    line = np.linspace(-1, 1, cells + 1)
    xy = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
    inner = (np.abs(xy) < 1).all(1)
    xy[inner] += random.uniform(-jitter, jitter, (inner.sum(), 2)) * 2 / cells
    first = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).reshape(-1)
    a, b, c, d = first, first + 1, first + cells + 2, first + cells + 1
    turned = random.integers(0, 2, len(first)).astype(bool)[:, None]
    first_half = np.where(turned, np.stack([a, b, c], 1), np.stack([b, d, a], 1))
    second_half = np.where(turned, np.stack([a, d, c], 1), np.stack([b, c, d], 1))
    return xy.astype(np.float32), np.concatenate([first_half, second_half])


def _clip(xy: np.ndarray, w: np.ndarray | float = 1.0) -> np.ndarray:
    w = np.broadcast_to(np.asarray(w, np.float32).reshape(-1, 1), (len(xy), 1))
    return np.concatenate([xy * w, 0 * w, w], 1).astype(np.float32)


@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("size", [(33, 50), (1, 1), (7, 1)])
@pytest.mark.parametrize("kind", ["flat", "perspective", "behind", "uv"])
def test_against_reference(device: str, kind: str, size: tuple[int, int], split: int | None):
    """The visible triangle, the barycentrics and the depth, by solving for the corners' weights at each pixel."""
    position, triangle = _scene(kind)
    got = _run(position, triangle, *size, device, split=split)
    visible, share, depth, sure = reference.rasterize(position, triangle, *size)
    sure = sure > 1e-9
    assert sure.mean() > 0.99
    np.testing.assert_array_equal(got.triangle.numpy()[sure], visible[sure])
    hit = sure & (visible >= 0)
    assert kind == "behind" or size != (33, 50) or 0.3 < hit.mean() < 1.0
    np.testing.assert_allclose(got.barycentric.numpy()[hit], share[hit][:, :2], atol=1e-6)
    np.testing.assert_allclose(got.depth.numpy()[hit], depth[hit], rtol=1e-5, atol=1e-6)
    missed = sure & (visible < 0)
    for values in (got.barycentric, got.depth, got.derivative):
        assert not values.numpy()[missed].any()


@pytest.mark.parametrize("kind", ["perspective", "behind", "uv"])
def test_derivative(device: str, kind: str):
    """Derivatives of the barycentrics per pixel, against autograd of the reference."""
    size = (33, 50)
    position, triangle = _scene(kind)
    got = _run(position, triangle, *size, device)
    visible = got.triangle.numpy()
    hit = visible >= 0
    pixels = plain.pixel_centres(*size)[torch.tensor(hit)].requires_grad_()
    b = plain.corner_weights(exact(position), torch.tensor(triangle)[visible[hit]], pixels, *size)
    share = b / b.sum(-1, keepdim=True)
    slopes = [torch.autograd.grad(share[:, i].sum(), pixels, retain_graph=True)[0] for i in range(2)]
    np.testing.assert_allclose(got.derivative.numpy()[hit], torch.cat(slopes, 1), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("space", ["clip", "uv"])
@pytest.mark.parametrize(("cells", "jitter"), [(1, 0.0), (3, 0.2), (16, 0.0), (45, 0.2), (64, 0.0), (100, 0.2)])
def test_no_gap_and_no_double_hit(device: str, cells: int, jitter: float, space: str, split: int | None):
    """Every pixel of a square is covered once, also where triangles that meet have corners of their own."""
    xy, triangle = _grid(cells, jitter)
    separate = xy[triangle].reshape(-1, 2), np.arange(triangle.size).reshape(-1, 3)
    for points, triangles in ((xy, triangle), separate):
        position = _clip(points) if space == "clip" else (points + 1) / 2
        coverage = _run(position, triangles, 64, 64, device, split=split).coverage.numpy()
        np.testing.assert_array_equal(coverage, 1)


@pytest.mark.parametrize("space", ["clip", "uv"])
@pytest.mark.parametrize(("cells", "step"), [(1, 60), (2, 1), (15, 4), (31, 2), (62, 1)])
def test_corners_on_pixel_centres(device: str, cells: int, step: int, space: str):
    """Of a square whose corners all lie on centres, those on its top and left belong to it, on the others not."""
    size, first = 64, 1
    xy, triangle = _grid(cells)
    pixel = first + step * np.rint((xy + 1) / 2 * cells)
    xy = (2 * pixel + 1 - size) / size
    position = _clip(xy * [1, -1]) if space == "clip" else (xy + 1) / 2
    want = np.zeros((size, size), int)
    want[first : first + cells * step, first : first + cells * step] = 1
    for split in SPLITS:
        np.testing.assert_array_equal(_run(position, triangle, size, size, device, split=split).coverage.numpy(), want)


def test_no_gap_in_perspective(device: str):
    """Corners scaled by powers of two lie as exactly on pixel centres; by others they are where float32 has them."""
    random = np.random.default_rng(7)
    xy, triangle = _grid(32)
    xy = xy * np.float32(62 / 64) + np.float32(1 / 64)
    for w in (2.0 ** random.integers(-3, 4, len(xy)), random.uniform(0.1, 10.0, len(xy))):
        coverage = _run(_clip(xy, w), triangle, 64, 64, device).coverage.numpy()
        np.testing.assert_array_equal(coverage[2:-2, 2:-2], 1)
        assert coverage.max() == 1


def test_no_gap_behind_the_viewer(device: str):
    """A closed box round the viewer: every pixel sees it once, whichever way it looks, and whatever crosses w = 0."""
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangle = np.array([t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))])
    random = np.random.default_rng(8)
    turns = [np.eye(3), *(np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in range(6))]
    for turn in turns:
        eye = (corner - random.uniform(-0.9, 0.9, 3)) @ turn
        position = np.concatenate([eye[:, :2], eye[:, 2:] - 0.1, eye[:, 2:]], 1)
        for split in SPLITS:
            got = _run(position, triangle, 40, 56, device, split=split)
            np.testing.assert_array_equal(got.coverage.numpy(), 1)
            assert (got.triangle.numpy() >= 0).all()


def test_slivers_exactly(device: str):
    """Triangles thinner than float64's rounding, through pixel centres or almost, against integers."""
    random = np.random.default_rng(9)
    size = (12, 16)
    for trial in range(60):
        pixel = np.stack([random.integers(0, 16, 3), random.integers(0, 12, 3)], 1)
        xy = np.stack([(2 * pixel[:, 0] + 1 - 16) / 16, (11 - 2 * pixel[:, 1]) / 12], 1)
        corners = _clip(xy, random.uniform(0.5, 2.0, 3) * (-1.0 if trial % 5 == 0 else 1.0) ** np.arange(3))
        # The third on the line of the other two, but for rounding.
        share = random.uniform(-0.5, 1.5)
        corners[2] = (1 - share) * corners[0] + share * corners[1]
        if trial % 3 == 0:
            corners[2] *= np.float32(2.0 ** random.integers(-60, 60))
        got = _run(corners, [0, 1, 2], *size, device).coverage.numpy()
        np.testing.assert_array_equal(got, reference.covers(corners, *size))
    for trial in range(60):  # and wide ones, their corners on pixel centres
        pixel = np.stack([random.integers(-4, 20, 3), random.integers(-4, 16, 3)], 1)
        xy = np.stack([(2 * pixel[:, 0] + 1 - 16) / 16, (11 - 2 * pixel[:, 1]) / 12], 1)
        corners = _clip(xy, 2.0 ** random.integers(-2, 3, 3) * np.where(trial % 4 == 0, [1, 1, -1], 1))
        got = _run(corners, [0, 1, 2], *size, device).coverage.numpy()
        np.testing.assert_array_equal(got, reference.covers(corners, *size))


def _gcd(a: int, b: int) -> tuple[int, int, int]:
    """g, x, y with a x + b y = g, the greatest common divisor."""
    if b == 0:
        return a, 1, 0
    g, x, y = _gcd(b, a % b)
    return g, y, x - a // b * y


def _sliver(random: np.random.Generator, height: int, width: int) -> np.ndarray | None:
    """Corners (x, y, w) of 24 bits with a pixel centre on an edge, and the least determinant: 2^-58 of its terms."""
    row, column = int(random.integers(0, height)), int(random.integers(0, width))
    centre = [(2 * column + 1 - width) * height, (height - 1 - 2 * row) * width, height * width]
    m = 2**23 // (height * width)
    a = [int(n) for n in random.integers(-(2**22), 2**22, 3)]
    a[2] = abs(a[2]) + 1
    b = [m * c - x for c, x in zip(centre, a, strict=True)]
    n = [a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)]
    g, x, y = _gcd(n[0], n[1])
    _, u, v = _gcd(g, n[2])
    c = [u * x, u * y, v]  # n . c is the greatest common divisor of n
    # Less of a and b leaves the determinant as it is.
    dot = lambda p, q: sum(i * j for i, j in zip(p, q, strict=True))  # noqa: E731
    aa, ab, bb, ac, bc = dot(a, a), dot(a, b), dot(b, b), dot(a, c), dot(b, c)
    det = aa * bb - ab * ab
    i, j = (ac * bb - bc * ab) // det, (bc * aa - ac * ab) // det
    c = [z - i * x - j * y for x, y, z in zip(a, b, c, strict=True)]
    corners = np.array([a, b, c], np.float64)
    return corners if np.abs(corners).max() < 2**24 and (corners[:, 2] > 0).all() else None


def test_edges_through_centres_exactly(device: str):
    """Where float64 errs: an edge of full mantissas through a centre, shared by two triangles, and slivers along it."""
    random = np.random.default_rng(11)
    height, width = 45, 77
    slivers = [_sliver(random, height, width) for _ in range(80)]
    slivers = [corners for corners in slivers if corners is not None]
    assert len(slivers) > 10
    covered = 0
    for trial, corners in enumerate(slivers):
        sliver = np.insert(corners, 2, 0.3 * corners[:, 2], 1).astype(np.float32)
        np.testing.assert_array_equal(sliver[:, [0, 1, 3]], corners)
        sliver = sliver[random.permutation(3)] if trial % 2 else sliver
        want = reference.covers(sliver, height, width)
        # In front of a plane just behind it, behind one just in front, however few digits its depth has.
        for depth, visible in ((0.31, 0), (0.29, 1)):
            plane = _clip(np.array([[-3, -3], [3, -3], [0, 3]])) * np.float32([1, 1, 0, 1])
            plane[:, 2] = depth
            got = _run(np.concatenate([sliver, plane]), np.arange(6), height, width, device)
            np.testing.assert_array_equal(got.coverage.numpy(), 1 + want)
            np.testing.assert_array_equal(got.triangle.numpy()[want], visible)
        covered += want.sum()
        # Two that share the edge on both sides of it.
        apart = np.concatenate([sliver[:2], _clip(np.array([[-9.0, 8.0], [9.0, -7.0]]))])
        sides = [reference.covers(apart[[0, 1, k]], height, width).astype(int) for k in (2, 3)]
        got = _run(apart, [[0, 1, 2], [1, 0, 3]], height, width, device).coverage.numpy()
        np.testing.assert_array_equal(got, sum(sides))
    assert covered > 5


@wp.kernel(enable_backward=False)
def _signs(
    # in:
    p: wp.array1d[wp.vec3d],
    v: wp.array1d[wp.vec3d],
    w: wp.array1d[wp.vec3d],
    # out:
    sign: wp.array1d[wp.float64],
):
    i = wp.tid()
    sign[i] = exact_sign(p[i], v[i], w[i])


def test_exact_sign(device: str):
    """Of determinants that are 0 or all but, with numbers as long as they come, against whole numbers."""
    random = np.random.default_rng(12)
    v, w = (random.integers(-(2**24) + 1, 2**24, (600, 3)) for _ in range(2))
    p = random.integers(-15, 16, (600, 1)) * v + random.integers(-15, 16, (600, 1)) * w
    p += random.integers(-1, 2, p.shape) * (np.arange(600) % 3 != 0)[:, None]
    rows = np.stack([p, v, w], 1).astype(object)
    a, b, c = rows[:, 0].T, rows[:, 1].T, rows[:, 2].T
    det = sum(a[i] * (b[i - 2] * c[i - 1] - b[i - 1] * c[i - 2]) for i in range(3))
    want = [(d > 0) - (d < 0) for d in det]
    assert min(want.count(s) for s in (-1, 0, 1)) > 100
    for scale in (1.0, 2.0**-149, 2.0**100):
        on_device = [array(values * s, wp.vec3d, device) for values, s in ((p, 1.0), (v, scale), (w, scale))]
        sign = wp.zeros(600, dtype=wp.float64, device=device)
        wp.launch(_signs, 600, inputs=on_device, outputs=[sign], device=device)
        np.testing.assert_array_equal(sign.numpy(), want)


def test_the_nearest_then_the_first(device: str):
    """Of two at the same depth the one of less number, whichever comes first in the list of large ones."""
    position = _clip(np.array([[-3, -3], [3, -3], [0, 3]]))
    far, near = position.copy(), position.copy()
    far[:, 2], near[:, 2] = 0.5, -0.5
    stack = np.concatenate([far, near, near, far])
    for split in SPLITS:
        got = _run(stack, np.arange(12), 8, 8, device, split=split)
        np.testing.assert_array_equal(got.triangle.numpy(), 1)
        np.testing.assert_array_equal(got.depth.numpy(), -0.5)
        np.testing.assert_array_equal(got.coverage.numpy(), 4)
    position[:, 2] = -0.0
    zeros = np.concatenate([far * np.float32([1, 1, 0, 1]), position])
    np.testing.assert_array_equal(_run(zeros, np.arange(6), 8, 8, device).triangle.numpy(), 0)
    first = _run((position[:, :2] + 1) / 2, [0, 1, 2] * 3, 8, 8, device)
    np.testing.assert_array_equal(first.triangle.numpy(), 0)


def test_depths_closer_than_float32(device: str):
    """Two depths that float32 can't tell apart: the less one is seen, though it comes last."""
    n = 2**22
    z, w = np.repeat([n, n - 1], 3), np.repeat([2 * n + 1, 2 * n - 1], 3)
    assert np.float32(z[0] / w[0]) == np.float32(z[3] / w[3]) and z[3] / w[3] < z[0] / w[0]
    position = _clip(np.array([[-3, -3], [3, -3], [0, 3]] * 2), w)
    position[:, 2] = z
    for split in SPLITS:
        got = _run(position, np.arange(6), 4, 4, device, split=split)
        np.testing.assert_array_equal(got.triangle.numpy(), 1)


def test_cull(device: str):
    """Clockwise triangles aren't drawn when asked so; a triangle seen from behind turns."""
    position = _clip(np.array([[-3, -3], [3, -3], [0, 3]]))
    uv = (position[:, :2] + 1) / 2  # the same on paper, with v up
    for order, visible in (([0, 1, 2], 0), ([0, 2, 1], -1)):
        assert (_run(position, order, 4, 4, device).triangle.numpy() == 0).all()
        assert (_run(position, order, 4, 4, device, cull=True).triangle.numpy() == visible).all()
        assert (_run(uv, order, 4, 4, device, cull=True).triangle.numpy() == visible).all()


def test_what_covers_nothing(device: str):
    """No area, no number, no corner, all behind, beside the image, between the centres; the rest is drawn as ever."""
    good = _clip(np.array([[-3, -3], [3, -3], [0, 3]]))
    bad = []
    for value in (np.nan, np.inf, -np.inf):
        for column in range(4):
            bad.append(good.copy())
            bad[-1][1, column] = value
    bad.append(good[[0, 0, 1]])
    bad.append(good[[1, 1, 1]])
    bad.append(np.zeros((3, 4), np.float32))
    bad.append(_clip(np.array([[-1, -1], [0, 0], [1, 1]])))  # a line, through pixel centres
    bad.append(good * np.float32([1, 1, 1, -1]))
    bad.append(good * np.float32([1, 1, 1, 0]))
    bad.append(_clip(np.array([[2, 2], [4, 2], [2, 4]])))
    bad.append(_clip(np.array([[0.01, 0.01], [0.02, 0.01], [0.01, 0.02]])))
    bad.append(np.full((3, 4), 1e-45, np.float32))
    position = np.concatenate([*bad, good])
    last = len(bad)
    for split in SPLITS:
        got = _run(position, np.arange(len(position)), 6, 7, device, split=split)
        np.testing.assert_array_equal(got.coverage.numpy(), 1)
        np.testing.assert_array_equal(got.triangle.numpy(), last)
        got = _run(good, [[0, 1, 3], [-1, 1, 2], [0, 1, 2**31 - 1], [0, 1, 2]], 6, 7, device, split=split)
        np.testing.assert_array_equal(got.coverage.numpy(), 1)
        np.testing.assert_array_equal(got.triangle.numpy(), 3)
        for nothing in (np.zeros((0, 4)), position[:-3]):
            got = _run(nothing, np.arange(len(nothing)), 6, 7, device, split=split)
            assert (got.triangle.numpy() == -1).all() and not got.depth.numpy().any()


def test_huge_and_tiny_numbers(device: str):
    """Corners far off the image, and coordinates at both ends of float32, scaled in homogeneous coordinates."""
    near = _clip(np.array([[-3.0, -3.0], [3.0, -3.0], [0.0, 3.0]]))
    want = _run(near, [0, 1, 2], 9, 9, device)
    for scale in (2.0**-140, 2.0**-60, 2.0**120):
        got = _run(near * np.float32(scale), [0, 1, 2], 9, 9, device)
        np.testing.assert_array_equal(got.coverage.numpy(), 1)
        np.testing.assert_allclose(got.barycentric.numpy(), want.barycentric.numpy(), atol=1e-6)
    for split in SPLITS:
        far = _clip(np.array([[-1e38, -1e38], [1e38, -1e38], [0.0, 1e38]]))
        got = _run(far, [0, 1, 2], 9, 9, device, split=split)
        np.testing.assert_array_equal(got.coverage.numpy(), 1)
        np.testing.assert_allclose(got.barycentric.numpy(), np.broadcast_to([0.25, 0.25], (9, 9, 2)), atol=1e-6)


def test_splitting_changes_nothing(device: str):
    """To the bit, whether triangles are cut into tiles or not, some of them or all."""
    position, triangle = _scene("perspective", 300)
    want = _run(position, triangle, 70, 90, device, split=10**9)
    for split in (0, 1, 64, 1000):
        got = _run(position, triangle, 70, 90, device, split=split)
        for name in ("triangle", "barycentric", "depth", "derivative", "coverage"):
            np.testing.assert_array_equal(getattr(got, name).numpy(), getattr(want, name).numpy(), name)


def test_run_again(device: str):
    """A second run has nothing of the first; on CUDA the same graph draws what its buffer holds when it is launched."""
    position, triangle = _scene("behind")
    reversed_corners = position[::-1].copy()
    on_device = array(position, float, device)
    drawing = Rasterizer(array(triangle.astype(np.int32), int, device), 33, 50, coverage=True)
    drawing.run(on_device)
    launch = lambda: drawing.run(on_device)  # noqa: E731
    if on_device.device.is_cuda:
        with wp.ScopedCapture(device) as capture:
            drawing.run(on_device)
        launch = lambda: wp.capture_launch(capture.graph)  # noqa: E731
    for values in (reversed_corners, position):
        on_device.assign(values)
        launch()
        want = _run(values, triangle, 33, 50, device)
        for name in ("triangle", "barycentric", "depth", "coverage"):
            np.testing.assert_array_equal(getattr(drawing.raster, name).numpy(), getattr(want, name).numpy(), name)


@pytest.mark.parametrize("kind", ["flat", "perspective", "behind", "uv"])
def test_gradient_of_positions(device: str, kind: str):
    """Of the barycentrics, against the reference's autograd."""
    size = (33, 50)
    position, triangle = _scene(kind, 12)
    got = _run(position, triangle, *size, device)
    visible = got.triangle.numpy()
    hit = visible >= 0
    toward = np.random.default_rng(3).normal(size=(*size, 2)).astype(np.float32)
    position64 = exact(position, grad=True)
    pixels = plain.pixel_centres(*size)[torch.tensor(hit)]
    b = plain.corner_weights(position64, torch.tensor(triangle)[visible[hit]], pixels, *size)
    ((b / b.sum(-1, keepdim=True))[:, :2] * exact(toward[hit])).sum().backward()
    on_device = [array(position, float, device), array(triangle.astype(np.int32), int, device)]
    grad = wp.zeros_like(on_device[0])
    space = "uv" if kind == "uv" else "clip"
    raster_gradient.rasterize_backward(*on_device, got.triangle, array(toward, wp.vec2, device), grad, space)
    close(grad, position64.grad, 1e-5)


def test_interpolate(device: str):
    """Values and both gradients, with corners of other numbers than those drawn with."""
    size = (33, 50)
    position, triangle = _scene("perspective")
    got = _run(position, triangle, *size, device)
    visible = torch.tensor(got.triangle.numpy())
    random = np.random.default_rng(4)
    for channels in (1, 3, 20):
        attribute = random.normal(size=(17, channels)).astype(np.float32)
        corner = random.integers(0, 17, triangle.shape).astype(np.int32)
        toward = random.normal(size=(*size, channels)).astype(np.float32)
        attribute64, uv64 = exact(attribute, grad=True), exact(got.barycentric.numpy(), grad=True)
        share = torch.cat([uv64, 1 - uv64.sum(-1, keepdim=True)], -1)
        want = (attribute64[torch.tensor(corner)[visible]] * share[..., None]).sum(-2) * (visible >= 0)[..., None]
        want.backward(exact(toward))
        here = array(attribute, float, device), array(corner, int, device), got.triangle, got.barycentric
        out = wp.full((*size, channels), 7.0, dtype=float, device=device)
        raster_gradient.interpolate(*here, out)
        close(out, want, 1e-6)
        grads = wp.zeros_like(here[0]), wp.full(size, 7.0, dtype=wp.vec2, device=device)
        raster_gradient.interpolate_backward(*here, array(toward, float, device), *grads)
        close(grads[0], attribute64.grad, 1e-5)
        close(grads[1], uv64.grad, 1e-5)


def test_interpolate_what_is_not_there(device: str):
    """Triangles beyond the list and corners beyond the attributes read 0 and give nothing."""
    triangle = array(np.array([[0, 1, 2], [0, 1, 3], [-1, 1, 2]]), int, device)
    attribute = array(np.ones((3, 2), np.float32), float, device)
    visible = array(np.array([[0, 1, 2, 3, -1]]), int, device)
    uv = array(np.full((1, 5, 2), 0.25, np.float32), wp.vec2, device)
    out = wp.full((1, 5, 2), 7.0, dtype=float, device=device)
    raster_gradient.interpolate(attribute, triangle, visible, uv, out)
    np.testing.assert_array_equal(out.numpy()[0, :, 0], [1, 0, 0, 0, 0])
    grad, grad_uv = wp.zeros_like(attribute), wp.zeros_like(uv)
    raster_gradient.interpolate_backward(attribute, triangle, visible, uv, out, grad, grad_uv)
    np.testing.assert_array_equal(grad.numpy()[:, 0], [0.25, 0.25, 0.5])
