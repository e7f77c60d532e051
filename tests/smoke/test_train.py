"""Training: it learns, resumes exactly, keeps the best network, and refuses unusable samples and settings."""

import csv
import math
import re
from dataclasses import replace
from unittest import mock

import pytest
import torch
from builders.checks import error_of
from builders.smoke_samples import file_content, small_pool

import wlm
from wlm.errors import WlmError
from wlm.smoke.evaluation import of_network, score
from wlm.smoke.fit import train
from wlm.smoke.network import dataset
from wlm.smoke.network.planes import GUIDES, OPACITY_PLANE, PLANES, Pool
from wlm.smoke.network.settings import NetworkSettings, Profile, TrainSettings
from wlm.smoke.network.trainer import Plan, Trainer, plan_round
from wlm.smoke.network.unet import SixWayNetwork

TINY = NetworkSettings(width=8, levels=2)


def _profile(network: NetworkSettings = TINY, **training) -> Profile:
    settings = {"rounds": 2, "steps": 6, "batch": 4, "warmup": 2, "average": 0.5} | training
    return Profile(name="tiny", network=network, training=TrainSettings(**settings))


def _pool(settings, *, seed, round, device, **options) -> Pool:
    return small_pool(4, 10 * (seed + 1) + 4 * round, 16).to(device)


def _worse(settings, *, round, **options) -> Pool:
    """Makes wrong targets after the first round."""
    pool = small_pool(4, 10, 16)
    return pool if round == 0 else replace(pool, targets=1 - pool.targets)


def _interrupted(settings, **options) -> Pool:
    raise KeyboardInterrupt


def _validation(settings, device, **options) -> Pool:
    return small_pool(2, resolution=16).to(device)


def _train(path, profile, make_pool=_pool, make_validation=_validation, **options):
    with mock.patch.multiple(dataset, make_pool=make_pool, make_validation=make_validation):
        return train(profile, path, **options)


def _curves(path) -> list[dict[str, float]]:
    with open(f"{path}.csv") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def test_it_learns_a_small_pool_by_heart(tmp_path, device):
    pool = small_pool(2, resolution=16).to(device)
    before = score(of_network(SixWayNetwork(TINY).to(device)), pool)
    profile = _profile(rounds=1, steps=50, batch=2, average=0.9, rate=3e-3)
    options = {"make_pool": lambda *a, **k: pool, "make_validation": lambda *a, **k: pool}
    training = _train(tmp_path / "a", profile, device=device, **options)
    # 32.3 dB after 50 steps, on the CPU; 22.1 dB before.
    assert training.finished and training.best > max(30.0, before.psnr + 6)
    assert training.score.lowest <= training.score.psnr <= training.score.highest
    assert training.steps == 50 and training.skipped == 0
    model = wlm.load(tmp_path / "a")
    assert wlm.smoke.evaluate(model, pool, device=device, half=False).psnr == pytest.approx(training.best, abs=0.05)
    assert model.summary == training.model.summary and model.summary["psnr"] == training.best
    assert set(model.summary["planes"]) == set(PLANES) and 0.0 < model.summary["seconds"] <= round(training.seconds, 1)
    assert model.summary["device"] == ("cpu" if device == "cpu" else torch.cuda.get_device_name(device))
    assert model.dataset == profile.dataset


@pytest.mark.parametrize("temporal", [pytest.param(0.0, marks=pytest.mark.slow), 0.1])
def test_a_stopped_training_ends_as_if_it_had_not_been(tmp_path, monkeypatch, temporal):
    monkeypatch.setattr("wlm.smoke.fit._CHUNK", 2)
    profile = _profile(temporal=temporal)
    whole = _train(tmp_path / "whole", profile, seed=1)

    def stop(progress) -> None:
        if progress.done == 4:
            raise KeyboardInterrupt

    path = tmp_path / "parts"
    with pytest.raises(KeyboardInterrupt):
        _train(path, profile, seed=1, progress=stop)
    assert wlm.load(path).summary["steps"] == 0
    steps = []
    while not (training := _train(path, profile, seed=1, resume=True, minutes=0.0)).finished:
        steps.append(training.steps)
    assert steps == [6, 8, 10]
    assert file_content(path) == file_content(tmp_path / "whole")
    assert replace(training, seconds=0) == replace(whole, seconds=0)
    assert not (tmp_path / "parts.partial").exists()
    for row, expected in zip(_curves(path), _curves(tmp_path / "whole"), strict=True):
        assert {**row, "seconds": 0} == {**expected, "seconds": 0}
    # Finished, it is left alone.
    content = path.read_bytes()
    with pytest.raises(WlmError, match=r"parts: cannot resume: the training is finished; start anew without --resume$"):
        _train(path, profile, seed=1, resume=True)
    assert path.read_bytes() == content and not (tmp_path / "parts.partial").exists()


@pytest.mark.slow
def test_a_training_stopped_in_its_first_pool_is_resumed(tmp_path):
    profile = _profile()
    _train(tmp_path / "whole", profile)
    path = tmp_path / "a"
    older = _train(path, profile, minutes=0.0)
    assert not older.finished and older.steps == 6
    with pytest.raises(KeyboardInterrupt):
        _train(path, profile, make_pool=_interrupted)
    assert (tmp_path / "a.partial").exists() and wlm.load(path).summary["steps"] == 0
    assert _train(path, profile, resume=True).finished
    assert file_content(path) == file_content(tmp_path / "whole")


def test_the_best_is_trusted_only_with_its_network(tmp_path):
    """If the output is damaged, missing or another network, the next validated one is saved, even if it is worse."""
    profile = _profile(steps=8, average=0.0)
    path, partial = tmp_path / "a", tmp_path / "a.partial"
    before = _train(path, profile, make_pool=_worse, minutes=0.0)
    checkpoint, network = partial.read_bytes(), path.read_bytes()
    with pytest.raises(KeyboardInterrupt):
        _train(path, profile, make_pool=_interrupted)
    for content in (path.read_bytes(), network[:-1], None):
        path.unlink() if content is None else path.write_bytes(content)
        partial.write_bytes(checkpoint)
        training = _train(path, profile, make_pool=_worse, resume=True)
        assert training.finished and training.best == training.score.psnr < before.best
        summary = wlm.load(path).summary
        assert (summary["steps"], summary["psnr"]) == (16, training.best)


def test_a_checkpoint_of_another_training_is_refused(tmp_path):
    path = tmp_path / "a"
    _train(path, _profile(), minutes=0.0)
    for profile in (_profile(rate=2e-3), _profile(NetworkSettings(width=16, levels=2))):
        assert "another fit" in error_of(_train, path, profile, resume=True)
    partial = tmp_path / "a.partial"
    content = bytearray(partial.read_bytes())
    content[-9] ^= 1
    partial.write_bytes(content)
    assert "damaged" in error_of(_train, path, _profile(), resume=True)
    # Without resume it is ignored.
    assert _train(path, _profile()).finished


def test_curves_and_progress(tmp_path, monkeypatch):
    monkeypatch.setattr("wlm.smoke.fit._CHUNK", 3)
    reports = []
    training = _train(tmp_path / "a", _profile(rounds=3, validate_every=2), progress=reports.append)
    assert [(progress.done, progress.total) for progress in reports] == [(3 * (i + 1), 18) for i in range(6)]
    assert all(progress.figures["loss"] > 0 and progress.seconds > 0 for progress in reports)
    assert reports[-1].figures["PSNR dB"] == training.score.psnr
    rows = _curves(tmp_path / "a")
    assert [row["step"] for row in rows] == [6, 12, 18]
    assert [math.isnan(row["psnr"]) for row in rows] == [True, False, False]
    assert rows[-1]["psnr"] == pytest.approx(training.score.psnr, abs=1e-5)
    assert rows[0]["loss"] == rows[0]["mse"] and rows[-1]["loss"] < rows[0]["loss"]


def test_the_best_network_is_kept(tmp_path):
    scores = []

    def run(rate: float):
        profile = _profile(steps=12, average=0.0, rate=rate)
        report = lambda progress: scores.append(progress.figures["PSNR dB"])  # noqa: E731
        return _train(tmp_path / "a", profile, make_pool=_worse, progress=report)

    # It ends far below where it began, and the best stays.
    assert re.search(r"diverged: .* dB after 24 steps, .* before the first; .* rate below 0.01", error_of(run, 1e-2))
    assert wlm.load(tmp_path / "a").summary["psnr"] == max(scores)
    scores.clear()
    training = run(1e-3)
    assert training.best == max(scores) > training.score.psnr
    assert training.model.summary["psnr"] == training.best


def test_nan_in_a_pool_is_an_error(tmp_path):
    def broken(settings, *, round, **options) -> Pool:
        pool = small_pool(4, 10)
        motion = pool.motion.clone()
        motion[2, 0, 0, 1] = math.nan
        return replace(pool, motion=motion) if round == 1 else pool

    with pytest.raises(WlmError, match="round 1: motion: sample 2: expected finite"):
        _train(tmp_path / "a", _profile(steps=2), make_pool=broken)
    empty = small_pool().take(torch.zeros(6, dtype=torch.bool))
    with pytest.raises(WlmError, match="validation: expected samples with smoke, found none"):
        _train(tmp_path / "a", _profile(), make_validation=lambda *a, **k: empty)


def test_a_step_of_nan_is_skipped(device):
    settings = TrainSettings(rounds=1, steps=6, batch=4)
    trainer = Trainer(TINY, settings, seed=0, device=device)
    pool = small_pool(4).to(device)
    plan = plan_round(settings, pool, seed=0, round=0)
    trainer.run(pool, plan.part(0, 2))
    before = trainer.state()
    broken = replace(pool, targets=torch.full_like(pool.targets, math.nan))
    trainer.run(broken, plan.part(2, 4))
    after = trainer.state()
    assert trainer.skipped == 2 and trainer.step == 4
    assert all(math.isfinite(value) for value in trainer.take_losses())
    for name, value in before.items():
        if name.startswith(("network.", "adam.")):
            assert (value == after[name]).all(), name
    trainer.run(pool, plan.part(4, 6))
    assert trainer.skipped == 2
    assert any((value != after[name]).any() for name, value in trainer.state().items() if name.startswith("network."))


def test_a_training_that_diverges_ends(tmp_path, monkeypatch):
    monkeypatch.setattr("wlm.smoke.fit._CHUNK", 4)
    gather = Trainer._gather

    def infinite(self, *args):
        guides, targets, motion = gather(self, *args)
        return guides, torch.full_like(targets, math.inf), motion

    monkeypatch.setattr(Trainer, "_gather", infinite)
    with pytest.raises(WlmError, match=r"diverged: 12 steps of round 0.*learning rate below 0.001"):
        _train(tmp_path / "a", _profile(steps=40))
    # Resuming doesn't reset the count.
    path = tmp_path / "b"
    for steps in (4, 8):
        assert _train(path, _profile(steps=40), minutes=0.0, resume=True).skipped == steps
    assert "diverged: 12 steps of round 0" in error_of(_train, path, _profile(steps=40), minutes=0.0, resume=True)


def test_a_plan_takes_each_sample_once_before_any_twice():
    settings = TrainSettings(rounds=1, steps=5, batch=4)
    pool = small_pool(10)
    plan = plan_round(settings, pool, seed=3, round=1)
    samples, frames, flips = plan.samples, plan.frames, plan.flips
    assert plan.corners is None
    assert samples.shape == (5, 4) and sorted(samples.flatten().tolist()) == sorted([*range(10)] * 2)
    assert set(frames.flatten().tolist()) == {0, 1} and flips.any() and not flips.all()
    again, next_round = (plan_round(settings, pool, seed=3, round=number).samples for number in (1, 2))
    assert torch.equal(samples, again) and not torch.equal(samples, next_round)
    pairs = plan_round(settings.model_copy(update={"temporal": 1.0}), pool, seed=3, round=1)
    assert pairs.samples.shape == (5, 2)


def _only(pool: Pool, *squares: tuple[int, int, int, int]) -> Pool:
    """Makes a pool whose first sample has smoke only in squares: first and last row, first and last column."""
    targets = pool.targets.clone()
    targets[0, :, OPACITY_PLANE] = 0
    for top, bottom, left, right in squares:
        targets[0, 1, OPACITY_PLANE, top : bottom + 1, left : right + 1] = 1.0
    return replace(pool, targets=targets)


@pytest.mark.parametrize("squares", [[(20, 22, 17, 30)], [(0, 0, 31, 31)], [(1, 2, 1, 2), (30, 31, 30, 31)], []])
def test_crops_contain_smoke(squares):
    """Every pixel of smoke is in some crop; of a sample without smoke, every pixel."""
    pool = _only(small_pool(1), *squares)
    settings = TrainSettings(rounds=1, steps=200, batch=2, crop=16, temporal=1.0)
    plan = plan_round(settings, pool, seed=0, round=0)
    smoke = pool.targets[0, :, OPACITY_PLANE].amax(0) > 0.05
    covered = torch.zeros(32, 32, dtype=torch.bool)
    for y, x in plan.corners[:, 0].tolist():
        assert 0 <= y <= 16 and 0 <= x <= 16
        assert smoke[y : y + 16, x : x + 16].any() or not squares
        covered[y : y + 16, x : x + 16] = True
    assert covered[smoke].all() and (squares or covered.all())


def test_crops_reach_the_end_of_samples_that_blocks_do_not_divide():
    """An image of 100 pixels ends in a block of four pixels."""
    pool = Pool(
        *(torch.zeros(1, 2, *rest, 100, 100) for rest in ((3,), (8,))), torch.zeros(1, 2, 100, 100), torch.zeros(1)
    )
    pool = _only(pool, (97, 99, 98, 99), (0, 1, 0, 99))
    settings = TrainSettings(rounds=1, steps=300, batch=2, crop=48, temporal=1.0)
    corners = plan_round(settings, pool, seed=0, round=0).corners[:, 0]
    assert corners.max(0).values.tolist() == [52, 52] and corners.min(0).values.tolist() == [0, 0]
    # Each block as likely as another: 7 of 8 are in the first row.
    assert 0.05 < (corners[:, 0] == 52).float().mean() < 0.25


def test_a_step_learns_from_crops():
    pool = small_pool(2)
    settings = TrainSettings(rounds=1, steps=6, batch=2, crop=16, temporal=1.0)
    plan = plan_round(settings, pool, seed=0, round=0)
    trainer = Trainer(TINY, settings, seed=0, device="cpu")
    for step in range(3):
        (n,), (y, x) = plan.samples[step].tolist(), plan.corners[step, 0].tolist()
        guides, targets, motion = trainer._gather(pool, replace(plan, flips=torch.zeros_like(plan.flips)), step)
        assert torch.equal(targets[0], pool.targets[n, :, :, y : y + 16, x : x + 16].float())
        assert torch.equal(guides[0], pool.guides[n, :, :, y : y + 16, x : x + 16].float())
        assert torch.equal(motion[0], pool.motion[n, :, y : y + 16, x : x + 16].float())
    trainer.run(pool, plan)
    assert trainer.step == 6 and trainer.skipped == 0


@pytest.mark.parametrize("temporal", [0.0, 0.1])
def test_one_seed_gives_one_training_on_one_device(device, temporal):
    """Weights are equal to the bit, also on a GPU with images large enough for parallel sums."""
    pool, edge, steps = small_pool(4, kind="six").to(device), *((1, 3) if device == "cpu" else (4, 12))
    parts = (pool.guides, pool.targets, pool.motion)
    pool = Pool(*(part.repeat(*(1,) * (part.ndim - 2), edge, edge) for part in parts), pool.sequence)
    settings = TrainSettings(rounds=1, steps=steps, batch=4, temporal=temporal)
    network = NetworkSettings(width=16, levels=4, guide="six", stem=2)
    states = []
    for _ in range(2):
        trainer = Trainer(network, settings, seed=3, device=device)
        trainer.run(pool, plan_round(settings, pool, seed=3, round=0))
        states.append(trainer.state())
    first, second = states
    assert first.keys() == second.keys() and all((first[name] == second[name]).all() for name in first)


@pytest.mark.parametrize("kind", ["paper", "six"])
def test_a_mirrored_sample_is_that_of_the_mirrored_smoke(kind):
    settings = TrainSettings(batch=2, temporal=1.0)
    trainer = Trainer(TINY.model_copy(update={"guide": kind}), settings, seed=0, device="cpu")
    pool = small_pool(2, kind=kind)
    flips = torch.tensor([[True, False]])
    samples = torch.tensor([[1, 0]])
    guides, targets, motion = trainer._gather(pool, Plan(samples, samples, flips, None), 0)
    names = {"right": "left", "left": "right"}
    for plane, name in enumerate(GUIDES[kind]):
        source = GUIDES[kind].index(names.get(name, name))
        assert torch.equal(guides[0, :, plane], pool.guides[1, :, source].float().flip(-1)), name
    for plane, name in enumerate(PLANES):
        source = PLANES.index(names.get(name, name))
        assert torch.equal(targets[0, :, plane], pool.targets[1, :, source].float().flip(-1)), name
    assert torch.equal(motion[0, 0], -pool.motion[1, 0].float().flip(-1))
    assert torch.equal(motion[0, 1], pool.motion[1, 1].float().flip(-1))
    assert torch.equal(guides[1], pool.guides[0].float()) and torch.equal(targets[1], pool.targets[0].float())


def test_a_profile_is_overridden_part_by_part():
    fast = Profile.load("fast")
    profile = fast.override({"training": {"steps": 7, "batch": 2}, "network": {"width": 8}})
    assert (profile.training.steps, profile.training.rounds) == (7, fast.training.rounds)
    assert (profile.training.batch, profile.training.temporal) == (2, fast.training.temporal)
    assert profile.dataset == fast.dataset and fast.override({}) is fast
    for wrong, message in (
        ({"training": {"stps": 7}}, "unknown key 'training.stps'; did you mean 'steps'"),
        ({"network": {"guide": "paper"}}, "dataset.guide: expected paper"),
    ):
        assert re.search(message, error_of(fast.override, wrong))


@pytest.mark.parametrize(
    "network, dataset, message",
    [
        ("{guide: six}", "{}", "dataset.guide: expected six like network.guide, found paper"),
        ("{guide: back}", "{}", "network.guide: expected 'paper' or 'six'"),
        ("{}", "{resolution: 32}\ntraining: {crop: 64}", "training.crop: expected at most dataset.resolution"),
    ],
)
def test_a_profile_whose_parts_disagree_is_one_line(tmp_path, network, dataset, message):
    path = tmp_path / "a.yaml"
    path.write_text(f"name: a\nnetwork: {network}\ndataset: {dataset}\n")
    line = error_of(Profile.load, path)
    assert line.startswith(f"{path}: ") and message in line


def test_the_rate_rises_and_falls():
    settings = TrainSettings(rounds=2, steps=50, warmup=9, rate=1e-2, floor=0.1)
    rates = [settings.rate_at(step) for step in range(100)]
    assert rates[0] == pytest.approx(1e-3) and max(rates) == pytest.approx(1e-2, rel=0.03)
    assert rates[-1] == pytest.approx(1e-3, rel=0.02) and rates[20:] == sorted(rates[20:], reverse=True)
