"""Depths of a flip book: worked out by hand, under point lights against the march to each, as files."""

import math

import numpy as np
import pytest
import torch
from builders.running import call, fails
from builders.smoke_plumes import SPHERE, facing, plume, write_frames
from PIL import Image
from reference.flipbook import from_point

from wlm.errors import WlmError
from wlm.fluid.volume import from_array
from wlm.smoke.camera import Camera
from wlm.smoke.data import load_frames
from wlm.smoke.flipbook.depth import encoded_depth, frames_depth, middle_depth
from wlm.smoke.flipbook.motion import ZERO
from wlm.smoke.march.fine import bake
from wlm.smoke.synthetic import make_plume
from wlm.smoke.transport.lighting import light_smoke
from wlm.smoke.transport.lights import PointLight
from wlm_kernels.smoke.settings import March


@pytest.mark.parametrize(("extinction", "mean"), [(0.001, 0.0), (2.0, None), (500.0, 2.0)])
def test_the_depth_of_even_smoke(device, extinction, mean):
    """Of a slab 4 thick: its middle where it is thin, its surface where it is thick, and in between by the integral."""
    volume = from_array(np.ones((32, 16, 16)), extinction=extinction, voxel=0.125, origin=(5, 0, 0), device=device)
    camera = Camera.around(volume, toward=(1, 0, 0), pixels=8, extent=1.0)
    if mean is None:
        seen = 1.0 - math.exp(-4.0 * extinction)
        mean = 2.0 - (1.0 / extinction - 4.0 * math.exp(-4.0 * extinction) / seen)
    found = middle_depth(volume, camera)
    assert found.shape == (8, 8) and torch.allclose(found, torch.full_like(found, mean), atol=0.07)


def test_where_there_is_no_smoke_the_depth_is_that_around(device):
    density = np.zeros((16, 16, 16))
    density[3:6, 6:10, 13:15] = 1.0
    volume = from_array(density, extinction=50.0, device=device)
    found = middle_depth(volume, facing(volume, size=16))
    assert torch.isfinite(found).all() and float(found.min()) > 4.0 and float(found.max()) < 7.5
    empty = from_array(np.zeros((4, 4, 4)), device=device)
    assert not middle_depth(empty, facing(empty, size=4)).any()
    with pytest.raises(ValueError, match="orthographic"):
        middle_depth(empty, facing(empty, size=4, perspective=True))


@pytest.mark.parametrize("extinction", [5.0, 40.0])
def test_point_lights_by_depth_are_nearer_to_the_truth(extinction):
    """RMS of the march to lights around the smoke and in it: on a flat billboard nearly half as much again."""
    volume = make_plume(24, seed=2, hot=False, extinction=extinction)
    camera = Camera.around(volume, toward=(0.3, 0.2, 1.0), pixels=20)
    six, depth = bake(volume, camera, step=0.5, estimate=False), middle_depth(volume, camera)
    ways = np.random.default_rng(3).normal(size=(6, 3))
    off = {"flat": [], "deep": []}
    for way, far in zip(ways / np.linalg.norm(ways, axis=1)[:, None], np.linspace(0.3, 1.2, 6), strict=True):
        lamp = PointLight(tuple((volume.centre + far * way).tolist()), (4 * math.pi,) * 3, radius=0.1)
        truth = light_smoke(volume, camera, [lamp], March(step=0.5, jitter=0.0)).shade()
        for name, given in (("flat", torch.zeros_like(depth)), ("deep", depth)):
            error = from_point(six, given, lamp, volume.centre) - truth
            off[name].append(float((error.square().mean() / truth.square().mean()).sqrt()))
    assert np.mean(off["deep"]) < 0.35 and np.mean(off["flat"]) > 1.4 * np.mean(off["deep"])


def test_the_command(tmp_path):
    """Of lightmaps that were baked before, and of the frames themselves; the shader has the scale."""
    folder = write_frames(tmp_path / "a", obstacles=[SPHERE]).path
    call("smoke", "bake", folder, "-o", tmp_path / "six", "--step", 1, "--resolution", 16)
    text = call("smoke", "flipbook", tmp_path / "six", "-o", tmp_path / "b.png", "--depth", folder)
    call("smoke", "flipbook", tmp_path / "six", "-o", tmp_path / "b", "--depth", folder)
    page = np.asarray(Image.open(tmp_path / "b_depth.png"))
    assert page.shape == (32, 32, 3) and (page[16:, 16:] == 127).all() and (page[..., 0] == page[..., 2]).all()
    frames = load_frames(folder)
    cameras = [bake(frames.load(n), facing(plume(), size=16, extent=1.32), estimate=False) for n in (1, 2, 3)]
    scale = float(frames_depth(frames, (1, 2, 3), cameras).abs().max())
    shader = (tmp_path / "b" / "smoke.glsl").read_text()
    assert "frame heights" in text and "float wlm_smoke_depth(" in shader and "vec4 wlm_smoke_point(" in shader
    assert int(np.abs(page.astype(int) - 127).max()) in (127, 128) and 0.0 < scale < 0.5
    call("smoke", "flipbook", tmp_path / "six", "-o", tmp_path / "d")
    assert "wlm_smoke_depth" not in (tmp_path / "d" / "smoke.glsl").read_text()
    assert not (tmp_path / "d" / "depth.png").exists()
    line = fails("smoke", "flipbook", tmp_path / "six", "-o", tmp_path / "e.png", "--depth", tmp_path / "none")
    assert "none: expected the smoke of the flip book, found none" in line
    with pytest.raises(WlmError, match=r"expected frame_0099.npz, of the flip book's frame 1"):
        frames_depth(frames, (99,), cameras[:1])
    book = ("--with", tmp_path / "b_2.png", "--cells", "2x2", "--depth", folder)
    assert "--depth: expected lightmaps" in fails(
        "smoke", "flipbook", tmp_path / "b_1.png", "-o", tmp_path / "e.png", *book
    )
    assert not list(tmp_path.glob("e*"))


def test_encoded():
    cells = encoded_depth(torch.tensor([[[-0.2, 0.0, 0.1]]]), 0.2)
    np.testing.assert_allclose(cells[0, 0, :, 1], [ZERO - 0.5, ZERO, ZERO + 0.25], atol=1e-6)
