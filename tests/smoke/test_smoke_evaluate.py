"""Evaluation: scores computed by hand, hard pools, and a network on a tiny set."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from builders.smoke_samples import random_model, small_pool

import wlm
from wlm.metrics import psnr_from_mse
from wlm.smoke.evaluation import evaluate, of_network, score
from wlm.smoke.model import SmokeModel
from wlm.smoke.network.dataset import make_validation
from wlm.smoke.network.planes import OPACITY_PLANE
from wlm.smoke.network.settings import DatasetSettings

FEW = DatasetSettings(cells=16, refine=2, resolution=16, frames=1, views=2, warmup=0.6, hot=0.0, validation_sequences=1)
FEW = FEW.model_copy(update={"moving": 0.0})


def _network(seed: int = 0, **settings) -> SmokeModel:
    return random_model(0.1, seed, levels=2, **settings)


def test_scores_are_those_worked_out_by_hand(device):
    pool = small_pool().to(device)
    guides, targets = (part.float().cpu().numpy().astype(float) for part in (pool.guides, pool.targets))
    mix = [0, 0, 1, 1, 0, 1, 1, 2]
    planes = np.maximum(guides[:, :, mix] * 1.5 - 0.1, 0)
    planes[:, :, 6:] = np.minimum(planes[:, :, 6:], 1)
    off = ((planes - targets) ** 2).mean((3, 4)).reshape(-1, 8)
    images = [psnr_from_mse(value, 1.0) for value in off[:, :6].mean(1)]
    for batch in (1, 4, 100):
        result = score(of_network(lambda guide: guide[:, mix] * 1.5 - 0.1), pool, batch=batch)
        assert result.psnr == pytest.approx(np.mean(images), abs=1e-4)
        assert (result.lowest, result.highest) == pytest.approx((min(images), max(images)), abs=1e-4)
        assert result.images == pytest.approx(images, abs=1e-4)
        assert result.planes == pytest.approx([psnr_from_mse(value, 1.0) for value in off.mean(0)], abs=1e-4)
        # The motion is a whole pixel upwards.
        visible = targets[:, 1, OPACITY_PLANE, :-1] > 0.01
        for name, frames in (("flicker", planes), ("reference_flicker", targets)):
            change = np.abs(frames[:, 1, :6, :-1] - frames[:, 0, :6, 1:])
            expected = change.transpose(0, 2, 3, 1)[visible].mean()
            assert getattr(result, name) == pytest.approx(expected, rel=1e-3), name


def test_hard_pools():
    pool = small_pool(2)
    empty = replace(pool, guides=torch.zeros_like(pool.guides), targets=torch.zeros_like(pool.targets))
    report = evaluate(_network(), empty)
    assert report.psnr > 90 and math.isnan(report.flicker) and math.isnan(report.flicker_ratio)
    assert report.to_json()["flicker"] is None and json.dumps(report.to_json(), allow_nan=False)


def test_a_decoder_scores_as_its_network(device):
    pool, model = small_pool(2, kind="six").to(device), _network(guide="six", stem=2)
    expected = score(of_network(model.network.to(device)), pool)
    for half, error in ((False, 1e-3), (True, 0.05)):
        report = wlm.smoke.evaluate(model, pool, device=device, half=half)
        assert report.psnr == pytest.approx(expected.psnr, abs=error)
        assert report.flicker == pytest.approx(expected.flicker, rel=error)
        assert (report.samples, report.bytes) == (2, model.file_bytes())


def test_the_test_set_is_held_out_from_the_choice_of_a_network(device):
    reports = []
    for kind in ("six", "paper"):
        settings = FEW.model_copy(update={"guide": kind})
        model = replace(_network(guide=kind), summary={"dataset": settings.model_dump(mode="json")})
        reports.clear()
        report = evaluate(model, device=device, progress=reports.append)
        validation = evaluate(model, make_validation(settings, device), device=device)
        assert report.samples == 2 and abs(report.psnr - validation.psnr) > 0.1
        assert report.guide_psnr > 20 if kind == "six" else math.isnan(report.guide_psnr)
        assert {progress.stage for progress in reports} == {"dataset", "evaluate"}
