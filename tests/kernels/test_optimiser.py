"""What follows a step: gathered sums, clamped maps, the rates' schedule, Adam over pieces, and repetition."""

import math

import numpy as np
import pytest
import torch
import warp as wp
from reference.levels import put_on_levels

from kernels.compare import array, close
from kernels.stepping import Case, fused_step, trainer
from wlm_kernels.lightmap import features, gather, levels
from wlm_kernels.lightmap.features import INPUTS

RATES = {"map_rate": 0.02, "net_rate": 0.005, "final_rate": 0.1}


def _share(step: int, steps: int, final: float) -> float:
    """Half a cosine from 1 at the first step to `final` at the last."""
    return final + (1.0 - final) * 0.5 * (1.0 + math.cos(math.pi * step / (steps - 1)))


def test_gather_clears_clamps_and_counts(device: str):
    """After a step the sums are 0, maps that the optimiser moved are within [0, 1], and the step is counted."""
    fit = trainer(Case(settings=RATES | {"steps": 12}), device)
    for step in range(14):
        assert fit.step == step
        before = fit.maps.clone()
        grads = fused_step(fit, False).grads
        share = _share(min(step, 11), 12, 0.1)  # beyond the last step its rate stays
        want = [0.02 * share, 0.005 * share]
        np.testing.assert_allclose(fit._rates[:2].cpu().numpy(), want, rtol=1e-5, err_msg=f"step {step}")
        # Adam moves a value by hardly more than its rate.
        assert float((fit.maps - before).abs().max()) < 0.02 * share * 4.0
        assert float(fit.maps.min()) == 0.0 and float(fit.maps.max()) == 1.0
        if step == 0:
            for key, view in fit.views.items():
                at = before.storage_offset() + view.storage_offset()
                start = before[at : at + view.numel()].view(view.shape).cpu().numpy()
                still = grads[key] == 0
                np.testing.assert_array_equal(view.cpu().numpy()[still], start[still])
        assert not fit._acc.cpu().numpy().any()
        if device == "cpu":
            assert not fit._partial.any() and not fit._partial_out.any() and not fit._loss_parts.any()
    fit.close()


def test_adam_is_torchs(device: str):
    """Twenty steps against torch's Adam in float64, fed with the same gradients."""
    settings = RATES | {"steps": 20}
    fit = trainer(Case(settings=settings, samples=1024), device)
    named = [fit.maps, fit.hidden, fit.output]
    whole = [value.cpu().double().clone().requires_grad_() for value in named]
    groups = [{"params": whole[:1], "lr": 1.0}, {"params": whole[1:], "lr": 1.0}]
    adam = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-8)
    for step in range(20):
        grads = fused_step(fit, step >= 10).grads
        maps = np.concatenate([grads[key].ravel() for key in fit.views])
        share = _share(step, 20, 0.1)
        for group, rate in zip(adam.param_groups, (0.02, 0.005), strict=True):
            group["lr"] = rate * share
        for value, grad in zip(whole, (maps, grads["hidden"], grads["output"]), strict=True):
            value.grad = torch.from_numpy(grad).double()
        adam.step()
        with torch.no_grad():
            whole[0].clamp_(0.0, 1.0)
    for name, value, mine in zip(("maps", "hidden", "output"), whole, named, strict=True):
        close(mine, value, 2e-5, name)
    fit.close()


def _turn(hidden: np.ndarray, rate: float) -> np.ndarray:
    """Moves of hidden layers [18 + H, H] by Muon, from their momentum; none of biases."""
    moved, width = np.zeros(hidden.shape), hidden.shape[1]
    for layer in (slice(INPUTS), slice(INPUTS + 1, INPUTS + 1 + width)):
        x = hidden[layer].astype(np.float64)
        x /= max(np.linalg.norm(x), 1e-300)
        for _ in range(5):
            gram = x @ x.T
            x = 3.4445 * x + (-4.775 * gram + 2.0315 * gram @ gram) @ x
        moved[layer] = -rate * 0.2 * max(x.shape) ** 0.5 * x
    return moved


@pytest.mark.parametrize("hidden", [5, 16, 48, 64])
def test_muon_moves_layers_along_their_orthogonal_momentum(device: str, hidden: int):
    """Of singular values over three decades, of rank 1 and 0; in a fit, where biases move with Adam."""
    if device != "cpu" and hidden % 16:
        pytest.skip("a GPU has no network of this width")
    random = np.random.default_rng(hidden)
    momentum = random.normal(size=(3, INPUTS + 2 + hidden, hidden)) * 10.0 ** random.uniform(-10, -7, hidden)
    momentum[1] = np.outer(momentum[1, :, 0], momentum[1, 0]) * 1e7
    momentum[2] = 0.0
    start = random.normal(size=momentum.shape).astype(np.float32)
    weights = array(start.ravel(), float, device)
    rates = array(np.array([[7.0, 0.5, 7.0, 7.0]], np.float32), wp.vec4, device)
    gather.turn(hidden, rates, array(momentum.astype(np.float32).ravel(), float, device), weights)
    want = np.stack([_turn(each, 0.5) for each in momentum.astype(np.float32)])
    # A GPU's operands are half floats, whose errors in directions without momentum the iteration multiplies by 480.
    moved = weights.numpy().reshape(start.shape) - start
    np.testing.assert_allclose(moved, want, atol=2e-5 if device == "cpu" else 0.03)
    fit = trainer(Case(hidden=hidden, settings={"muon": True, "net_rate": 0.01}), device)
    start = fit.hidden.cpu().numpy().copy()
    grads = fused_step(fit, False).grads["hidden"]
    want, biases = np.stack([_turn(each, 0.01) for each in grads]), np.s_[:, [INPUTS, INPUTS + 1 + hidden]]
    want[biases] = -0.01 * grads[biases] / (np.abs(grads[biases]) + 1e-8)
    np.testing.assert_allclose(fit.hidden.cpu().numpy() - start, want, atol=1e-6 if device == "cpu" else 6e-4)
    fit.close()


def test_integer_sums_are_those_of_floats(device: str):
    """A GPU's sums of the maps, in steps of 2^-40, wherever they are updated."""
    random, results = np.random.default_rng(0), []
    values, sums = random.uniform(-0.2, 1.2, 48).astype(np.float32), random.normal(size=48).astype(np.float32)
    rates, control = array(np.array([[0.02, 0.01, 10.0, 10.0]], np.float32), wp.vec4, device), array([0], int, device)
    none = [wp.zeros((1, 0), dtype=float, device=device), gather.Adam(), wp.zeros(0, dtype=float, device=device)]
    for scalar, stored in ((float, sums), (wp.int64, np.round(sums * 2.0**40).astype(np.int64))):
        adam, maps, acc = gather.Adam(), features.Maps(), array(stored[None], scalar, device)
        maps.values = array(values, float, device)
        adam.decay, adam.epsilon = wp.vec2(0.9, 0.99), 1e-8
        adam.first, adam.second = (array(np.zeros_like(values), float, device) for _ in range(2))
        gather.update(rates, acc, adam, maps, *none, *none, none[0], none[2], control, maps.values, clear=True)
        results.append([maps.values.numpy(), adam.first.numpy(), adam.second.numpy()])
        assert not acc.numpy().any()
    for floats, integers in zip(*results, strict=True):
        np.testing.assert_allclose(integers, floats, rtol=1e-6)
    assert control.numpy()[0] == 2


@pytest.mark.parametrize("factor", [1.0, 1e-6, 1e3])
def test_levels_are_torchs(device: str, factor: float):
    """Networks on 8-bit levels, bit for bit; a unit without weights, and biases as they are."""
    random = np.random.default_rng(1)
    hidden = (random.normal(size=(3, 4 + 17 + 2, 17)) * factor).astype(np.float32)
    output = (random.normal(size=(3, 18, 3)) * factor).astype(np.float32)
    hidden[1, :4, 5] = 0.0
    nets = [array(values, float, device) for values in (hidden, output)]
    made = [wp.empty_like(values) for values in nets]
    levels.put_on_levels(*nets, *made)
    for got, want in zip(made, put_on_levels(torch.tensor(hidden), torch.tensor(output), 4), strict=True):
        np.testing.assert_array_equal(got.numpy(), want.numpy())


def test_stages_and_repetition(device: str):
    """One seed gives one result, bit for bit, through all three stages; another seed another."""
    settings = {"steps": 20, "quantise_from": 0.4, "freeze_from": 0.8}

    def fit(seed: int) -> list[dict[str, np.ndarray]]:
        run = trainer(Case(settings=settings), device, seed, spread=False)
        states = []
        for steps in (16, 4):  # frozen from step 16 on
            run.run(steps)
            states.append({key: value.copy() for key, value in run.state().items()})
        run.close()
        return states

    first, second, other = fit(3), fit(3), fit(4)
    for a, b in zip(first, second, strict=True):
        for key in a:
            np.testing.assert_array_equal(a[key], b[key], err_msg=key)
    assert (first[0]["maps"] != other[0]["maps"]).any()
    np.testing.assert_array_equal(first[1]["maps"], first[0]["maps"])
    assert (first[1]["hidden"] != first[0]["hidden"]).any()
