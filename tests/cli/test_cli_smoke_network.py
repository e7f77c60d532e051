"""The commands of the network: train, predict, evaluate and export."""

import json
import os
import re
import signal

import numpy as np
import pytest
import torch
import yaml
from builders.running import call, fails
from builders.smoke_samples import file_content

import wlm
from wlm.smoke import codec
from wlm.smoke.codec import open_network, shipped
from wlm.smoke.data import load_frames, read_six_way
from wlm.smoke.march.six_way import bake, bake_coarse
from wlm.smoke.model import SmokeModel
from wlm.smoke.network import onnx_file
from wlm.smoke.network.planes import GUIDES, encode_lightmaps, render_guide
from wlm.smoke.network.settings import DatasetSettings
from wlm.smoke.network.trainer import Trainer
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
        "warmup": 0.4,
        "validation_sequences": 1,
        "moving": 0.0,
    },
}


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """A profile with the result and the output of its training."""
    folder = tmp_path_factory.mktemp("trained")
    (folder / "tiny.yaml").write_text(yaml.safe_dump(PROFILE))
    text = call("smoke", "train", folder / "tiny.yaml", "-o", folder / "a.safetensors", "--seed", 3)
    return folder, text, call.stderr


@pytest.fixture
def network(trained):
    return trained[0] / "a.safetensors"


def test_train(trained):
    folder, text, stderr = trained
    assert sorted(os.listdir(folder)) == ["a.safetensors", "a.safetensors.csv", "tiny.yaml"]
    assert "8 of 8" in text and "best validation PSNR, dB" in text
    assert re.search(r"train: 8 of 8, PSNR \d+\.\d+ dB, loss \d", stderr)
    model = wlm.load(folder / "a.safetensors")
    assert model.settings.guide == "six" and model.summary["seed"] == 3
    assert model.dataset == DatasetSettings(**PROFILE["dataset"])
    assert (folder / "a.safetensors.csv").read_text().count("\n") == 3


@pytest.mark.slow
def test_a_training_is_stopped_and_resumed(trained, tmp_path, monkeypatch):
    """A training stopped by Ctrl-C and by the time limit ends with the same weights."""
    folder, _, _ = trained
    words = ("smoke", "train", folder / "tiny.yaml", "-o", tmp_path / "a.safetensors", "--seed", 3)
    run, calls = Trainer.run, []

    def interrupted(self, *args):
        run(self, *args)
        calls.append(1)
        if len(calls) == 1:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("wlm.smoke.fit._CHUNK", 2)
    monkeypatch.setattr(Trainer, "run", interrupted)
    call(*words, code=130)
    monkeypatch.setattr(Trainer, "run", run)
    assert f"stopped at step 2: repeat the command with --resume to continue from {tmp_path}" in call.stderr
    assert sorted(os.listdir(tmp_path)) == ["a.safetensors", "a.safetensors.partial"]
    text = call(*words, "--resume", "--minutes", 0)
    assert "out of time at step 4" in call.stderr and "4 of 8" in text
    assert "it was made with seed 3, not 4" in fails(*words[:-1], 4, "--resume")
    call(*words, "--resume")
    assert not (tmp_path / "a.safetensors.partial").exists()
    assert file_content(tmp_path / "a.safetensors") == file_content(folder / "a.safetensors")


def test_predict_marches_as_in_training(network, volume, tmp_path):
    out = tmp_path / "a.exr"
    text = call("smoke", "predict", volume, "-o", out, "--network", network, "--resolution", 20, "--seed", 4)
    assert "their mean light" in text and "network" in text and "error" not in text
    six = read_six_way(out)
    # A tenth of the 24 voxels of the longest edge.
    march = March(2.4, seed=4, threshold=4.0 / 24)
    guide = render_guide(load_frames(volume).load(1), six.camera, "six", march)
    planes = wlm.load(network).decoder(height=20, width=six.camera.width)(guide)
    torch.testing.assert_close(encode_lightmaps(six)[:6], planes[:6], rtol=1e-2, atol=1e-3)
    call("smoke", "predict", volume, "-o", out, "--network", network, "--resolution", 20, "--seed", 5)
    assert not torch.equal(read_six_way(out).lightmaps, six.lightmaps)
    # As what bake wrote.
    call("smoke", "shade", out, "-o", tmp_path / "a.png")


@pytest.mark.parametrize(
    ("pixels", "method", "march"),
    [
        (60, "coarse march, step 1", lambda smoke, camera: bake_coarse(smoke, camera, March(1.0, seed=2))),
        (8, "fine march, step 2", lambda smoke, camera: bake(smoke, camera, step=2.0)),
    ],
)
def test_predict_by_the_faster_march(pixels, method, march, volume, tmp_path):
    text = call("smoke", "predict", volume, "-o", tmp_path / "a.exr", "--resolution", pixels, "--seed", 2)
    six = read_six_way(tmp_path / "a.exr")
    expected = march(load_frames(volume).load(1), six.camera)
    assert method in text and expected.method == method
    for name in ("lightmaps", "transparency", "emission"):
        torch.testing.assert_close(getattr(six, name), getattr(expected, name), rtol=1e-3, atol=1e-4)


def test_the_network_that_ships_has_a_name(network, volume, tmp_path, monkeypatch):
    for name, words in (("a", ("--network", "fast")), ("b", ("--network", shipped())), ("c", ("--network", network))):
        call("smoke", "predict", volume, "-o", tmp_path / f"{name}.exr", "--resolution", 20, *words)
    default, same, other = (read_six_way(tmp_path / f"{name}.exr").lightmaps for name in "abc")
    assert torch.equal(default, same) and not torch.equal(default, other)
    # On the shipped one's own smoke the others would take minutes.
    monkeypatch.setattr(codec, "shipped", lambda: network)
    monkeypatch.setattr(onnx_file, "export_onnx", lambda model, path, **size: model.settings.width)
    assert "512 x 512 pixels" in call("smoke", "export-onnx", "-o", tmp_path / "a.onnx")


def test_evaluate(network, tmp_path):
    path = tmp_path / "a.json"
    text = call("evaluate", network, "--resolution", 20, "--json", path)
    report = json.loads(path.read_text())
    assert report["resolution"] == 20 and report["cells"] == 16
    assert report["lowest"] <= report["psnr"] <= report["highest"] and len(report["planes"]) == 8
    for value in (report["psnr"], report["guide_psnr"], report["planes"]["top"]):
        assert f"{value:.4g}" in text
    facts, model = report["network"], wlm.load(network)
    assert facts.items() >= model.settings.model_dump(mode="json").items()
    assert (facts["name"], facts["profile"], facts["seed"], facts["device"]) == ("a", "tiny", 3, "cpu")
    assert facts["parameters"] == sum(weight.numel() for weight in model.network.parameters())
    assert (facts["steps"], facts["seconds"]) == (model.summary["steps"], model.summary["seconds"])


@pytest.mark.slow
def test_export(network, tmp_path):
    """The ONNX network computes the same at a size that its levels do not divide."""
    for package in ("onnx", "onnxscript"):
        pytest.importorskip(package)
    runtime = pytest.importorskip("onnxruntime")
    out = tmp_path / "a.onnx"
    text = call("smoke", "export-onnx", network, "-o", out, "--resolution", 18)
    assert f"{out.stat().st_size:,}" in text and "18 x 18 pixels" in text and "torchvision" not in call.stderr
    guide = torch.rand(1, len(GUIDES["six"]), 18, 18)
    (planes,) = runtime.InferenceSession(out).run(["lightmaps"], {"guide": guide.numpy()})
    with torch.no_grad():
        assert np.allclose(planes, wlm.load(network).network(guide), atol=1e-5)


def test_wrong_words_are_one_line(trained, network, volume, tmp_path):
    out = tmp_path / "a.exr"
    predict = ("smoke", "predict", volume, "-o", out)
    assert "gone.safetensors: cannot read" in fails(*predict, "--network", tmp_path / "gone.safetensors")
    train = ("smoke", "train", trained[0] / "tiny.yaml", "-o")
    assert "ends in .safetensors" in fails(*train, tmp_path / "a.wlm")
    assert "profile '7' of smoke-network" in fails("smoke", "train", "7", "-o", tmp_path / "a.safetensors")
    assert "ends in .onnx" in fails("smoke", "export-onnx", network, "-o", tmp_path / "a.txt")
    bare = tmp_path / "bare.safetensors"
    SmokeModel(open_network(network).network, {}).save(bare)
    assert "bare.safetensors: summary.dataset: expected" in fails(*predict, "--network", bare)
    other = tmp_path / "other.yaml"
    other.write_text(yaml.safe_dump(PROFILE | {"dataset": {}}))
    assert "dataset.guide: expected six" in fails("smoke", "train", other, "-o", tmp_path / "a.safetensors")
    assert sorted(os.listdir(tmp_path)) == ["bare.safetensors", "other.yaml"]
