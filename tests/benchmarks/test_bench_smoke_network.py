"""The networks' benchmark on tiny grids: every row has its figures, and they agree with what they are of."""

from dataclasses import replace

import pytest
import torch
from builders.bench_rows import by_option, check_outputs

import benchmarks.smoke_network as bench
import benchmarks.smoke_sizes as sizes
from benchmarks.smoke_network import PANELS, QUICK, Subject, open_subjects, plotted, run_rows, score
from wlm.smoke.model import SmokeModel
from wlm.smoke.network.settings import DatasetSettings, NetworkSettings
from wlm.smoke.network.unet import SixWayNetwork

TINY = replace(
    QUICK,
    refine=2,
    resolution=32,
    kinds=("jet",),
    frames=2,
    six=(4.0, 1.0, 0.5),
    coarse=(4.0, 0.8),
    swept=((4.0, 1.0), (0.8, 4.0)),
    turns=(0.0, 60.0),
    scales=(1.0, 2.0),
    profile=16,
    samples=(1,),
    repeats=1,
)
NETWORK = NetworkSettings(guide="six", width=8, levels=2, stem=2)
SETTINGS = DatasetSettings(guide="six")


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    """A file with a network that is as it begins: its outputs are the guide's own planes."""
    path = tmp_path_factory.mktemp("networks") / "young.safetensors"
    torch.manual_seed(1)
    SmokeModel(SixWayNetwork(NETWORK), {"dataset": SETTINGS.model_dump(mode="json")}).save(path)
    return path


@pytest.fixture(scope="module")
def rows(network):
    """Without a path tracer, whether there is one or not."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "has_tracer", lambda: False)
        untrained = Subject("raw", SmokeModel(SixWayNetwork(NETWORK), {}), SETTINGS, False)
        return run_rows(TINY, [*open_subjects([network], []), untrained], device="cpu")


def test_every_row_has_its_figures(rows):
    methods = ["time against error", "frame", "flip book", "profiles", "density"]
    assert list(dict.fromkeys(row.method for row in rows)) == methods
    labels = [(row.method, row.option) for row in rows]
    assert len(set(labels)) == len(labels)
    for row in rows:
        assert (row.system, row.scene) == ("smoke-network", "unseen smoke")
        assert row.method == "density" or row["time_ms"] > 0.0
        assert "psnr" not in row.figures or row["psnr_min"] <= row["psnr"] <= row["psnr_max"]


def test_time_against_error(rows):
    table = by_option(rows, "time against error")
    psnr = {option: row.get("psnr") for option, row in table.items()}
    assert psnr["six ways, step 0.5"] is None and table["six ways, step 0.5"].notes == "the reference"
    assert psnr["six ways, step 1"] > psnr["six ways, step 4"] + 6.0
    assert psnr["coarse, h 0.8"] > psnr["coarse, h 4"] + 6.0
    between = psnr["coarse, h 4, nodes 1"], psnr["coarse, h 0.8, nodes 4"]
    assert psnr["coarse, h 4"] < min(between) and max(between) < psnr["coarse, h 0.8"]
    # A network that hasn't learned yet gives back its guide, which is the coarse march.
    assert psnr["young, fp32"] == pytest.approx(psnr["coarse, h 0.8"], abs=0.01)
    assert psnr["raw, fp32"] is None and table["raw, fp32"].notes == "not trained"


def test_grids_of_several_sizes(monkeypatch):
    monkeypatch.setattr(sizes, "_QUICK", (12, 8))
    monkeypatch.setattr(sizes, "_PIXELS", {"cpu": (16,)})
    partial = []
    rows = sizes.run(quick=True, device="cpu", done=lambda rows: partial.append(len(rows)))
    assert partial == [len(rows) // 2, len(rows)]
    for scene in ("plume, 12³, 16² pixels", "plume, 8³, 16² pixels"):
        table = {row.option: row for row in rows if row.scene == scene}
        assert all(row["time_ms"] > 0.0 for row in table.values())
        assert table["bake, step 1"]["psnr"] > table["bake, step 4"]["psnr"] + 6.0
        assert {"psnr"}.isdisjoint(table["bake, step 0.5"].figures | table["six pictures by diffusion"].figures)


def test_parts_of_a_frame(rows):
    frame = by_option(rows, "frame")
    for name in ("young", "raw"):
        parts = [frame[f"{name}, {part}"]["time_ms"] for part in ("guide", "network", "decode")]
        assert frame[f"{name}, all four"]["time_ms"] == pytest.approx(sum(parts) + frame["shade"]["time_ms"])
    assert "32x32x32" in frame["simulation"].notes


def test_a_score():
    references = [torch.zeros(8, 4, 4), torch.ones(8, 4, 4)]
    predicted = [torch.full((8, 4, 4), 0.1), torch.ones(8, 4, 4) - 0.01]
    predicted[0][6:] = 9.0  # opacity and emission don't count
    expected = {"psnr": 30.0, "psnr_min": 20.0, "psnr_max": 40.0}
    assert score(predicted, references) == pytest.approx(expected, abs=1e-3)


def test_rows_make_a_file_tables_and_a_plot(rows, tmp_path):
    points = plotted(rows)
    check_outputs(rows, tmp_path, PANELS, points)
    assert [row.method for row in points] == ["six ways"] * 3 + ["coarse"] * 4 + ["young", "raw"]
    assert points[0].option == "step 4" and points[-3].option == "h 0.8, nodes 4"
