"""Bundles: textures that hold the model's numbers exactly, a mesh with both UVs, a shader that compiles."""

from dataclasses import replace

import numpy as np
import pytest
from builders.atlas_meshes import charts, sheet
from builders.atlas_models import KINDS, MIXED, random_model, shared_model

from wlm.atlas import colour
from wlm.atlas.bundle import bundle
from wlm.atlas.data import from_arrays
from wlm.atlas.shader import glsl
from wlm.errors import WlmError
from wlm.formats.gltf import parse_gltf
from wlm.formats.shared_exponent import unpack_rgb9e5

FORMATS = {"half": "R16G16B16A16_FLOAT", "rgb9e5": "R9G9B9E5_SHAREDEXP", "bc6h": "BC6H_UF16"}


@pytest.mark.parametrize("kind", ["tiles", "cascade"])
def test_the_lookup_texture_is_exact(kind):
    model = random_model(sheet(), kind)
    texture = bundle(model).textures["lut"]
    assert texture.fmt == ("R16G16_UINT" if kind == "tiles" else "R16G16_UNORM")
    assert (texture.height, texture.width) == model.lut.shape[:2]
    np.testing.assert_array_equal(np.frombuffer(texture.data.tobytes(), "<u2").reshape(model.lut.shape), model.lut)


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


def test_a_texture_beyond_a_gpu():
    model = replace(random_model(sheet(), "plain"), texels=np.zeros((1, 1, 16385, 3), np.float16))
    with pytest.raises(WlmError, match="sheet: colour: expected at most 16384 texels along a side, found 16385"):
        bundle(model)


def test_the_shader_names_the_uvs_that_it_takes():
    assert "the new UVs of mesh.glb" in glsl(random_model(sheet(), "cascade"))
    assert "the mesh's own lightmap UVs" in glsl(random_model(sheet(), "tiles"))
    assert "usampler2D" in glsl(random_model(sheet(), "tiles"))
    assert "lut" not in glsl(random_model(sheet(), "plain")).lower()
