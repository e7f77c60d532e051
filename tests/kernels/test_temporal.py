"""The fused training step: samples, loss and all gradients, against the whole model in float64."""

import numpy as np
import pytest

from kernels.compare import close
from kernels.stepping import TILE, Case, Problem, Trainer, draw, drawn_noise, fused_step, problem, tolerance, trainer
from wlm_kernels.lightmap import matrix_step

# One width in the quick run, since each compiles kernels of its own. Matrix units of a GPU have no odd ones.
WIDTHS = [pytest.param(width, marks=[] if width == 16 else pytest.mark.slow) for width in (16, 17, 32, 64)]


def _trainer(case: Case, device: str) -> Trainer:
    if device != "cpu" and case.hidden not in matrix_step.WIDTHS:
        pytest.skip("a GPU fits no such networks")
    return trainer(case, device)


# Each axis and shape at its least, and both ends of a clamped time axis.
VARIANTS = {
    "periodic": {"periodic": True},
    "clamped-weighted": {"periodic": False, "emphasis": 1.2},
    "one-cell": {"shape": (4, 1, 1, 1), "emphasis": -0.5},
    "three-texels": {"emphasis": 0.7, "texels": (5000, 3)},
}


def _hold(fit: Trainer, twin: Problem) -> None:
    """Holds that the coming step is the reference's, and closes the trainer."""
    expected = twin.step()
    fused = fused_step(fit, twin.quantised)
    close(fused.loss, expected.loss, tolerance(fit), "loss")
    assert fused.grads.keys() == expected.grads.keys()
    for key, grad in expected.grads.items():
        close(fused.grads[key], grad, tolerance(fit), f"gradient of {key}")
        # A gradient that is 0 everywhere would hold anything: one slice or cell moves nothing only by design.
        assert grad.any()
    fit.close()


@pytest.mark.parametrize("quantised", [False, True], ids=["continuous", "quantised"])
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("hidden", WIDTHS)
def test_a_step(device: str, hidden: int, variant: str, quantised: bool):
    """Loss, maps and network, against autograd; also of a tile with three valid texels."""
    case = Case(hidden=hidden, **VARIANTS[variant])
    fit = _trainer(case, device)
    twin = problem(fit, case, quantised)
    _, features = draw(fit, quantised)
    close(features, twin.features(), 2e-6, "features")
    _hold(fit, twin)


@pytest.mark.slow
def test_exact_step(device: str):
    """The exact GELU, which costs a fit more."""
    case = Case(gelu="exact", emphasis=1.0)
    fit = trainer(case, device)
    _hold(fit, problem(fit, case, False))


def test_later_steps(device: str):
    """Five steps on, with sums cleared and parameters moved, a step is still the reference's."""
    case = Case()
    fit = trainer(case, device)
    for _ in range(5):
        fused_step(fit, False)
    _hold(fit, problem(fit, case, False))


def test_draws_are_valid_and_even(device: str):
    """Only valid texels, all of them in turn, all times alike; other samples at the next step."""
    case = Case(samples=4096, texels=(20, 3))
    fit = trainer(case, device)
    place, _ = draw(fit, False)
    fused_step(fit, False)
    later, _ = draw(fit, False)
    assert (place != later).any()
    targets = case.targets()
    for i, count in enumerate(case.texels):
        drawn, times = np.unique(place[i, :, 0] * TILE + place[i, :, 1], return_counts=True)
        np.testing.assert_array_equal(drawn, targets.texels[i, :count])
        # Five standard deviations of an even draw.
        share = 1 / count
        assert np.abs(times / 4096 - share).max() < 5 * (share * (1 - share) / 4096) ** 0.5
        _, hours = np.unique(place[i, :, 2], return_counts=True)
        assert len(hours) == 5 and np.abs(hours / 4096 - 0.2).max() < 5 * (0.16 / 4096) ** 0.5
    fit.close()


def test_noise_is_one_step_of_8_bits(device: str):
    """Eq. 6: uniform in +-1/512 on each map feature, independent; none on exact levels and on the time."""
    fit = trainer(Case(samples=4096), device)
    noise = drawn_noise(fit, False)[..., :12].reshape(-1, 12) / 12**0.5
    assert 0.99 / 512 < np.abs(noise).max() <= 1.001 / 512
    assert np.abs(noise.mean(0)).max() < 5 / 256 / (12 * len(noise)) ** 0.5
    np.testing.assert_allclose(noise.std(0), 1 / 256 / 12**0.5, rtol=0.05)
    correlation = np.corrcoef(noise.T) - np.eye(12)
    assert np.abs(correlation).max() < 6 / len(noise) ** 0.5
    fit.close()


def test_tile_is_the_same_alone_and_in_a_batch(device: str):
    """A tile's samples, loss and gradients do not depend on its neighbours in a batch."""
    numbers, texels = (2, 7, 30), (900, TILE * TILE, 40)
    batch = trainer(Case(numbers=numbers, texels=texels), device, spread=False)
    together = fused_step(batch, False)
    batch.close()
    for i, number in enumerate(numbers):
        fit = trainer(Case(numbers=(number,), texels=(texels[i],)), device, spread=False)
        alone = fused_step(fit, False)
        fit.close()
        np.testing.assert_array_equal(together.loss[i : i + 1], alone.loss)
        for key, grad in alone.grads.items():
            part = together.grads[key].reshape(3, -1)[i]
            np.testing.assert_array_equal(part, grad.ravel(), err_msg=key)


def test_two_lanes_equal_one():
    """On the CPU two threads sum halves of the samples in buffers of their own; one lane gives the same sum."""
    case = Case()
    single, double = (trainer(case, "cpu") for _ in range(2))
    lanes = fused_step(double, False)
    sums = acc, partial, partial_out, loss = single._launch_sums
    networks = single._nets[0]
    single._kernels.launch(single._maps[0], *networks, single.batch, case.samples, *sums, 0, case.samples)
    flat = np.concatenate([grad.ravel() for key, grad in lanes.grads.items() if key in single.views])
    assert not acc.numpy()[1].any()
    close(flat, acc.numpy()[0], 1e-6, "maps")
    close(lanes.grads["hidden"], partial.numpy()[0], 1e-6, "hidden")
    close(lanes.grads["output"], partial_out.numpy()[0], 1e-6, "output")
    close(lanes.loss, loss.numpy()[0], 1e-5, "loss")
    single.close()
    double.close()
