"""What follows a step: gathered sums, clamped maps, the rates' schedule, Adam over pieces, and repetition."""

import math

import numpy as np
import pytest
import torch
import warp as wp
from reference.levels import put_on_levels

from kernels.compare import array, close
from kernels.stepping import Case, fused_step, trainer
from wlm_kernels.lightmap import gather, levels

RATES = {"map_rate": 0.02, "net_rate": 0.005, "final_rate": 0.1}


def _share(step: int, steps: int, final: float) -> float:
    """Half a cosine from 1 at the first step to `final` at the last."""
    return final + (1.0 - final) * 0.5 * (1.0 + math.cos(math.pi * step / (steps - 1)))


def test_gather_clears_clamps_and_counts(device: str):
    """After a step the sums are 0, the maps that the optimiser moved were within [0, 1], and the step is counted."""
    fit = trainer(Case(settings=RATES | {"steps": 12}), device)
    start = fit.maps.detach().clone()
    assert float(start.min()) < 0.0 and float(start.max()) > 1.0
    for step in range(14):
        assert fit.step == step
        before = fit.maps.detach().clone()
        fused_step(fit, False)
        share = _share(min(step, 11), 12, 0.1)  # beyond the last step its rate stays
        np.testing.assert_allclose(
            fit._rates.cpu().numpy(), [0.02 * share, 0.005 * share], rtol=1e-5, err_msg=f"step {step}"
        )
        # Adam moves a value by hardly more than its rate, from where gather has put it.
        moved = (fit.maps.detach() - before.clamp(0.0, 1.0)).abs()
        assert float(moved.max()) < 0.02 * share * 4.0
        still = fit.maps_grad == 0
        if step == 0:
            torch.testing.assert_close(fit.maps.detach()[still], before.clamp(0, 1)[still], rtol=0, atol=0)
        assert not fit._acc.cpu().numpy().any()
        if device == "cpu":
            assert not fit._partial.any() and not fit._partial_out.any() and not fit._loss_parts.any()
    fit.close()


def test_adam_is_torchs(device: str):
    """Twenty steps against torch's Adam in float64, fed with the same gradients."""
    settings = RATES | {"steps": 20}
    fit = trainer(Case(settings=settings, samples=1024), device)
    named = [fit.maps, fit.hidden, fit.output]
    whole = [value.detach().cpu().double().clone().requires_grad_() for value in named]
    groups = [{"params": whole[:1], "lr": 1.0}, {"params": whole[1:], "lr": 1.0}]
    adam = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-8)
    for step in range(20):
        fused_step(fit, step >= 10)
        with torch.no_grad():
            whole[0].clamp_(0.0, 1.0)
        share = _share(step, 20, 0.1)
        for group, rate in zip(adam.param_groups, (0.02, 0.005), strict=True):
            group["lr"] = rate * share
        for value, grad in zip(whole, (fit.maps_grad, fit.hidden.grad, fit.output.grad), strict=True):
            value.grad = grad.cpu().double()
        adam.step()
    for name, value, mine in zip(("maps", "hidden", "output"), whole, named, strict=True):
        close(mine.detach(), value, 2e-5, name)
    fit.close()


def test_a_gpus_update_is_torchs_adam(device: str):
    """The launches that move the parameters on a GPU, wherever they run: sums to gradients, Adam, rates and counts."""
    random, steps, parts = np.random.default_rng(0), 6, 3
    shapes = {"maps": 48, "hidden": 31, "output": 7}
    values = {key: random.uniform(-0.2, 1.2, count).astype(np.float32) for key, count in shapes.items()}
    twins = {key: torch.tensor(value, dtype=torch.float64).requires_grad_() for key, value in values.items()}
    adams = {key: torch.optim.Adam([twin], betas=(0.9, 0.99), eps=1e-8) for key, twin in twins.items()}
    mine = {key: array(value, float, device) for key, value in values.items()}
    grads = {key: array(np.zeros_like(value), float, device) for key, value in values.items()}
    moments = {}
    for key, value in values.items():
        moments[key] = gather.Adam()
        moments[key].decay, moments[key].epsilon = wp.vec2(0.9, 0.99), 1e-8
        moments[key].first, moments[key].second = (array(np.zeros_like(value), float, device) for _ in range(2))
    done = np.arange(1, steps + 1)
    share = np.linspace(1.0, 0.5, steps)
    schedule = array(np.stack([share, 1 - 0.9**done, np.sqrt(1 - 0.99**done)], 1).astype(np.float32), wp.vec3, device)
    control, rates = array(np.zeros(1, np.int32), int, device), array(np.zeros(4, np.float32), float, device)
    mean_loss = array(np.zeros(2, np.float32), float, device)
    for step in range(steps):
        move = step < 4
        sums = {key: random.normal(size=(parts, count)).astype(np.float32) for key, count in shapes.items()}
        acc = array(np.round(sums["maps"].sum(0) * 2.0**40).astype(np.int64)[None], wp.int64, device)
        loss = array(np.full((parts, 2), 0.5, np.float32), float, device)
        net = [array(sums[key], float, device) for key in ("hidden", "output")]
        gather.update_maps(
            schedule, (0.02, 0.01), control, move, acc, moments["maps"], mine["maps"], grads["maps"], rates
        )
        gather.update_net(
            *net, loss, rates, moments["hidden"], moments["output"], mine["hidden"], mine["output"], mean_loss, control,
            grads["hidden"], grads["output"],
        )  # fmt: skip
        assert not acc.numpy().any() and control.numpy()[0] == step + 1
        np.testing.assert_allclose(rates.numpy()[:2], np.array([0.02, 0.01]) * share[step], rtol=1e-6)
        np.testing.assert_allclose(mean_loss.numpy(), 1.5 * (1 - 0.98 ** (step + 1)), rtol=1e-5)
        with torch.no_grad():
            twins["maps"].clamp_(0.0, 1.0)
        for key, adam in adams.items():
            close(grads[key], sums[key].sum(0), 1e-6, f"gradient of {key}")
            twins[key].grad = torch.tensor(sums[key].sum(0), dtype=torch.float64)
            adam.param_groups[0]["lr"] = (0.02 if key == "maps" else 0.01) * share[step]
            if move or key != "maps":
                adam.step()
            close(mine[key], twins[key], 2e-6, f"{key} after {step}")


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
        for steps in (16, 1, 3):  # frozen from step 16 on; the step after only puts the maps back into [0, 1]
            run.run(steps)
            states.append({key: value.copy() for key, value in run.state().items()})
        run.close()
        return states

    first, second, other = fit(3), fit(3), fit(4)
    for a, b in zip(first, second, strict=True):
        for key in a:
            np.testing.assert_array_equal(a[key], b[key], err_msg=key)
    assert (first[0]["maps"] != other[0]["maps"]).any()
    np.testing.assert_array_equal(first[1]["maps"], np.clip(first[0]["maps"], 0.0, 1.0))
    np.testing.assert_array_equal(first[2]["maps"], first[1]["maps"])
    assert (first[2]["hidden"] != first[1]["hidden"]).any()
