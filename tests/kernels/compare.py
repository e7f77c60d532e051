"""Comparing arrays of a device with float64 references."""

import numpy as np
import torch
import warp as wp


def array(values: np.ndarray, dtype, device: str, grad: bool = False) -> wp.array:
    """Puts values on a device; `dtype` is the Warp type of an element."""
    return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device, requires_grad=grad)


def half_array(values: torch.Tensor, half: bool, device: str) -> wp.array:
    """Puts a tensor on a device, in half or single floats."""
    return wp.array(values.numpy(), dtype=wp.float16 if half else float, device=device)


def noise(half: bool, *shape: int) -> torch.Tensor:
    """Normal random float32 values; with `half`, values that half floats hold."""
    values = torch.randn(*shape, generator=torch.Generator().manual_seed(sum(shape)))
    return values.half().float() if half else values


def exact(values: np.ndarray, grad: bool = False) -> torch.Tensor:
    """The same values for the reference, which runs on the CPU."""
    return torch.tensor(np.asarray(values), dtype=torch.float64, requires_grad=grad)


def error(got, want) -> float:
    """The largest difference, relative to the largest value wanted (NaN counts as infinite)."""
    got, want = _numpy(got), _numpy(want)
    assert got.shape == want.shape, f"{got.shape} and {want.shape}"
    if not np.isfinite(got).all():
        return float("inf")
    scale = np.abs(want).max(initial=0.0)
    return float(np.abs(got - want).max(initial=0.0) / (scale if scale > 0 else 1.0))


def close(got, want, tolerance: float = 1e-4, name: str = "values") -> None:
    """Asserts that `error` is within a tolerance."""
    found = error(got, want)
    assert found <= tolerance, f"{name}: error {found:.3g} of the largest value, allowed {tolerance:.3g}"


def _numpy(values) -> np.ndarray:
    if isinstance(values, torch.Tensor):
        return values.detach().cpu().double().numpy()
    if isinstance(values, wp.array):
        values = values.numpy()
    return np.asarray(values, np.float64)
