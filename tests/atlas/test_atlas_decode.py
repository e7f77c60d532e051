"""The runtime path: models of all three methods against float64, and the lightmap in its own layout."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from builders.atlas_meshes import charts, sheet
from builders.atlas_models import KINDS, MIXED
from builders.checks import error_of

import wlm
from benchmarks.atlas_exact import decode64
from wlm.atlas.decode import Decoder
from wlm.atlas.fit import compress
from wlm.atlas.model import AtlasModel, Profile, SheetPlace
from wlm.atlas.stored import store
from wlm.atlas.views import Points
from wlm.errors import WlmError

FEW = {"views": 2, "fallback": False}


def model_of(mesh, method: str, texels: np.ndarray, **parts: np.ndarray) -> AtlasModel:
    """A model with the given textures and UVs."""
    profile = Profile(name=method, method="cascade")
    texels, places = texels.astype(np.float16)[None], (SheetPlace(mesh.name, *mesh.sheets[0].mask.shape),)
    settings = (mesh.name, mesh.source, profile, method, "half", mesh.states, places, texels)
    return AtlasModel(*settings, stored=store(mesh), **parts)


@cache
def models(make_mesh) -> dict[str, AtlasModel]:
    """For a mesh one model of each method, and a plain one under new UVs."""
    mesh, random = make_mesh(), np.random.default_rng(0)
    texels = random.random((11, 17, 3))
    uv = (1.0 - mesh.sheets[0].uv[mesh.sheets[0].triangle])[..., ::-1].astype(np.float32)
    lut = random.integers(0, 65536, (9, 13, 2)).astype(np.uint16)
    return {
        "tiles": compress(mesh, "standard", colour="half", tile=7, **FEW),
        MIXED: compress(mesh, "standard", **FEW),
        "cascade": model_of(mesh, "cascade", texels, lut=lut, uv=uv),
        "plain": model_of(mesh, "plain", texels),
        "plain with uv": model_of(mesh, "plain", mesh.sheets[0].lightmap[::-1, ::-1].transpose(1, 0, 2), uv=uv),
    }


def points(mesh, count: int = 500, device: str = "cpu") -> Points:
    """Random points on the mesh."""
    random, (own,) = np.random.default_rng(1), mesh.sheets
    triangle = random.integers(0, len(own.triangle), count)
    weight = random.dirichlet([1.0, 1.0, 1.0], count)
    uv = (own.uv[own.triangle[triangle]] * weight[:, :, None]).sum(1)
    kinds = torch.float32, torch.int32, torch.int64, torch.float32
    parts = zip((uv, 0 * triangle, triangle, weight), kinds, strict=True)
    return Points(*(torch.tensor(part, dtype=kind, device=device) for part, kind in parts))


@pytest.mark.parametrize("name", [*KINDS, MIXED])
def test_against_float64(device: str, name: str):
    mesh, model = sheet(), models(sheet)[name]
    random = np.random.default_rng(2)
    uv = random.uniform(-0.1, 1.1, (2000, 2)).astype(np.float32)
    if model.method == "tiles":
        # A point on a border of tiles may be read from either.
        place = (uv * [mesh.sheets[0].mask.shape[1], mesh.sheets[0].mask.shape[0]] - 0.5) / model.profile.tile
        uv = uv[np.abs(place - np.rint(place)).min(1) > 1e-4]
    expected = decode64(model, uv)
    decoder = model.decoder(device)
    assert np.ptp(expected) > 0.3
    # A cascade's second coordinate inherits the rounding of its first.
    np.testing.assert_allclose(decoder.read(torch.from_numpy(uv).to(device)).cpu().numpy(), expected, atol=5e-5)
    assert decoder.read(torch.empty((0, 2), device=device)).shape == (0, 3)


def test_new_uvs_show_the_same_light(device: str):
    """A lightmap turned by its UVs and by its texels alike is the lightmap."""
    mesh = sheet()
    decoder = Decoder(models(sheet)["plain with uv"], device)
    drawn = points(mesh, device=device)
    expected = decode64(model_of(mesh, "plain", mesh.sheets[0].lightmap), drawn.uv.cpu().numpy())
    np.testing.assert_allclose(decoder(drawn).cpu().numpy(), expected, atol=2e-4)
    np.testing.assert_allclose(decoder.lightmap(), mesh.sheets[0].lightmap, atol=2e-3)


def test_the_lightmap_in_its_own_layout(device: str):
    """As the decoder reads each texel's centre in the mask, zero outside."""
    mesh = charts()
    for name, model in models(charts).items():
        decoder = Decoder(model, device)
        decoded = decoder.lightmap()
        assert decoded.shape == mesh.sheets[0].lightmap.shape and decoded.dtype == np.float32
        assert not decoded[~mesh.sheets[0].mask].any() and (decoded[mesh.sheets[0].mask] > 0).any(), name
        if not len(model.uv):
            row, column = np.nonzero(mesh.sheets[0].mask)
            uv = np.stack([column + 0.5, row + 0.5], 1) / mesh.sheets[0].mask.shape[::-1]
            light = decoder.read(torch.tensor(uv, dtype=torch.float32, device=device)).cpu().numpy()
            np.testing.assert_array_equal(decoded[row, column], light)
    exact = models(charts)["plain with uv"]
    # A texel with its centre in no triangle has its neighbour's light.
    assert np.abs(Decoder(exact, device).lightmap() - mesh.sheets[0].lightmap)[mesh.sheets[0].mask].mean() < 0.02


def test_another_mesh_is_refused():
    model = models(sheet)["plain with uv"]
    with pytest.raises(WlmError, match="triangles, but its new UVs are for"):
        _ = replace(model, uv=model.uv[1:]).scene
    model = models(sheet)["tiles"]
    with pytest.raises(WlmError, match="sheet: expected a sheet of the size in the model, found 48x41"):
        Decoder(model).texels(sheet(height=41).sheets[0])
    with pytest.raises(WlmError, match="sheet: expected the mesh and lightmaps that the model was made of, hash"):
        wlm.atlas.evaluate(model, sheet(quads=5))
    assert "device 'tpu'" in error_of(Decoder, model, "tpu")
