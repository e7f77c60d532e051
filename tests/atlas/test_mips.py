"""Mips: each level against means of the lightmap, no step between them, and what a file and a shader have of them."""

import dataclasses
import shutil
import subprocess

import numpy as np
import pytest
import torch
from builders.atlas_meshes import charts, sheet
from builders.atlas_models import MIXED, random_model

import wlm
from wlm.atlas.colour import encode
from wlm.atlas.fit import compress
from wlm.atlas.mips import Tail, make_tail, tail_light
from wlm.atlas.model import tail_bits, tail_shapes
from wlm.atlas.shader import glsl
from wlm.errors import WlmError

HALF = {"views": 2, "mips": True, "fallback": False}


@pytest.fixture(scope="module")
def pair():
    mesh = sheet(height=64, width=96)
    return mesh, compress(mesh, "standard", budget=0.3, **HALF)


def means(image: np.ndarray, side: int) -> np.ndarray:
    """Of squares of `side` x `side` texels."""
    height, width = (size // side for size in image.shape[:2])
    return image.reshape(height, side, width, side, -1).mean((1, 3))


def test_sizes_of_levels():
    assert tail_shapes(64, 96) == [(16, 24), (8, 12), (4, 6), (2, 3), (1, 1)]
    # Whole blocks: Direct3D and browsers take no others.
    assert tail_shapes(1, 1) == [(4, 4), (2, 2), (1, 1)] and tail_shapes(17, 33)[:2] == [(8, 12), (4, 6)]
    assert tail_bits(64, 96) == 8 * 16 * (24 + 6 + 2 + 1 + 1)


def test_each_level_is_the_lightmap_made_smaller(pair, device):
    mesh, model = pair
    decoder = model.decoder(device)
    for octaves, side in ((2, 4), (3, 8), (4, 16)):
        want = means(mesh.sheets[0].lightmap, side)
        row, column = np.mgrid[: want.shape[0], : want.shape[1]].reshape(2, -1)
        uv = np.stack([(column + 0.5) / want.shape[1], (row + 0.5) / want.shape[0]], 1).astype(np.float32)
        points = torch.from_numpy(uv).to(device)
        light = decoder.read(points, lod=torch.full((len(uv),), float(octaves), device=device)).cpu().numpy()
        error = np.square(light - want.reshape(-1, 3)).mean()
        assert -10 * np.log10(error / np.ptp(mesh.sheets[0].lightmap) ** 2) > 36.0
    beyond = decoder.read(points[:1], lod=torch.full((1,), 99.0, device=device)).cpu().numpy()
    np.testing.assert_allclose(beyond[0], mesh.sheets[0].lightmap.mean((0, 1)), rtol=0.02)


def test_there_is_no_step(pair, device):
    """From level to level light changes by as much as the distance allows; up close it is the tiles'."""
    _, model = pair
    decoder, uv = model.decoder(device), torch.tensor([[0.31, 0.42]], device=device)
    lods = torch.linspace(0.0, 6.0, 601, device=device)
    light = decoder.read(uv.expand(601, 2), lod=lods)
    assert float(light.diff(dim=0).abs().max()) < 0.03 * float(light.max())
    assert torch.equal(light[0], decoder.read(uv)[0])


def test_gaps_do_not_count(device):
    """A texel at a chart's border is the mean of those in the chart; black gaps would halve it."""
    mesh = charts(lambda place: np.full((*place.shape[:-1], 3), 0.5), height=96, width=128)
    assert not mesh.sheets[0].mask.all()
    tail = Tail(make_tail(mesh.sheets[0], "bc6h", device), 96, 128, "bc6h", device)
    uv = torch.rand((500, 2), generator=torch.Generator().manual_seed(0)).to(device)
    light = tail.read(uv, torch.linspace(2, 7, 500, device=device))
    torch.testing.assert_close(light, torch.full_like(light, 0.5), rtol=1e-3, atol=0)


def test_the_bits_are_counted_and_the_file_keeps_them(pair, tmp_path):
    mesh, model = pair
    assert 8 * model.tail.size == tail_bits(64, 96)
    bare = dataclasses.replace(model, tail=model.tail[:0])
    share = tail_bits(64, 96) / (48 * mesh.sheets[0].mask.size)
    assert bare.compression_ratio - model.compression_ratio == pytest.approx(share)
    assert 0.28 < 1.0 - model.compression_ratio <= 0.3
    model.save(tmp_path / "a.wlm")
    np.testing.assert_array_equal(wlm.load(tmp_path / "a.wlm").tail, model.tail)
    tail = model.bundle().textures["tail"]
    assert (tail.width, tail.height, tail.mips, tail.fmt) == (24, 16, 4, "BC6H_UF16")
    np.testing.assert_array_equal(tail.data, model.tail)
    for text, there in ((glsl(model), True), (glsl(bare), False)):
        assert ("vec3 wlm_atlas_grad(vec2 uv, vec2 dx, vec2 dy)" in text) == ("wlm_atlas_tail" in text) == there
    with pytest.raises(ValueError, match="lod: expected a model with mips"):
        bare.decoder().read(torch.zeros(1, 2), lod=torch.zeros(1))


@pytest.mark.skipif(shutil.which("glslangValidator") is None, reason="glslangValidator is not installed")
@pytest.mark.parametrize("kind", ["tiles", MIXED, "plain", "cascade"])
def test_the_shader_compiles(kind, tmp_path):
    model = dataclasses.replace(random_model(sheet(), kind), tail=np.zeros((1, 16), np.uint8))
    places = "uv, uv" if len(model.uv) else "uv"
    call = f"wlm_atlas_grad({places}, dFdx(uv), dFdy(uv))"
    main = f"in vec2 uv;\nout vec4 light;\nvoid main() {{ light = vec4({call}, 1.0); }}\n"
    (tmp_path / "shader.frag").write_text(f"#version 330\n{glsl(model)}{main}")
    done = subprocess.run(["glslangValidator", "shader.frag"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0 and "WARNING" not in done.stdout, done.stdout


def test_a_margin_is_not_read(device):
    """Of a lightmap whose quarter isn't of whole blocks, the tail reads what it does of one that is."""
    mesh = sheet(height=50, width=70)
    levels = tail_light(mesh.sheets[0].lightmap, mesh.sheets[0].mask)
    blocks = np.concatenate([encode(light, "bc6h", weight)[0] for light, weight in levels])
    np.testing.assert_allclose(levels[0][0][:12, :17], means(mesh.sheets[0].lightmap[:48, :68], 4), rtol=1e-5)
    tail = Tail(blocks, 50, 70, "bc6h", device)
    row, column = np.mgrid[:12, :17].reshape(2, -1)
    uv = np.stack([(4 * column + 2) / 70, (4 * row + 2) / 50], 1).astype(np.float32)
    light = tail.read(torch.from_numpy(uv).to(device), torch.full((len(uv),), 2.0, device=device)).cpu().numpy()
    want = means(mesh.sheets[0].lightmap[:48, :68], 4).reshape(-1, 3)
    assert np.sqrt(np.square(light - want).mean()) < 0.02 * np.ptp(want)


@pytest.mark.parametrize("kind", ["astc", "cascade", "plain with uv"])
def test_mips_of_other_methods(kind, device):
    """Under the lightmap's own UVs, and as blocks that the colours' GPU has."""
    mesh = charts(lambda place: np.full((*place.shape[:-1], 3), 0.5), height=60, width=84)
    if kind == "astc":
        pytest.importorskip("astc_encoder")
        model = compress(mesh, "astc", views=1, mips=True, budget=0.5, fallback=False)
    else:
        model = random_model(mesh, kind)
        model = dataclasses.replace(model, tail=make_tail(mesh.sheets[0], "bc6h", device))
    own = torch.rand((100, 2), generator=torch.Generator().manual_seed(1)).to(device)
    new = 1.0 - own if len(model.uv) else None
    decoder, lod = model.decoder(device), torch.linspace(2.0, 6.0, 100, device=device)
    light = decoder.read(own if new is None else new, lod=lod, own=None if new is None else own)
    torch.testing.assert_close(light, torch.full_like(light, 0.5), rtol=0.01, atol=0)
    near = decoder.read(own if new is None else new, lod=0 * lod, own=None if new is None else own)
    assert torch.equal(near, decoder.read(own if new is None else new))
    if new is not None:
        with pytest.raises(ValueError, match="own: expected the sheet's own UVs"):
            decoder.read(new, lod=lod)
    tail = model.bundle().textures["tail"]
    assert (tail.width, tail.height) == (24, 16) and tail.fmt.startswith("ASTC" if kind == "astc" else "BC6H")


def test_a_budget_that_mips_exceed():
    with pytest.raises(WlmError, match="budget: 0.01 is less than mips take"):
        compress(sheet(), "standard", mips=True, budget=0.01)
