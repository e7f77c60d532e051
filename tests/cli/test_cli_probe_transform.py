"""The commands on a transform's file, which knows its probes by their places."""

import json

import numpy as np
import pytest
from builders.probe_sets import synthetic
from builders.running import call, fails

from wlm.cli.console import progress_bar
from wlm.probe import load, save_probes

PROBES, DEAD = 160, 5


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """`room.npz`, and files of it without positions (`a.wlm`) and with (`b.wlm`)."""
    folder = tmp_path_factory.mktemp("transform")
    probes = synthetic(PROBES, dead=DEAD)
    save_probes(folder / "room.npz", probes.position, probes.values)
    call("probe", "compress", folder / "room.npz", "-o", folder / "a.wlm", "--target-psnr", 42)
    call("probe", "compress", folder / "room.npz", "-o", folder / "b.wlm", "--max-bytes", 3000, "--positions")
    return folder


def test_size_and_psnr_are_as_asked(folder):
    assert 2700 < (folder / "b.wlm").stat().st_size <= 3000
    call("probe", "evaluate", folder / "a.wlm", folder / "room.npz", "--hold-out", "--json", folder / "a.json")
    report = json.loads((folder / "a.json").read_text())
    assert 42.0 <= report["psnr"] < 43.0 and report["between_psnr"] > 30.0
    held = report["held_out"]
    assert held["probes"] == (PROBES - DEAD) // 5 and held["psnr"] > held["nearest"] > 0.0
    assert held["bytes"] <= 0.8 * report["bytes"]
    facts = json.loads(call("probe", "info", folder / "a.wlm", "--json"))
    assert facts["method"] == "transform" and not facts["positions"] and facts["dead"] == DEAD
    assert "transform" in call("probe", "info", folder / "b.wlm")


def test_probes_and_points_are_decoded(folder, tmp_path):
    call("probe", "decode", folder / "a.wlm", "--positions", folder / "room.npz", "-o", tmp_path / "own.npz")
    own, room = load(tmp_path / "own.npz"), load(folder / "room.npz")
    assert (own.values[~room.live] == 0).all() and np.abs(own.values - room.values).max() < 0.1 * np.ptp(room.values)
    (tmp_path / "points.json").write_text(json.dumps((room.position[:7] + 0.01).tolist()))
    words = [
        "probe",
        "decode",
        folder / "a.wlm",
        "--positions",
        tmp_path / "points.json",
        "-o",
        tmp_path / "points.npz",
    ]
    assert "the file has no positions" in fails(*words)
    call(*words, "--original", folder / "room.npz")
    assert load(tmp_path / "points.npz").values.shape == (7, 27)
    call("probe", "decode", folder / "b.wlm", "-o", tmp_path / "stored.npz")
    np.testing.assert_allclose(load(tmp_path / "stored.npz").position, room.position, atol=1e-3)
    assert "expected the 160 probes" in fails(*words, "--original", tmp_path / "points.npz")


def test_walks_and_exports_have_the_places(folder, tmp_path):
    call("probe", "walk", folder / "a.wlm", folder / "room.npz", "--frames", 2)
    call("probe", "volume", folder / "b.wlm", "-o", tmp_path / "volume")
    three = ["probe", "export", folder / "a.wlm", "--engine", "three"]
    call(*three, "--original", folder / "room.npz", "-o", tmp_path / "grid", "--cells", 3)
    assert "holds no positions" in fails(*three, "-o", tmp_path / "none")
    call("probe", "export", folder / "b.wlm", "-o", tmp_path / "b")
    call("probe", "export", folder / "a.wlm", "-o", tmp_path / "a", "--original", folder / "room.npz")
    assert {path.name for path in (tmp_path / "a").iterdir()} >= {"light.bin", "probe.glsl", "probe.json"}
    assert "holds no positions" in fails("probe", "export", folder / "a.wlm", "-o", tmp_path / "c")


def test_options_of_the_other_method_are_refused(folder, tmp_path):
    words = ["probe", "compress", folder / "room.npz", "-o", tmp_path / "a.wlm"]
    assert "--ratio: expected a profile of the method gaussians" in fails(*words, "--ratio", 0.1)
    assert "--checkpoint-every: expected with Gaussians" in fails(*words, "--checkpoint-every", 1)
    assert "--max-bytes: expected a profile of the method transform" in fails(
        *words, "--profile", "small", "--max-bytes", 9
    )
    assert not list(tmp_path.iterdir())


def test_progress_of_unknown_length_tells_no_time_left(capsys):
    for done, total, text in ((3, 0, "PSNR 48 dB"), (4, 5, "")):
        with progress_bar("fit") as report:
            report(done, total, text)
    first, second = capsys.readouterr().err.splitlines()
    assert first == "fit: 3, PSNR 48 dB" and second.startswith("fit: 4 of 5, 0:0")


def test_several_hours_in_one_file(folder, tmp_path):
    room = load(folder / "room.npz")
    hours = {"sh_06.00": room.values[:30], "sh_18.50": room.values[:30, ::-1]}
    np.savez(tmp_path / "day.npz", position=room.position[:30], **hours)
    file, day = tmp_path / "day.wlm", tmp_path / "day.npz"
    call("probe", "compress", day, "--times", "18.5,6", "-o", file, "--target-psnr", 40, "--positions")
    facts = json.loads(call("probe", "info", file, "--json"))
    assert facts["times"] == [6.0, 18.5] and {hour["time"] for hour in facts["hours"]} == {6.0, 18.5}
    assert "bytes of 18.5 h" in call("probe", "info", file)
    call("probe", "evaluate", file, day, "--json", tmp_path / "all.json")
    report = json.loads((tmp_path / "all.json").read_text())
    assert report["times"] == [6.0, 18.5] and all(hour["psnr"] >= 39.99 for hour in report["hours"])
    call("probe", "evaluate", file, day, "--time", "18.5", "--json", tmp_path / "one.json")
    assert json.loads((tmp_path / "one.json").read_text())["psnr"] == report["hours"][1]["psnr"]
    for time in (6, 9, 18.5):
        call("probe", "decode", file, "--time", time, "-o", tmp_path / f"{time}.npz")
    at = {time: load(tmp_path / f"{time}.npz").values for time in (6, 9, 18.5)}
    np.testing.assert_allclose(at[9], 0.76 * at[6] + 0.24 * at[18.5], atol=1e-6)
    call("web", file, "-o", tmp_path / "day.html")
    assert "6, of 6, 18.5" in (tmp_path / "day.html").read_text()
    call("probe", "export", file, "--time", 9, "-o", tmp_path / "engine")
    assert json.loads((tmp_path / "engine" / "probe.json").read_text())["time"] == 9.0
    for words, line in (
        (["decode", file, "-o", tmp_path / "x.npz"], "expected --time, the file holds 6, 18.5"),
        (["decode", folder / "b.wlm", "--time", 9, "-o", tmp_path / "x.npz"], "expected a file of several hours"),
        (["evaluate", file, day, "--time", 9], "expected one of the file's hours to compare with, 6, 18.5, got 9"),
        (["evaluate", file, day, "--volume"], "--time: expected with --volume"),
        (["evaluate", file, day, "--time", 6, "--hold-out"], "--hold-out: expected no --time"),
        (["compress", day, "--times", "6,x", "-o", tmp_path / "x.wlm"], "--times: expected hours as 9,12,21.5"),
        (["compress", day, day, "-o", tmp_path / "x.wlm"], "expected one file of probes"),
    ):
        assert line in fails("probe", *words)
