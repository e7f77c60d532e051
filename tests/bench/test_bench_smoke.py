"""The smoke benchmark on tiny grids: every row has its figures, and they agree with what they are of."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

import wlm.bench.smoke as bench
from wlm.bench import Row, plot, read_json, table, write_json
from wlm.bench.report import figures, report, tables
from wlm.bench.smoke import PANELS, plotted, run, run_rows
from wlm.bench.smoke_air import storage_rows
from wlm.bench.smoke_light import make_cloud, six_rows
from wlm.bench.smoke_setup import QUICK, Bench, number, percent
from wlm.bench.smoke_setup import row as make_row
from wlm.bench.timing import Timing
from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume
from wlm.smoke.baking import bake
from wlm.smoke.camera import Camera
from wlm.smoke.learn.synthetic import make_plume

TINY = replace(
    QUICK,
    lattice=32,
    small=12,
    compared=(20, 40),
    drift=60,
    fills=(0.0, 1.0),
    coarse=6,
    cloud=24,
    resolution=16,
    guide_shared=(2, 10),
    guide_alone=(1, 10),
    six=(1.0, 0.5),
    plume=8,
    scale=0.08,
    frames=2,
    repeats=1,
)
METHODS = [
    ("jet", "lattice"),
    ("jet", "lattice storage"),
    ("ball", "advection"),
    ("cube", "advection bricks"),
    ("cloud", "guide"),
    ("cloud", "six ways"),
    ("plume", "weights"),
    ("jet-sphere", "frame"),
]


@pytest.fixture(scope="module")
def rows():
    return run_rows(TINY, device="cpu")


def of(rows, method: str) -> dict[str, Row]:
    return {row.option: row for row in rows if row.method == method}


def share(text: str) -> float:
    assert text.endswith("%")
    return float(text[:-1]) / 100.0


def test_every_row_has_its_figures(rows):
    assert list(dict.fromkeys((row.scene, row.method) for row in rows)) == METHODS
    keys = [(row.scene, row.method, row.option) for row in rows]
    assert len(set(keys)) == len(keys)
    for row in rows:
        assert row.system == "smoke" and figures(row)
        assert (row.decode_ms is None) == (row.method in ("lattice storage", "weights"))
        assert row.decode_ms is None or row.decode_ms > 0.0


def test_shares_of_the_copy(rows):
    """The bytes that a step must move, over its time and the copy's bandwidth."""
    lattice = of(rows, "lattice")
    copied = 1e9 * float(figures(lattice["a copy"])["GB/s"])
    for option, size, cell in (
        ("float32, periodic", 32, 152),
        ("float32, all boundaries", 32, 153),
        ("float16, all boundaries", 32, 77),
        ("float32, all boundaries, D3Q27 recursive", 32, 217),
        ("float16, all boundaries, 12³", 12, 77),
    ):
        row = lattice[option]
        seconds = 1e-3 * row.decode_ms
        assert share(figures(row)["of the copy"]) == pytest.approx(size**3 * cell / seconds / copied, rel=0.01)
        assert float(figures(row)["MLUPS"]) == pytest.approx(1e-6 * size**3 / seconds, rel=0.01)
    for option, moved in (("semi-lagrangian, float32", 8), ("maccormack, float32", 20), ("maccormack, float16", 10)):
        row = of(rows, "advection")[option]
        found = 24**3 * moved / (1e-3 * row.decode_ms) / copied
        assert share(figures(row)["of the copy"]) == pytest.approx(found, rel=0.01)


def test_sixteen_bits_lose_little(rows):
    storage = of(rows, "lattice storage")
    assert 0.0 < share(figures(storage["float16, 40 steps"])["RMS"]) < 0.01
    assert share(figures(storage["float16, 40 steps"])["largest"]) > share(figures(storage["float16, 40 steps"])["RMS"])
    drift = {name: abs(float(figures(storage[f"{name}, 60 steps"])["mass drift"])) for name in ("float32", "float16")}
    assert drift["float32"] < drift["float16"] < 1e-4


def test_schemes_and_a_solution(rows):
    """The ball comes round; the scheme of second order is the better one, and 16 bits change little."""
    found = of(rows, "advection")
    error = {option: share(figures(row)["RMS"]) for option, row in found.items() if "RMS" in figures(row)}
    assert len(error) == 4
    assert error["maccormack, float32"] < 0.8 * error["semi-lagrangian, float32"] < 0.8
    for scheme in ("maccormack", "semi-lagrangian"):
        assert error[f"{scheme}, float16"] == pytest.approx(error[f"{scheme}, float32"], rel=0.05)
        assert found[f"{scheme}, float32"].max_error < 1.0
    bricks = of(rows, "advection bricks")
    assert share(figures(bricks["maccormack, smoke in 0%"])["worked on"]) == 0.0
    assert share(figures(bricks["maccormack, smoke in 100%"])["worked on"]) == 1.0


def test_smaller_steps_have_smaller_errors(rows):
    guides, six = of(rows, "guide"), of(rows, "six ways")
    light = {option: share(figures(row)["light RMS"]) for option, row in guides.items()}
    assert light["h 2"] < light["h 10"] and light["h 1, each pixel alone"] < light["h 10, each pixel alone"]
    assert light["h 10, float16"] == pytest.approx(light["h 10"], rel=0.01)
    assert guides["h 2"].psnr > guides["h 10"].psnr and guides["h 2"].max_error < guides["h 10"].max_error
    assert six["step 0.5"].max_error < six["step 1"].max_error
    assert share(figures(six["step 0.5"])["RMS by halving"]) < share(figures(six["step 1"])["RMS by halving"])
    # What the coarser one lacks of the finer is what the finer one says by halving.
    assert figures(six["step 1"])["RMS from the finest"] == figures(six["step 0.5"])["RMS by halving"]


def test_six_ways_are_those_of_the_system(rows):
    """A row's error is what the march itself says."""
    volume = DensityVolume(make_cloud(24, "cpu"), extinction=8.0 / 24)
    eye = volume.centre + 24 * np.array([1.6, 0.9, 2.2])
    camera = Camera.look_at(eye, volume.centre, extent=1.15 * 24, height=16, width=16)
    assert of(rows, "six ways")["step 1"].max_error == bake(volume, camera, step=1.0).error.largest


def test_weights(rows):
    """Eq. 5 is too bright by half on average; the sums of the other rules are 1."""
    bias = {rule: share(figures(row)["bias"]) for rule, row in of(rows, "weights").items()}
    assert set(bias) == {"squared", "absolute", "normalised"}
    assert bias["absolute"] > 0.3 and abs(bias["squared"]) < 0.15 and abs(bias["normalised"]) < 0.15
    for row in of(rows, "weights").values():
        given = figures(row)
        assert share(given["least"]) < share(given["bias"]) < share(given["most"])
        assert 0.0 < share(given["RMS"]) < share(given["worst light's RMS"])


def test_a_frame_is_the_sum_of_its_stages(rows):
    frame = of(rows, "frame")
    parts = ("simulation", "guide", "obstacles' shadows", "weights and background")
    total = frame["all but the network"]
    assert total.decode_ms == pytest.approx(sum(frame[part].decode_ms for part in parts))
    assert float(figures(total)["frames/s"]) == pytest.approx(1e3 / total.decode_ms, rel=0.01)
    assert frame["air alone"].decode_ms < frame["simulation"].decode_ms


def test_one_measurement_twice():
    """Errors don't hang on what ran before."""
    setup = Bench("cpu", TINY)
    assert storage_rows(setup) == storage_rows(setup)
    first, second = six_rows(setup), six_rows(setup)
    assert [row.max_error for row in first] == [row.max_error for row in second]


def test_the_cloud():
    cloud = make_cloud(24, "cpu")
    assert cloud.shape == (24, 24, 24) and 0.0 == float(cloud.min()) < float(cloud.max()) <= 1.0
    assert 0.05 < float((cloud > 0).float().mean()) < 0.5
    assert torch.equal(cloud, make_cloud(24, "cpu")) and not torch.equal(cloud, make_cloud(24, "cpu", seed=1))


def test_the_plume():
    plume, cold = make_plume(16), make_plume(16, hot=False, extinction=3.0)
    assert torch.equal(plume.density, cold.density) and (plume.voxel, cold.extinction) == (1 / 16, 3.0)
    assert cold.temperature is None and 0.0 < float(plume.density.max()) <= 1.5
    assert float(plume.temperature[:, :4].max()) > 0.5 and float(plume.temperature[:, 5:].max()) == 0.0
    # It rises, and widens as it does.
    wide = (plume.density > 0).sum((0, 2))
    assert 0 < int(wide[1]) < int(wide[6]) < int(wide[11])
    assert torch.equal(plume.density, make_plume(16).density)
    assert not torch.equal(plume.density, make_plume(16, seed=2).density)


def test_notes_of_rows():
    timing = Timing(8.0, 7.0, 9.0, 3)
    made = make_row("s", "m", "o", {"a b": "1%", "c": "2"}, "more, of it", timing=timing, calls=4, max_error=0.5)
    assert made.notes == "a b: 1%; c: 2; more, of it"
    assert figures(made) == {"a b": "1%", "c": "2"}
    assert (made.decode_ms, made.decode_ms_spread, made.max_error) == (2.0, 0.5, 0.5)
    assert make_row("s", "m", "o").notes == "" and figures(make_row("s", "m", "o", note="just words")) == {}
    assert (number(23825.4), number(6.036), number(0.0)) == ("23,825", "6.04", "0")
    assert (percent(0.90961), percent(1.0), percent(6.3e-5)) == ("91%", "100%", "0.0063%")


def test_tables():
    """A table a method with columns of its own; other systems' rows keep the table that they have."""
    first = make_row("jet", "lattice", "a", {"cells": "16³"}, timing=Timing(1.0, 0.5, 2.0, 3))
    second = make_row("jet", "lattice", "b", {"cells": "16³", "MLUPS": "7"}, "slow")
    third = make_row("plume", "weights", "c", {"bias": "+1.0%"}, max_error=0.25)
    made = tables([first, second, third])
    assert made == (
        "#### lattice: jet\n\n"
        "|  | cells | ms | p90−p10 ms | MLUPS | notes |\n"
        "|---|---:|---:|---:|---:|---|\n"
        "| a | 16³ | 1 | 1.5 |  |  |\n"
        "| b | 16³ |  |  | 7 | slow |\n"
        "\n#### weights: plume\n\n"
        "|  | bias | largest error |\n"
        "|---|---:|---:|\n"
        "| c | +1.0% | 0.25 |\n"
    )
    other = Row("probe", "room", "ours", "a", notes="4 Gaussians; title: no column")
    assert tables([other]) == table([other])
    assert tables([first, other]) == table([other]) + "\n" + tables([first])
    assert tables([]) == ""


def test_rows_make_a_file_a_page_and_a_plot(rows, tmp_path):
    path = tmp_path / "rows.json"
    environment = {"device": "cpu", "device_name": "a CPU", "command": "wlm bench smoke", "date": "2026-01-02T03:04:05"}
    environment |= {"threads": 1, "python": "3", "warp": "1", "torch": "2"}
    write_json(path, rows, environment)
    assert read_json(path)[0] == rows
    page = report([path])
    for scene, method in METHODS:
        assert page.count(f"#### {method}: {scene}\n") == 1
    assert page.count("\n| ") == len(rows) + len(METHODS)
    assert {row.method for row in plotted(rows)} == {"guide", "six ways"}
    plot(plotted(rows), tmp_path / "rows.png", PANELS)
    assert (tmp_path / "rows.png").stat().st_size > 10_000


def test_the_command(rows, tmp_path, monkeypatch):
    """What it writes, and the command line that it keeps."""
    from wlm.cli.bench import app

    seen = {}

    def measured(**options):
        seen.update(options)
        return rows

    monkeypatch.setattr(bench, "run", measured)
    json, png = str(tmp_path / "a.json"), str(tmp_path / "a.png")
    result = CliRunner().invoke(app, ["smoke", "--quick", "--json", json, "--plot", png])
    assert result.exit_code == 0, result.output
    assert seen["quick"] and seen["device"] == "cpu"
    found, environment = read_json(json)
    assert found == rows and environment["command"] == "wlm bench smoke --quick --device cpu"
    assert "#### frame: jet-sphere" in result.output and (tmp_path / "a.png").stat().st_size > 1000


def test_what_is_refused():
    with pytest.raises(WlmError, match="device 'tpu'"):
        run(quick=True, device="tpu")


@pytest.mark.parametrize(("system", "label"), [("smoke", "time (ms)"), ("probe", "decode time (ms)")])
def test_what_a_time_is_called(system: str, label: str, tmp_path, monkeypatch):
    """Only what decodes has a decode time."""
    import matplotlib

    monkeypatch.setitem(matplotlib.rcParams, "svg.fonttype", "none")
    plot([Row(system, "s", "m", decode_ms=1.0, psnr=30.0)], tmp_path / "p.svg", "decode_ms")
    assert f">{label}<" in (tmp_path / "p.svg").read_text(encoding="utf-8")
