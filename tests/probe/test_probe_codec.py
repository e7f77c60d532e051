"""The file: what is written comes back bit for bit, its size is arithmetic, and damage is one line."""

import dataclasses
import zlib

import numpy as np
import pytest
from builders.probe_models import random_model

from wlm.errors import WlmError
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.probe import codec
from wlm.probe.codec import pack_bits, unpack_bits
from wlm.probe.model import ProbeModel, network_size


def pack_slowly(values, widths):
    """One bit after another, through Python's integers."""
    number, at = 0, 0
    for row in values.tolist():
        for value, width in zip(row, widths, strict=True):
            number |= value << at
            at += int(width)
    return list(number.to_bytes(-(-at // 8), "little"))


@pytest.mark.parametrize(
    ("count", "widths"),
    [(1, [1]), (1, [16]), (3, [4, 5]), (7, [16, 16, 16, *[10] * 16]), (5, [11] * 9), (64, [1, 2, 3, 16]), (9, [7])],
    ids=str,
)
def test_bits_against_a_slow_packing(count, widths):
    rng = np.random.default_rng(count)
    widths = np.array(widths)
    values = (rng.integers(0, 2**16, (count, len(widths))) % 2**widths).astype(np.uint16)
    for case in (values, np.zeros_like(values), np.broadcast_to(2**widths - 1, values.shape).astype(np.uint16)):
        packed = pack_bits(case, widths)
        assert packed.dtype == np.uint8 and packed.tolist() == pack_slowly(case, widths)
        back = unpack_bits(packed, widths, count)
        assert back.dtype == np.uint16
        np.testing.assert_array_equal(back, case)


def test_bits_of_no_rows():
    assert len(pack_bits(np.zeros((0, 2), np.uint16), np.array([3, 16]))) == 0
    assert unpack_bits(np.zeros(0, np.uint8), np.array([3, 16]), 0).shape == (0, 2)


def test_bits_that_do_not_fit():
    with pytest.raises(ValueError, match="fit the width"):
        pack_bits(np.array([[3, 8]], np.uint16), np.array([2, 3]))
    for length in (1, 3):
        with pytest.raises(ValueError, match=f"{length} bytes for 2 rows of 5 bits"):
            unpack_bits(np.zeros(length, np.uint8), np.array([2, 3]), 2)


def assert_same(a: ProbeModel, b: ProbeModel) -> None:
    for field in dataclasses.fields(ProbeModel):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, np.ndarray):
            assert x.shape == y.shape and x.dtype == y.dtype, field.name
            np.testing.assert_array_equal(x, y, err_msg=field.name)
        else:
            assert x == y, field.name


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
    size = codec.write(tmp_path / "a.wlm", model)
    assert size == (tmp_path / "a.wlm").stat().st_size
    back = codec.read(tmp_path / "a.wlm")
    assert_same(back, model)
    codec.write(tmp_path / "b.wlm", back)
    assert (tmp_path / "a.wlm").read_bytes() == (tmp_path / "b.wlm").read_bytes()


def test_the_size_is_the_arithmetic_of_the_paper(tmp_path):
    # Section 5's setting: 5% of 15,000 probes, latents of 9, 10 bits, 64 units; table 1 states 21.01 bits a probe.
    model = random_model(count=750, probes=15000, dead=0, hidden=64)
    assert model.profile.gaussian_bits() == 3 * 16 + 16 * 10
    size = codec.write(tmp_path / "a.wlm", model)
    artifact = read_artifact(tmp_path / "a.wlm")
    assert artifact.parts == {
        "gaussians": 750 * 208 // 8,
        "net": 2 * network_size(9, 64, 27),
        "bounds": 2 * 19 * 4,
        "frame": 8 * 8,
    }
    assert size == sum(artifact.parts.values()) + artifact.header_bytes
    assert artifact.header_bytes < 700
    assert size * 8 / 15000 < 21.01


def test_dead_probes_cost_a_bit_each_at_most(tmp_path):
    sizes = [codec.write(tmp_path / "a.wlm", random_model(probes=20000, dead=dead)) for dead in (0, 1, 20000)]
    assert sizes[0] < sizes[1] < sizes[0] + 200 and sizes[2] < sizes[0] + 200
    model = random_model(probes=20000)
    noise = np.random.default_rng(0).random(20000) < 0.5
    worst = codec.write(tmp_path / "a.wlm", dataclasses.replace(model, dead=noise))
    assert worst < sizes[0] + 2500 + 200


def test_every_flipped_byte_and_every_cut_is_refused(tmp_path):
    codec.write(tmp_path / "a.wlm", random_model(positions=True))
    content = (tmp_path / "a.wlm").read_bytes()
    for place in [*range(0, 200, 7), *range(200, len(content), 97), len(content) - 1]:
        damaged = bytearray(content)
        damaged[place] ^= 0x41
        for text in (bytes(damaged), content[:place]):
            (tmp_path / "b.wlm").write_bytes(text)
            with pytest.raises(WlmError, match="b.wlm") as error:
                codec.read(tmp_path / "b.wlm")
            assert "\n" not in str(error.value)


def put(index, value):
    def change(array):
        array = array.copy()
        array[index] = value
        return array

    return change


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
    codec.write(tmp_path / "a.wlm", random_model(positions=True))
    # "gaussians" is a part and a setting; the part is meant.
    artifact = read_artifact(tmp_path / "a.wlm")
    settings, tensors = dict(artifact.settings), dict(artifact.tensors)
    for key, value in changes.items():
        held = tensors if key in tensors else settings
        held[key] = value(held[key]) if callable(value) else value
        if value is None:
            del held[key]
    write_artifact(tmp_path / "a.wlm", codec.SYSTEM, settings, tensors, artifact.source)
    with pytest.raises(WlmError, match="a.wlm: the file's parts do not fit") as error:
        codec.read(tmp_path / "a.wlm")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("count", [0, -1, 39, 41, 10**15])
def test_another_count_of_gaussians_is_one_line(count, tmp_path):
    codec.write(tmp_path / "a.wlm", random_model())
    artifact = read_artifact(tmp_path / "a.wlm")
    settings = artifact.settings | {"gaussians": count}
    write_artifact(tmp_path / "a.wlm", codec.SYSTEM, settings, artifact.tensors, artifact.source)
    with pytest.raises(WlmError, match="a.wlm: the file's parts do not fit"):
        codec.read(tmp_path / "a.wlm")


def test_other_files_are_refused(tmp_path):
    with pytest.raises(WlmError, match="cannot read"):
        codec.read(tmp_path / "absent.wlm")
    write_artifact(tmp_path / "a.wlm", "lightmap", {}, {}, "0")
    with pytest.raises(WlmError, match="expected an artifact of probe, found one of lightmap"):
        codec.read(tmp_path / "a.wlm")
