import json
import re

import numpy as np
import pytest
import yaml
from builders.probe_sets import synthetic
from builders.running import call, check_a_stop_is_resumed, fails

import wlm.cli.console
import wlm.probe.volume.walk
from wlm.probe import data, evaluate, save_probes

PROBES, DEAD = 160, 5


@pytest.fixture(scope="session")
def room(tmp_path_factory):
    """A probe set with five dead probes, in a file."""
    path = tmp_path_factory.mktemp("room") / "room.npz"
    probes = synthetic(PROBES, dead=DEAD)
    save_probes(path, probes.position, probes.values)
    return path


@pytest.fixture(scope="session")
def profile(tmp_path_factory):
    path = tmp_path_factory.mktemp("profile") / "tiny.yaml"
    settings = {"name": "tiny", "method": "gaussians", "ratio": 0.1, "hidden": 16, "latent": 3, "steps": 30}
    path.write_text(yaml.safe_dump(settings))
    return path


@pytest.fixture(scope="session")
def fitted(room, profile, tmp_path_factory):
    """The set compressed, without its positions."""
    path = tmp_path_factory.mktemp("fitted") / "a.wlm"
    call("compress", room, "-o", path, "--profile", profile)
    return path


@pytest.fixture(scope="session")
def carrying(room, profile, tmp_path_factory):
    """The set compressed, with its positions."""
    path = tmp_path_factory.mktemp("carrying") / "a.wlm"
    call("compress", room, "-o", path, "--profile", profile, "--positions")
    return path


def test_the_options_of_compress_reach_the_fit(room, profile, tmp_path):
    out, other, wider = tmp_path / "a.wlm", tmp_path / "b.wlm", tmp_path / "wider.yaml"
    wider.write_text(profile.read_text().replace("latent: 3", "latent: 4"))
    options = ["--profile", wider, "--ratio", 0.2, "--latent", 3, "--steps", 12, "--positions"]
    call("compress", room, "-o", out, *options, "--key", "sh", "--convention", "threejs")
    model = wlm.load(out)
    settings = model.profile
    assert (settings.ratio, settings.latent, settings.steps) == (0.2, 3, 12)
    assert model.source == data.load(room).source[:8]
    slack = model.extent * model.size.max() / 65535
    np.testing.assert_allclose(model.stored_positions(), data.load(room).position, rtol=0, atol=slack)
    # The seed of the command is the seed of the fit.
    for seed, same in ((0, True), (1, False)):
        call("compress", room, "-o", other, *options, "--seed", seed)
        assert (other.read_bytes() == out.read_bytes()) is same
    # Another convention is other light.
    call("compress", room, "-o", other, *options, "--convention", "godot")
    assert wlm.load(other).source == data.load(room, convention="godot").source[:8] != model.source


def test_a_fit_to_pictures_takes_a_mesh(room, profile, tmp_path):
    mesh, out = tmp_path / "floor.obj", tmp_path / "a.wlm"
    mesh.write_text("v 0 0 0\nv 8 0 0\nv 8 0 6\nv 0 0 6\nf 1 2 3 4\n")
    files = []
    for words in ((), ("--mesh", mesh)):
        call("compress", room, "-o", out, "--profile", profile, "--method", "gaussians", *words)
        files.append(out.read_bytes())
    assert files[0] != files[1]


def decoded(path, *words):
    """The values that decode wrote, in the convention that the file states."""
    call("decode", *words, "-o", path)
    return data.load(path)


@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_decode_at_the_probes(suffix, fitted, carrying, room, tmp_path):
    probes = data.load(room)
    decoder = wlm.load(fitted).decoder(position=probes.position)
    light = decoded(tmp_path / f"a{suffix}", fitted, "--positions", room)
    np.testing.assert_array_equal(light.values, decoder.decode_probes())
    np.testing.assert_array_equal(light.position, probes.position)
    assert np.count_nonzero(~light.live) == DEAD
    stored = decoded(tmp_path / f"b{suffix}", carrying)
    np.testing.assert_array_equal(stored.values, wlm.load(carrying).decoder().decode_probes())
    assert not stored.values[~probes.live].any()


def test_decode_anywhere(fitted, tmp_path):
    points = np.random.default_rng(0).random((PROBES, 3)) * [8, 3, 6]
    expected = wlm.load(fitted).decoder().decode(points)
    assert expected.any(1).all(), "as many points as probes, and none of them is dead"
    np.savez(tmp_path / "a.npz", position=points)
    light = decoded(tmp_path / "out.npz", fitted, "--positions", tmp_path / "a.npz")
    np.testing.assert_array_equal(light.values, expected)
    path = write_json(tmp_path / "b.json", points[:1].tolist())
    np.testing.assert_array_equal(decoded(tmp_path / "out.json", fitted, "--positions", path).values, expected[:1])


def write_json(path, content):
    path.write_text(json.dumps(content))
    return path


def test_evaluate_prints_and_writes_the_report(fitted, room, tmp_path):
    words = ["evaluate", fitted, room, "--json", tmp_path / "r.json"]
    text = call(*words)
    probes, size = data.load(room), fitted.stat().st_size
    report = evaluate(wlm.load(fitted), probes)
    stored = json.loads((tmp_path / "r.json").read_text())
    assert stored == report.to_json()
    for word in (f"{report.psnr:.2f}", f"{report.irradiance_psnr:.2f}", f"{size:,}", "wlm tiny", "harmonics, band 2"):
        assert word in text
    said = [line.removeprefix("warning: ") for line in call.stderr.splitlines() if line.startswith("warning: ")]
    assert f"at the worst, probe {report.worst_probe['probe']} at (" in call.stderr and said == report.warnings


def test_evaluate_against_another_set(fitted, tmp_path):
    probes = synthetic(PROBES, dead=DEAD)
    save_probes(tmp_path / "a.npz", probes.position, 2.0 * probes.values)
    call("evaluate", fitted, tmp_path / "a.npz")
    assert f"warning: {tmp_path / 'a.npz'}: not the input that {fitted} was made from" in call.stderr
    other = synthetic(PROBES, seed=3, dead=DEAD)
    save_probes(tmp_path / "b.npz", other.position, other.values)
    assert f"expected the positions of its own {PROBES} probes" in fails("evaluate", fitted, tmp_path / "b.npz")
    save_probes(tmp_path / "c.npz", probes.position[1:], probes.values[1:])
    line = fails("evaluate", fitted, tmp_path / "c.npz")
    assert f"has {PROBES - 1} probes, but {PROBES} were compressed" in line


def test_info_says_what_is_in_the_file(fitted, carrying):
    facts = json.loads(call("info", fitted, "--json"))
    model = wlm.load(fitted)
    assert facts["bytes_on_disk"] == fitted.stat().st_size == sum(facts["parts"].values())
    assert (facts["probes"], facts["dead_probes"], facts["numbers_per_probe"]) == (PROBES, DEAD, 27)
    assert facts["gaussians"] == model.content.count and facts["positions_stored"] is False
    assert facts["bits_per_probe"] == facts["bytes_on_disk"] * 8 / PROBES
    assert facts["profile"]["name"] == "tiny" and facts["GPU_bytes"] == model.content.nbytes
    assert facts["device"] == "cpu" and facts["bytes_on_device"] == model.decoder().device_bytes
    text = call("info", fitted)
    assert f"{facts['bytes_on_disk']:,}" in text and facts["source"] in text
    assert re.search(r"positions stored +│ +no │", text)
    facts = json.loads(call("info", carrying, "--json"))
    assert facts["positions_stored"] is True and 2e5 < sum(facts["volume_bytes"].values()) < 1e6
    assert "device 'tpu'" in fails("info", fitted, "--device", "tpu")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["compress", "absent.npz", "-o", "{tmp}/a.wlm"], "absent.npz: no such file or folder"),
        (["compress", "{set}", "-o", "{set}"], "ends in .wlm"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--ratio", "0"], "--ratio: expected"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--mesh", "absent.glb"], "absent.glb"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--key", "noon"], "expected values named noon"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--convention", "quake"], "convention"),
        (["decode", "{fit}", "-o", "{tmp}/f.npz"], "stores no positions"),
        (["decode", "{fit}", "-o", "{tmp}/f.npz", "--positions", "{bad}"], "position[0]: expected finite"),
        (["decode", "{fit}", "-o", "{tmp}/f.exr", "--positions", "{set}"], "ends in .npz or .json"),
        (["decode", "{fit}", "-o", "{tmp}/f.npz", "--positions", "{set}", "--convention", "quake"], "convention"),
        (["decode", "{fit}", "-o", "{other}", "--positions", "{other}"], "expected another file than the input"),
        (["evaluate", "{fit}", "{bad}", "--json", "{bad}"], "expected another file than the input"),
        (["evaluate", "{fit}", "absent.npz"], "absent.npz: cannot read the arrays: No such file"),
        (["probe", "volume", "{fit}", "-o", "{tmp}/out"], "stores no positions"),
        (["probe", "volume", "{fit}", "{other}", "-o", "{tmp}/out"], "expected the 160 probes of"),
        (["probe", "volume", "{fit}", "{set}", "-o", "{tmp}/out", "--block", "-1"], "volume block"),
        (["probe", "frobnicate"], "frobnicate"),
        (["probe"], "Missing command"),
    ],
    ids=lambda value: "-".join(value[:1] + value[-2:]).replace("/", "_") if isinstance(value, list) else "",
)
def test_bad_input_is_one_line_and_exit_code_2(words, says, room, fitted, tmp_path, tmp_path_factory):
    other = tmp_path_factory.mktemp("other") / "other.npz"
    points = synthetic(PROBES, seed=9)
    save_probes(other, points.position, points.values)
    bad = write_json(other.with_name("bad.json"), [[1, 2, float("nan")]])
    places = {"set": room, "fit": fitted, "tmp": tmp_path, "other": other, "bad": bad}
    assert says in fails(*(word.format(**places) for word in words))
    assert not list(tmp_path.iterdir()), "nothing is left behind"


def test_a_ctrl_c_is_kept_and_resumed_to_the_same_bytes(room, profile, tmp_path, monkeypatch):
    check_a_stop_is_resumed(monkeypatch, tmp_path, ["compress", room, "--profile", profile])


def test_volume_writes_what_a_viewer_has_round(fitted, carrying, room, tmp_path):
    text = call("probe", "volume", fitted, room, "-o", tmp_path / "out", "--at", 1, 2.5, -3)
    files = list((tmp_path / "out").iterdir())
    assert len(files) == 8 and all(file.name in text and f"{file.stat().st_size:,}" in text for file in files)
    document = json.loads((tmp_path / "out" / "bundle.json").read_text())
    assert document["viewpoint"] == [1.0, 2.5, -3.0]
    call("probe", "volume", carrying, "-o", tmp_path / "out", "--block", 0.5, "--update", "--shader", "wgsl")
    assert "fn wlm_update_scroll" in (tmp_path / "out" / "update" / "probe.wgsl").read_text()
    assert all((tmp_path / "out" / "update" / name).stat().st_size for name in ("volume.js", "read.wgsl"))
    assert json.loads((tmp_path / "out" / "update" / "bundle.json").read_text())["dispatches"][0]["threads"] > 100
    assert json.loads((tmp_path / "out" / "bundle.json").read_text())["levels"][0]["block"] == 0.5
    assert "viewpoint: expected" in fails("probe", "volume", carrying, "-o", tmp_path / "no", "--at", 1, 2, "nan")


@pytest.mark.parametrize(("engine", "index", "file"), [("three", "grid", "grid.ktx2"), ("unreal", "light", "sh5.dds")])
def test_lattices_of_engines(engine, index, file, fitted, tmp_path):
    text = call("export", fitted, "--engine", engine, "-o", tmp_path / "out", "--cells", 5)
    assert max(json.loads((tmp_path / "out" / f"{index}.json").read_text())["resolution"]) == 5 and file in text
    assert "cells" in fails("export", fitted, "--engine", "unity", "-o", tmp_path / "no", "--cells", 4)


def test_a_volume_takes_the_normals_of_probes(carrying, room, tmp_path):
    arrays = dict(np.load(room))
    np.savez(tmp_path / "room.npz", normal=np.tile([0.0, 1.0, 0.0], (len(arrays["position"]), 1)), **arrays)
    pools = []
    for name, probes in (("plain", room), ("known", tmp_path / "room.npz")):
        call("probe", "volume", carrying, probes, "-o", tmp_path / name)
        pools.append((tmp_path / name / "pool.bin").read_bytes())
    assert len(pools[0]) == len(pools[1]) and pools[0] != pools[1]


def test_evaluate_scores_walks_and_pictures(fitted, room, tmp_path, monkeypatch):
    monkeypatch.setattr(wlm.probe.volume.walk, "_STEP", 2.0)  # sides of a block per frame
    text = call("evaluate", fitted, room, "--views", 2, "--volume", "--json", tmp_path / "r.json")
    report = json.loads((tmp_path / "r.json").read_text())
    views, walked = report["views"], report["volume"]
    assert walked["original"]["light_psnr"] == 120.0 > walked["original"]["psnr"] > walked["decoded"]["psnr"]
    assert f"{walked['decoded']['psnr']:.2f}" in text and "sampled from the cascaded volume" in text
    assert [score["light"] for score in views] == ["decoded", "lossless, volume", "decoded, volume"]
    assert all(f"{score['psnr']:.2f}" in text for score in views)
