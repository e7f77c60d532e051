"""The runtime path: models of all three methods against float64, and the lightmap in its own layout."""

import numpy as np
import pytest
import torch
from builders.atlas_meshes import charts, sheet

from wlm.atlas.decode import Decoder
from wlm.atlas.exact import decode64
from wlm.atlas.fit import compress
from wlm.atlas.model import AtlasModel, Profile, load_profile
from wlm.errors import WlmError

STANDARD = load_profile("standard").model_copy(update={"views": 2, "fallback": False})
NO_UV, NO_BLOCKS = np.empty((0, 3, 2), np.float32), np.empty((0, 16), np.uint8)


def made(mesh, method: str, texels: np.ndarray, lut: np.ndarray | None = None, uv: np.ndarray = NO_UV) -> AtlasModel:
    """A model of given textures."""
    lut = np.empty((0, 0, 2), np.uint16) if lut is None else lut
    size = mesh.mask.shape
    profile = Profile(name=method, method="cascade")
    return AtlasModel(
        mesh.name, mesh.source, profile, method, "half", *size, texels.astype(np.float16), NO_BLOCKS, lut, uv
    )


def models(mesh) -> dict[str, AtlasModel]:
    """One of each method, and a plain one under UVs of its own."""
    random = np.random.default_rng(0)
    texels = random.random((11, 17, 3))
    turned = (1.0 - mesh.uv[mesh.triangle])[..., ::-1].astype(np.float32)
    return {
        "tiles": compress(mesh, STANDARD),
        "cascade": made(mesh, "cascade", texels, random.integers(0, 65536, (9, 13, 2)).astype(np.uint16), turned),
        "plain": made(mesh, "plain", texels),
        "plain with uv": made(mesh, "plain", mesh.lightmap[::-1, ::-1].transpose(1, 0, 2), uv=turned),
    }


def points(mesh, count: int = 500) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Random ones on the mesh: UVs, triangles and weights."""
    random = np.random.default_rng(1)
    triangle = random.integers(0, len(mesh.triangle), count)
    weight = random.dirichlet([1.0, 1.0, 1.0], count)
    uv = (mesh.uv[mesh.triangle[triangle]] * weight[:, :, None]).sum(1)
    return tuple(torch.tensor(part, dtype=kind) for part, kind in
                 ((uv, torch.float32), (triangle, torch.int32), (weight, torch.float32)))  # fmt: skip


@pytest.mark.parametrize("name", ["tiles", "cascade", "plain", "plain with uv"])
def test_against_float64(device: str, name: str):
    mesh = sheet()
    model = models(mesh)[name]
    random = np.random.default_rng(2)
    uv = random.uniform(-0.1, 1.1, (2000, 2)).astype(np.float32)
    if name == "tiles":
        # A point on a border of tiles may be read from either.
        place = (uv * [mesh.mask.shape[1], mesh.mask.shape[0]] - 0.5) / model.profile.tile
        uv = uv[np.abs(place - np.rint(place)).min(1) > 1e-4]
    want = decode64(model, uv)
    got = Decoder(model, device).read(torch.from_numpy(uv).to(device)).cpu().numpy()
    assert np.ptp(want) > 0.3
    # A cascade's second coordinate inherits the rounding of its first.
    np.testing.assert_allclose(got, want, atol=5e-5)


def test_the_reference_agrees_with_the_tests_own():
    """Two float64 readings, made apart."""
    from reference import tiles as reference

    mesh = sheet()
    model = compress(mesh, STANDARD)
    uv = np.random.default_rng(3).random((300, 2))
    want = reference.decode(uv, model.height, model.width, model.profile.tile, model.lut, model.texels)
    np.testing.assert_allclose(decode64(model, uv), want, atol=1e-12)


@pytest.mark.parametrize("name", ["tiles", "cascade", "plain", "plain with uv"])
def test_no_point(device: str, name: str):
    model = models(sheet())[name]
    assert Decoder(model, device).read(torch.empty((0, 2), device=device)).shape == (0, 3)


def test_a_sampler_takes_the_meshs_own_uvs(device: str):
    """A model with new UVs finds them by triangle and weights, one without reads the given ones."""
    mesh = sheet()
    for name, model in models(mesh).items():
        uv, triangle, weight = points(mesh)
        own = uv
        if len(model.uv):
            own = torch.tensor((model.uv[triangle.numpy()] * weight.numpy()[:, :, None]).sum(1))
        decoder = Decoder(model, device)
        got = decoder(uv.to(device), triangle.to(device), weight.to(device))
        assert torch.allclose(got, decoder.read(own.to(device)), atol=1e-4), name


def test_new_uvs_show_the_same_light(device: str):
    """A lightmap turned by its UVs and by its texels alike is the lightmap."""
    mesh = sheet()
    decoder = Decoder(models(mesh)["plain with uv"], device)
    parts = [part.to(device) for part in points(mesh)]
    want = decode64(made(mesh, "plain", mesh.lightmap), parts[0].cpu().numpy())
    np.testing.assert_allclose(decoder(*parts).cpu().numpy(), want, atol=2e-4)
    np.testing.assert_allclose(decoder.lightmap(mesh), mesh.lightmap, atol=2e-3)


def test_the_lightmap_in_its_own_layout(device: str):
    """As the decoder reads each texel's centre in the mask, zero outside."""
    mesh = charts()
    for name, model in models(mesh).items():
        decoder = Decoder(model, device)
        decoded = decoder.lightmap(mesh)
        assert decoded.shape == mesh.lightmap.shape and decoded.dtype == np.float32
        assert not decoded[~mesh.mask].any() and (decoded[mesh.mask] > 0).any(), name
        if not len(model.uv):
            row, column = np.nonzero(mesh.mask)
            uv = np.stack([column + 0.5, row + 0.5], 1) / mesh.mask.shape[::-1]
            got = decoder.read(torch.tensor(uv, dtype=torch.float32, device=device)).cpu().numpy()
            np.testing.assert_array_equal(decoded[row, column], got)
    exact = models(mesh)["plain with uv"]
    # A texel with its centre in no triangle has its neighbour's light.
    assert np.abs(Decoder(exact, device).lightmap(mesh) - mesh.lightmap)[mesh.mask].mean() < 0.02


def test_another_mesh_is_refused():
    mesh = sheet()
    model = compress(mesh, STANDARD)
    line = "sheet: expected the mesh and lightmap that the model was made of"
    for other in (sheet(height=41), sheet(lambda place: place[..., :1] * np.ones(3)), sheet(quads=5)):
        with pytest.raises(WlmError, match=line):
            Decoder(model).lightmap(other)
    with pytest.raises(WlmError, match="device 'tpu'"):
        Decoder(model, "tpu")


def test_reading_into_a_given_array(device: str):
    """What a graph replays: the same array is written anew."""
    import warp as wp

    from wlm import interop

    mesh = sheet()
    for model in models(mesh).values():
        decoder = Decoder(model, device)
        uv = points(mesh)[0].to(device)
        out = torch.full((len(uv), 3), -1.0, device=device)
        decoder.run(interop.to_warp(uv, wp.vec2), out)
        wp.synchronize()
        assert torch.equal(out, decoder.read(uv))
