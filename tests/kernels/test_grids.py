"""Planes and volumes: sampling with a clamped or a periodic time axis, and its adjoint."""

import numpy as np
import pytest
import torch
import warp as wp
from reference import grids as reference

from kernels.compare import array, close, exact
from wlm_kernels import interpolate

# Each axis is one cell long in one of them.
PLANES = [(2, 5, 7, 3), (1, 1, 6, 2), (3, 4, 1, 1), (1, 1, 1, 5)]  # S, T, W, C
VOLUMES = [
    (2, 4, 5, 6, 3),
    (1, 1, 3, 4, 2),
    (2, 3, 1, 5, 1),
    (1, 2, 4, 1, 2),
    (1, 1, 1, 1, 4),
]  # S, T, H, W, C


def _problem(shape: tuple[int, ...], count: int = 160) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random values, slices and points; the first points take every mix of 0, 1 and a cell border."""
    random = np.random.default_rng(sum(shape))
    axes = len(shape) - 2
    points = random.uniform(0.0, 1.0, (count, axes)).astype(np.float32)
    corners = np.stack(np.meshgrid(*[[0.0, 1.0, 1.0 / shape[1]]] * axes), -1).reshape(-1, axes)
    points[: len(corners)] = corners
    slices = random.integers(0, shape[0], count).astype(np.int32)
    return random.normal(size=shape).astype(np.float32), slices, points


def _run(values: wp.array, times: int, slices: wp.array, points: wp.array, periodic: bool) -> wp.array:
    """Samples a plane (points of 2) or a volume (of 3, its first two axes joined)."""
    out = wp.zeros((len(points), values.shape[-1]), dtype=float, device=values.device, requires_grad=True)
    if points.dtype == wp.vec2:
        interpolate.sample_plane(values, slices, points, out, periodic)
    else:
        interpolate.sample_volume(values, times, slices, points, out, periodic)
    return out


def _joined(values: np.ndarray) -> np.ndarray:
    return values if values.ndim == 4 else values.reshape(-1, *values.shape[2:])


@pytest.mark.parametrize("periodic", [False, True], ids=["clamped", "periodic"])
@pytest.mark.parametrize("shape", PLANES + VOLUMES, ids=lambda s: "x".join(map(str, s)))
def test_against_reference(device: str, shape: tuple[int, ...], periodic: bool):
    """Values and gradients against grid_sample in float64, and central differences, exact for a linear function."""
    values, slices, points = _problem(shape)
    vec = wp.vec2 if points.shape[1] == 2 else wp.vec3
    on_device = array(_joined(values), float, device, grad=True)
    where = (array(slices, int, device), array(points, vec, device))
    with wp.Tape() as tape:
        out = _run(on_device, shape[1], *where, periodic)
    values64 = exact(values, grad=True)
    sample = reference.plane if points.shape[1] == 2 else reference.volume
    out64 = sample(values64, torch.tensor(slices), exact(points), periodic)
    close(out, out64, 1e-5, "value")

    toward = np.random.default_rng(1).normal(size=tuple(out64.shape)).astype(np.float32)
    tape.backward(grads={out: array(toward, float, device)})
    out64.backward(exact(toward))
    gradient = on_device.grad.numpy().reshape(shape)
    close(gradient, values64.grad, 1e-5, "gradient")

    step = np.random.default_rng(2).normal(size=shape).astype(np.float32)
    ends = [
        _run(array(_joined(values + sign * step), float, device), shape[1], *where, periodic).numpy()
        for sign in (np.float32(-1), np.float32(1))
    ]
    slope = 0.5 * ((ends[1].astype(np.float64) - ends[0]) * toward).sum()
    size = float(np.abs(gradient * step).sum())
    assert slope == pytest.approx(float((gradient.astype(np.float64) * step).sum()), abs=1e-5 * size)


@pytest.mark.parametrize("axes", [2, 3])
def test_ends_of_time(device: str, axes: int):
    """At t = 0 and 1 a clamped axis gives its first and last slice, a periodic one the mean of both."""
    shape = (1, 4, 3, 2) if axes == 2 else (1, 4, 3, 3, 2)
    values = np.broadcast_to(
        np.arange(4, dtype=np.float32).reshape(1, 4, *[1] * (len(shape) - 2)), shape
    ).copy()
    points = np.full((2, axes), 0.3, np.float32)
    points[:, -1] = [0.0, 1.0]
    vec = wp.vec2 if axes == 2 else wp.vec3
    where = (array(np.zeros(2, np.int32), int, device), array(points, vec, device))
    on_device = array(_joined(values), float, device)
    clamped = _run(on_device, 4, *where, False).numpy()
    np.testing.assert_allclose(clamped, [[0, 0], [3, 3]], atol=1e-6)
    np.testing.assert_allclose(_run(on_device, 4, *where, True).numpy(), 1.5, atol=1e-6)
