"""The network at work: folded weights give the same planes, and hard smoke gives sound lightmaps."""

from dataclasses import replace

import pytest
import torch
from builders.smoke_plumes import plume
from builders.smoke_samples import STEP, sample, seen

from wlm.fluid.volume import from_array
from wlm.smoke.coarse import march
from wlm.smoke.decode import Predictor, predict
from wlm.smoke.model import NetworkSettings, SixWayNetwork
from wlm.smoke.planes import GUIDES
from wlm_kernels.smoke.settings import March

TINY = {"width": 8, "levels": 3}


def _network(spread: float = 0.2, **changed) -> SixWayNetwork:
    torch.manual_seed(0)
    network = SixWayNetwork(NetworkSettings(**TINY | changed))
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=spread)
    return network


def _clamped(planes: torch.Tensor) -> torch.Tensor:
    planes = planes.clamp(min=0)
    return torch.cat([planes[:6], planes[6:].clamp(max=1)])


@pytest.mark.parametrize("size", [(32, 32), (50, 70), (17, 23), (1, 9), (1, 1)])
@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"stem": 2},
        {"adapters": False, "stem": 2},
        {"emission": False, "depth": False, "residual": False},
        {"emission": False, "adapters": False},
        {"adapters": False, "residual": False, "stem": 2},
        {"guide": "six", "stem": 2},
        {"guide": "six", "depth": False},
    ],
)
def test_folded_weights_give_the_same_planes(changed, size):
    network = _network(**changed)
    predictor = Predictor(network, *size)
    for seed in range(2):
        guide = torch.rand(len(GUIDES[network.settings.guide]), *size, generator=torch.Generator().manual_seed(seed))
        guide[:, : size[0] // 2] = 0
        with torch.no_grad():
            wanted = _clamped(network(guide[None])[0])
        assert wanted.max() > 0.25
        assert torch.allclose(predictor(guide), wanted, atol=1e-5 * float(wanted.max()))


@pytest.mark.parametrize("stem", [1, 2])
@pytest.mark.parametrize("size", [(50, 70), (17, 41)])
def test_far_from_smoke_all_is_zero(device, size, stem):
    """As the network has it, whose mask is torch's."""
    network = _network(guide="six", stem=stem)
    guide = torch.rand(9, *size, generator=torch.Generator().manual_seed(0))
    # Light alone isn't smoke; the last pixel of a block is enough.
    guide[-2] = 0
    guide[-2, 7, 7] = 1e-3
    with torch.no_grad():
        wanted = _clamped(network(guide[None])[0])
    predictor = Predictor(network.to(device), *size, device=device, half=False)
    made = predictor(guide.to(device)).cpu()
    assert torch.allclose(made, wanted, atol=1e-4 * float(wanted.max()))
    assert (made[:, :16, 15] > 0).any() and not made[:, 16:].any() and not made[:, :, 16:].any()
    assert not predictor(torch.zeros_like(guide, device=device)).any()


@pytest.mark.parametrize("kind", ["paper", "six"])
def test_a_device_gives_what_the_cpu_gives(device, kind):
    network = _network(0.1, guide=kind)
    guide, _ = sample(plume(hot=True), seen(plume()), kind=kind)
    with torch.no_grad():
        wanted = _clamped(network(guide[None])[0])
    for half, error in ((False, 1e-4), (True, 1e-2)):
        predictor = Predictor(network.to(device), 32, 32, device=device, half=half)
        # Eager first, then captured, then replayed.
        for _ in range(5):
            made = predictor(guide.to(device)).cpu()
            assert torch.allclose(made, wanted, atol=error * float(wanted.max()))
        network.cpu()


@pytest.mark.parametrize("stem", [1, 2])
def test_hard_smoke(device, stem):
    """Nothing, a box full of it, ten times the density, and pixels that no level's squares divide."""
    predictor = Predictor(_network(stem=stem, guide="six").to(device), 50, 70, device=device)
    volumes = {
        "thin": plume(device=device),
        "dense": replace(plume(device=device), extinction=80.0),
        "empty": from_array(torch.zeros(4, 4, 4), voxel=0.25, device=device),
        "full": from_array(torch.ones(8, 8, 8), voxel=0.5, extinction=50.0, device=device),
    }
    for name, volume in volumes.items():
        camera = replace(seen(volume), height=50, width=70)
        six = predict(volume, camera, predictor, March(STEP))
        assert six.lightmaps.shape == (6, 50, 70) and six.emission is None
        for plane in (six.lightmaps, six.transparency):
            assert torch.isfinite(plane).all() and plane.min() >= 0, name
        assert six.transparency.max() <= 1
        assert bool((six.lightmaps > 0).any()) == (name != "empty")
        if name == "empty":
            assert (six.transparency == 1).all()


def test_emission_is_given_where_there_is_some():
    hot, camera = plume(hot=True), seen(plume())
    assert predict(hot, camera, Predictor(_network(), 32, 32), March(STEP)).emission.shape == (32, 32)
    assert predict(hot, camera, Predictor(_network(emission=False), 32, 32), March(STEP)).emission is None


def test_of_six_lights_an_untrained_network_is_the_coarse_march(device):
    """It begins as that, seed and all."""
    volume = plume(hot=True, device=device)
    camera = seen(volume)
    network = SixWayNetwork(NetworkSettings(**TINY, guide="six")).to(device)
    predictor = Predictor(network, 32, 32, device=device, half=False)
    assert predictor.guide == "six"
    found = predict(volume, camera, predictor, March(STEP, seed=5))
    known = march(volume, camera, March(STEP, seed=5))
    for name in ("lightmaps", "transparency", "emission"):
        torch.testing.assert_close(getattr(found, name), getattr(known, name), rtol=1e-4, atol=1e-5)
    with pytest.raises(ValueError, match=r"expected \[9, 32, 32\]"):
        predictor(torch.zeros(3, 32, 32, device=device))


def test_predictions_repeat_and_the_network_is_left_alone():
    network = _network()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    predictor = Predictor(network, 32, 32)
    volume, camera = plume(), seen(plume())
    one, other = (predict(volume, camera, predictor, March(STEP, seed=3)) for _ in range(2))
    assert torch.equal(one.lightmaps, other.lightmaps)
    assert not torch.equal(one.lightmaps, predict(volume, camera, predictor, March(STEP, seed=4)).lightmaps)
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


def test_wrong_sizes_are_refused():
    with pytest.raises(ValueError, match="pixel"):
        Predictor(_network(), 0, 4)
    with pytest.raises(ValueError, match=r"expected \[3, 8, 8\]"):
        Predictor(_network(), 8, 8)(torch.zeros(3, 8, 9))
