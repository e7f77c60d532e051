"""The network: its size, what its switches change, what it makes of hard images, its file, and the one that ships."""

import runpy
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import torch
from builders.smoke_plumes import plume
from builders.smoke_samples import small_pool
from pydantic import ValidationError

import wlm.smoke.codec as file_module
from wlm.errors import WlmError
from wlm.fluid.volume import from_array
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.metrics.error import psnr_from_mse
from wlm.smoke.baking import bake
from wlm.smoke.coarse import march
from wlm.smoke.codec import SYSTEM, export_onnx, load_network, save_network, settings_of, shipped
from wlm.smoke.decode import Predictor, predict
from wlm.smoke.learn.dataset import DatasetSettings
from wlm.smoke.model import ADAPTERS, NafBlock, NetworkSettings, SixWayNetwork, parameter_count, support
from wlm.smoke.planes import GUIDES, OPACITY_PLANE, PLANES, encode_lightmaps
from wlm.smoke.scene import CameraSettings, make_camera

TINY = {"width": 8, "levels": 3}


def _network(seed: int = 0, spread: float = 0.2, **changed) -> SixWayNetwork:
    """A tiny network all of whose weights matter."""
    torch.manual_seed(seed)
    network = SixWayNetwork(NetworkSettings(**TINY | changed))
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=spread)
    return network


def test_the_u_net_has_its_published_size():
    """Ronneberger's of 64 channels with 1 channel in and 2 out is known for its 31.03 million."""
    network = SixWayNetwork(NetworkSettings(width=64))
    count = sum(parameter_count(part) for part in (network.encoder, network.decoder))
    # Ours reads 3 planes; its up-convolutions, of 2 x 2 pixels, are the rest but for the last layer's 130.
    ups = sum(4 * 2 * c * c + c for c in (64, 128, 256, 512))
    assert count - 2 * 9 * 64 + ups + 130 == 31_030_658


def test_a_block_has_its_published_size_and_begins_as_nothing():
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
    wanted = (x, block.norm1.weight, block.norm1.bias)
    gradients = (torch.autograd.grad((found**3).sum(), wanted) for found in (ours, theirs))
    for one, other in zip(*gradients, strict=True):
        assert torch.allclose(one, other, rtol=1e-5, atol=1e-5)
    with torch.no_grad():
        assert torch.allclose(block.norm1(x), theirs, atol=1e-12)


def test_it_begins_as_a_mix_of_the_guide():
    guides = small_pool().guides[:, 0].float()
    made = SixWayNetwork(NetworkSettings(**TINY))(guides)
    assert torch.allclose(made[:, 6], guides[:, 1])
    assert torch.equal(made[:, 0], made[:, 1]) and (made[:, 7] == 0).all()


@pytest.mark.parametrize("stem", [1, 2])
def test_of_six_lights_it_begins_as_these(stem):
    """Up to the mask, which is 1 wherever the guide has smoke."""
    guides = small_pool(2, kind="six").guides[:, 1].float()
    network = SixWayNetwork(NetworkSettings(**TINY, guide="six", stem=stem))
    made = network(guides)
    for name, plane in zip(PLANES, made.unbind(1), strict=True):
        assert torch.allclose(plane, guides[:, GUIDES["six"].index(name)], atol=1e-6), name
    assert network.encoder[0][0].in_channels == 9 * stem**2


def test_switches_change_what_they_should():
    guides = small_pool().guides[:, 0].float()
    depthless = guides.clone()
    depthless[:, 2] = 0
    full = _network()
    assert len(full.adapters) == len(ADAPTERS) and full(guides)[:, 7].abs().max() > 0
    assert not torch.equal(full(guides), full(depthless))

    for residual in (False, True):
        blind = _network(depth=False, residual=residual)
        assert torch.equal(blind(guides), blind(depthless))
    assert parameter_count(_network(residual=False)) == parameter_count(full) - 3 * 25 * len(PLANES)

    shared = _network(adapters=False)
    assert len(shared.adapters) == len(shared.heads) == 1
    assert parameter_count(shared) == parameter_count(full) - 3 * (7 * 8**2 + 33 * 8)

    cold = _network(emission=False)
    assert (cold(guides)[:, 7] == 0).all() and cold(guides)[:, 6].abs().max() > 0

    coarse = _network(stem=2)
    assert coarse.features(guides).shape == (6, 8, 16, 16)
    assert coarse(guides).shape == full(guides).shape


def test_an_adapter_makes_its_own_planes():
    guides = small_pool().guides[:1, 0].float()
    network = _network()
    before = network(guides)
    for number, group in enumerate(ADAPTERS):
        kept = network.heads[number].bias.detach().clone()
        with torch.no_grad():
            network.heads[number].bias += 1
        changed = (network(guides) != before).any((0, 2, 3))
        assert [name for name, moved in zip(PLANES, changed, strict=True) if moved] == [
            name for name in PLANES if name in group
        ]
        with torch.no_grad():
            network.heads[number].bias.copy_(kept)


@pytest.mark.parametrize("stem", [1, 2])
def test_empty_images_stay_empty_and_full_ones_finite(stem):
    network = _network(stem=stem)
    assert (network(torch.zeros(2, 3, 33, 40)) == 0).all()
    assert torch.isfinite(network(torch.ones(1, 3, 33, 40))).all()


def test_attention_of_a_large_half_image_stays_finite():
    block = NafBlock(8).half()
    with torch.no_grad():
        block.beta.fill_(1)
        block.depthwise.bias.fill_(14)
    made = block(torch.zeros(1, 8, 128, 128, dtype=torch.float16))
    # Each pixel is 14 x 14 before the attention: their sum is beyond half floats.
    assert torch.isfinite(made).all() and made.abs().max() > 1


def test_smoke_reaches_no_farther_than_stated():
    opacity = torch.zeros(1, 1, 40, 50)
    opacity[0, 0, 20, 13] = 0.01
    near = support(opacity)[0, 0]
    rows, columns = near.nonzero().unbind(1)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (8, 31, 0, 23)
    assert near[20 - 8 : 20 + 9, 13 - 8 : 13 + 9].all()


@pytest.mark.parametrize("stem", [1, 2])
@pytest.mark.parametrize("size", [(50, 70), (1, 1), (3, 17)])
def test_any_resolution(stem, size):
    network = _network(stem=stem)
    guide = torch.rand(1, 3, *size)
    made = network(guide)
    assert made.shape == (1, len(PLANES), *size) and torch.isfinite(made).all()
    padded = torch.zeros(1, 3, *(-(-n // network.settings.multiple) * network.settings.multiple for n in size))
    padded[:, :, : size[0], : size[1]] = guide
    assert torch.allclose(network(padded)[:, :, : size[0], : size[1]], made, atol=1e-6)


def test_settings_that_do_not_fit_are_refused():
    for wrong in ({"levels": 1}, {"levels": 7}, {"width": 12}, {"stem": 3}, {"unknown": 1}):
        with pytest.raises(ValidationError):
            NetworkSettings(**TINY | wrong)


def test_a_file_holds_the_network(tmp_path):
    network = _network(stem=2)
    path = tmp_path / "a.network"
    size = save_network(path, network, {"psnr": 30.5})
    assert size == path.stat().st_size < 2 * parameter_count(network) + 20000
    found, summary = load_network(path, width=8)
    assert found.settings == network.settings and summary == {"psnr": 30.5}
    guides = small_pool().guides[:2, 0].float()
    assert torch.allclose(found(guides), network.half().float()(guides), atol=1e-5)


def test_a_file_says_how_its_network_looks_at_smoke(tmp_path):
    path = tmp_path / "a.network"
    made = DatasetSettings(guide="six", guide_step=0.04, surface=2.0, cells=32)
    save_network(path, _network(guide="six"), {"dataset": made.model_dump(mode="json")})
    assert settings_of(path, load_network(path)[1]) == made
    for summary, told in (({}, "summary.dataset: expected"), ({"dataset": {"cells": 1}}, "summary.dataset.cells: exp")):
        with pytest.raises(WlmError, match=told) as error:
            settings_of(path, summary)
        assert str(error.value).startswith(f"{path}: ")


def _rewritten(path, change) -> None:
    held = read_artifact(path)
    settings, tensors = dict(held.settings), {name: np.array(value) for name, value in held.tensors.items()}
    change(settings, tensors)
    write_artifact(path, SYSTEM, settings, tensors, held.source)


@pytest.mark.parametrize(
    "change, told",
    [
        (lambda settings, tensors: tensors.pop("up.0.weight"), "lacks up.0.weight"),
        (lambda settings, tensors: tensors.update(more=np.zeros(3, np.float16)), "has more"),
        (lambda settings, tensors: settings["network"].update(width=16), "expected .*16.*found .*8"),
        (lambda settings, tensors: settings["network"].update(width=7), "network.width"),
        (lambda settings, tensors: settings.update(summary=3), "summary"),
        (lambda settings, tensors: tensors["filter.weight"].fill(np.nan), "filter.weight: expected finite"),
        (lambda settings, tensors: tensors.update({"filter.weight": np.zeros((8, 3, 5, 5), np.float32)}), "float32"),
    ],
)
def test_a_file_that_is_wrong_is_refused_in_one_line(tmp_path, change, told):
    path = tmp_path / "a.network"
    save_network(path, _network(), {})
    _rewritten(path, change)
    with pytest.raises(WlmError, match=told) as error:
        load_network(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_damaged_file_another_width_and_unfit_weights_are_refused(tmp_path):
    path = tmp_path / "a.network"
    network = _network()
    save_network(path, network, {})
    with pytest.raises(WlmError, match=r"width: expected 16, found 8"):
        load_network(path, width=16)
    content = bytearray(path.read_bytes())
    content[-3] ^= 1
    path.write_bytes(content)
    with pytest.raises(WlmError, match="damaged"):
        load_network(path)
    with torch.no_grad():
        network.filter.weight[0, 0] = 1e5
    with pytest.raises(WlmError, match="weight filter.weight"):
        save_network(path, network, {})


def test_a_network_comes_with_the_package(monkeypatch, tmp_path):
    path = shipped()
    assert path.stat().st_size <= 10_000_000
    network, summary = load_network(path)
    assert network.settings.width <= 24 and network.settings.guide == settings_of(path, summary).guide == "six"
    assert {"profile", "seed", "steps", "seconds", "device"} <= summary.keys()
    # What a wheel takes along: the file must be among it, by what setup.py says.
    package = resources.files("wlm")
    assert package.joinpath("data", path.name).is_file()
    given = {}
    monkeypatch.setattr("setuptools.setup", given.update)
    runpy.run_path(str(Path(file_module.__file__).parents[2] / "setup.py"))
    assert path in {found for pattern in given["package_data"]["wlm"] for found in Path(str(package)).glob(pattern)}
    monkeypatch.setattr(file_module, "_SHIPPED", tmp_path / "gone.safetensors")
    with pytest.raises(WlmError, match="gone.safetensors: expected the network that comes with wlm, found none"):
        shipped()


def test_the_network_that_ships_is_better_than_the_march_that_it_reads():
    """On dense smoke with an edge, which steps of a voxel miss, at as many pixels a length as it was trained with."""
    density = (plume().density.numpy() > 0.4).astype(np.float32).repeat(4, 0).repeat(4, 1).repeat(4, 2)
    volume = from_array(density, extinction=25.0, voxel=0.0125, origin=(-0.5, 0.0, -0.5))
    settings = CameraSettings(resolution=256, extent=0.6).turned(30.0)
    camera = make_camera(settings, volume.origin, (1.0, 1.2, 1.0))
    network, summary = load_network(shipped())
    look = settings_of("", summary).look(volume.shape)
    wanted = encode_lightmaps(bake(volume, camera, step=0.5, estimate=False))[:OPACITY_PLANE]
    ours = predict(volume, camera, Predictor(network, camera.height, camera.width), look)
    coarse = march(volume, camera, look)
    better, worse = (
        psnr_from_mse(float((encode_lightmaps(found)[:OPACITY_PLANE] - wanted).square().mean()), 1.0)
        for found in (ours, coarse)
    )
    # 43.3 dB against 38.3, on the CPU.
    assert better > worse + 3.5 > 41.0


def test_onnx_of_no_pixels_is_refused(tmp_path):
    with pytest.raises(ValueError, match="pixel"):
        export_onnx(_network(), tmp_path / "a.onnx", 0, 22)
    assert not (tmp_path / "a.onnx").exists()


@pytest.mark.slow  # the command's test does as much once
@pytest.mark.parametrize("kind, stem", [("six", 2), ("paper", 1)])
def test_onnx_computes_the_same(tmp_path, kind, stem):
    for needed in ("onnx", "onnxscript"):
        pytest.importorskip(needed)
    runtime = pytest.importorskip("onnxruntime")
    network = _network(guide=kind, stem=stem, levels=2)
    path = tmp_path / "a.onnx"
    assert export_onnx(network, path, 18, 22) == path.stat().st_size
    guide = torch.rand(1, len(GUIDES[kind]), 18, 22)
    (found,) = runtime.InferenceSession(path).run(["lightmaps"], {"guide": guide.numpy()})
    assert np.allclose(found, network(guide).detach(), atol=1e-5)
