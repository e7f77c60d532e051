"""The MLP as an operation: networks far out, of zeros, the same bits every time, and shapes that there are none of.

`tests/ops/test_operations.py` holds values and gradients to the twin, at all widths that the settings allow.
"""

import numpy as np
import pytest
import torch

from benchmarks import plain
from kernels.compare import close, exact
from wlm import ops

NETWORKS, BATCH = 3, 37
# Inputs, units and outputs; the cases of the operation have them too.
SIZES = {"exact": (16, 16, 3), "tanh": (5, 16, 4), "fast": (5, 17, 1)}


def _problem(inputs: int = 16, width: int = 16, outputs: int = 3) -> list[np.ndarray]:
    """Inputs, and the weights and biases of networks whose answers are of the order of 1."""
    random = np.random.default_rng(1)
    hidden = random.normal(0, 1, (NETWORKS, inputs + width + 2, width))
    hidden[:, :inputs] /= inputs**0.5
    hidden[:, inputs + 1 : -1] /= width**0.5
    output = random.normal(0, 1, (NETWORKS, width + 1, outputs)) / width**0.5
    x = random.normal(size=(NETWORKS, BATCH, inputs))
    return [values.astype(np.float32) for values in (x, hidden, output)]


def _toward(outputs: int = 3) -> np.ndarray:
    return np.random.default_rng(2).normal(size=(NETWORKS, BATCH, outputs)).astype(np.float32)


def _run(device: str, problem: list[np.ndarray], gelu: str = "exact") -> list[torch.Tensor]:
    """y, and the gradients of x, hidden and output."""
    leaves = [torch.tensor(values, device=device, requires_grad=True) for values in problem]
    y = ops.mlp(*leaves, gelu=gelu)
    y.backward(torch.tensor(_toward(y.shape[-1]), device=device))
    return [y.detach(), *(leaf.grad for leaf in leaves)]


@pytest.mark.parametrize("gelu", SIZES)
def test_large_inputs(device: str, gelu: str):
    """Far out GELU is 0 or x and its slope 0 or 1: finite, and still the twin's."""
    problem = _problem(*SIZES[gelu])
    problem[0] = np.where(problem[0] > 0, np.float32(30.0), np.float32(-30.0))
    leaves64 = [exact(values, grad=True) for values in problem]
    y64 = plain.mlp(*leaves64, gelu=gelu)
    y64.backward(exact(_toward(y64.shape[-1])))
    tolerance = 5e-3 if gelu == "fast" and device != "cpu" else 1e-5
    for got, want in zip(_run(device, problem, gelu), [y64, *(leaf.grad for leaf in leaves64)], strict=True):
        close(got, want, tolerance)


def test_zero_weights(device: str):
    """A network of zeros answers 0, moves only its last bias, and divides by nothing."""
    x, hidden, output = _problem()
    y, grad_x, grad_w, grad_o = _run(device, [x, np.zeros_like(hidden), np.zeros_like(output)])
    for values in (y, grad_x, grad_w, grad_o[:, :-1]):
        assert not values.any()
    np.testing.assert_allclose(grad_o[:, -1].cpu(), _toward().sum(1), rtol=1e-4, atol=1e-4)


def test_gradients_repeat(device: str):
    """Sums run in a fixed order: the same gradients, bit for bit."""
    first, second = (_run(device, _problem()) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert torch.equal(a, b)
