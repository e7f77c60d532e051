"""The network from the command line: trained, stopped and resumed, used, measured, exported."""

import json
import os
import re
import signal

import numpy as np
import pytest
import torch
import yaml
from builders.running import call, fails
from builders.smoke_plumes import plume, write_frames

from wlm.fluid.volume import save_volume
from wlm.formats.artifact import read_artifact
from wlm.smoke import codec
from wlm.smoke.coarse import march
from wlm.smoke.codec import load_network, save_network, settings_of, shipped
from wlm.smoke.data import load_frames, read_six_way
from wlm.smoke.decode import Predictor, predict
from wlm.smoke.learn import dataset
from wlm.smoke.learn.dataset import DatasetSettings
from wlm.smoke.learn.trainer import Trainer
from wlm.smoke.planes import GUIDES
from wlm_kernels.smoke.settings import March

PROFILE = {
    "name": "tiny",
    "network": {"guide": "six", "width": 8, "levels": 2, "stem": 2},
    "training": {"rounds": 2, "steps": 4, "batch": 2, "rate": 2e-4, "warmup": 1, "average": 0.5},
    "dataset": {
        "guide": "six",
        "guide_step": 0.1,
        "cells": 16,
        "refine": 2,
        "resolution": 16,
        "sequences": 1,
        "frames": 1,
        "views": 2,
        "views_a_frame": 1,
        "warmup": 0.6,
        "validation_sequences": 1,
        "moving": 0.0,
    },
}


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """A profile and what its training leaves, with what it said."""
    folder = tmp_path_factory.mktemp("trained")
    (folder / "tiny.yaml").write_text(yaml.safe_dump(PROFILE))
    text = call("smoke", "train", folder / "tiny.yaml", "-o", folder / "a.safetensors", "--seed", 3)
    return folder, text, call.stderr


@pytest.fixture
def network(trained):
    return trained[0] / "a.safetensors"


@pytest.fixture
def volume(tmp_path):
    save_volume(tmp_path / "plume.npz", plume(hot=True))
    return tmp_path / "plume.npz"


def kept(path):
    """All that a network's file holds, but for the time that its training took."""
    held = read_artifact(path)
    settings = {**held.settings, "summary": {**held.settings["summary"], "seconds": 0}}
    return settings, {name: array.tobytes() for name, array in held.tensors.items()}


def test_train(trained):
    folder, text, stderr = trained
    assert sorted(os.listdir(folder)) == ["a.safetensors", "a.safetensors.csv", "tiny.yaml"]
    assert "8 of 8" in text and "best validation, dB" in text
    assert re.search(r"train: 8 of 8, PSNR \d+\.\d+ dB, loss \d", stderr)
    loaded, summary = load_network(folder / "a.safetensors")
    assert loaded.settings.guide == "six" and summary["seed"] == 3
    # What looking at smoke as in training takes.
    assert settings_of("", summary) == DatasetSettings(**PROFILE["dataset"])
    assert (folder / "a.safetensors.csv").read_text().count("\n") == 3


def test_a_training_is_stopped_and_resumed(trained, tmp_path, monkeypatch):
    """By Ctrl-C, then by the clock; it ends with the same weights."""
    folder, _, _ = trained
    words = ("smoke", "train", folder / "tiny.yaml", "-o", tmp_path / "a.safetensors", "--seed", 3)
    run, done = Trainer.run, []

    def interrupted(self, *args):
        run(self, *args)
        done.append(1)
        if len(done) == 1:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("wlm.smoke.fit._CHUNK", 2)
    monkeypatch.setattr(Trainer, "run", interrupted)
    call(*words, code=130)
    monkeypatch.setattr(Trainer, "run", run)
    assert f"stopped at step 2: the same command with --resume goes on from {tmp_path}" in call.stderr
    assert sorted(os.listdir(tmp_path)) == ["a.safetensors", "a.safetensors.partial"]
    text = call(*words, "--resume", "--minutes", 0)
    assert "out of time at step 4" in call.stderr and "4 of 8" in text
    assert "it was made with seed 3, not 4" in fails(*words[:-1], 4, "--resume")
    partial = tmp_path / "a.safetensors.partial"
    before = partial.read_bytes()
    partial.write_bytes(before[:-9] + b"?" + before[-8:])
    assert "a.safetensors.partial: the artifact is damaged" in fails(*words, "--resume")
    partial.write_bytes(before)
    call(*words, "--resume")
    assert not partial.exists()
    assert kept(tmp_path / "a.safetensors") == kept(folder / "a.safetensors")


def test_nothing_to_resume_is_told(trained, tmp_path):
    words = ("smoke", "train", trained[0] / "tiny.yaml", "-o", tmp_path / "a.safetensors")
    call(*words, "--resume", "--minutes", 0)
    assert "a.safetensors.partial: there is nothing to resume; starting at step 0" in call.stderr


def test_a_training_is_stopped_before_its_first_step(trained, tmp_path, monkeypatch):
    folder, _, _ = trained
    words = ("smoke", "train", folder / "tiny.yaml", "-o", tmp_path / "a.safetensors", "--seed", 3)

    def interrupted(*_, progress, **__):
        os.kill(os.getpid(), signal.SIGINT)
        progress(1, {})

    with monkeypatch.context() as patch:
        patch.setattr(dataset, "make_pool", interrupted)
        call(*words, code=130)
    assert "stopped before another step: the same command with --resume goes on" in call.stderr
    call(*words, "--resume")
    assert kept(tmp_path / "a.safetensors") == kept(folder / "a.safetensors")
    held = (tmp_path / "a.safetensors").read_bytes()
    assert "a.safetensors: is finished; without --resume it is trained anew" in fails(*words, "--resume")
    assert (tmp_path / "a.safetensors").read_bytes() == held


def test_predict_looks_as_training_did(network, volume, tmp_path):
    out = tmp_path / "a.exr"
    text = call("smoke", "predict", volume, "-o", out, "--network", network, "--resolution", 20, "--seed", 4)
    assert "mean light" in text and "error" not in text
    found = read_six_way(out)
    camera = found.camera
    smoke = load_frames(volume).load(1)
    loaded, _ = load_network(network)
    # A tenth of the 24 voxels of the longest edge.
    look = March(2.4, seed=4, threshold=4.0 / 24)
    wanted = predict(smoke, camera, Predictor(loaded, 20, camera.width), look)
    for name in ("lightmaps", "transparency", "emission"):
        torch.testing.assert_close(getattr(found, name), getattr(wanted, name), rtol=1e-3, atol=1e-4)
    call("smoke", "predict", volume, "-o", out, "--network", network, "--resolution", 20, "--seed", 5)
    assert not torch.equal(read_six_way(out).lightmaps, found.lightmaps)
    # As what bake wrote.
    call("smoke", "shade", out, "-o", tmp_path / "a.png")


@pytest.mark.parametrize("words, step", [((), 24 / 130), (("--step", 4), 4.0)])
def test_predict_by_the_coarse_march_alone(volume, tmp_path, words, step):
    call("smoke", "predict", volume, "-o", tmp_path / "a.exr", "--coarse", *words, "--resolution", 20, "--seed", 2)
    found = read_six_way(tmp_path / "a.exr")
    wanted = march(load_frames(volume).load(1), found.camera, March(step, step, seed=2))
    for name in ("lightmaps", "transparency", "emission"):
        torch.testing.assert_close(getattr(found, name), getattr(wanted, name), rtol=1e-3, atol=1e-4)


def test_without_a_network_the_one_that_ships_is_used(network, volume, tmp_path, monkeypatch):
    for name, words in (("a", ()), ("b", ("--network", shipped())), ("c", ("--network", network))):
        call("smoke", "predict", volume, "-o", tmp_path / f"{name}.exr", "--resolution", 20, *words)
    ours, same, other = (read_six_way(tmp_path / f"{name}.exr").lightmaps for name in "abc")
    assert torch.equal(ours, same) and not torch.equal(ours, other)
    # On the shipped one's own smoke the others would take minutes.
    monkeypatch.setattr(codec, "shipped", lambda: network)
    text = call("smoke", "evaluate", "--resolution", 16, "--json", tmp_path / "a.json")
    assert str(network) in text.replace("\n", "") and json.loads((tmp_path / "a.json").read_text())["cells"] == 16
    monkeypatch.setattr(codec, "export_onnx", lambda made, *size: made.settings.width)
    assert "8 bytes, 512 x 512 pixels" in call("smoke", "export", "-o", tmp_path / "a.onnx")


@pytest.mark.parametrize("resolution, told", [(20, False), (8, True), (150, True)])
def test_predict_says_where_it_has_not_learned(network, volume, tmp_path, resolution, told):
    """A network of images of so many pixels along the box's edge."""
    call("smoke", "predict", volume, "-o", tmp_path / "a.exr", "--network", network, "--resolution", resolution)
    assert ("has learned from" in " ".join(call.stderr.split())) == told


def test_predict_frames(network, tmp_path):
    folder = write_frames(tmp_path / "frames").path
    call("smoke", "predict", folder, "-o", tmp_path / "six", "--network", network, "--resolution", 170)
    assert " ".join(call.stderr.split()).count("has learned from") == 1
    call("smoke", "predict", folder, "-o", tmp_path / "six", "--network", network, "--resolution", 17)
    assert sorted(os.listdir(tmp_path / "six")) == [f"six_{i:04d}.exr" for i in (1, 2, 3)]
    assert read_six_way(tmp_path / "six" / "six_0002.exr").lightmaps.shape == (6, 17, 17)


def test_evaluate(network, volume, tmp_path):
    report = tmp_path / "a.json"
    text = call("smoke", "evaluate", network, "--smoke", volume, "--resolution", 20, "--json", report)
    found = json.loads(report.read_text())
    names = ["density x 0.5", "density x 1", "density x 2", str(volume)]
    assert [one["name"] for one in found["sets"]] == names and found["resolution"] == 20 and found["cells"] == 16
    for one in found["sets"]:
        assert list(one["methods"]) == ["network", "coarse march", "flip book"] and one["half_loss"] is None
        for method in one["methods"].values():
            assert method["lowest"] <= method["psnr"] <= method["highest"] and len(method["planes"]) == 8
            assert f"{method['psnr']:.2f}" in text and f"{method['planes']['top']:.2f}" in text
    # It stands still.
    assert found["sets"][3]["methods"]["network"]["flicker_ratio"] is None
    told = found["network"]
    loaded, summary = load_network(network)
    assert told.items() >= loaded.settings.model_dump(mode="json").items()
    assert (told["name"], told["profile"], told["seed"], told["device"]) == ("a", "tiny", 3, "cpu")
    assert told["parameters"] == sum(weight.numel() for weight in loaded.parameters())
    assert (told["steps"], told["seconds"]) == (summary["steps"], summary["seconds"])


def test_a_report_says_of_a_network_what_its_file_does(network, tmp_path):
    old = tmp_path / "old.safetensors"
    loaded, summary = load_network(network)
    save_network(old, loaded, {"dataset": summary["dataset"], "seed": 5})
    call("smoke", "evaluate", old, "--resolution", 8, "--json", tmp_path / "a.json")
    told = json.loads((tmp_path / "a.json").read_text())["network"]
    assert told["seed"] == 5 and not {"profile", "steps", "seconds", "device"} & told.keys()


def test_export(network, tmp_path):
    """ONNX computes what the network does, of a size that its levels' squares don't divide."""
    for needed in ("onnx", "onnxscript"):
        pytest.importorskip(needed)
    runtime = pytest.importorskip("onnxruntime")
    out = tmp_path / "a.onnx"
    text = call("smoke", "export", network, "-o", out, "--resolution", 18)
    assert f"{out.stat().st_size:,} bytes, 18 x 18 pixels" in text and "torchvision" not in call.stderr
    guide = torch.rand(1, len(GUIDES["six"]), 18, 18)
    (found,) = runtime.InferenceSession(out).run(["lightmaps"], {"guide": guide.numpy()})
    with torch.no_grad():
        assert np.allclose(found, load_network(network)[0](guide), atol=1e-5)


def test_wrong_words_are_one_line(trained, network, volume, tmp_path):
    out = tmp_path / "a.exr"
    made = ("smoke", "predict", volume, "-o", out)
    assert "--coarse: expected no --network" in fails(*made, "--coarse", "--network", network)
    assert "--step: expected --coarse beside it" in fails(*made, "--step", 3)
    assert "--step" in fails(*made, "--coarse", "--step", 0)
    assert "gone.safetensors: cannot read" in fails(*made, "--network", tmp_path / "gone.safetensors")
    assert "expected an artifact" in fails(*made, "--network", volume)
    assert "device 'tpu'" in fails(*made, "--network", network, "--device", "tpu")
    assert "ends in .exr" in fails("smoke", "predict", volume, "-o", tmp_path / "a.png", "--network", network)
    train = ("smoke", "train", trained[0] / "tiny.yaml", "-o")
    assert "ends in .safetensors" in fails(*train, tmp_path / "a.wlm")
    assert "does not exist" in fails(*train, tmp_path / "no" / "a.safetensors")
    assert "device 'tpu'" in fails(*train, tmp_path / "a.safetensors", "--device", "tpu")
    assert "network-7" in fails("smoke", "train", "7", "-o", tmp_path / "a.safetensors")
    evaluate = ("smoke", "evaluate", network)
    assert "ends in .json" in fails(*evaluate, "--json", tmp_path / "a.txt")
    assert "ends in .onnx" in fails("smoke", "export", network, "-o", tmp_path / "a.txt")
    bare = tmp_path / "bare.safetensors"
    save_network(bare, load_network(network)[0], {})
    assert "bare.safetensors: summary.dataset: expected" in fails(*made, "--network", bare)
    other = tmp_path / "other.yaml"
    other.write_text(yaml.safe_dump(PROFILE | {"dataset": {}}))
    told = fails("smoke", "train", other, "-o", tmp_path / "a.safetensors")
    assert "dataset.guide: expected six" in told
    assert sorted(os.listdir(tmp_path)) == ["bare.safetensors", "other.yaml", "plume.npz"]
