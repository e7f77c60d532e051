"""What follows a step: gathered sums, clamped maps, the rates' schedule, Adam over pieces, and repetition."""

import math

import numpy as np
import pytest
import torch

from kernels.compare import close
from kernels.stepping import Case, draw, fused_step, trainer

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


def test_loss_is_a_running_mean(device: str):
    """A fiftieth of each step's loss: repeated losses L come to L (1 - 0.98^k)."""
    fit = trainer(Case(settings={"map_rate": 1e-9, "net_rate": 1e-9}, samples=4096), device)
    first = fused_step(fit, True).loss
    for _ in range(29):
        fused_step(fit, True)
    # The loss differs a little from step to step with the samples drawn.
    np.testing.assert_allclose(fit.losses(), first * (1 - 0.98**30), rtol=0.05)
    fit.close()


@pytest.mark.parametrize("split", [False, True], ids=["as-is", "36-pieces"])
def test_adam_over_pieces_is_adam_over_the_whole(device: str, split: bool, monkeypatch: pytest.MonkeyPatch):
    """Twenty steps against torch's Adam in float64 over whole tensors, fed with the same gradients."""
    settings = RATES | {"steps": 20}
    fit = trainer(Case(settings=settings, samples=1024), device)
    if split:
        # The CPU keeps one piece; what a GPU does must be right wherever it is tested.
        with monkeypatch.context() as patch:
            patch.setattr(fit, "_cuda", True)
            pieces = fit._pieces()
        assert 30 <= len(pieces) <= 36 and sum(p.numel() for p in pieces) == fit.maps.numel()
        options = {key: fit._adam_maps.defaults[key] for key in ("betas", "eps", "fused", "capturable")}
        rate = fit._adam_maps.param_groups[0]["lr"]
        fit._adam_maps = torch.optim.Adam(pieces, lr=rate, **options)
    named = [fit.maps, fit.hidden, fit.output]
    whole = [value.detach().cpu().double().clone().requires_grad_() for value in named]
    groups = [{"params": whole[:1], "lr": 1.0}, {"params": whole[1:], "lr": 1.0}]
    adam = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=fit.profile.adam_epsilon)
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


def test_training_lowers_the_loss(device: str):
    """Four hundred texels of noise are learnt better than by their mean."""
    case = Case(samples=1024, numbers=(1,), texels=(400,), settings={"steps": 120, "map_rate": 0.03})
    fit = trainer(case, device, spread=False)
    fit.run(120)
    end = fused_step(fit, True).loss[0]
    targets = case.targets()
    chosen = targets.colour[0][:, targets.texels[0]]
    assert end < 0.8 * chosen.var((0, 1)).mean()
    fit.close()


def test_resumed_fit_goes_on(device: str):
    """A state put into a new trainer draws the same samples and makes the same step."""
    case = Case(settings={"steps": 20})
    run = trainer(case, device)
    run.run(7)
    resumed = trainer(case, device, spread=False)
    resumed.load(run.state())
    np.testing.assert_array_equal(draw(run, False)[1], draw(resumed, False)[1])
    run.run(9)
    resumed.run(9)
    a, b = run.state(), resumed.state()
    assert a.keys() == b.keys()
    for key in a:
        np.testing.assert_array_equal(a[key], b[key], err_msg=key)
    run.close()
    resumed.close()
