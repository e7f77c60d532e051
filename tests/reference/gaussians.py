"""3D Gaussians in float64: their sum (eq. 2 to 6), its gradients by autograd, and what reaches what."""

import numpy as np
import torch
from scipy.optimize import lsq_linear

LATENT = 10
SHORTEST = 1e-12


def rotations(q: torch.Tensor) -> torch.Tensor:
    """Rotation matrices [K, 3, 3] of quaternions w x y z of any length [K, 4]; one shorter than 1e-12 doesn't turn."""
    n = q.norm(dim=1, keepdim=True)
    there = n >= SHORTEST
    still = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=q.dtype)
    w, x, y, z = torch.where(there, q / torch.where(there, n, 1.0), still).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


def whitening(rows: torch.Tensor) -> torch.Tensor:
    """W = S^-1 R^T, [K, 3, 3]."""
    return rotations(rows[:, 6:10]).transpose(1, 2) / rows[:, 3:6].exp()[:, :, None]


def gaussian_sum(rows: torch.Tensor, x: torch.Tensor, cut: float, support: str = "ellipsoid") -> torch.Tensor:
    """Eq. 5 over the Gaussians that reach each point.

    Args:
        rows: [K, 10 + L]: centre, log of the scale, quaternion, latent.
        x: [N, 3].
        cut: In standard deviations.
        support: "ellipsoid", or "sphere" (eq. 6). What is reached is a constant to autograd.

    Returns:
        [L, N].
    """
    d = x[:, None] - rows[None, :, :3]
    d2 = torch.einsum("kij,nkj->nki", whitening(rows), d).square().sum(-1)
    if support == "sphere":
        reached = d.detach().norm(dim=-1) < cut * rows[:, 3:6].detach().exp().amax(1)
    else:
        reached = d2.detach() < cut * cut
    return (torch.where(reached, torch.exp(-0.5 * d2), 0.0) @ rows[:, LATENT:]).T


def gradients(rows: np.ndarray, x: np.ndarray, grad_f: np.ndarray, cut: float, support: str = "ellipsoid"):
    """The sum [L, N], and the gradient of sum(f * grad_f) by the rows [K, 10 + L]."""
    leaf = torch.tensor(rows, dtype=torch.float64, requires_grad=True)
    f = gaussian_sum(leaf, torch.tensor(x, dtype=torch.float64), cut, support)
    (f * torch.tensor(grad_f, dtype=torch.float64)).sum().backward()
    return f.detach().numpy(), leaf.grad.numpy()


def reach(rows: np.ndarray, cut: float, support: str = "ellipsoid") -> np.ndarray:
    """Half the size [K, 3] of the box round what each Gaussian reaches."""
    exact = torch.tensor(rows, dtype=torch.float64)
    scale = exact[:, 3:6].exp()
    if support == "sphere":
        return cut * scale.amax(1, keepdim=True).expand(-1, 3).numpy()
    return cut * (rotations(exact[:, 6:10]) * scale[:, None, :]).norm(dim=2).numpy()


def nearest(whiten: np.ndarray, centre: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Least |W (y - centre)| over a box that may be unbounded, by a solver of bounded least squares."""
    found = lsq_linear(whiten, whiten @ centre, bounds=(low, high), method="bvls", tol=1e-14)
    return float(np.linalg.norm(whiten @ (found.x - centre)))


def quantised(values: np.ndarray, low: np.ndarray, high: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Values on the levels of the file (eq. 13 and 14); a channel without a range is its lowest value."""
    span = np.where(high > low, high - low, 1.0)
    code = np.clip(np.floor((values - low) / span * levels + 0.5), 0, levels)
    return np.where(high > low, code * span / levels + low, low)
