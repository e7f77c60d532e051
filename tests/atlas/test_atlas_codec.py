"""The file: a model comes back bit for bit, its size is arithmetic, and contradictions in it are one line."""

import dataclasses

import numpy as np
import pytest
from builders.atlas_meshes import charts, sheet, triangle
from builders.atlas_models import KINDS, MIXED, random_model, save_plainly
from builders.checks import assert_same
from builders.resigned import GONE, put, rewrite

import wlm
from wlm.atlas import codec, colour
from wlm.atlas.corners import PARTS, decode_corners, encode_corners, snapped
from wlm.atlas.model import MOST_SIZE, pack_entries
from wlm.atlas.streams import deflated
from wlm.errors import WlmError
from wlm.formats.artifact import read_artifact

STORED = [(kind, stored) for kind in KINDS for stored in ("half", "rgb9e5", "bc6h", "astc")] + [(MIXED, "mixed")]


@pytest.mark.parametrize(("kind", "stored"), STORED)
def test_a_model_comes_back(kind, stored, tmp_path, monkeypatch):
    """So do the facts of `describe`, which decodes nothing; and the size is the bits of the textures and a header."""
    mesh, path = sheet(), tmp_path / "a.wlm"
    model = random_model(mesh, kind, stored)
    size = model.save(path)
    assert size == path.stat().st_size == model.file_bytes()
    back = wlm.load(path)
    assert_same(back, model)
    back.save(tmp_path / "b.wlm")
    assert path.read_bytes() == (tmp_path / "b.wlm").read_bytes()

    monkeypatch.setattr(colour, "decode", None)
    facts = codec.describe(path)
    for name in ("name", "source", "method", "colour"):
        assert facts[name] == getattr(model, name), name
    assert (facts["cr"], facts["found"]) == (model.compression_ratio, back.report)
    assert facts["profile"] == model.profile.model_dump(mode="json")
    assert (facts["size"], facts["colour_size"], facts["lut_size"]) == ([48, 40], [23, 18], [*model.lut.shape[1::-1]])
    assert facts["new_uvs"] == len(model.uv) and facts["bytes"] == size == sum(facts["parts"].values())

    texel_bytes = {"half": 6, "rgb9e5": 4, "mixed": 4}
    colour_bytes = 18 * 23 * texel_bytes[stored] if stored in texel_bytes else 5 * 6 * 16
    block_bytes = 16 * 20 if stored == "mixed" else 0
    expected = {"colour": colour_bytes, "blocks": block_bytes, "lut": model.lut.size * 2}
    header = facts["parts"].pop("header")
    uv = sum(facts["parts"].pop(name, 0) for name in PARTS)
    assert header < 900 and (0 < uv < 32 * len(model.uv) if len(model.uv) else uv == 0)
    assert facts["parts"].keys() == {name for name, count in expected.items() if count}
    assert all(0.7 * expected[name] < count <= expected[name] for name, count in facts["parts"].items())  # random
    # Eq. 9 counts the textures, whole blocks of them, and no UVs; half floats as a GPU holds them, of four channels.
    padding = 18 * 23 * 16 if stored == "half" else 0
    bits = 8 * (colour_bytes + block_bytes) + padding + model.lut.shape[0] * model.lut.shape[1] * 32
    assert model.compression_ratio == pytest.approx(1.0 - bits / (mesh.mask.size * 48), abs=1e-12)


@pytest.mark.parametrize("mesh", [charts(), triangle(), sheet(height=1, width=1), sheet(height=2, width=90)])
def test_meshes_of_other_sizes(mesh, tmp_path):
    for kind in KINDS:
        model = random_model(mesh, kind, tile=3)
        model.save(tmp_path / "a.wlm")
        assert_same(wlm.load(tmp_path / "a.wlm"), model)


def test_the_smallest_and_the_largest_numbers(tmp_path):
    model = random_model(sheet(), "cascade")
    texels = model.texels.copy()
    texels[0, 0] = 0.0, 65504.0, 2.0**-24
    lut, uv = model.lut.copy(), model.uv.copy()
    lut[0, 0], uv[0, 0] = (0, 65535), (0.0, 1.0)
    model = dataclasses.replace(model, texels=texels, lut=lut, uv=uv)
    model.save(tmp_path / "a.wlm")
    assert_same(wlm.load(tmp_path / "a.wlm"), model)


def test_earlier_files_are_read(tmp_path):
    for kind, stored in STORED:
        model = random_model(sheet(), kind, stored)
        corners = np.nextafter(model.uv, np.float32(0.5))  # beside the places of 16 bits
        model = dataclasses.replace(model, uv=corners)
        save_plainly(model, tmp_path / "a.wlm")
        back = wlm.load(tmp_path / "a.wlm")
        assert_same(back, model)
        back.save(tmp_path / "b.wlm")
        assert_same(wlm.load(tmp_path / "b.wlm"), model)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"parts": {"lut": [9, 9, 10**9]}}, "part lut: .*: expected what .* bytes can hold"),
        ({"parts": {"lut": [10**6, 0, 2]}}, "part lut: expected 0 bytes"),
        ({"parts": {"dial": [1]}}, "setting parts: dial is none of the file's"),
        ({"parts": {"lut": [4, 4, 2]}}, "part lut: expected 64 bytes"),
        ({"parts": {}}, "part .* is uint8"),
    ],
)
def test_streams_that_do_not_fit_are_refused(change, words, tmp_path):
    path = tmp_path / "a.wlm"
    random_model(sheet(), "tiles").save(path)
    assert read_artifact(path).settings["parts"]["lut"] == [6, 7, 2]
    rewrite(path, change)
    with pytest.raises(WlmError, match=f"a.wlm: .*{words}"):
        wlm.load(path)


@pytest.mark.parametrize(
    ("part", "change", "words"),
    [
        ("uv_place", lambda v: v[..., :3], "uv_triangle: expected numbers below 3"),
        ("uv_index", lambda v: v[..., :-1], "uv_order: expected a number for each"),
        ("uv_triangle", lambda v: v[..., :1], "uv_index: expected numbers below 1"),
        ("uv_order", lambda v: v * 0 + 6, "uv_order: expected numbers of at most 5"),
        ("uv_index", GONE, "uv_index is missing"),
    ],
)
def test_corners_that_do_not_fit_are_refused(part, change, words, tmp_path, monkeypatch):
    path = tmp_path / "a.wlm"
    monkeypatch.setattr(codec, "deflated", lambda parts: (parts, {}))
    random_model(sheet(), "cascade").save(path)
    rewrite(path, tensors={part: change if change is GONE else lambda v: np.ascontiguousarray(change(v))})
    with pytest.raises(WlmError, match=words):
        wlm.load(path)


def test_corners_take_few_bytes():
    """Triangles that share texels, and those that share corners, name what is there: exact, and in 2 bytes each."""
    random = np.random.default_rng(0)
    row, column = np.mgrid[:40, :40].reshape(2, -1, 1)
    quad = np.stack([column, row], 2) + [[0, 0], [1, 0], [0, 1]]
    uv = snapped(quad / 40)[random.permutation(1600).repeat(4)]
    uv = np.take_along_axis(uv, random.permuted(np.tile(np.arange(3), (6400, 1)), axis=1)[:, :, None], 1)
    parts = encode_corners(uv)
    np.testing.assert_array_equal(decode_corners({name: parts[name] for name in PARTS}), uv)
    assert sum(part.size for part in deflated(parts)[0].values()) < 4 * len(uv) < uv.nbytes / 5


def _refused(tmp_path, kind: str, words: str, settings=None, tensors=None, stored: str = "half") -> None:
    """Saves a model with other settings or tensors; reading and describing it are one line."""
    path = tmp_path / "a.wlm"
    save_plainly(random_model(sheet(), kind, stored), path)
    rewrite(path, settings, tensors)
    for read in (wlm.load, codec.describe):
        with pytest.raises(WlmError, match=words) as error:
            read(path)
        assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("kind", "part", "change", "words"),
    [
        ("tiles", "colour", lambda v: v[:-1], "colour is float16 .17, 23, 3., expected float16 .18, 23, 3."),
        ("tiles", "colour", put((3, 4, 1), np.inf), "colour: expected finite numbers"),
        ("tiles", "colour", put((3, 4, 1), -1.0), "colour: expected numbers of at least 0, found -1"),
        ("tiles", "colour", GONE, "colour is missing"),
        ("tiles", "lut", lambda v: np.ascontiguousarray(v[:, :-1]), "lut is uint16"),
        ("tiles", "lut", put((0, 0), pack_entries(np.array([20, 0]), np.array([4, 1]))), "beyond the colour texture"),
        ("tiles", "lut", put((0, 0), pack_entries(np.array([0, 17]), np.array([1, 2]))), "beyond the colour texture"),
        ("tiles", "lut", GONE, "lut is missing"),
        ("cascade", "lut", GONE, "lut is missing"),
        ("cascade", "lut", lambda v: v[:0], "lut is empty"),
        ("cascade", "lut", lambda v: np.ascontiguousarray(v[..., :1]), "lut is uint16"),
        ("plain", "lut", np.zeros((2, 2, 2), np.uint16), "lut is uint16"),
        ("cascade", "uv", lambda v: np.ascontiguousarray(v[:, :2]), "uv is float32"),
        ("cascade", "uv", put((0, 1, 0), -0.1), "uv: expected 0 to 1, found -0.1"),
        ("plain with uv", "uv", put((0, 1, 0), 1.5), "uv: expected 0 to 1, found 1.5"),
    ],
)
def test_parts_that_do_not_fit_are_refused(kind, part, change, words, tmp_path):
    _refused(tmp_path, kind, words, tensors={part: change})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"method": "magic"}, "setting method: expected .* got 'magic'"),
        ({"colour": "png"}, "setting colour: expected .* got 'png'"),
        ({"method": None}, "setting method: expected .* got None"),
        ({"size": [0, 48]}, "setting size.0: expected .* got 0"),
        ({"size": [40, 10**9]}, "setting size.1: expected .* got 1000000000"),
        ({"size": [40]}, "setting size: "),
        ({"size": [40.5, 48]}, "setting size.0: expected a valid integer, got 40.5"),
        ({"size": [80, 48]}, "lut is uint16"),
        ({"texels": [19, 23]}, "colour is float16 .18, 23, 3., expected float16 .19, 23, 3."),
        ({"texels": "ab"}, "setting texels: expected a valid list, got 'ab'"),
        ({"profile": {"name": "a", "tile": 99}}, "setting profile.tile: expected"),
        ({"profile": {"name": "a", "colours": 3}}, "setting unknown key 'profile.colours'"),
        ({"profile": {}}, "setting profile.name"),
        ({"profile": 7}, "profile"),
        ({"report": 7}, "setting report: "),
    ],
)
def test_settings_that_do_not_fit_are_refused(change, words, tmp_path):
    _refused(tmp_path, "tiles", words, change)


def test_blocks_that_are_none_of_the_format(tmp_path):
    both = {"lut": put((0, 0), np.array([15, 3]))}
    _refused(tmp_path, MIXED, "lut: a tile is of both textures", tensors=both)
    beyond = {"lut": put((0, 0), pack_entries(np.array([16, 4]), np.array([8, 4]), True))}
    _refused(tmp_path, MIXED, "beyond the colour texture", tensors=beyond)
    blocks = {"colour": lambda v: np.zeros((29, 16), np.uint8)}
    _refused(tmp_path, "plain", "colour is uint8 .29, 16., expected uint8 .30, 16.", tensors=blocks, stored="astc")
    model = random_model(sheet(), "plain", "astc")
    save_plainly(model, tmp_path / "a.wlm")
    rewrite(tmp_path / "a.wlm", tensors={"colour": put(7, 0)})  # a reserved mode
    with pytest.raises(WlmError, match="a.wlm: astc: expected blocks of the format"):
        wlm.load(tmp_path / "a.wlm")


def test_a_texture_beyond_what_entries_reach(tmp_path):
    model = random_model(sheet(), "tiles")
    wide = dataclasses.replace(model, texels=np.zeros((18, MOST_SIZE + 1, 3), np.float16))
    with pytest.raises(WlmError, match="a.wlm: not written: .*beyond the colour texture"):
        wide.save(tmp_path / "a.wlm")
    assert not (tmp_path / "a.wlm").exists()
    save_plainly(model, tmp_path / "a.wlm")
    rewrite(tmp_path / "a.wlm", {"texels": [18, MOST_SIZE + 1]}, {"colour": wide.texels})
    with pytest.raises(WlmError, match="beyond the colour texture"):
        wlm.load(tmp_path / "a.wlm")
