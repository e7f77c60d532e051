"""Training: it learns, goes on exactly where it stopped, keeps the best network, and refuses what can't be learned."""

import csv
import math
from dataclasses import replace

import pytest
import torch
from builders.smoke_samples import small_pool

from wlm.config import profile_names
from wlm.errors import WlmError
from wlm.formats.artifact import read_artifact
from wlm.smoke.codec import load_network
from wlm.smoke.evaluation import evaluate
from wlm.smoke.fit import NetworkProfile, load_profile, train
from wlm.smoke.learn.losses import LossSettings
from wlm.smoke.learn.trainer import Plan, Trainer, TrainSettings, plan_round
from wlm.smoke.model import NetworkSettings, SixWayNetwork
from wlm.smoke.planes import GUIDES, OPACITY_PLANE, PLANES, Pool

TINY = NetworkSettings(width=8, levels=2)


def _profile(network: NetworkSettings = TINY, **training) -> NetworkProfile:
    settings = {"rounds": 2, "steps": 6, "batch": 4, "warmup": 2, "average": 0.5} | training
    return NetworkProfile(name="tiny", network=network, training=TrainSettings(**settings))


def _pool(settings, *, seed, round, device) -> Pool:
    return small_pool(4, 10 * (seed + 1) + 4 * round).to(device)


def _validation(settings, device) -> Pool:
    return small_pool(2).to(device)


def _train(path, profile, **options):
    return train(path, profile, **{"make_pool": _pool, "make_validation": _validation} | options)


def _curves(path) -> list[dict[str, float]]:
    with open(f"{path}.csv") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def _kept(path) -> tuple[dict, dict[str, bytes]]:
    """All that a network's file holds, but for the time that its training took."""
    held = read_artifact(path)
    settings = {**held.settings, "summary": {**held.settings["summary"], "seconds": 0}}
    return settings, {name: array.tobytes() for name, array in held.tensors.items()}


def test_it_learns_a_small_pool_by_heart(tmp_path, device):
    pool = small_pool(2).to(device)
    network = NetworkSettings(width=8, levels=3)
    before = evaluate(SixWayNetwork(network).to(device), pool)
    profile = _profile(network, rounds=1, steps=80, average=0.9, mirror="none", rate=3e-3)
    result = _train(
        tmp_path / "a", profile, device=device, make_pool=lambda *a, **k: pool, make_validation=lambda *a: pool
    )
    # 37.6 dB after 80 steps, on the CPU.
    assert result.finished and result.best > max(32.0, before.psnr + 6)
    assert result.score.lowest <= result.score.psnr <= result.score.highest
    assert result.steps == 80 and result.skipped == 0
    found, summary = load_network(tmp_path / "a", device=device)
    assert evaluate(found, pool).psnr == pytest.approx(result.best, abs=0.05)
    assert summary["psnr"] == result.best and set(summary["planes"]) == set(PLANES)
    assert 0.0 < summary["seconds"] <= round(result.seconds, 1)
    assert summary["device"] == ("cpu" if device == "cpu" else torch.cuda.get_device_name(device))


@pytest.mark.parametrize("losses", [LossSettings(), LossSettings(temporal=0.1)])
def test_a_stopped_training_ends_as_if_it_had_not_been(tmp_path, monkeypatch, losses):
    monkeypatch.setattr("wlm.smoke.fit._CHUNK", 2)
    profile = _profile(losses=losses)
    whole = _train(tmp_path / "whole", profile, seed=1)

    def stop(progress) -> None:
        if progress.step == 4:
            raise KeyboardInterrupt

    path = tmp_path / "parts"
    with pytest.raises(KeyboardInterrupt):
        _train(path, profile, seed=1, progress=stop)
    steps = []
    while not (result := _train(path, profile, seed=1, resume=True, minutes=0.0)).finished:
        steps.append(result.steps)
    assert steps == [6, 8, 10]
    assert _kept(path) == _kept(tmp_path / "whole")
    assert replace(result, seconds=0) == replace(whole, seconds=0)
    assert not (tmp_path / "parts.partial").exists()
    for one, other in zip(_curves(path), _curves(tmp_path / "whole"), strict=True):
        assert {**one, "seconds": 0} == {**other, "seconds": 0}


def test_a_finished_training_is_not_resumed(tmp_path):
    path = tmp_path / "a"
    _train(path, _profile())
    held = path.read_bytes()
    with pytest.raises(WlmError, match=r"a: is finished; without --resume it is trained anew$"):
        _train(path, _profile(), resume=True)
    assert path.read_bytes() == held and not (tmp_path / "a.partial").exists()


def _stopped(settings, **options) -> Pool:
    raise KeyboardInterrupt


def _worse(settings, *, seed, round, device) -> Pool:
    """After the first round what is learned is wrong."""
    pool = small_pool(4, 10)
    return pool if round == 0 else replace(pool, targets=1 - pool.targets)


def test_a_training_stopped_in_its_first_pool_is_resumed(tmp_path):
    profile = _profile()
    _train(tmp_path / "whole", profile)
    path, partial = tmp_path / "a", tmp_path / "a.partial"
    assert not _train(path, profile, minutes=0.0).finished  # an older one, of round 1
    with pytest.raises(KeyboardInterrupt):
        _train(path, profile, make_pool=_stopped)
    assert partial.exists() and load_network(path)[1]["steps"] == 0
    assert _train(path, profile, resume=True).finished
    assert _kept(path) == _kept(tmp_path / "whole")


@pytest.mark.parametrize("how", ["untrained", "damaged", "gone"])
def test_the_best_is_trusted_only_with_its_network(tmp_path, how):
    profile = _profile(steps=20, average=0.0)
    path, partial = tmp_path / "a", tmp_path / "a.partial"
    before = _train(path, profile, make_pool=_worse, minutes=0.0)
    held = partial.read_bytes()
    if how == "untrained":
        with pytest.raises(KeyboardInterrupt):
            _train(path, profile, make_pool=_stopped)
        partial.write_bytes(held)
    elif how == "damaged":
        path.write_bytes(path.read_bytes()[:-1])
    else:
        path.unlink()
    result = _train(path, profile, make_pool=_worse, resume=True)
    assert result.finished and result.best == result.score.psnr < before.best
    summary = load_network(path)[1]
    assert (summary["steps"], summary["psnr"]) == (40, result.best)


def test_curves_and_progress_tell_how_it_goes(tmp_path, monkeypatch):
    monkeypatch.setattr("wlm.smoke.fit._CHUNK", 3)
    seen = []
    result = _train(tmp_path / "a", _profile(rounds=3, validate_every=2), progress=seen.append)
    assert [(at.round, at.step, at.steps) for at in seen] == [(i // 2, 3 * (i + 1), 18) for i in range(6)]
    assert all(at.loss > 0 and at.seconds > 0 for at in seen)
    rows = _curves(tmp_path / "a")
    assert [row["step"] for row in rows] == [6, 12, 18]
    assert [math.isnan(row["psnr"]) for row in rows] == [True, False, False]
    assert rows[-1]["psnr"] == pytest.approx(result.score.psnr, abs=1e-5)
    assert rows[0]["loss"] == rows[0]["mse"] and rows[-1]["loss"] < rows[0]["loss"]


def test_the_best_network_is_kept(tmp_path):
    scores = []

    def train(rate: float):
        profile = _profile(steps=20, average=0.0, rate=rate)
        return _train(tmp_path / "a", profile, make_pool=_worse, progress=lambda at: scores.append(at.psnr))

    # Far below where it began it ends, and what was best stays.
    with pytest.raises(WlmError, match=r"diverged: .* dB after 40 steps, .* before the first; .* rate than 0.01"):
        train(1e-2)
    assert load_network(tmp_path / "a")[1]["psnr"] == max(scores)
    scores.clear()
    result = train(1e-3)
    assert result.best == max(scores) > result.score.psnr
    assert load_network(tmp_path / "a")[1]["psnr"] == result.best


def test_an_untrained_network_is_kept_until_there_is_a_better_one(tmp_path, monkeypatch):
    monkeypatch.setattr("wlm.smoke.fit._CHUNK", 2)
    result = _train(tmp_path / "a", _profile(), minutes=0.0)
    summary = load_network(tmp_path / "a")[1]
    assert not result.finished and result.steps > 0
    assert summary["steps"] == 0 and summary["psnr"] == result.best


def test_a_checkpoint_of_another_training_is_refused(tmp_path):
    path = tmp_path / "a"
    _train(path, _profile(), minutes=0.0)
    for profile in (_profile(rate=2e-3), _profile(NetworkSettings(width=16, levels=2))):
        with pytest.raises(WlmError, match="another fit"):
            _train(path, profile, resume=True)
    partial = tmp_path / "a.partial"
    content = bytearray(partial.read_bytes())
    content[-9] ^= 1
    partial.write_bytes(content)
    with pytest.raises(WlmError, match="damaged"):
        _train(path, _profile(), resume=True)
    # Without resume it is ignored.
    assert _train(path, _profile()).finished


@pytest.mark.parametrize("name", ["guides", "targets", "motion"])
def test_nan_in_a_pool_is_told(tmp_path, name):
    def broken(settings, *, seed, round, device) -> Pool:
        pool = small_pool(4, 10)
        values = getattr(pool, name).clone()
        values[2, 0, 0, 1] = math.nan
        return replace(pool, **{name: values}) if round == 1 else pool

    with pytest.raises(WlmError, match=f"round 1: {name}: sample 2: expected finite"):
        _train(tmp_path / "a", _profile(), make_pool=broken)
    with pytest.raises(WlmError, match="validation: expected samples, found none"):
        empty = Pool(*(tensor[:0] for tensor in vars(small_pool()).values()))
        _train(tmp_path / "a", _profile(), make_validation=lambda settings, device: empty)


def test_a_step_of_nan_is_left_out(device):
    settings = TrainSettings(rounds=1, steps=6, batch=4, graph=False)
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
    real = Trainer._gather

    def endless(self, *args):
        guides, targets, motion = real(self, *args)
        return guides, torch.full_like(targets, math.inf), motion

    monkeypatch.setattr(Trainer, "_gather", endless)
    with pytest.raises(WlmError, match=r"diverged: 12 steps of round 0.*smaller rate than 0.001"):
        _train(tmp_path / "a", _profile(steps=40))
    # The count goes on over stops.
    path = tmp_path / "b"
    for steps in (4, 8):
        assert _train(path, _profile(steps=40), minutes=0.0, resume=True).skipped == steps
    with pytest.raises(WlmError, match=r"diverged: 12 steps of round 0"):
        _train(path, _profile(steps=40), minutes=0.0, resume=True)


def test_a_plan_takes_each_sample_once_before_any_twice():
    settings = TrainSettings(rounds=1, steps=5, batch=4, mirror="sides")
    pool = small_pool(10)
    plan = plan_round(settings, pool, seed=3, round=1)
    samples, frames, turns = plan.samples, plan.frames, plan.turns
    assert plan.corners is None
    assert samples.shape == (5, 4) and sorted(samples.flatten().tolist()) == sorted([*range(10)] * 2)
    assert set(frames.flatten().tolist()) == {0, 1} and turns[..., 0].any() and not turns[..., 1].any()
    again, other = (plan_round(settings, pool, seed=3, round=number).samples for number in (1, 2))
    assert torch.equal(samples, again) and not torch.equal(samples, other)
    still = plan_round(settings.model_copy(update={"mirror": "none"}), pool, seed=3, round=1)
    assert not still.turns.any()
    pairs = plan_round(settings.model_copy(update={"losses": LossSettings(temporal=1.0)}), pool, seed=3, round=1)
    assert pairs.samples.shape == (5, 2)


def _only(pool: Pool, *squares: tuple[int, int, int, int]) -> Pool:
    """A pool whose first sample has smoke in these alone: first and last row, first and last column."""
    targets = pool.targets.clone()
    targets[0, :, OPACITY_PLANE] = 0
    for top, bottom, left, right in squares:
        targets[0, 1, OPACITY_PLANE, top : bottom + 1, left : right + 1] = 1.0
    return replace(pool, targets=targets)


@pytest.mark.parametrize("squares", [[(20, 22, 17, 30)], [(0, 0, 31, 31)], [(1, 2, 1, 2), (30, 31, 30, 31)], []])
def test_parts_of_samples_have_smoke(squares):
    """All that there is in some part or other; of a sample without any, all."""
    pool = _only(small_pool(1), *squares)
    settings = TrainSettings(rounds=1, steps=200, batch=2, crop=16, losses=LossSettings(temporal=1.0))
    plan = plan_round(settings, pool, seed=0, round=0)
    smoke = pool.targets[0, :, OPACITY_PLANE].amax(0) > 0.05
    seen = torch.zeros(32, 32, dtype=torch.bool)
    for y, x in plan.corners[:, 0].tolist():
        assert 0 <= y <= 16 and 0 <= x <= 16
        assert smoke[y : y + 16, x : x + 16].any() or not squares
        seen[y : y + 16, x : x + 16] = True
    assert seen[smoke].all() and (squares or seen.all())


def test_parts_reach_the_end_of_samples_that_squares_do_not_divide():
    """Of 100 pixels, of which the last four are a square of their own."""
    pool = Pool(
        *(torch.zeros(1, 2, *rest, 100, 100) for rest in ((3,), (8,))), torch.zeros(1, 2, 100, 100), torch.zeros(1)
    )
    pool = _only(pool, (97, 99, 98, 99), (0, 1, 0, 99))
    settings = TrainSettings(rounds=1, steps=300, batch=2, crop=48, losses=LossSettings(temporal=1.0))
    corners = plan_round(settings, pool, seed=0, round=0).corners[:, 0]
    assert corners.max(0).values.tolist() == [52, 52] and corners.min(0).values.tolist() == [0, 0]
    # Each square as likely as another: 7 of 8 are in the first row.
    assert 0.05 < (corners[:, 0] == 52).float().mean() < 0.25


def test_a_step_learns_from_parts():
    pool = small_pool(2)
    settings = TrainSettings(rounds=1, steps=6, batch=2, crop=16, losses=LossSettings(temporal=1.0))
    plan = plan_round(settings, pool, seed=0, round=0)
    trainer = Trainer(TINY, settings, seed=0, device="cpu")
    for step in range(3):
        (n,), (y, x) = plan.samples[step].tolist(), plan.corners[step, 0].tolist()
        guides, found, motion = trainer._gather(pool, replace(plan, turns=torch.zeros_like(plan.turns)), step)
        assert torch.equal(found[0], pool.targets[n, :, :, y : y + 16, x : x + 16].float())
        assert torch.equal(guides[0], pool.guides[n, :, :, y : y + 16, x : x + 16].float())
        assert torch.equal(motion[0], pool.motion[n, :, y : y + 16, x : x + 16].float())
    trainer.run(pool, plan)
    assert trainer.step == 6 and trainer.skipped == 0
    with pytest.raises(ValueError, match="at most 32 pixels"):
        plan_round(settings.model_copy(update={"crop": 48}), pool, seed=0, round=0)


@pytest.mark.parametrize("losses", [LossSettings(), LossSettings(temporal=0.1)])
def test_one_seed_gives_one_training_on_one_device(device, losses):
    """To the bit; images are large enough for a GPU to spread its sums over."""
    pool = small_pool(4, kind="six").to(device)
    pool = Pool(
        *(part.repeat(*(1,) * (part.ndim - 2), 4, 4) for part in (pool.guides, pool.targets, pool.motion)),
        pool.sequence,
    )
    settings = TrainSettings(rounds=1, steps=12, batch=4, losses=losses)
    network = NetworkSettings(width=16, levels=4, guide="six", stem=2)
    states = []
    for _ in range(2):
        trainer = Trainer(network, settings, seed=3, device=device)
        trainer.run(pool, plan_round(settings, pool, seed=3, round=0))
        states.append(trainer.state())
    one, other = states
    assert one.keys() == other.keys() and all((one[name] == other[name]).all() for name in one)


@pytest.mark.parametrize("kind", ["paper", "six"])
@pytest.mark.parametrize("way, swapped", [(0, ("right", "left")), (1, ("top", "bottom"))])
def test_a_sample_that_is_turned_over_is_what_its_mirror_would_be(way, swapped, kind):
    settings = TrainSettings(batch=2, losses=LossSettings(temporal=1.0))
    trainer = Trainer(TINY.model_copy(update={"guide": kind}), settings, seed=0, device="cpu")
    pool = small_pool(2, kind=kind)
    turns = torch.zeros(1, 2, 2, dtype=torch.bool)
    turns[0, 0, way] = True
    samples = torch.tensor([[1, 0]])
    guides, targets, motion = trainer._gather(pool, Plan(samples, samples, turns, None), 0)
    axis = -1 - way
    one, other = (PLANES.index(name) for name in swapped)
    names = dict(zip(swapped, reversed(swapped), strict=True))
    for plane, name in enumerate(GUIDES[kind]):
        source = GUIDES[kind].index(names.get(name, name))
        assert torch.equal(guides[0, :, plane], pool.guides[1, :, source].float().flip(axis)), name
    assert torch.equal(targets[0, :, one], pool.targets[1, :, other].float().flip(axis))
    assert torch.equal(targets[0, :, 5:], pool.targets[1, :, 5:].float().flip(axis))
    assert torch.equal(motion[0, way], -pool.motion[1, way].float().flip(axis))
    assert torch.equal(motion[0, 1 - way], pool.motion[1, 1 - way].float().flip(axis))
    assert torch.equal(guides[1], pool.guides[0].float()) and torch.equal(targets[1], pool.targets[0].float())


def test_profiles_load():
    names = [name for name in profile_names("smoke") if name.startswith("network-")]
    assert names == [f"network-{name}" for name in ("16", "24", "32", "fast", "paper")]
    for name in names:
        profile = load_profile(name.removeprefix("network-"))
        kind = "paper" if name == "network-paper" else "six"
        assert profile.name == name and profile.network.guide == profile.dataset.guide == kind
        widths = {"network-paper": 16, "network-fast": 24}
        assert profile.network.width == (widths[name] if name in widths else int(name[-2:]))
    with pytest.raises(WlmError, match="network-7"):
        load_profile("7")


@pytest.mark.parametrize(
    "network, dataset, told",
    [
        ("{guide: six}", "{}", "dataset.guide: expected six, which network.guide is, found paper"),
        ("{}", "{guide: six}", "dataset.guide: expected paper, which network.guide is, found six"),
        ("{guide: back}", "{}", "network.guide: expected 'paper', 'front', 'sides' or 'six'"),
        ("{levels: 1}", "{}", "network.levels: "),
        ("{}", "{resolution: 32}, training: {crop: 64}", "training.crop: expected at most 32, which dataset.res"),
    ],
)
def test_a_profile_whose_parts_disagree_is_one_line(tmp_path, network, dataset, told):
    path = tmp_path / "a.yaml"
    path.write_text(f"name: a\nnetwork: {network}\ndataset: {dataset}\n".replace("}, training", "}\ntraining"))
    with pytest.raises(WlmError) as error:
        load_profile(str(path))
    assert str(error.value).startswith(f"{path}: ") and told in str(error.value) and "\n" not in str(error.value)


def test_the_rate_rises_and_falls():
    settings = TrainSettings(rounds=2, steps=50, warmup=9, rate=1e-2, floor=0.1)
    rates = [settings.rate_at(step) for step in range(100)]
    assert rates[0] == pytest.approx(1e-3) and max(rates) == pytest.approx(1e-2, rel=0.03)
    assert rates[-1] == pytest.approx(1e-3, rel=0.02) and rates[20:] == sorted(rates[20:], reverse=True)
