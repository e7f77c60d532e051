"""The Gaussians' sum and its gradients, against autograd in float64 and by differences."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
import warp as wp
from reference import gaussians as reference

from benchmarks import plain
from kernels.compare import array, close
from wlm_kernels.probe import cubes as probe_cubes
from wlm_kernels.probe import gaussian_sum
from wlm_kernels.probe.gaussian_sum import SUPPORTS

TOLERANCE = 2e-5  # of a group's largest gradient; float32 gives 6e-6 where a needle is 30 times as long as wide
CUT = 3.0
GROUPS = {"centre": slice(0, 3), "scale": slice(3, 6), "rotation": slice(6, 10), "latent": slice(10, None)}
CORNERS = ([0.0, 0.0, 0.0], [1.0, 1.0, 1.0])


@dataclass
class Problem:
    """Rows [K, 10 + L], points [N, 3] and the gradient of the sum at them [L, N]."""

    rows: np.ndarray
    x: np.ndarray
    grad_f: np.ndarray


def _points_within(row: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """Points where a Gaussian is large, whatever its shape."""
    turn = plain.rotations(torch.tensor(row[None, 6:10], dtype=torch.float64))[0].numpy()
    return row[:3] + (random.normal(size=(count, 3)) * np.exp(row[3:6].astype(np.float64))) @ turn.T


def _problem(latent: int, anisotropy: float, gaussians: int = 24, points: int = 200, longest: float = 0.3) -> Problem:
    """Gaussians of one anisotropy, points anywhere, points on the centres and points within the Gaussians."""
    random = np.random.default_rng(int(anisotropy) + latent)
    rows = random.normal(size=(gaussians, 10 + latent)).astype(np.float32)
    rows[:, :3] = random.random((gaussians, 3))
    rows[:, 3:6] = np.log(longest) - np.log(anisotropy) * np.array([1.0, 0.0, 0.5])
    # A needle's own points are all that see its short axes.
    within = [_points_within(row, 6, random) for row in rows]
    x = np.concatenate([random.random((points, 3)), rows[:, :3], *within]).astype(np.float32)
    return Problem(rows, x, random.normal(size=(latent, len(x))).astype(np.float32))


class Sums:
    """A problem on a device, with or without lists of Gaussians by cube."""

    def __init__(self, problem: Problem, device: str, support: str = "ellipsoid", lists: bool = False, cut=CUT):
        self.support, self.cut = support, cut
        self.rows = array(problem.rows, float, device)
        self.x = array(problem.x, wp.vec3, device)
        self.grad_f = array(problem.grad_f, float, device)
        self.shapes = gaussian_sum.shapes(self.rows, cut, support)
        self.cubes = probe_cubes.build(self.shapes, *CORNERS) if lists else None

    def forward(self) -> np.ndarray:
        f = wp.full(self.grad_f.shape, np.nan, dtype=float, device=self.rows.device)
        gaussian_sum.sum(self.rows, self.shapes, self.cubes, self.x, f, self.cut)
        return f.numpy()

    def backward(self) -> np.ndarray:
        grad = wp.full(self.rows.shape, np.nan, dtype=float, device=self.rows.device)
        gaussian_sum.backward(self.rows, self.shapes, self.cubes, self.x, self.grad_f, grad, self.cut)
        return grad.numpy()


def _in_own_size(grad: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Gradients in a Gaussian's own units, or those of a small one, or of a short quaternion, would hide all others.

    A centre is measured in the shortest scale, a quaternion in its length.
    """
    grad, rows = np.array(grad, np.float64), rows.astype(np.float64)
    grad[:, :3] *= np.exp(rows[:, 3:6].min(1, keepdims=True))
    length = np.linalg.norm(rows[:, 6:10], axis=1, keepdims=True)
    grad[:, 6:10] *= np.where(length > 0, length, 1.0)
    return grad


def _hold(got: np.ndarray, want: np.ndarray, rows: np.ndarray, turns: bool = True, name: str = "") -> None:
    """Compares gradients by group; `turns`: whether any Gaussian feels a turn."""
    got, want = _in_own_size(got, rows), _in_own_size(want, rows)
    for group, part in GROUPS.items():
        if group == "rotation" and not turns:
            # The exact gradient is 0: what rounding leaves is small beside the sums that it is made of.
            assert np.abs(got[:, part]).max() <= TOLERANCE * np.abs(want[:, GROUPS["scale"]]).max(), name
        else:
            assert np.abs(want[:, part]).max() > 0, group
            close(got[:, part], want[:, part], TOLERANCE, f"{name}: gradient of {group}")


def _hold_all(problem: Problem, device: str, support: str = "ellipsoid", turns: bool = True) -> None:
    want_f, want = reference.gradients(problem.rows, problem.x, problem.grad_f, CUT, support)
    alone = None
    for lists in (False, True):
        sums = Sums(problem, device, support, lists)
        f = sums.forward()
        close(f, want_f, 1e-5, f"lists {lists}: sum")
        # A list leaves out what doesn't count, and keeps the order of what does.
        alone = f if alone is None else alone
        np.testing.assert_array_equal(f, alone)
        _hold(sums.backward(), want, problem.rows, turns, f"lists {lists}")


@pytest.mark.parametrize("support", SUPPORTS)
@pytest.mark.parametrize("anisotropy", [1.0, 30.0, 1000.0])
def test_against_autograd(device: str, anisotropy: float, support: str):
    """Sum and gradients, with every kind of list and with none."""
    _hold_all(_problem(9, anisotropy), device, support, turns=anisotropy > 1)


def test_hard_gaussians(device: str):
    """No rotation stored, collapsed, flat, as large as all, and far off, among ordinary ones."""
    problem = _problem(9, 8.0)
    rows, random = problem.rows, np.random.default_rng(6)
    rows[0, 6:10] = 0.0
    rows[1, 6:10] = [0.0, 3e-13, 0.0, 0.0]  # too short for a direction
    rows[2, 6:10] *= 1e6
    rows[3, 3:6] = np.log(1e-4)
    rows[4, 3:6] = np.log(4.0)
    rows[5, 3:6] = np.log([4.0, 1e-4, 4.0])
    rows[6, :3] = 50.0
    points = [_points_within(row, 8, random) for row in rows[:6]]
    x = np.concatenate([problem.x, rows[:7, :3], *points]).astype(np.float32)
    problem = Problem(rows, x, random.normal(size=(9, len(x))).astype(np.float32))
    _hold_all(problem, device)
    grad = Sums(problem, device).backward()
    assert not grad[:2, 6:10].any(), "no rotation, no gradient"
    assert grad[:2, :6].all()


def test_one_gaussian_and_one_point(device: str):
    """On the centre only the latent has a gradient; 1.5 standard deviations off all have."""
    rows = np.array([[0.5, 0.5, 0.5, -2, -1, -3, 1, 2, 3, 4, 2.0]], np.float32)
    x = rows[:, :3].copy()
    problem = Problem(rows, x, np.full((1, 1), 3.0, np.float32))
    for grad in (Sums(problem, device).backward(), Sums(problem, device, lists=True).backward()):
        np.testing.assert_array_equal(grad, [[0.0] * 10 + [3.0]])
    assert Sums(problem, device).forward() == 2.0
    problem.x = (x + np.array([0.1, 0.05, -0.06])).astype(np.float32)
    _hold_all(problem, device)


def test_not_a_number(device: str):
    """A point that is NaN gets 0 and gives nothing; a Gaussian that is NaN adds nothing to any point."""
    problem = _problem(1, 8.0)
    want, want_grad = Sums(problem, device).forward(), Sums(problem, device).backward()
    x, rows = np.insert(problem.x, 7, np.nan, axis=0), np.insert(problem.rows, 7, np.nan, axis=0)
    grad_f = np.insert(problem.grad_f, 7, 1.0, axis=1)
    for lists in (False, True):
        sums = Sums(Problem(rows, x, grad_f), device, lists=lists)
        f, grad = sums.forward(), sums.backward()
        assert f[0, 7] == 0.0
        np.testing.assert_array_equal(np.delete(f, 7, 1), want)
        _hold(np.delete(grad, 7, 0), want_grad, problem.rows)
