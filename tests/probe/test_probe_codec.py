"""The file: what is written comes back bit for bit, its size is arithmetic, and damage is one line."""

import dataclasses
import zlib

import numpy as np
import pytest
from builders.checks import assert_same, put
from builders.probe_models import random_model

from wlm.errors import WlmError
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.probe.model import ProbeModel
from wlm.system import load


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"positions": True},
        {"dead": 0},
        {"dead": 200},
        {"count": 1, "probes": 1, "dead": 0, "positions": True},
        {"probes": 9, "dead": 9},
        {"bits": 4, "latent": 1, "hidden": 8, "outputs": 1},
        {"bits": 16, "latent": 32, "outputs": 48, "support": "sphere", "optimiser": "adan"},
        {"origin": (1e9, -1e9, 1 / 3), "ratio": 1 / 3},
    ],
    ids=str,
)
def test_what_is_written_comes_back(settings, tmp_path):
    model = random_model(**settings)
    size = model.save(tmp_path / "a.wlm")
    assert size == model.file_bytes() == (tmp_path / "a.wlm").stat().st_size
    back = load(tmp_path / "a.wlm")
    assert_same(back, model)
    back.save(tmp_path / "b.wlm")
    assert (tmp_path / "a.wlm").read_bytes() == (tmp_path / "b.wlm").read_bytes()


def test_the_size_is_the_arithmetic_of_the_paper(tmp_path):
    # Section 5's setting: 5% of 15,000 probes, latents of 9, 10 bits, 64 units; table 1 states 21.01 bits a probe.
    model = random_model(count=750, probes=15000, dead=0, hidden=64)
    assert model.profile.code_bits().sum() == 3 * 16 + 16 * 10
    size = model.save(tmp_path / "a.wlm")
    artifact = read_artifact(tmp_path / "a.wlm")
    assert artifact.parts == {
        "gaussians": 750 * 208 // 8,
        "net": 2 * (13 * 64 + 65 * 64 + 65 * 27),
        "bounds": 2 * 19 * 4,
        "frame": 8 * 8,
    }
    assert size == sum(artifact.parts.values()) + artifact.header_bytes
    assert artifact.header_bytes < 700
    assert size * 8 / 15000 < 21.01


def test_dead_probes_cost_a_bit_each_at_most(tmp_path):
    sizes = [random_model(probes=20000, dead=dead).save(tmp_path / "a.wlm") for dead in (0, 1, 20000)]
    assert sizes[0] < sizes[1] < sizes[0] + 200 and sizes[2] < sizes[0] + 200
    model = random_model(probes=20000)
    noise = np.random.default_rng(0).random(20000) < 0.5
    worst = dataclasses.replace(model, dead=noise).save(tmp_path / "a.wlm")
    assert worst < sizes[0] + 2500 + 200


def deflated(count):
    return np.frombuffer(zlib.compress(bytes(count)), np.uint8)


@pytest.mark.parametrize(
    "changes",
    [
        {"gaussians": None},
        {"gaussians": lambda v: v[:-1]},
        {"gaussians": lambda v: np.append(v, np.uint8(0))},
        {"gaussians": lambda v: v.astype(np.uint16)},
        {"net": None},
        {"net": lambda v: v[:-1]},
        {"net": lambda v: v.astype(np.float32)},
        {"net": put(7, np.nan)},
        {"bounds": lambda v: v[:, :-1]},
        {"bounds": lambda v: v.astype(np.float64)},
        {"bounds": put((1, 4), np.inf)},
        {"frame": lambda v: v[:7]},
        {"frame": put(0, np.nan)},
        {"frame": put(3, 0.0)},
        {"frame": put(3, -1.0)},
        {"frame": put(4, -0.1)},
        {"frame": put(6, 1.5)},
        {"dead": lambda v: v[: len(v) // 2]},
        {"dead": deflated(24)},
        {"dead": deflated(26)},
        {"dead": deflated(10**6)},
        {"dead": np.arange(30, dtype=np.uint8)},
        {"positions": lambda v: v[:-1]},
        {"positions": lambda v: v.astype(np.int32)},
        {"probes": 199},
        {"probes": 0},
        {"probes": None},
        {"probes": "many"},
        {"outputs": 28},
        {"outputs": 0},
        {"dropped": -1},
        {"dropped": float(2**70)},
        *({"count": count} for count in (0, -1, 39, 41, 10**15)),
        {"profile": None},
        {"profile": []},
        {"profile": {"hidden": 16}},
        {"profile": {"name": "x", "hidden": 16, "latent": 8}},
        {"profile": {"name": "x", "hidden": 16, "bits": 11}},
        {"profile": {"name": "x", "hidden": 17}},
        {"profile": {"name": "x", "hidden": 16, "colour": "blue"}},
    ],
    ids=lambda changes: "-".join(changes),
)
def test_parts_that_do_not_fit_are_one_line(changes, tmp_path):
    random_model(positions=True).save(tmp_path / "a.wlm")
    artifact = read_artifact(tmp_path / "a.wlm")
    settings, tensors = dict(artifact.settings), dict(artifact.tensors)
    for key, value in changes.items():
        content = tensors if key in tensors else settings
        # "gaussians" is a part, and a setting too: their count.
        name = "gaussians" if key == "count" else key
        content[name] = value(content[name]) if callable(value) else value
        if value is None:
            del content[name]
    write_artifact(tmp_path / "a.wlm", ProbeModel.SYSTEM, settings, tensors, artifact.source)
    with pytest.raises(WlmError, match="a.wlm: (the file's parts do not fit|setting )") as error:
        load(tmp_path / "a.wlm", "probe")
    assert "\n" not in str(error.value)
