"""The file: what is stored comes back bit for bit, it is small, and damage is one line."""

import functools
import json
import struct

import numpy as np
import pytest
from builders.checks import assert_same, misuse_of, put
from builders.probe_models import random_model, whole_model, with_whole
from builders.probe_sets import synthetic
from builders.resigned import GONE, WEIRD

import wlm
from wlm.errors import WlmError
from wlm.formats import zstd
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.formats.compact import BODY
from wlm.probe import codec
from wlm.probe.model import ProbeModel
from wlm.system import load


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"positions": True},
        {"positions": True, "dead": 0},
        {"dead": 199},
        {"count": 1, "probes": 1, "dead": 0, "positions": True},
        {"latent": 1, "hidden": 8, "outputs": 1},
        {"latent": 32, "outputs": 48, "support": "sphere", "optimiser": "adan"},
        {"origin": (1e9, -1e9, 1 / 3), "ratio": 1 / 3},
    ],
    ids=str,
)
def test_gaussians_come_back(settings, tmp_path):
    model = whole_model(**settings)
    size = model.save(tmp_path / "random.wlm")
    assert size == model.file_bytes() == (tmp_path / "random.wlm").stat().st_size
    back = load(tmp_path / "random.wlm")
    assert_same(back, model)
    back.save(tmp_path / "again.wlm")
    assert (tmp_path / "random.wlm").read_bytes() == (tmp_path / "again.wlm").read_bytes()


def test_only_quantised_gaussians_are_stored(tmp_path):
    assert "expected Gaussians quantised to integers" in misuse_of(random_model().save, tmp_path / "a.wlm")


@pytest.mark.parametrize("profile", ["standard", "compact", "paper", "small", "pca"])
def test_no_file_is_larger_than_half_floats_and_a_little(profile, tmp_path):
    for count, coefficients in ((1, 1), (1, 9), (2, 4), (3, 9), (5, 1), (9, 9), (33, 4), (60, 9)):
        probes = synthetic(count, coefficients=coefficients, dead=2 if count > 4 else 0)
        model = wlm.probe.compress(probes, profile, steps=10)
        assert model.file_bytes() <= 2 * probes.outputs * probes.probes + 200, (count, coefficients)
        assert model.content.nbytes == model.bundle().nbytes


def test_dead_probes_cost_a_bit_each_at_most(tmp_path):
    sizes = [whole_model(probes=20000, dead=dead).save(tmp_path / "a.wlm") for dead in (0, 1, 19999)]
    assert sizes[0] < sizes[1] < sizes[0] + 200 and sizes[2] < sizes[0] + 200


@functools.cache
def model_of(method):
    return whole_model(positions=True) if method == "gaussians" else wlm.probe.compress(synthetic(300, dead=5))


def stored(model, tmp_path):
    """The header and the parts of a model's file, and a function that writes changed ones and reads them."""
    path = tmp_path / "a.wlm"
    model.save(path)
    artifact = read_artifact(path)
    body = artifact.tensors[BODY].tobytes()
    length = struct.unpack_from("<H", body)[0]
    header = json.loads(body[2 : 2 + length])
    table = codec._table(codec._Header.model_validate(header), type(model.content))
    parts = codec._split(body[2 + length :], table, len(body))

    def read(header, parts):
        text = json.dumps(header).encode()
        frame = zstd.compress(b"".join(codec._planes(part) for part in parts.values()))
        content = {BODY: np.frombuffer(struct.pack("<H", len(text)) + text + frame, np.uint8)}
        write_artifact(path, ProbeModel.SYSTEM, {}, content, "")
        return load(path, "probe")

    return header, parts, read


GAUSSIANS = [
    {"box": put(0, np.nan)},
    {"box": put(3, 0.0)},
    {"box": put(3, -1.0)},
    {"box": put(4, -0.1)},
    {"box": put(6, 1.5)},
    {"dead": put(0, 255)},
    {"dead": lambda part: part[:-1]},
    {"gain": put(0, 0.0)},
    {"gain": put(0, -1.0)},
    {"gain": put(0, np.inf)},
    {"gaussians": lambda part: part[:, :-1]},
    {"steps": put(0, 0)},
    {"steps": put(0, 0x7F80)},
    {"steps": put(9, 0x7F00)},
    {"steps": put(3, 0x7000)},
    {"network": lambda part: part[:-1]},
    {"network": put(0, 1 << 30)},
    {"positions": lambda part: part[:, :-1]},
    {"probes": 199},
    {"outputs": 28},
    {"outputs": 4097},
    {"probes": 2**40},
    {"dropped": -1},
    {"dropped": float(2**70)},
    {"live": 200},
    {"live": 196},
    {"source": "0123"},
    *({"count": count} for count in (0, -1, 39, 41, 10**7, 10**15)),
    {"profile": {"name": "x", "hidden": 16, "latent": 8, "method": "gaussians"}},
    {"profile": {"name": "x", "hidden": 16}},
    {"profile": {"name": "x", "hidden": 17, "method": "gaussians"}},
    {"profile": {"name": "x", "hidden": 16, "method": "gaussians", "colour": "blue"}},
]
COMPONENTS = [
    {"code": lambda part: part[:-1]},
    {"width": put((0, 0), 0)},
    {"code": put((0, 3), 1024)},
    {"width": put((0, 2), 17)},
    {"clusters": 2},
    {"bounds": put((1, 0, 2), -1.0)},
    {"bounds": put((0, 0, 0), 100.0)},
    {"bounds": put((0, 0, 0), np.nan)},
    {"bounds": put((0, 0, 1), np.inf)},
    {"basis": lambda part: part[:, :-1]},
    {"count": 29},
    {"count": 27},
    {"live": 30},
]


@pytest.mark.parametrize(
    ("method", "changes"),
    [*(("gaussians", changes) for changes in GAUSSIANS), *(("pca", changes) for changes in COMPONENTS)],
)
def test_parts_that_do_not_fit_are_one_line(method, changes, tmp_path):
    model = model_of(method)
    header, parts, read = stored(model, tmp_path)
    assert_same(read(header, parts).content, model.content)
    for key, value in changes.items():
        content = parts if key in parts else header
        content[key] = value(content[key]) if callable(value) else value
        if value is None:
            del content[key]
    with pytest.raises(WlmError, match="a.wlm: (the file's parts do not fit|setting |part)") as error:
        read(header, parts)
    assert "\n" not in str(error.value)


# What is a good value after all.
ACCEPTED = {("dropped", "zero"), ("dropped", "gone"), ("positions", "true")}
# What is a good value of a file with other parts.
OTHER_PARTS = {("live", "none"), ("live", "gone"), ("positions", "gone"), ("clusters", "gone")}


@pytest.mark.parametrize("method", ["gaussians", "pca"])
def test_weird_settings_are_one_line(method, tmp_path):
    header, parts, read = stored(model_of(method), tmp_path)
    assert {"probes", "source", "profile", "count", "live"} <= set(header)
    weird = WEIRD | {"gone": GONE, "nan": float("nan"), "infinity": float("inf"), "minus": float("-inf")}
    for key in header:
        for kind, value in weird.items():
            changed = {name: one for name, one in (header | {key: value}).items() if one is not GONE}
            if (key, kind) in ACCEPTED:
                read(changed, parts)
                continue
            unit_vectors = method == "pca" and key == "count" and kind in ("zero", "gone") and "clusters" not in header
            said = "parts: expected " if unit_vectors or (key, kind) in OTHER_PARTS else f"setting {key}"
            with pytest.raises(WlmError) as error:
                read(changed, parts)
            line = str(error.value)
            assert "\n" not in line and "a.wlm" in line and said in line, (key, kind, line)


def test_a_name_does_not_reach_the_terminal_as_orders(tmp_path):
    header, parts, read = stored(whole_model(), tmp_path)
    assert read(header | {"profile": header["profile"] | {"name": "p\x9b2J"}}, parts).profile.name == "p 2J"
    path = tmp_path / "a\x1b[2J\u202eb.wlm"
    (tmp_path / "a.wlm").rename(path)
    assert load(path).name == "a [2J b"


def test_steps_beyond_floats_are_refused(tmp_path):
    model = whole_model()
    whole = model.content.whole
    whole.step[9:] *= 2.0**127
    with pytest.raises(WlmError, match="part gaussians"), np.errstate(over="ignore"):
        with_whole(model, whole).save(tmp_path / "a.wlm")
    assert not (tmp_path / "a.wlm").exists()
