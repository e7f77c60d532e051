"""Losses: definitions, and errors of known kinds."""

import math

import pytest
import torch
from builders.smoke_samples import small_pool

from wlm.smoke.network.losses import losses, temporal, warp
from wlm.smoke.network.settings import TrainSettings


def test_parts_are_computed_only_where_they_weigh():
    pool = small_pool()
    targets = pool.targets.float()
    predicted = targets + 0.1
    predicted[:, 1] += 0.1
    for weight, parts in ((0.0, ("mse",)), (0.5, ("mse", "temporal"))):
        assert TrainSettings(temporal=weight).losses == parts
        found = losses(predicted, targets, pool.motion, weight)
        assert tuple(found) == ("loss", *parts)
        expected = float(found["mse"]) + (weight * float(found["temporal"]) if weight else 0.0)
        assert float(found["loss"]) == pytest.approx(expected)
    assert float(losses(targets + 0.1, targets, pool.motion, 0.0)["mse"]) == pytest.approx(0.01, rel=1e-4)


def test_warping_by_nan_or_infinity_is_outside():
    image = torch.rand(1, 2, 4, 5, requires_grad=True)
    motion = torch.zeros(1, 2, 4, 5)
    motion[0, 0, 1, 2], motion[0, 1, 2, 3], motion[0, :, 3, 4] = math.nan, math.inf, -math.inf
    warped, inside = warp(image, motion)
    assert torch.isfinite(warped).all() and inside.sum() == 17
    for value in (math.inf, math.nan, 1e38):
        (gradient,) = torch.autograd.grad((warped * torch.tensor([value])).sum(), image, retain_graph=True)
        assert torch.isfinite(gradient).all() == (value == 1e38) and not (gradient < 0).any()


@pytest.mark.parametrize("size", [(7, 9), (1, 5), (1, 1)])
def test_warping_and_its_gradient_are_those_of_torch(size):
    height, width = size
    image = torch.randn(2, 3, height, width, dtype=torch.float64, requires_grad=True)
    motion = 4 * torch.randn(2, 2, height, width, dtype=torch.float64)
    column = torch.arange(width) - motion[:, 0]
    row = torch.arange(height)[:, None] - motion[:, 1]
    places = torch.stack([(2 * column + 1) / width - 1, (2 * row + 1) / height - 1], -1)
    theirs = torch.nn.functional.grid_sample(image, places, padding_mode="border", align_corners=False)
    ours, inside = warp(image, motion)
    assert torch.allclose(ours, theirs, atol=1e-12)
    within = (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
    assert torch.equal(inside[:, 0] > 0, within)
    gradients = [torch.autograd.grad((warped**3).sum(), image)[0] for warped in (ours, theirs)]
    assert torch.allclose(*gradients, rtol=1e-9, atol=1e-9)
    assert torch.autograd.gradcheck(lambda x: warp(x, motion)[0], image, atol=1e-6)


def test_temporal_loss_sees_flicker_and_not_a_steady_error():
    target = torch.zeros(1, 2, 8, 12, 16)
    target[:, :, 6, 2:10, 2:12] = 1.0
    still = torch.zeros(1, 2, 12, 16)
    assert temporal(target + 0.1, target, still) == pytest.approx(0.0, abs=1e-7)
    flicker = target.clone()
    flicker[:, 1] += 0.1
    assert float(temporal(flicker, target, still)) == pytest.approx(0.1, rel=1e-5)
    # An error that moves along with the smoke is steady too.
    moving = torch.zeros(1, 2, 12, 16)
    moving[:, 0] = 2.0
    error = torch.rand(1, 8, 12, 16)
    carried = target + torch.stack([error, error.roll(2, -1)], 1)
    assert float(temporal(carried, target, moving)) == pytest.approx(0.0, abs=1e-6)
    assert float(temporal(carried, target, still)) > 0.1
    # Change outside the smoke doesn't count, and no smoke at all is no loss.
    outside = target.clone()
    outside[:, 1, :, :, 13:] += 1
    assert temporal(outside, target, still) == 0
    assert temporal(flicker, torch.zeros_like(target), still) == 0
