"""Files and bundles: a model comes back bit for bit, its size is arithmetic, and contradictions are one line."""

import dataclasses

import numpy as np
import pytest
from builders.atlas_meshes import charts, sheet, triangle
from builders.atlas_models import KINDS, MIXED, random_model, save_plainly, shared_model
from builders.checks import assert_same, error_of, put
from builders.resigned import rewrite

import wlm
from wlm.atlas import codec, colour
from wlm.atlas.bundle import bundle
from wlm.atlas.data import LightmappedScene, from_arrays, join
from wlm.atlas.model import MOST_SIZE, AtlasModel, pack_entries
from wlm.errors import WlmError
from wlm.formats.artifact import read_artifact
from wlm.formats.gltf import parse_gltf
from wlm.formats.shared_exponent import unpack_rgb9e5

STORED = [(kind, stored) for kind in KINDS for stored in ("half", "rgb9e5", "bc6h", "astc")] + [(MIXED, "mixed")]


@pytest.mark.parametrize(("kind", "stored"), STORED)
def test_a_model_comes_back(kind, stored, tmp_path):
    """Its size is the bits of the textures and a header, with triangles and masks apart."""
    scene, path = sheet(), tmp_path / "a.wlm"
    model = random_model(scene, kind, stored)
    size = model.save(path)
    assert size == path.stat().st_size == model.file_bytes()
    back = wlm.load(path)
    _assert_same(back, model)
    back.save(tmp_path / "b.wlm")
    assert path.read_bytes() == (tmp_path / "b.wlm").read_bytes()

    texel_bytes = {"half": 6, "rgb9e5": 4, "mixed": 4}
    colour_bytes = 18 * 23 * texel_bytes[stored] if stored in texel_bytes else 5 * 6 * 16
    block_bytes = 16 * 20 if stored == "mixed" else 0
    expected = {"colour": colour_bytes, "blocks": block_bytes, "lut": model.lut.size * 2, "uv": model.uv.size * 2}
    artifact = read_artifact(path)
    parts = dict(artifact.parts)
    assert codec.sizes(model) == (size, parts.pop("mesh") + parts.pop("mask"))
    assert artifact.header_bytes < 1300
    assert parts.keys() == {name for name, count in expected.items() if count}
    assert all(0.5 * expected[name] < count <= expected[name] for name, count in parts.items())  # random
    # Eq. 9 counts the textures, whole blocks of them, and no UVs; half floats as a GPU holds them, with four channels.
    padding = 18 * 23 * 16 if stored == "half" else 0
    bits = 8 * (colour_bytes + block_bytes) + padding + model.lut.shape[0] * model.lut.shape[1] * 32
    assert model.compression_ratio == pytest.approx(1.0 - bits / (scene.sheets[0].mask.size * 48), abs=1e-12)


@pytest.mark.parametrize("separate", [False, True])
def test_a_model_of_many_lightmaps_comes_back(separate, tmp_path):
    scene = _many()
    model = shared_model(scene, separate=separate)
    model.save(tmp_path / "a.wlm")
    back = wlm.load(tmp_path / "a.wlm")
    _assert_same(back, model)
    assert [each.name for each in back.scene.sheets] == [each.name for each in scene.sheets]
    bits = 2 * 16 * 40 * 32 + model.lut.nbytes * 8 + 2 * 8 * 128 + len(model.rows) * 128
    assert model.bits == bits and model.source_bits == scene.texels * 48


def test_the_scene_comes_back(tmp_path):
    """The triangles, UVs and masks, in the same order; the lightmaps alone are not in the file."""
    for scene in (charts(), _many()):
        model = shared_model(scene) if len(scene.states) > 1 else random_model(scene, "cascade")
        model.save(tmp_path / "a.wlm")
        back = wlm.load(tmp_path / "a.wlm").scene
        assert (back.uv_set, back.metres, back.objects) == (scene.uv_set, scene.metres, scene.objects)
        for one, other in zip(back.sheets, scene.sheets, strict=True):
            for name in ("position", "triangle", "uv", "active", "mask"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
            assert one.lightmaps.shape == (0, *other.mask.shape, 3)


def _many() -> LightmappedScene:
    """Two sheets in two states."""
    scenes = []
    for each in (sheet(), charts()):
        (own,) = each.sheets
        light = np.stack([own.lightmap, 0.5 * own.lightmap])
        scenes.append(from_arrays(own.position, own.triangle, own.uv, light, own.mask, own.name))
    return join(scenes)


def _assert_same(back: AtlasModel, model: AtlasModel) -> None:
    """Everything is the same, of the stored scene too."""
    assert_same(dataclasses.replace(back, stored=None), dataclasses.replace(model, stored=None))
    assert back.stored.glb == model.stored.glb
    for name in ("objects", "uv_set", "metres", "hides"):
        assert getattr(back.stored, name) == getattr(model.stored, name)
    for one, other in zip(back.stored.masks, model.stored.masks, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("mesh", [charts(), triangle(), sheet(height=1, width=1), sheet(height=2, width=90)])
def test_meshes_of_other_sizes(mesh, tmp_path):
    for kind in KINDS:
        model = random_model(mesh, kind, tile=3)
        model.save(tmp_path / "a.wlm")
        _assert_same(wlm.load(tmp_path / "a.wlm"), model)


def _refused(tmp_path, kind: str, words: str, settings=None, tensors=None, stored: str = "half") -> None:
    """Saves a model with other settings or tensors; reading it is one line."""
    path = tmp_path / "a.wlm"
    save_plainly(shared_model(_many()) if kind == "shared" else random_model(sheet(), kind, stored), path)
    rewrite(path, settings, tensors)
    with pytest.raises(WlmError, match=words) as error:
        wlm.load(path)
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("kind", "part", "change", "words"),
    [
        ("tiles", "lut", put((0, 0), pack_entries(np.array([20, 0]), np.array([4, 1]))), "beyond the colour texture"),
        ("cascade", "lut", lambda v: v[:0], "expected at least one texel in each of these"),
    ],
)
def test_parts_that_do_not_fit_are_refused(kind, part, change, words, tmp_path):
    _refused(tmp_path, kind, words, tensors={part: change})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"texels": [19, 23]}, "colour is float16 .1, 18, 23, 3., expected float16 .1, 19, 23, 3."),
        ({"states": ["a", "b"]}, "expected one of each for method tiles, found more"),
        ({"separate": True}, "setting separate: only method shared has .*, found tiles"),
    ],
)
def test_settings_that_do_not_fit_are_refused(change, words, tmp_path):
    _refused(tmp_path, "tiles", words, change)


def test_blocks_that_are_none_of_the_format(tmp_path):
    both = {"lut": put((0, 0), np.array([15, 3]))}
    _refused(tmp_path, MIXED, "lut: a tile's entry counts blocks along one axis", tensors=both)
    beyond = {"lut": put((0, 0), pack_entries(np.array([16, 4]), np.array([8, 4]), True))}
    _refused(tmp_path, MIXED, "beyond the colour texture", tensors=beyond)
    blocks = {"colour": lambda v: np.zeros((1, 29, 16), np.uint8)}
    _refused(tmp_path, "plain", "colour is uint8 .1, 29, 16., expected uint8 .1, 30, 16", tensors=blocks, stored="astc")
    model = random_model(sheet(), "plain", "astc")
    save_plainly(model, tmp_path / "a.wlm")
    rewrite(tmp_path / "a.wlm", tensors={"colour": put((0, 7), 0)})  # a reserved mode
    assert "a.wlm: astc: the block in row 1, column 1 is invalid" in error_of(wlm.load, tmp_path / "a.wlm")


def test_a_texture_beyond_what_entries_reach(tmp_path):
    model = random_model(sheet(), "tiles")
    wide = dataclasses.replace(model, texels=np.zeros((1, 18, MOST_SIZE + 1, 3), np.float16))
    with pytest.raises(WlmError, match="a.wlm: not written: .*at most 4096 texels along a side"):
        wide.save(tmp_path / "a.wlm")
    assert not (tmp_path / "a.wlm").exists()
    save_plainly(model, tmp_path / "a.wlm")
    rewrite(tmp_path / "a.wlm", {"texels": [18, MOST_SIZE + 1]}, {"colour": wide.texels})
    assert "at most 4096 texels along a side" in error_of(wlm.load, tmp_path / "a.wlm")


@pytest.mark.parametrize(
    ("part", "change", "words"),
    [
        ("lut", put((0, 0), np.array([36 << 4 | 7, 0, 0, 1])), "beyond the colour texture"),
        ("lut", put((0, 0), np.array([0, 0, 7, 1])), "names a factor beyond the last one"),
        ("lut", put((0, 0), np.array([0, 0, 0, 1 << 8 | 1])), "more coarse components, of one block each, than"),
        ("lut", lambda v: np.ascontiguousarray(v[..., :3]), "expected entries of 2 or 4 numbers"),
        ("sheets", put((0, 0), 999), "expected the height and width in setting sizes"),
        ("sheets", put((0, 4), 3), "expected as many tiles as"),
        ("sheets", put((1, 2), 90), "beyond the lookup texture"),
        ("sheets", put((0, 6), 1), "expected its next mip level in a later row of its state, found row 1"),
        ("sheets", lambda v: v[:1], "expected 2 or more rows per state, for 1 states, found 1"),
    ],
)
def test_shared_parts_that_do_not_fit_are_refused(part, change, words, tmp_path):
    _refused(tmp_path, "shared", words, tensors={part: change})


def test_shared_settings_that_do_not_fit_are_refused(tmp_path):
    for words, settings in (
        ("expected 2 or more rows per state, for 2 states, found 2", {"separate": True}),
        ("expected the height and width in setting sizes", {"sizes": [[48, 40], [48, 64]]}),
        ("expected rgb9e5 or mixed for method shared", {"colour": "half"}),
        ("setting objects: expected an object or more for each of the 2 sheets", {"objects": []}),
    ):
        _refused(tmp_path, "shared", words, settings)


FORMATS = {"half": "R16G16B16A16_FLOAT", "rgb9e5": "R9G9B9E5_SHAREDEXP", "bc6h": "BC6H_UF16"}


@pytest.mark.parametrize("stored", ["half", "rgb9e5", "bc6h", "astc", "mixed"])
def test_the_colours_are_exact(stored):
    model = random_model(sheet(), MIXED if stored == "mixed" else "plain", stored)
    made = bundle(model)
    texture, first = made.textures["colour"], "rgb9e5" if stored == "mixed" else stored
    assert texture.fmt == FORMATS.get(first, "ASTC_4x4_SFLOAT_BLOCK") and (texture.width, texture.height) == (23, 18)
    data, texels = texture.data.tobytes(), model.texels[0].astype(np.float32)
    if first == "half":
        whole = np.frombuffer(data, "<f2").reshape(18, 23, 4)
        np.testing.assert_array_equal(whole[..., :3], texels)
        assert (whole[..., 3] == 1).all()
    elif first == "rgb9e5":
        np.testing.assert_array_equal(unpack_rgb9e5(np.frombuffer(data, "<u4").reshape(18, 23)), texels)
    else:
        blocks = np.frombuffer(data, np.uint8).reshape(-1, 16)
        np.testing.assert_array_equal(colour.decode(blocks, 18, 23, first), texels)
        np.testing.assert_array_equal(texture.image, texels)
    assert ("blocks" in made.textures) == (stored == "mixed")
    if stored == "mixed":
        second = made.textures["blocks"]
        blocks = np.frombuffer(second.data.tobytes(), np.uint8).reshape(-1, 16)
        decoded = colour.decode(blocks, second.height, second.width, "bc6h")
        np.testing.assert_array_equal(decoded, model.block_texels[0].astype(np.float32))
    assert 8 * made.nbytes == model.bits


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("mesh", [sheet(), charts()], ids=["sheet", "charts"])
def test_the_mesh_keeps_its_uvs_and_gets_new_ones(kind, mesh):
    model, (own,) = random_model(mesh, kind), mesh.sheets
    made = bundle(model)
    (primitive,) = parse_gltf("mesh.glb", made.files["mesh.glb"])[1]
    np.testing.assert_array_equal(primitive.position[primitive.triangle], own.position[own.triangle])
    np.testing.assert_array_equal(primitive.uv[0][primitive.triangle], own.uv[own.triangle].astype(np.float32))
    new = len(model.uv) > 0
    assert set(primitive.uv) == ({0, 1} if new else {0}) and made.document["uv_set"] == int(new)
    if new:
        np.testing.assert_array_equal(primitive.uv[1][primitive.triangle], model.uv)
    np.testing.assert_array_equal(made.reference["lightmap"], model.decoder().lightmap())
    assert made.exact == "WLM_ATLAS_EXACT" and made.model is model


@pytest.mark.parametrize("separate", [False, True])
def test_many_lightmaps_are_texture_arrays(separate):
    (own,) = sheet().sheets
    light = np.stack([own.lightmap, 0.5 * own.lightmap, own.lightmap**2])
    model = shared_model(from_arrays(own.position, own.triangle, own.uv, light, name="thing"), separate=separate)
    made = bundle(model)
    assert set(made.textures) == {"colour", "lut", "sheets", "factors"} and made.textures["colour"].layers == 2
    sheets = np.frombuffer(made.textures["sheets"].data.tobytes(), "<u2").reshape(-1, 2, 4)
    assert sheets[0].tolist() == [[48, 40, 0, 0], [7, 6, 0, 0]] and len(sheets) == (3 if separate else 1)
    factors = np.frombuffer(made.textures["factors"].data.tobytes(), "<f4").reshape(3, 8, 4)
    np.testing.assert_array_equal(factors[..., :3], model.factor)
    assert made.document["objects"] == [{"node": 0, "label": "thing", "sheet": 0, "scale_offset": [1, 1, 0, 0]}]
    assert made.document["layer_heights"] == {"colour": 16} and 8 * made.nbytes == model.bits
    node = parse_gltf("mesh.glb", made.files["mesh.glb"])[0].content["nodes"][0]
    assert node["extras"] == {"wlm": {"sheet": 0, "scale_offset": [1, 1, 0, 0], "uv_set": 0}}


def test_a_mask_that_triangles_do_not_imply_is_stored():
    """Decoded without the inputs, the lightmap has the texels of the mask and no others."""
    (own,) = charts().sheets
    mask = own.mask & (np.arange(64) < 40)
    scene = from_arrays(own.position, own.triangle, own.uv, own.lightmap, mask)
    decoded = random_model(scene, "tiles").decoder().lightmap()
    assert not decoded[~mask].any() and (decoded[mask] > 0).any()
