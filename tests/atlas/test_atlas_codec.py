"""The file: what is written comes back bit for bit, its size is arithmetic, and damage is one line."""

import dataclasses

import numpy as np
import pytest
from builders.atlas_meshes import charts, sheet, triangle
from builders.atlas_models import KINDS, random_model

from wlm.atlas import codec, colour
from wlm.atlas.model import MOST_SIZE, AtlasModel, pack_entries
from wlm.errors import WlmError
from wlm.formats.artifact import read_artifact, write_artifact


def assert_same(a: AtlasModel, b: AtlasModel) -> None:
    for field in dataclasses.fields(AtlasModel):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, np.ndarray):
            assert x.shape == y.shape and x.dtype == y.dtype, field.name
            np.testing.assert_array_equal(x, y, err_msg=field.name)
        else:
            assert x == y, field.name


@pytest.mark.parametrize("colour", ["half", "bc6h", "astc"])
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_written_comes_back(kind, colour, tmp_path):
    model = random_model(sheet(), kind, colour)
    size = codec.write(tmp_path / "a.wlm", model)
    assert size == (tmp_path / "a.wlm").stat().st_size
    back = codec.read(tmp_path / "a.wlm")
    assert_same(back, model)
    codec.write(tmp_path / "b.wlm", back)
    assert (tmp_path / "a.wlm").read_bytes() == (tmp_path / "b.wlm").read_bytes()


@pytest.mark.parametrize("stored", ["half", "bc6h", "astc"])
@pytest.mark.parametrize("kind", KINDS)
def test_what_a_file_holds_takes_no_decoding(kind, stored, tmp_path, monkeypatch):
    model = random_model(sheet(), kind, stored)
    size = codec.write(tmp_path / "a.wlm", model)
    monkeypatch.setattr(colour, "decode", None)
    found = codec.inspect(tmp_path / "a.wlm")
    for name in ("name", "source", "profile", "method", "colour", "height", "width", "report", "compression_ratio"):
        assert getattr(found, name) == getattr(model, name), name
    assert (found.texels, found.lut) == (model.texels.shape[:2], model.lut.shape[:2])
    assert found.triangles == len(model.uv) and found.file_bytes == size
    assert found.header_bytes + sum(found.parts.values()) == size


@pytest.mark.parametrize("mesh", [charts(), triangle(), sheet(height=1, width=1), sheet(height=2, width=90)])
def test_meshes_of_other_sizes(mesh, tmp_path):
    for kind in KINDS:
        model = random_model(mesh, kind, tile=3)
        codec.write(tmp_path / "a.wlm", model)
        assert_same(codec.read(tmp_path / "a.wlm"), model)


def test_the_smallest_and_the_largest_numbers(tmp_path):
    model = random_model(sheet(), "cascade")
    texels = model.texels.copy()
    texels[0, 0] = 0.0, 65504.0, 2.0**-24
    lut, uv = model.lut.copy(), model.uv.copy()
    lut[0, 0], uv[0, 0] = (0, 65535), (0.0, 1.0)
    model = dataclasses.replace(model, texels=texels, lut=lut, uv=uv)
    codec.write(tmp_path / "a.wlm", model)
    assert_same(codec.read(tmp_path / "a.wlm"), model)


@pytest.mark.parametrize("colour", ["half", "bc6h"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_size_is_the_bits_of_the_textures_and_a_header(kind, colour, tmp_path):
    mesh = sheet()
    model = random_model(mesh, kind, colour)
    size = codec.write(tmp_path / "a.wlm", model)
    artifact = read_artifact(tmp_path / "a.wlm")
    colour_bytes = 18 * 23 * 6 if colour == "half" else 5 * 6 * 16
    expected = {"colour": colour_bytes, "lut": model.lut.size * 2, "uv": len(model.uv) * 24}
    assert artifact.parts == {name: count for name, count in expected.items() if count}
    assert size == sum(artifact.parts.values()) + artifact.header_bytes and artifact.header_bytes < 700
    # Eq. 9 counts both textures, whole blocks of them, and no UVs.
    bits = 8 * colour_bytes + model.lut.shape[0] * model.lut.shape[1] * 32
    assert model.compression_ratio == pytest.approx(1.0 - bits / (mesh.mask.size * 48), abs=1e-12)


def test_every_flipped_byte_and_every_cut_is_refused(tmp_path):
    codec.write(tmp_path / "a.wlm", random_model(sheet(), "cascade"))
    content = (tmp_path / "a.wlm").read_bytes()
    for place in [*range(0, 200, 7), *range(200, len(content), 97), len(content) - 1]:
        damaged = bytearray(content)
        damaged[place] ^= 0x41
        for text in (bytes(damaged), content[:place]):
            (tmp_path / "b.wlm").write_bytes(text)
            with pytest.raises(WlmError, match="b.wlm") as error:
                codec.read(tmp_path / "b.wlm")
            assert "\n" not in str(error.value)


def _put(index, value):
    def change(array):
        array = array.copy()
        array[index] = value
        return array

    return change


@pytest.mark.parametrize(
    ("kind", "part", "change", "words"),
    [
        ("tiles", "colour", lambda v: v[:-1], "colour: expected float16 .18, 23, 3., got float16 .17, 23, 3."),
        ("tiles", "colour", lambda v: v.astype(np.float32), "colour: expected float16"),
        ("tiles", "colour", _put((3, 4, 1), np.nan), "negative or not finite"),
        ("tiles", "colour", _put((3, 4, 1), np.inf), "negative or not finite"),
        ("tiles", "colour", _put((3, 4, 1), -1.0), "negative or not finite"),
        ("tiles", "colour", None, "colour"),
        ("tiles", "lut", lambda v: v[:, :-1], "lut: expected uint16"),
        ("tiles", "lut", lambda v: v.astype(np.int16), "lut: expected uint16"),
        ("tiles", "lut", _put((0, 0), pack_entries(np.array([20, 0]), np.array([4, 1]))), "beyond the colour texture"),
        ("tiles", "lut", _put((0, 0), pack_entries(np.array([0, 17]), np.array([1, 2]))), "beyond the colour texture"),
        ("tiles", "lut", None, "lut: expected uint16"),
        ("cascade", "lut", None, "lut: expected uint16"),
        ("cascade", "lut", lambda v: v[..., :1], "lut: expected uint16"),
        ("cascade", "uv", lambda v: v.astype(np.float64), "uv: expected float32"),
        ("cascade", "uv", lambda v: v[:, :2], "uv: expected float32"),
        ("cascade", "uv", _put((0, 1, 0), np.nan), r"uv: outside \[0, 1\]"),
        ("cascade", "uv", _put((0, 1, 0), -0.1), r"uv: outside \[0, 1\]"),
        ("plain with uv", "uv", _put((0, 1, 0), 1.5), r"uv: outside \[0, 1\]"),
    ],
)
def test_parts_that_do_not_fit_are_refused(kind, part, change, words, tmp_path):
    codec.write(tmp_path / "a.wlm", random_model(sheet(), kind))
    artifact = read_artifact(tmp_path / "a.wlm")
    tensors = dict(artifact.tensors)
    if change is None:
        del tensors[part]
    else:
        tensors[part] = np.ascontiguousarray(change(tensors[part]))
    write_artifact(tmp_path / "b.wlm", "atlas", artifact.settings, tensors, artifact.source)
    for read in (codec.read, codec.inspect):
        with pytest.raises(WlmError, match=words) as error:
            read(tmp_path / "b.wlm")
        assert str(error.value).startswith(f"{tmp_path / 'b.wlm'}: ") and "\n" not in str(error.value)


def test_a_table_with_a_plain_model_is_refused(tmp_path):
    codec.write(tmp_path / "a.wlm", random_model(sheet(), "plain"))
    artifact = read_artifact(tmp_path / "a.wlm")
    tensors = dict(artifact.tensors) | {"lut": np.zeros((2, 2, 2), np.uint16)}
    write_artifact(tmp_path / "a.wlm", "atlas", artifact.settings, tensors, artifact.source)
    with pytest.raises(WlmError, match="lut"):
        codec.read(tmp_path / "a.wlm")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"method": "magic"}, "method 'magic'"),
        ({"colour": "png"}, "colour 'png'"),
        ({"method": None}, "method None"),
        ({"size": [0, 48]}, "a size of 0 x 48"),
        ({"size": [40, 10**9]}, "a size of 40 x 1000000000"),
        ({"size": [40]}, "don't fit"),
        ({"size": [40.5, 48]}, "a size of 40.5"),
        ({"size": [80, 48]}, "lut: expected uint16"),
        ({"texels": [19, 23]}, "colour: expected float16 .19, 23, 3."),
        ({"texels": "ab"}, "a size of a x b"),
        ({"profile": {"name": "a", "tile": 99}}, "profile.tile"),
        ({"profile": {"name": "a", "colours": 3}}, "profile.colours"),
        ({"profile": {}}, "profile.name"),
        ({"profile": 7}, "don't fit"),
        ({"report": 7}, "don't fit"),
    ],
)
def test_settings_that_do_not_fit_are_refused(change, words, tmp_path):
    codec.write(tmp_path / "a.wlm", random_model(sheet(), "tiles"))
    artifact = read_artifact(tmp_path / "a.wlm")
    write_artifact(tmp_path / "b.wlm", "atlas", artifact.settings | change, artifact.tensors, artifact.source)
    for read in (codec.read, codec.inspect):
        with pytest.raises(WlmError, match=words) as error:
            read(tmp_path / "b.wlm")
        assert str(error.value).startswith(f"{tmp_path / 'b.wlm'}: ") and "\n" not in str(error.value)


@pytest.mark.parametrize("key", ["name", "method", "colour", "size", "texels", "profile", "report"])
def test_a_missing_setting_is_refused(key, tmp_path):
    codec.write(tmp_path / "a.wlm", random_model(sheet(), "tiles"))
    artifact = read_artifact(tmp_path / "a.wlm")
    settings = {name: value for name, value in artifact.settings.items() if name != key}
    write_artifact(tmp_path / "b.wlm", "atlas", settings, artifact.tensors, artifact.source)
    with pytest.raises(WlmError, match=key):
        codec.read(tmp_path / "b.wlm")


def test_blocks_that_are_none_of_the_format(tmp_path):
    codec.write(tmp_path / "a.wlm", random_model(sheet(), "plain", "astc"))
    artifact = read_artifact(tmp_path / "a.wlm")
    for change, words in (({"colour": np.zeros((29, 16), np.uint8)}, "colour: expected uint8"), ({}, None)):
        tensors = dict(artifact.tensors) | change
        if words is None:  # a block whose mode is reserved
            tensors["colour"] = tensors["colour"].copy()
            tensors["colour"][7] = 0
            words = "astc: expected blocks of the format"
        write_artifact(tmp_path / "b.wlm", "atlas", artifact.settings, tensors, artifact.source)
        with pytest.raises(WlmError, match=words):
            codec.read(tmp_path / "b.wlm")


def test_another_system_is_refused(tmp_path):
    write_artifact(tmp_path / "a.wlm", "probe", {}, {"x": np.zeros(1)}, "0123")
    with pytest.raises(WlmError, match="atlas"):
        codec.read(tmp_path / "a.wlm")
    with pytest.raises(WlmError, match="none.wlm"):
        codec.read(tmp_path / "none.wlm")


def test_a_texture_beyond_what_entries_reach(tmp_path):
    model = random_model(sheet(), "tiles")
    wide = dataclasses.replace(model, texels=np.zeros((18, MOST_SIZE + 1, 3), np.float16))
    codec.write(tmp_path / "a.wlm", wide)
    with pytest.raises(WlmError, match="beyond the colour texture"):
        codec.read(tmp_path / "a.wlm")
