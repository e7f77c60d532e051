"""The network: its size, its settings, hard images, its file, the shipped network, and ONNX."""

import runpy
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import torch
from builders.checks import error_of
from builders.smoke_plumes import plume
from builders.smoke_samples import random_model, small_pool

import wlm
from wlm.errors import WlmError
from wlm.fluid.volume import from_array
from wlm.metrics import psnr_from_mse
from wlm.smoke import codec
from wlm.smoke.codec import open_network, shipped
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.six_way import bake, bake_coarse
from wlm.smoke.model import SmokeModel, parameter_count
from wlm.smoke.network.planes import GUIDES, OPACITY_PLANE, PLANES, encode_lightmaps
from wlm.smoke.network.prediction import predict
from wlm.smoke.network.settings import DatasetSettings, NetworkSettings
from wlm.smoke.network.unet import ADAPTERS, NafBlock, SixWayNetwork
from wlm.smoke.scene import CameraSettings, make_camera


def _network(**settings) -> SixWayNetwork:
    return random_model(**settings).network


def test_the_u_net_has_its_published_size():
    """Ronneberger's U-Net with 64 channels, 1 input and 2 outputs has 31.03 million parameters."""
    network = SixWayNetwork(NetworkSettings(width=64))
    count = sum(parameter_count(part) for part in (network.encoder, network.decoder))
    # Ours reads 3 planes; its up-convolutions, of 2 x 2 pixels, are the rest but for the last layer's 130.
    ups = sum(4 * 2 * c * c + c for c in (64, 128, 256, 512))
    assert count - 2 * 9 * 64 + ups + 130 == 31_030_658


def test_a_block_has_its_published_size_and_starts_as_the_identity():
    block = NafBlock(24)
    assert parameter_count(block) == 7 * 24**2 + 33 * 24
    x = torch.randn(2, 24, 5, 6)
    assert torch.equal(block(x), x)


def test_norm_and_its_gradient_are_those_of_torch():
    block = NafBlock(8).double()
    torch.nn.init.normal_(block.norm1.weight)
    torch.nn.init.normal_(block.norm1.bias)
    x = torch.randn(2, 8, 3, 4, dtype=torch.float64, requires_grad=True)
    ours = block.norm1(x)
    weight, bias = (parameter[:, 0, 0] for parameter in (block.norm1.weight, block.norm1.bias))
    theirs = torch.nn.functional.layer_norm(x.permute(0, 2, 3, 1), (8,), weight, bias, 1e-6).permute(0, 3, 1, 2)
    variables = (x, block.norm1.weight, block.norm1.bias)
    gradients = (torch.autograd.grad((output**3).sum(), variables) for output in (ours, theirs))
    for our_gradient, their_gradient in zip(*gradients, strict=True):
        assert torch.allclose(our_gradient, their_gradient, rtol=1e-5, atol=1e-5)
    with torch.no_grad():
        assert torch.allclose(block.norm1(x), theirs, atol=1e-12)


def test_it_starts_as_a_mix_of_the_guide():
    guides = small_pool().guides[:, 0].float()
    planes = SixWayNetwork(NetworkSettings(width=8, levels=3))(guides)
    assert torch.allclose(planes[:, 6], guides[:, 1])
    assert torch.equal(planes[:, 0], planes[:, 1]) and (planes[:, 7] == 0).all()


@pytest.mark.parametrize("stem", [1, 2])
def test_with_six_lights_it_starts_as_these(stem):
    """An untrained network returns the planes of its guide where there is smoke."""
    guides = small_pool(2, kind="six").guides[:, 1].float()
    network = SixWayNetwork(NetworkSettings(width=8, levels=3, guide="six", stem=stem))
    for name, plane in zip(PLANES, network(guides).unbind(1), strict=True):
        assert torch.allclose(plane, guides[:, GUIDES["six"].index(name)], atol=1e-6), name
    assert network.encoder[0][0].in_channels == 9 * stem**2


def test_switches_change_what_they_should():
    guides = small_pool().guides[:, 0].float()
    depthless = guides.clone()
    depthless[:, 2] = 0
    full = _network()
    planes = full(guides)
    assert len(full.adapters) == len(ADAPTERS) and planes[:, 7].abs().max() > 0
    assert not torch.equal(planes, full(depthless))

    shared = _network(adapters=False)
    assert len(shared.adapters) == len(shared.heads) == 1
    assert parameter_count(shared) == parameter_count(full) - 3 * (7 * 8**2 + 33 * 8)

    coarse = _network(stem=2)
    assert coarse.features(guides).shape == (6, 8, 16, 16)
    assert coarse(guides).shape == planes.shape


def test_attention_of_a_large_half_image_stays_finite():
    block = NafBlock(8).half()
    with torch.no_grad():
        block.beta.fill_(1)
        block.depthwise.bias.fill_(14)
    output = block(torch.zeros(1, 8, 128, 128, dtype=torch.float16))
    # Each pixel is 14 x 14 before the attention: their sum is beyond half floats.
    assert torch.isfinite(output).all() and output.abs().max() > 1


@pytest.mark.parametrize("stem", [1, 2])
@pytest.mark.parametrize("size", [(50, 70), (1, 1), (3, 17)])
def test_any_resolution(stem, size):
    network = _network(stem=stem)
    guide = torch.rand(1, 3, *size)
    planes = network(guide)
    assert planes.shape == (1, len(PLANES), *size) and torch.isfinite(planes).all()
    padded = torch.zeros(1, 3, *(-(-n // network.settings.multiple) * network.settings.multiple for n in size))
    padded[:, :, : size[0], : size[1]] = guide
    assert torch.allclose(network(padded)[:, :, : size[0], : size[1]], planes, atol=1e-6)


def test_a_file_says_how_its_network_looks_at_smoke(tmp_path):
    path, model = tmp_path / "a.network", random_model(guide="six")
    settings = DatasetSettings(guide="six", guide_step=0.04, surface=2.0, cells=32)
    SmokeModel(model.network, {"dataset": settings.model_dump(mode="json")}).save(path)
    assert open_network(path).dataset == settings
    for summary, message in (({}, "summary.dataset: expect"), ({"dataset": {"cells": 1}}, "summary.dataset.cells: ")):
        SmokeModel(model.network, summary).save(path)
        assert wlm.load(path).summary == summary
        with pytest.raises(WlmError, match=message) as error:
            open_network(path)
        assert str(error.value).startswith(f"{path}: ")


def test_weights_beyond_half_floats_are_refused(tmp_path):
    path, model = tmp_path / "a.network", random_model()
    with torch.no_grad():
        model.network.filter.weight[0, 0] = 1e5
    assert "a.network: weight filter.weight: cannot write" in error_of(model.save, path)
    assert not path.exists()


def test_a_network_comes_with_the_package(monkeypatch, tmp_path):
    path = shipped()
    assert path.stat().st_size <= 10_000_000
    model = open_network("fast")
    assert model.settings.width <= 24 and model.settings.guide == model.dataset.guide == "six"
    assert {"profile", "seed", "steps", "seconds", "device"} <= model.summary.keys()
    model.save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == path.read_bytes()
    # What a wheel takes along: the file must be among it, by what setup.py says.
    package = resources.files("wlm")
    assert package.joinpath("data", path.name).is_file()
    options = {}
    monkeypatch.setattr("setuptools.setup", options.update)
    runpy.run_path(str(Path(codec.__file__).parents[2] / "setup.py"))
    assert path in {file for pattern in options["package_data"]["wlm"] for file in Path(str(package)).glob(pattern)}
    monkeypatch.setattr(codec, "_SHIPPED", tmp_path / "gone.safetensors")
    assert "gone.safetensors: the network that comes with wlm is missing" in error_of(open_network)


def test_the_network_that_ships_is_better_than_the_march_that_it_reads():
    """Dense smoke with an edge, with as many pixels per length as in the training."""
    density = (plume().density.numpy() > 0.4).astype(np.float32).repeat(4, 0).repeat(4, 1).repeat(4, 2)
    volume = from_array(density, extinction=25.0, voxel=0.0125, origin=(-0.5, 0.0, -0.5))
    settings = CameraSettings(resolution=144, extent=0.3375).turned(30.0)
    camera = make_camera(settings, volume.origin, (1.0, 1.2, 1.0))
    model = open_network()
    target = encode_lightmaps(bake(volume, camera, step=0.5, estimate=False))[:OPACITY_PLANE]
    coarse = bake_coarse(volume, camera, model.dataset.look(volume.shape))

    def score(six: SixWay) -> float:
        return psnr_from_mse(float((encode_lightmaps(six)[:OPACITY_PLANE] - target).square().mean()), 1.0)

    # 43.3 dB against 38.3, on the CPU, for 256 pixels.
    assert score(predict(volume, camera, model)) > score(coarse) + 3.5 > 41.0
