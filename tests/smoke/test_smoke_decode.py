"""The network at run time: folded weights give the same planes, and hard smoke gives valid lightmaps."""

from dataclasses import replace

import pytest
import torch
from builders.smoke_plumes import plume
from builders.smoke_samples import STEP, random_model, sample, view_of

from wlm.fluid.volume import from_array
from wlm.smoke.model import SmokeModel
from wlm.smoke.network.planes import GUIDES, decode_lightmaps, render_guide
from wlm_kernels.smoke.settings import March


def _expected(model: SmokeModel, guide: torch.Tensor) -> torch.Tensor:
    """Returns the network's planes, clamped."""
    with torch.no_grad():
        planes = model.network(guide[None])[0].clamp(min=0)
    return torch.cat([planes[:6], planes[6:].clamp(max=1)])


@pytest.mark.parametrize("size", [(32, 32), (17, 23), (1, 9), (1, 1)])
@pytest.mark.parametrize("settings", [{}, {"stem": 2}, {"adapters": False, "stem": 2}, {"guide": "six", "stem": 2}])
def test_folded_weights_give_the_same_planes(settings, size):
    model = random_model(**settings)
    decoder = model.decoder(height=size[0], width=size[1])
    for seed in range(2):
        guide = torch.rand(len(GUIDES[decoder.guide]), *size, generator=torch.Generator().manual_seed(seed))
        guide[:, : size[0] // 2] = 0
        expected = _expected(model, guide)
        assert expected.max() > 0.25
        assert torch.allclose(decoder(guide), expected, atol=1e-5 * float(expected.max()))


@pytest.mark.parametrize("stem", [1, 2])
@pytest.mark.parametrize("size", [(50, 70), (17, 41)])
def test_far_from_smoke_all_is_zero(device, size, stem):
    model = random_model(guide="six", stem=stem)
    guide = torch.rand(9, *size, generator=torch.Generator().manual_seed(0))
    # Light alone isn't smoke; the last pixel of a block is enough.
    guide[-2] = 0
    guide[-2, 7, 7] = 1e-3
    expected = _expected(model, guide)
    decoder = model.decoder(device, height=size[0], width=size[1], half=False)
    planes = decoder(guide.to(device)).cpu()
    assert torch.allclose(planes, expected, atol=1e-4 * float(expected.max()))
    assert (planes[:, :16, 15] > 0).any() and not planes[:, 16:].any() and not planes[:, :, 16:].any()
    assert not decoder(torch.zeros_like(guide, device=device)).any()


@pytest.mark.parametrize("kind", ["paper", "six"])
def test_a_device_gives_what_the_cpu_gives(device, kind):
    model = random_model(0.1, guide=kind)
    guide, _ = sample(plume(hot=True), view_of(plume()), kind=kind)
    expected = _expected(model, guide)
    for half, error in ((False, 1e-4), (True, 1e-2)):
        decoder = model.decoder(device, height=32, width=32, half=half)
        # Eager first, then captured, then replayed.
        for _ in range(5):
            assert torch.allclose(decoder(guide.to(device)).cpu(), expected, atol=error * float(expected.max()))


@pytest.mark.parametrize("stem", [1, 2])
def test_hard_smoke(device, stem):
    decoder = random_model(stem=stem, guide="six").decoder(device, height=50, width=70)
    volumes = {
        "thin": plume(device=device),
        "dense": replace(plume(device=device), extinction=80.0),
        "empty": from_array(torch.zeros(4, 4, 4), voxel=0.25, device=device),
        "full": from_array(torch.ones(8, 8, 8), voxel=0.5, extinction=50.0, device=device),
    }
    for name, volume in volumes.items():
        camera = replace(view_of(volume), height=50, width=70)
        six = decode_lightmaps(decoder(render_guide(volume, camera, "six", March(STEP))))
        for plane in (six.lightmaps, six.transparency):
            assert torch.isfinite(plane).all() and plane.min() >= 0, name
        assert six.transparency.max() <= 1
        assert bool((six.lightmaps > 0).any()) == (name != "empty")
        if name == "empty":
            assert (six.transparency == 1).all()
