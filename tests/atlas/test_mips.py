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
from wlm.atlas.fit import compress
from wlm.atlas.mips import Tail, make_tail
from wlm.atlas.model import Profile, tail_bits, tail_shapes
from wlm.atlas.shader import atlas_glsl
from wlm.errors import WlmError
from wlm.formats.dds_reader import read_dds

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
    assert tail_shapes(1, 1) == [(1, 1)] and tail_shapes(5, 33) == [(2, 9), (1, 4), (1, 2), (1, 1)]
    assert tail_bits(64, 96) == 8 * 16 * (24 + 6 + 2 + 1 + 1)


def test_each_level_is_the_lightmap_made_smaller(pair, device):
    mesh, model = pair
    decoder = model.decoder(device)
    for octaves, side in ((2, 4), (3, 8), (4, 16)):
        want = means(mesh.lightmap, side)
        row, column = np.mgrid[: want.shape[0], : want.shape[1]].reshape(2, -1)
        uv = np.stack([(column + 0.5) / want.shape[1], (row + 0.5) / want.shape[0]], 1).astype(np.float32)
        points = torch.from_numpy(uv).to(device)
        light = decoder.read(points, torch.full((len(uv),), float(octaves), device=device)).cpu().numpy()
        error = np.square(light - want.reshape(-1, 3)).mean()
        assert -10 * np.log10(error / np.ptp(mesh.lightmap) ** 2) > 36.0
    beyond = decoder.read(points[:1], torch.full((1,), 99.0, device=device)).cpu().numpy()
    np.testing.assert_allclose(beyond[0], mesh.lightmap.mean((0, 1)), rtol=0.02)


def test_there_is_no_step(pair, device):
    """From level to level light changes by as much as the distance allows; up close it is the tiles'."""
    _, model = pair
    decoder, uv = model.decoder(device), torch.tensor([[0.31, 0.42]], device=device)
    lods = torch.linspace(0.0, 6.0, 601, device=device)
    light = decoder.read(uv.expand(601, 2), lods)
    assert float(light.diff(dim=0).abs().max()) < 0.03 * float(light.max())
    assert torch.equal(light[0], decoder.read(uv)[0])


def test_gaps_do_not_count(device):
    """A texel at a chart's border is the mean of those in the chart; black gaps would halve it."""
    mesh = charts(lambda place: np.full((*place.shape[:-1], 3), 0.5), height=96, width=128)
    assert not mesh.mask.all()
    tail = Tail(make_tail(mesh, device), 96, 128, device)
    uv = torch.rand((500, 2), generator=torch.Generator().manual_seed(0)).to(device)
    light = tail.read(uv, torch.linspace(2, 7, 500, device=device))
    torch.testing.assert_close(light, torch.full_like(light, 0.5), rtol=1e-3, atol=0)


def test_the_bits_are_counted_and_the_file_keeps_them(pair, tmp_path):
    mesh, model = pair
    assert 8 * model.tail.size == tail_bits(64, 96)
    bare = dataclasses.replace(model, tail=model.tail[:0])
    share = tail_bits(64, 96) / (48 * mesh.mask.size)
    assert bare.compression_ratio - model.compression_ratio == pytest.approx(share)
    assert 0.28 < 1.0 - model.compression_ratio <= 0.3
    model.save(tmp_path / "a.wlm")
    np.testing.assert_array_equal(wlm.load(tmp_path / "a.wlm").tail, model.tail)
    wlm.atlas.export(model, tmp_path / "out", mesh)
    first, _ = read_dds(tmp_path / "out" / "tail.dds")
    assert first.shape[:2] == (16, 24)
    for text, there in ((atlas_glsl(model), True), (atlas_glsl(bare), False)):
        assert ("vec3 wlm_atlas_grad(vec2 uv, vec2 dx, vec2 dy)" in text) == ("wlm_atlas_tail" in text) == there
    with pytest.raises(ValueError, match="lod: expected a model with mips"):
        bare.decoder().read(torch.zeros(1, 2), torch.zeros(1))


@pytest.mark.skipif(shutil.which("glslangValidator") is None, reason="glslangValidator is not installed")
@pytest.mark.parametrize("kind", ["tiles", MIXED, "plain"])
def test_the_shader_compiles(kind, tmp_path):
    model = dataclasses.replace(random_model(sheet(), kind), tail=np.zeros((1, 16), np.uint8))
    main = "in vec2 uv;\nout vec4 light;\nvoid main() { light = vec4(wlm_atlas_grad(uv, dFdx(uv), dFdy(uv)), 1.0); }\n"
    (tmp_path / "shader.frag").write_text(f"#version 330\n{atlas_glsl(model)}{main}")
    done = subprocess.run(["glslangValidator", "shader.frag"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0 and "WARNING" not in done.stdout, done.stdout


def test_where_there_are_none():
    for profile, words in (("cascade", "tiles"), ("astc", "found astc")):
        with pytest.raises(WlmError, match=f"--mips: .*{words}"):
            Profile.load(profile).override({"mips": True}, "--")
    with pytest.raises(WlmError, match="budget: 0.01 is less than mips take"):
        compress(sheet(), "half", mips=True, budget=0.01)
