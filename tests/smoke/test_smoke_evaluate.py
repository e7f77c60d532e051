"""Evaluation: figures worked out by hand, methods held against what they stand for, and all of it on a tiny set."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from builders.smoke_plumes import plume
from builders.smoke_samples import small_pool

from wlm.baselines.smoke import billboard
from wlm.errors import WlmError
from wlm.fluid.volume import save_volume
from wlm.metrics.error import psnr_from_mse
from wlm.smoke.baking import bake
from wlm.smoke.decode import Predictor
from wlm.smoke.evaluation import (
    COARSE,
    FLIP_BOOK,
    HALF,
    NETWORK,
    coarse,
    compare,
    evaluate,
    evaluate_all,
    flip_book,
    of_predictor,
)
from wlm.smoke.learn.dataset import DatasetSettings, _fixed_cameras, load_probe_volume, make_validation
from wlm.smoke.model import NetworkSettings, SixWayNetwork
from wlm.smoke.planes import GUIDES, OPACITY_PLANE, PLANES, Pool, encode_lightmaps

TINY = {"width": 8, "levels": 2}
FEW = DatasetSettings(
    cells=16, refine=2, resolution=24, frames=1, views=3, warmup=0.8, hot=0.0, validation_sequences=1, moving=0.0
)


def _network(seed: int = 0, **changed) -> SixWayNetwork:
    torch.manual_seed(seed)
    network = SixWayNetwork(NetworkSettings(**TINY | changed))
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    return network


def _reference(pool: Pool, part: slice) -> torch.Tensor:
    return pool.targets[part].float()


def _empty(pool: Pool) -> Pool:
    return pool.take(torch.zeros(len(pool), dtype=torch.bool))


def test_figures_are_those_worked_out_by_hand(device):
    pool = small_pool().to(device)
    guides, targets = (part.float().cpu().numpy().astype(float) for part in (pool.guides, pool.targets))

    class Mix(torch.nn.Module):
        def forward(self, given):
            return given[:, [0, 0, 1, 1, 0, 1, 1, 2]] * 1.5 - 0.1

    made = np.maximum(guides[:, :, [0, 0, 1, 1, 0, 1, 1, 2]] * 1.5 - 0.1, 0)
    made[:, :, 6:] = np.minimum(made[:, :, 6:], 1)
    off = ((made - targets) ** 2).mean((3, 4)).reshape(-1, 8)
    images = [psnr_from_mse(value, 1.0) for value in off[:, :6].mean(1)]
    for batch in (1, 4, 100):
        found = evaluate(Mix(), pool, batch=batch)
        assert found.psnr == pytest.approx(np.mean(images), abs=1e-4)
        assert (found.lowest, found.highest) == pytest.approx((min(images), max(images)), abs=1e-4)
        assert found.planes == pytest.approx([psnr_from_mse(value, 1.0) for value in off.mean(0)], abs=1e-4)
        # The motion is a whole pixel upwards.
        seen = targets[:, 1, OPACITY_PLANE, :-1] > 0.01
        for name, planes in (("flicker", made), ("reference_flicker", targets)):
            change = np.abs(planes[:, 1, :6, :-1] - planes[:, 0, :6, 1:])
            wanted = change.transpose(0, 2, 3, 1)[seen].mean()
            assert getattr(found, name) == pytest.approx(wanted, rel=1e-3), name


def test_the_reference_itself_is_perfect_and_as_steady_as_itself():
    found = compare({"reference": _reference}, small_pool())["reference"]
    assert found.psnr == found.lowest == found.highest == found.planes[0] > 90
    assert found.flicker_ratio == 1.0 and found.flicker > 0


def test_noise_flickers():
    def noisy(pool: Pool, part: slice) -> torch.Tensor:
        random = torch.Generator().manual_seed(part.start)
        planes = pool.targets[part].float()
        return planes + 0.05 * torch.randn(planes.shape, generator=random)

    def dark(pool: Pool, part: slice) -> torch.Tensor:
        return 0.9 * pool.targets[part].float()

    found = compare({"noisy": noisy, "dark": dark}, small_pool())
    assert found["noisy"].flicker_ratio > 1.3
    assert found["dark"].flicker_ratio == pytest.approx(0.9, abs=1e-3), "an error that stays is none of it"
    assert found["dark"].reference_flicker == found["noisy"].reference_flicker


def test_hard_pools():
    pool = small_pool(2)
    with pytest.raises(ValueError, match="samples"):
        evaluate(_network(), _empty(pool))
    nothing = replace(pool, guides=torch.zeros_like(pool.guides), targets=torch.zeros_like(pool.targets))
    found = evaluate(_network(), nothing)
    assert found.psnr > 90 and math.isnan(found.flicker) and math.isnan(found.flicker_ratio)
    assert found.to_json()["flicker"] is None and json.dumps(found.to_json(), allow_nan=False)
    with pytest.raises(ValueError, match=r"planes: expected \[2, 2, 8, 32, 32\], got \[2, 2, 7, 32, 32\]"):
        compare({"short": lambda pool, part: pool.targets[part][:, :, :7]}, pool)


def test_a_predictor_is_the_network(device):
    pool = small_pool(2, kind="six").to(device)
    network = _network(guide="six", stem=2).to(device)
    whole = evaluate(network, pool)
    for half, error in ((False, 1e-3), (True, 0.05)):
        found = evaluate(network, pool, Predictor(network, 32, 32, device=device, half=half))
        assert found.psnr == pytest.approx(whole.psnr, abs=error)
        assert found.flicker == pytest.approx(whole.flicker, rel=error)
    with pytest.raises(ValueError, match="encoded"):
        compare({"small": of_predictor(Predictor(network, 16, 16, device=device))}, pool)


def test_the_coarse_march_is_its_guide():
    pool = small_pool(2, kind="six")
    planes = coarse(pool, slice(0, 2))
    for name, plane in zip(PLANES, planes.unbind(2), strict=True):
        assert torch.equal(plane, pool.guides[:, :, GUIDES["six"].index(name)].float())
    assert compare({"coarse": coarse}, pool)["coarse"].psnr > 20
    with pytest.raises(ValueError, match="kind six"):
        coarse(small_pool(2), slice(0, 2))


def test_a_flip_book_is_the_billboard(tmp_path, device):
    """What turns with the camera shows the side that was baked, of those samples that are to be looked at."""
    save_volume(tmp_path / "a.npz", plume())
    pool = load_probe_volume(tmp_path / "a.npz", FEW, device=device, extinction=8.0)
    others, shown = flip_book(pool, 3)
    assert len(pool) == 3 and len(others) == 2 and torch.equal(others.targets, pool.targets[1:])
    volume = plume(device=device)
    first, *rest = _fixed_cameras(FEW, volume.origin, volume.voxel * np.array(volume.shape))
    baked = bake(volume, first, step=FEW.reference_step, estimate=False)
    for planes, camera in zip(shown(others, slice(0, 2)), rest, strict=True):
        wanted = encode_lightmaps(billboard(baked, first, camera, volume.centre))
        assert (planes - wanted).abs().max() < 4e-3
    keep = torch.tensor([False, False, True], device=device)
    others, shown = flip_book(pool, 3, keep)
    assert len(others) == 1 and torch.equal(shown(others, slice(0, 4)), pool.targets[:1].float())
    assert len(flip_book(pool, 1)[0]) == 0
    with pytest.raises(ValueError, match="whole sets of 2 views, got 3"):
        flip_book(pool, 2)


def test_all_methods_on_all_sets(tmp_path, device):
    save_volume(tmp_path / "a.npz", plume())
    told = []
    results = {}
    for kind in ("six", "paper"):
        settings = FEW.model_copy(update={"guide": kind})
        network = _network(guide=kind).to(device)
        options = {"densities": (1.0,), "device": device, "progress": lambda *words: told.append(words)}
        results[kind] = evaluate_all(network, settings, [tmp_path / "a.npz"], **options)
        smoke, volume = results[kind]
        assert (smoke.name, volume.name) == ("density x 1", str(tmp_path / "a.npz"))
        assert smoke.samples == volume.samples == 3
        names = [NETWORK, *([HALF] if device != "cpu" else []), COARSE, FLIP_BOOK]
        assert list(smoke.methods) == list(volume.methods) == names
        assert (smoke.half_loss is None) == (device == "cpu")
        assert smoke.methods[COARSE].psnr > smoke.methods[FLIP_BOOK].psnr + 3
        # A volume stands still.
        assert volume.methods[NETWORK].flicker < 1e-6 and math.isnan(volume.methods[NETWORK].flicker_ratio)
        assert json.dumps(smoke.to_json(), allow_nan=False)
    assert [words[:2] for words in told] == [(1, 2), (2, 2)] * 2
    # What needs no network is the same beside any.
    for one, other in zip(*results.values(), strict=True):
        assert one.methods[COARSE] == other.methods[COARSE] and one.methods[FLIP_BOOK] == other.methods[FLIP_BOOK]
        assert one.methods[NETWORK] != other.methods[NETWORK]
    # Of sequences by which no network was chosen.
    psnr = [evaluate(network, make_validation(settings, device, test=test)).psnr for test in (True, False)]
    assert psnr[0] == results["paper"][0].methods[NETWORK].psnr != psnr[1]
    empty = FEW.model_copy(update={"guide": "six", "least_coverage": 1.0})
    with pytest.raises(WlmError, match="density x 2: expected frames with smoke"):
        evaluate_all(_network(guide="six").to(device), empty, densities=(2.0,), device=device)
