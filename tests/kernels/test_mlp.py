"""The MLP as an operation: networks far out, of zeros, the same bits every time, and shapes that there are none of.

`tests/ops/test_operations.py` holds values and gradients to the twin, at all widths that the settings allow.
"""

import numpy as np
import pytest
import torch

from kernels.compare import close, exact
from wlm import ops
from wlm.ops import plain
from wlm_kernels import mlp

INPUTS, NETWORKS, BATCH = 16, 3, 37


def _problem(width: int, inputs: int = INPUTS) -> list[np.ndarray]:
    """Inputs, and the weights and biases of networks whose answers are of the order of 1."""
    random = np.random.default_rng(1)
    hidden = random.normal(0, 1, (NETWORKS, inputs + width + 2, width))
    hidden[:, :inputs] /= inputs**0.5
    hidden[:, inputs + 1 : -1] /= width**0.5
    output = random.normal(0, 1, (NETWORKS, width + 1, 3)) / width**0.5
    x = random.normal(size=(NETWORKS, BATCH, inputs))
    return [values.astype(np.float32) for values in (x, hidden, output)]


def _toward() -> np.ndarray:
    return np.random.default_rng(2).normal(size=(NETWORKS, BATCH, 3)).astype(np.float32)


def _run(device: str, problem: list[np.ndarray], gelu: str = "exact") -> list[torch.Tensor]:
    """y, and the gradients of x, hidden and output."""
    leaves = [torch.tensor(values, device=device, requires_grad=True) for values in problem]
    y = ops.mlp(*leaves, gelu=gelu)
    y.backward(torch.tensor(_toward(), device=device))
    return [y.detach(), *(leaf.grad for leaf in leaves)]


@pytest.mark.parametrize("gelu", mlp.GELUS)
def test_large_inputs(device: str, gelu: str):
    """Far out GELU is 0 or x and its slope 0 or 1: finite, and still the twin's."""
    problem = _problem(16)
    problem[0] = np.where(problem[0] > 0, np.float32(30.0), np.float32(-30.0))
    leaves64 = [exact(values, grad=True) for values in problem]
    y64 = plain.mlp(*leaves64, gelu=gelu)
    y64.backward(exact(_toward()))
    tolerance = 5e-3 if gelu == "fast" and device != "cpu" else 1e-5
    for got, want in zip(_run(device, problem, gelu), [y64, *(leaf.grad for leaf in leaves64)], strict=True):
        close(got, want, tolerance)


def test_zero_weights(device: str):
    """A network of zeros answers 0, moves only its last bias, and divides by nothing."""
    x, hidden, output = _problem(16)
    y, grad_x, grad_w, grad_o = _run(device, [x, np.zeros_like(hidden), np.zeros_like(output)])
    for values in (y, grad_x, grad_w, grad_o[:, :-1]):
        assert not values.any()
    np.testing.assert_allclose(grad_o[:, -1].cpu(), _toward().sum(1), rtol=1e-4, atol=1e-4)


def test_gradients_repeat(device: str):
    """Sums run in a fixed order: the same gradients, bit for bit."""
    first, second = (_run(device, _problem(16)) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert torch.equal(a, b)


def test_shapes_are_checked():
    """A size below 1 or an unknown GELU is an error, and a shape is built once."""
    assert mlp.parameter_count(16, 16) == 16 * 16 + 16 + 16 * 16 + 16 + 16 * 3 + 3
    assert mlp.kernels(16, 8) is mlp.kernels(16, 8)
    for wrong in ((0, 8, "exact"), (4, 0, "exact"), (4, 8, "relu"), (4, 8, "exact", 0)):
        with pytest.raises(ValueError, match="MLP: expected sizes above 0 and GELU"):
            mlp.kernels(*wrong)
