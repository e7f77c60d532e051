"""Reading textures: values, gradients, borders, and coordinates that are NaN, infinite or huge."""

import numpy as np
import pytest
import warp as wp

from benchmarks import plain
from kernels.compare import array, close, exact
from wlm_kernels.raster import mips, texture
from wlm_kernels.raster.texture import BOUNDARIES, FILTERS

SHAPES = [(7, 5, 3), (4, 8, 1), (1, 6, 2), (6, 1, 2), (1, 1, 4), (3, 3, 17)]  # H, W, C


class Reading:
    """A texture read at points, on a device."""

    def __init__(self, image: np.ndarray, uv: np.ndarray, device: str, **mode: str):
        self.image, self.uv = array(image, float, device), array(uv, wp.vec2, device)
        self.mode, self.device = mode, device

    def forward(self) -> np.ndarray:
        out = wp.full((len(self.uv), self.image.shape[2]), 7.0, dtype=float, device=self.device)
        mips.sample(self.image, self.uv, out, **self.mode)
        return out.numpy()

    def backward(self, toward: np.ndarray, copies: int = 1) -> tuple[np.ndarray, np.ndarray]:
        height, width, channels = self.image.shape
        on_image = wp.zeros((height, width, channels * copies), dtype=float, device=self.device)
        on_uv = wp.full(len(self.uv), 7.0, dtype=wp.vec2, device=self.device)
        mips.sample_backward(self.image, self.uv, array(toward, float, self.device), on_image, on_uv, **self.mode)
        return on_image.numpy().reshape(*self.image.shape, copies).sum(-1), on_uv.numpy()


def _points(shape: tuple[int, ...], count: int = 300) -> np.ndarray:
    """Inside and some periods away; none near a texel's centre or edge, where slopes change."""
    random = np.random.default_rng(sum(shape))
    size = np.array([shape[1], shape[0]])
    half = random.integers(-5 * size, 6 * size, (count, 2)) * 2 + random.integers(0, 2, (count, 2))
    return ((0.5 * half + random.uniform(0.05, 0.45, (count, 2))) / size).astype(np.float32)


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("filter", FILTERS)
@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: "x".join(map(str, s)))
def test_against_reference(device: str, shape: tuple[int, ...], filter: str, boundary: str):
    """Values and both gradients."""
    random = np.random.default_rng(1)
    image, uv = random.normal(size=shape).astype(np.float32), _points(shape)
    toward = random.normal(size=(len(uv), shape[2])).astype(np.float32)
    reading = Reading(image, uv, device, filter=filter, boundary=boundary)
    image64, uv64 = exact(image, grad=True), exact(uv, grad=True)
    want = plain.texture(image64, uv64, filter=filter, boundary=boundary)
    want.backward(exact(toward))
    close(reading.forward(), want, 1e-5, "value")
    for copies in (1, 32):
        grad_image, grad_uv = reading.backward(toward, copies)
        close(grad_image, image64.grad, 1e-5, "texels")
        close(grad_uv, uv64.grad, 1e-4, "uv")


def test_a_texel_at_a_centre_stands_alone(device: str):
    """An infinite neighbour without weight isn't read."""
    image = np.array([[[1.0], [np.inf]], [[np.nan], [3.0]]], np.float32)
    uv = np.array([[0.25, 0.25], [0.75, 0.75]], np.float32)
    for filter in FILTERS:
        np.testing.assert_array_equal(Reading(image, uv, device, filter=filter).forward(), [[1.0], [3.0]])


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("filter", FILTERS)
def test_coordinates_without_a_texel(device: str, filter: str, boundary: str):
    """NaN reads NaN and gives nothing; infinity likewise, unless it is clamped; huge numbers are even integers."""
    image = np.random.default_rng(3).uniform(1.0, 2.0, (3, 5, 2)).astype(np.float32)
    bad = [[np.nan, 0.5], [0.5, np.nan], [np.nan, np.nan]]
    infinite = [[np.inf, 0.1], [0.9, -np.inf]]
    huge = np.array([[3e38, 0.5], [-3e38, 0.5], [1e20, -1e20], [-1e-40, 1e-40]], np.float32)
    lost = bad if boundary == "clamp" else bad + infinite
    uv = np.array(lost, np.float32)
    reading = Reading(image, uv, device, filter=filter, boundary=boundary)
    assert np.isnan(reading.forward()).all()
    grad_image, grad_uv = reading.backward(np.ones((len(uv), 2), np.float32))
    assert not grad_image.any() and not grad_uv.any()
    near = {"clamp": [[1, 0.5], [0, 0.5], [1, 0], [0, 0]]}.get(boundary, [[0, 0.5], [0, 0.5], [0, 0], [0, 0]])
    if boundary == "wrap" and filter == "nearest":
        near[3][0] = 1 - 1e-6  # just below 0 is the last texel
    args = {"filter": filter, "boundary": boundary}
    want = Reading(image, np.array(near, np.float32), device, **args).forward()
    np.testing.assert_array_equal(Reading(image, huge, device, **args).forward(), want)
    if boundary == "clamp":
        ends = np.array([[1, 0.1], [0.9, 0]], np.float32)
        values = Reading(image, np.array(infinite, np.float32), device, **args).forward()
        np.testing.assert_array_equal(values, Reading(image, ends, device, **args).forward())


def test_weights_of_a_wide_texture(device: str):
    """At 16,384 texels weights keep 24 bits: with coordinates that float32 holds, error 1e-6 and not 1e-3."""
    image = np.zeros((1, 16384, 1), np.float32)
    image[0, ::2] = 1.0
    u = np.random.default_rng(4).uniform(0.1, 0.9, 500).astype(np.float32)
    uv = np.stack([u, np.full(500, 0.5, np.float32)], 1)
    place = u.astype(np.float64) * 16384 - 0.5
    low = np.floor(place)
    want = np.where(low % 2 == 0, 1 - (place - low), place - low)
    close(Reading(image, uv, device).forward()[:, 0], want, 1e-6)


@wp.kernel(enable_backward=False)
def _wave(
    # in:
    x: wp.array1d[float],
    # out:
    y: wp.array1d[wp.vec2],
):
    i = wp.tid()
    y[i] = wp.vec2(texture.triangle_wave(x[i]), texture.triangle_wave_slope(x[i]))


def test_triangle_wave(device: str):
    """Eq. 8: against an arccosine of a cosine, and its slope against its own steps."""
    x = np.append(np.random.default_rng(6).uniform(-9, 9, 500), [0, 1, -1, 2, 0.5, -0.5, 1e30]).astype(np.float32)
    out = wp.zeros(len(x), dtype=wp.vec2, device=device)
    wp.launch(_wave, len(x), inputs=[array(x, float, device)], outputs=[out], device=device)
    y = out.numpy()
    np.testing.assert_array_equal(y[-7:, 0], [0, 1, 1, 0, 0.5, 0.5, 0])
    close(y[:-1, 0], np.arccos(np.cos(np.pi * x[:-1].astype(np.float64))) / np.pi, 1e-6)
    phase = np.mod(x[:500], 2.0)
    np.testing.assert_array_equal(y[:500, 1], np.where(phase < 1.0, 1.0, -1.0))
