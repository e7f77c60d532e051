"""The training step on a GPU's matrix units, in half floats, against the CPU's float32 kernel on the same samples."""

import numpy as np
import pytest
import warp as wp

from kernels.compare import close
from kernels.stepping import Case, Step, Trainer, fused_step, tolerance, trainer
from wlm_kernels.lightmap.matrix_step import WIDTHS

pytestmark = pytest.mark.skipif(not wp.is_cuda_available(), reason="only a GPU has matrix units")


def _pair(case: Case) -> tuple[Trainer, Trainer]:
    """The same fit on both devices."""
    return trainer(case, "cpu"), trainer(case, "cuda:0")


def _steps(pair: tuple[Trainer, Trainer], quantised: bool) -> list[Step]:
    steps = [fused_step(fit, quantised) for fit in pair]
    for fit in pair:
        fit.close()
    return steps


def _hold(pair: tuple[Trainer, Trainer], quantised: bool) -> None:
    expected, found = _steps(pair, quantised)
    close(found.loss, expected.loss, 1e-3, "loss")
    for key, grad in expected.grads.items():
        close(found.grads[key], grad, tolerance(pair[1]), f"gradient of {key}")


@pytest.mark.parametrize("quantised", [False, True], ids=["continuous", "quantised"])
@pytest.mark.parametrize("hidden", WIDTHS)
def test_loss_and_gradients(hidden: int, quantised: bool):
    """Many blocks of samples, every width, both GELUs, a network on levels."""
    gelu = "tanh" if hidden in (16, 64) else "exact"
    settings = {"net_bits": 8 if hidden == 64 else 16}
    case = Case(hidden=hidden, gelu=gelu, samples=2048, emphasis=0.7, settings=settings)
    pair = _pair(case)
    _hold(pair, quantised)


@pytest.mark.parametrize("factor", [1e-3, 1e5])
def test_gradients_beyond_the_range_of_halves(factor: float):
    """Weights of the error over six orders of magnitude from time to time, all times a factor."""
    pair = _pair(Case(hidden=64, samples=1024, emphasis=0.5))
    times = pair[0].batch.weight.shape[1]
    for fit in pair:
        weight = fit.batch.weight.numpy() * factor * np.logspace(-6, 0, times)[None, :, None]
        fit.batch.weight = wp.array(weight.astype(np.float32), dtype=wp.vec3, device=fit.device)
    _hold(pair, False)


def test_each_sample_counts():
    """Samples of little weight move their own texels as exactly as the others do: halves are scaled by sample."""
    pair = _pair(Case(hidden=32, samples=1024, texels=(9000, 9000)))
    for fit in pair:
        weight = fit.batch.weight.numpy()
        weight[:, 1:] *= 1e-5
        fit.batch.weight = wp.array(weight, dtype=wp.vec3, device=fit.device)
    expected, found = _steps(pair, False)
    grad, mine = (step.grads["uv_weights"] for step in (expected, found))
    small = (np.abs(grad) < 1e-3 * np.abs(grad).max()) & (grad != 0)
    assert small.sum() > 500
    # In a sample's own units; cells of tiny gradients lie near the 2^-40 in which sums are held.
    assert np.median(np.abs(mine - grad)[small] / np.abs(grad)[small]) < 5e-3
