"""Operations under torch.compile, against plain calls: values and gradients, of every operation."""

import shutil

import numpy as np
import pytest
import torch
from builders.operation_subjects import WITHOUT, Subject, subjects

from wlm import ops

# Torch does not quote the paths that it gives to the compiler.
_SKIPPED = pytest.mark.skipif(
    shutil.which("g++") is None or " " in torch.__file__, reason="inductor needs g++ and a path without spaces"
)
BACKENDS = ["aot_eager", pytest.param("inductor", marks=[pytest.mark.slow, _SKIPPED])]


def _results(subject: Subject, backend: str) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Values, and gradients of a sum of squares, in which the compiler has work before and after the operation."""
    leaves = {name: torch.tensor(values).requires_grad_() for name, values in subject.leaves.items()}
    constants = {name: torch.tensor(values) for name, values in subject.constants.items()}

    def work(**leaves: torch.Tensor) -> list[torch.Tensor]:
        values = subject.run(**{name: 1.0 * leaf for name, leaf in leaves.items()}, **constants)
        return [0.5 * value.square() for value in values]

    torch._dynamo.reset()
    values = (torch.compile(work, backend=backend) if backend else work)(**leaves)
    grads = torch.autograd.grad(sum(value.sum() for value in values), list(leaves.values()))
    return [value.detach() for value in values], list(grads)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", [name for name in ops.__all__ if name not in WITHOUT])
def test_every_operation(name: str, backend: str):
    subject = subjects(name)[0]
    for found, expected in zip(_results(subject, backend), _results(subject, ""), strict=True):
        for one, other in zip(found, expected, strict=True):
            assert np.allclose(one, other, rtol=1e-6, atol=1e-7)


def _picture(corners: torch.Tensor, attribute: torch.Tensor) -> torch.Tensor:
    triangle = torch.tensor([[0, 1, 2]])
    return ops.interpolate(attribute, triangle, ops.rasterize(corners, triangle, 8, 8)).square().sum()


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_picture(backend: str):
    """One operation after another, with nothing between."""
    corners = torch.tensor([[-1.0, -1, 0, 1], [1, -1, 0, 1], [1, 1, 0, 1]], requires_grad=True)
    attribute = torch.rand(3, 2, requires_grad=True)
    torch._dynamo.reset()
    found, expected = torch.compile(_picture, backend=backend)(corners, attribute), _picture(corners, attribute)
    assert expected > 1.0 and torch.allclose(found, expected)
    for pair in zip(*(torch.autograd.grad(each, (corners, attribute)) for each in (found, expected)), strict=True):
        assert torch.allclose(*pair)
