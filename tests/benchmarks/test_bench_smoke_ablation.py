"""The ablation on tiny pools: each variant is what its name says, and learns from what the others do."""

from dataclasses import replace

import pytest
import torch
from builders.bench_rows import ENVIRONMENT, check_command
from builders.smoke_samples import small_pool
from typer.testing import CliRunner

import benchmarks.smoke_ablation as bench
from benchmarks import Row, read_json, tables, write_json
from benchmarks.rivals.smoke import coarse
from benchmarks.runner import Bench
from benchmarks.smoke_ablation import FULL, QUICK, AblationSizes, run, run_rows, variants
from wlm.errors import WlmError
from wlm.smoke.evaluation import Score, of_network, score
from wlm.smoke.network.dataset import make_validation
from wlm.smoke.network.settings import Profile
from wlm.smoke.network.trainer import Trainer, plan_round

SIZES = AblationSizes(dataset={"resolution": 32}, validation={"frames": 2}, rounds=2, steps=5)
BASE = Profile(
    name="tiny",
    network={"guide": "six", "width": 8, "levels": 3, "stem": 2, "adapters": False},
    training={"batch": 4, "warmup": 0, "crop": 64, "temporal": 0.02},
    dataset={"guide": "six", "guide_spacing": 0.02},
)
TRAINED = ["base", "four adapters", "no temporal loss", "one level less", "stem 1"]
GUIDES = ["guide of the paper"]


@pytest.fixture
def requests(monkeypatch):
    """Pools of plumes in place of simulated ones, and a list of those that were asked for."""
    requests = []

    def pool(settings, *, seed, round, device):
        requests.append((settings, seed, round))
        return small_pool(4, 4 * round, 32, settings.guide).to(device)

    def validation(settings, device):
        requests.append((settings, None, None))
        return small_pool(2, 12, 32, settings.guide).to(device)

    monkeypatch.setattr(bench, "make_pool", pool)
    monkeypatch.setattr(bench, "make_validation", validation)
    return requests


def changes(a, b, path=""):
    """What differs between nested settings, by dotted names."""
    differences = {}
    for name, value in b.items():
        if isinstance(value, dict):
            differences |= changes(a[name], value, f"{path}{name}.")
        elif value != a[name]:
            differences[path + name] = value
    return differences


def test_variants_are_what_they_say():
    profiles = variants(BASE)
    assert profiles.pop("base") == BASE and profiles.pop("coarse march") is None
    assert {name: changes(BASE.model_dump(), profile.model_dump()) for name, profile in profiles.items()} == {
        "four adapters": {"network.adapters": True},
        "no temporal loss": {"training.temporal": 0.0},
        "one level less": {"network.levels": 2},
        "stem 1": {"network.stem": 1},
        "guide of six lights": {},
        "guide of the paper": {"network.guide": "paper", "dataset.guide": "paper", "dataset.guide_spacing": None},
    }


def test_what_a_profile_is_already_is_left_out(requests):
    least = Profile(
        name="least",
        network={"guide": "paper", "width": 8, "levels": 2, "adapters": True},
        training={"batch": 2},
        dataset={"guide": "paper"},
    )
    lines = []
    rows = run_rows(SIZES, least, device="cpu", progress=lambda line: lines.append(line.split(": ", 1)[1]))
    options = ["base", "guide of six lights", "coarse march"]
    assert [row.option for row in rows] == options
    assert [line for line in lines if "left out" in line] == [
        f"{name}: left out, least is so already" for name in [*TRAINED[1:], "guide of the paper"]
    ]
    # Of the march alone, and of the variants with its guide.
    assert [settings.guide for settings, _, round in requests if round is None] == ["paper", "six"]
    with pytest.raises(WlmError, match="^bench: --only: stem 1: least is so already$"):
        run_rows(SIZES, least, ["stem 1"], device="cpu")


def test_an_unknown_row(requests):
    with pytest.raises(WlmError, match=r"^bench: --only: expected one of base, four adapters, .*; found 'no adapter'$"):
        run_rows(SIZES, BASE, ["base", "no adapter"], device="cpu")
    assert not requests


@pytest.mark.slow
def test_rows(requests, device, tmp_path):
    lengths = []
    rows = run_rows(SIZES, BASE, device=device, done=lambda rows: lengths.append(len(rows)))
    assert [row.option for row in rows] == [*TRAINED, *GUIDES, "coarse march"]
    assert lengths == [*range(1, len(rows) + 1)]
    for row in rows:
        assert (row.system, row.scene, row.method) == ("smoke-network", "validation, tiny", "ablation")
        assert row["psnr_min"] <= row["psnr"] <= row["psnr_max"]
        assert {"right_psnr", "left_psnr", "flicker_ratio"} < row.figures.keys()
        if row.option != "coarse march":
            assert row["encode_seconds"] > 0.0 and row["step_ms"] > 0.0
    assert rows[-1].notes == "no network" and "encode_seconds" not in rows[-1].figures
    counts = {row.option: row.get("parameters") for row in rows}
    assert all(counts[name] < counts["base"] for name in ("one level less", *GUIDES))
    assert counts["no temporal loss"] == counts["base"] < counts["four adapters"]
    path = tmp_path / "rows.json"
    others = [Row("smoke-network", "unseen smoke", "profiles")]
    write_json(path, others, ENVIRONMENT)
    write_json(path, rows, ENVIRONMENT)
    assert read_json(path)[0] == [*others, *rows]  # they don't replace those of the other benchmark
    lines = tables(rows).splitlines()
    assert lines.count("#### ablation: validation, tiny") == 1
    assert all(any(line.startswith(f"| {row.option} | {row['psnr']:.2f} |") for line in lines) for row in rows)


@pytest.mark.slow
def test_variants_learn_from_the_same_samples(requests):
    run_rows(SIZES, BASE, device="cpu")
    kinds = ["six", "paper"]
    assert [(settings.guide, seed, round) for settings, seed, round in requests] == [
        (kind, seed, round) for kind in kinds for seed, round in ((None, None), (0, 0), (0, 1))
    ]
    for settings, _, round in requests:
        changed = {"guide", "guide_spacing", "frames"}
        assert settings.resolution == 32 and settings.frames == (2 if round is None else 8)
        assert settings.model_dump(exclude=changed) == requests[0][0].model_dump(exclude=changed)


def test_a_row_is_of_a_network_that_has_learned(requests, device):
    """As one that is trained by hand."""
    base, temporal = run_rows(SIZES, BASE, ["no temporal loss", "base"], device=device)
    assert (base.option, temporal.option) == ("base", "no temporal loss") and base["psnr"] != temporal["psnr"]
    settings = BASE.training.model_copy(update={"rounds": 2, "steps": 5, "crop": None})
    trainer = Trainer(BASE.network, settings, seed=0, device=device)
    validation = small_pool(2, 12, 32, "six").to(device)
    before = score(of_network(trainer.average), validation)
    for i in range(2):
        pool = small_pool(4, 4 * i, 32, "six").to(device)
        trainer.run(pool, plan_round(settings, pool, seed=0, round=i))
    after = score(of_network(trainer.average), validation)
    assert base["psnr"] == pytest.approx(after.psnr, abs=1e-6 if device == "cpu" else 1e-3)
    assert abs(after.psnr - before.psnr) > 0.01
    sides = [base[f"{side}_psnr"] for side in ("right", "left")]
    assert sides == pytest.approx(after.planes[:2], abs=1e-6 if device == "cpu" else 1e-3)


def test_skipped_steps_are_in_the_notes(requests, monkeypatch):
    class Broken(Trainer):
        @property
        def skipped(self):
            return 3

    monkeypatch.setattr(bench, "Trainer", Broken)
    (row,) = run_rows(replace(SIZES, steps=1, rounds=1), BASE, ["base"], device="cpu")
    assert row.notes == "3 steps gave NaN or infinity"


def test_no_smoke(requests, monkeypatch):
    monkeypatch.setattr(bench, "make_pool", lambda *_, **__: small_pool().take(torch.zeros(6, dtype=torch.bool)))
    with pytest.raises(WlmError, match="^bench: round 0: expected frames with smoke, found none$"):
        run_rows(SIZES, BASE, ["base"], device="cpu")


@pytest.mark.slow
def test_simulated_smoke():
    """At the size of a check on a CPU, the march alone: it is that of the profile's own validation."""
    (row,) = run_rows(QUICK, BASE, ["coarse march"], device="cpu")
    settings = BASE.dataset.model_copy(update=dict(QUICK.dataset) | dict(QUICK.validation))
    pool = make_validation(settings)
    assert len(pool) >= 2
    assert row["psnr"] == pytest.approx(score(coarse, pool).psnr)
    assert tables([row]).count("| coarse march |") == 1


def test_sizes(monkeypatch):
    calls = []
    monkeypatch.setattr(bench, "run_rows", lambda *args, **options: calls.append((args, options)))
    run("paper", quick=True, device="cpu")
    run("fast", ["base"], quick=False, device="cpu", rounds=1, steps=7)
    ((quick, first, none), _), ((full, second, only), options) = calls
    assert (quick, first.name, tuple(none)) == (QUICK, "network-paper", ())
    assert full == replace(FULL, rounds=1, steps=7) and second.name == "network-fast" and only == ["base"]
    assert options["device"] == "cpu"
    with pytest.raises(WlmError, match="nosuch"):
        run("nosuch", quick=True, device="cpu")


def test_full_sizes_are_what_samples_and_trainings_get(requests, monkeypatch):
    """Of each shipped profile: all of its variants fit together."""
    trained = []

    def train(profile, pools, device):
        trained.append((profile, len(pools)))
        return Trainer(BASE.network, BASE.training, seed=0, device=device).average, 0, 1.0, 1.0

    monkeypatch.setattr(bench, "_train", train)
    monkeypatch.setattr(bench, "score", lambda method, pool: score(method, small_pool(2, 12, 32, "six")))
    for name in ("fast", "paper"):
        trained.clear()
        assert len(run(name, quick=False, device="cpu")) == len(trained) + 1 >= 6
        for profile, rounds in trained:
            training = profile.training
            assert (training.rounds, training.steps, training.crop, rounds) == (2, 1200, None, 2)
            sizes = ("cells", "resolution", "sequences", "frames", "validation_sequences")
            assert [getattr(profile.dataset, size) for size in sizes] == [50, 256, 14, 8, 4]
    assert {settings.frames for settings, _, round in requests if round is None} == {4}


def test_the_command(monkeypatch, tmp_path):
    from benchmarks.app import app

    rows = [bench._row(Bench("smoke-network", "cpu", scene="validation, tiny"), "base", _evaluation(), step_ms=3.0)]
    words = ["smoke-ablation", "--quick", "--profile", "paper", "--rounds", "2", "--steps", "9"]
    words += ["--only", "base", "--only", "stem 1"]
    command, arguments, options = check_command(monkeypatch, bench, rows, words, tmp_path)
    expected = "smoke-ablation --quick --profile paper --device cpu --rounds 2 --steps 9 --only base --only 'stem 1'"
    assert command == f"python -m benchmarks {expected}"
    assert arguments == ("paper", ["base", "stem 1"]) and options["quick"] and options["device"] == "cpu"
    assert (options["rounds"], options["steps"]) == (2, 9)
    _, arguments, options = check_command(monkeypatch, bench, rows, ["smoke-ablation"], tmp_path)
    assert arguments == ("fast", ()) and not options["quick"] and options["steps"] is None
    for option in ("--rounds", "--steps"):
        assert CliRunner().invoke(app, ["smoke-ablation", option, "0"]).exit_code == 2


def _evaluation():
    return Score(31.0, 30.0, 32.0, (31.0,) * 8, 0.1, 0.1, (30.0, 32.0))
