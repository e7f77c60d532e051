"""3D Gaussians in float64: gradients by autograd, and what reaches what; the sum is `benchmarks.plain`'s."""

import numpy as np
import torch
from scipy.optimize import lsq_linear

from benchmarks import plain


def gradients(rows: np.ndarray, x: np.ndarray, grad_f: np.ndarray, cut: float, support: str = "ellipsoid"):
    """The sum [L, N], and the gradient of sum(f * grad_f) by the rows [K, 10 + L]."""
    leaf = torch.tensor(rows, dtype=torch.float64, requires_grad=True)
    f = plain.gaussian_sum(leaf, torch.tensor(x, dtype=torch.float64), cut=cut, support=support).T
    (f * torch.tensor(grad_f, dtype=torch.float64)).sum().backward()
    return f.detach().numpy(), leaf.grad.numpy()


def reach(rows: np.ndarray, cut: float, support: str = "ellipsoid") -> np.ndarray:
    """Half the size [K, 3] of the box round what each Gaussian reaches."""
    exact = torch.tensor(rows, dtype=torch.float64)
    scale = exact[:, 3:6].exp()
    if support == "sphere":
        return cut * scale.amax(1, keepdim=True).expand(-1, 3).numpy()
    return cut * (plain.rotations(exact[:, 6:10]) * scale[:, None, :]).norm(dim=2).numpy()


def nearest(whiten: np.ndarray, centre: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Least |W (y - centre)| over a box that may be unbounded, by a solver of bounded least squares."""
    found = lsq_linear(whiten, whiten @ centre, bounds=(low, high), method="bvls", tol=1e-14)
    return float(np.linalg.norm(whiten @ (found.x - centre)))


def quantised(values: np.ndarray, low: np.ndarray, high: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Values on the levels of the file (eq. 13 and 14); a channel without a range is its lowest value."""
    span = np.where(high > low, high - low, 1.0)
    code = np.clip(np.floor((values - low) / span * levels + 0.5), 0, levels)
    return np.where(high > low, code * span / levels + low, low)
