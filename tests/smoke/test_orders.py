"""Light of all orders by the filter and its network: against path tracing, on its own smoke and on a simulation's."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from builders.smoke_plumes import plume

from wlm.bench.smoke_light import make_cloud
from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume, from_array
from wlm.smoke.camera import Camera, unit
from wlm.smoke.learn.synthetic import make_plume
from wlm.smoke.shading import Light
from wlm.smoke.transport.features import FEATURES, ambient, blur, make_inputs, orders_march
from wlm.smoke.transport.filtering import OrdersModel, load_orders, scatter
from wlm.smoke.transport.gating import FACTS, fit_gate, gate
from wlm.smoke.transport.learning import Lesson, fit_filter, make_lessons, psnr, train_network, with_gate
from wlm.smoke.transport.lighting import LitSmoke, light_smoke
from wlm.smoke.transport.lights import PointLight
from wlm.smoke.transport.samples import ALBEDOS, Sample, draw_view, make_sample
from wlm.smoke.transport.tracing import trace
from wlm_kernels.smoke.settings import March


@pytest.fixture(scope="module")
def unseen() -> list[Sample]:
    """Two views that no training has, with little noise."""
    return [make_sample(90_000, number, samples=256, pixels=32, lights=2) for number in (0, 1)]


@pytest.fixture(scope="module")
def lessons(unseen) -> list[Lesson]:
    return [lesson for sample in unseen for lesson in make_lessons(sample)]


def test_the_network_is_worth_its_name_and_never_worse(lessons):
    """Better than the filter alone, on no light worse; a network that wasn't trained fails here."""
    model = load_orders()

    def gains(model: OrdersModel) -> list[float]:
        found = []
        for lesson in lessons:
            for albedo in (0.8, 1.0):
                both = (model.light(lesson.inputs, (albedo,) * 3, network=n)[..., 0] for n in (True, False))
                with_it, without = (psnr(light, lesson.light[ALBEDOS.index(albedo)]) for light in both)
                found.append(with_it - without)
        return found

    def holds(model: OrdersModel) -> bool:
        found = gains(model)
        return min(found) > -0.02 and np.mean(found) > 0.1

    assert holds(model)
    random = torch.Generator().manual_seed(1)
    last = 0.3 * torch.randn(model.arrays["last"].shape, generator=random)
    untrained = OrdersModel(model.arrays | {"last": last, "gate_bias": torch.full((1,), 50.0)})
    assert not holds(untrained)
    # A gate that is fitted to it shuts it out, and a network that adds nothing adds nothing.
    shut = with_gate(untrained, lessons)
    assert min(gains(shut)) > -0.02 and not holds(shut)


def test_a_gate_tells_lights_that_gain_from_those_that_lose():
    """By a fact that differs between them; where there is none to tell them by, nothing is taken."""
    random = torch.Generator().manual_seed(2)
    told = torch.zeros(400, FACTS)
    told[:, 4] = torch.randn(400, generator=random)
    good = told[:, 4] > 0
    told[:, 4] += 2.0 * told[:, 4].sign()
    gains = torch.where(good[:, None], torch.tensor([0.0, 0.3, 0.5, 0.6]), torch.tensor([0.0, -0.1, -0.3, -0.5]))
    share = gate(fit_gate(told, gains), told)
    assert share[good].mean() > 0.08 and share[~good].max() < 0.01 and share.max() <= 0.5
    mixed = gains[torch.randperm(400, generator=random)]
    assert gate(fit_gate(told, mixed), told).max() < 0.05
    # What isn't a number counts as usual, and the picture has numbers.
    told[0, 3] = math.nan
    assert torch.isfinite(gate(fit_gate(told[1:], gains[1:]), told)).all()


def test_far_from_what_it_was_trained_on_the_network_is_left_out(lessons):
    """Smoke as deep as none that was learned, and lights behind the camera and before it."""
    model = load_orders()
    low, high = model.arrays["range"]
    inputs = replace(lessons[0].inputs, cosine=0.3, depth=0.5 * (low + high))
    assert model.trust(inputs) == 1.0 and model.trust(replace(inputs, depth=high)) == 1.0
    assert 0 < model.trust(replace(inputs, depth=high + 0.2)) < 1 and 0 < model.trust(replace(inputs, cosine=-0.8)) < 1
    for other in ({"depth": high + 1.0}, {"depth": low - 1.0}, {"cosine": 0.95}, {"cosine": -0.95}):
        beyond = replace(inputs, **other)
        assert torch.equal(model.multiple(beyond), model.filtered(beyond))


@pytest.mark.parametrize("cells", [32, 64])
def test_on_no_grid_is_the_network_worse_than_its_input(cells: int):
    """Smoke of another maker and a plume, at both ends of the thickness that was learned, in cells coarse and fine."""
    model, gains = load_orders(), []
    cloud = DensityVolume(make_cloud(cells, "cpu"), 8.0, 1.0 / cells)
    for number, volume in enumerate((cloud, make_plume(cells, seed=12, hot=False, extinction=40.0))):
        random = np.random.default_rng([cells, number])
        camera = Camera.around(volume, toward=random.normal(size=3), pixels=20)
        lights = [Light(tuple(map(float, random.normal(size=3)))) for _ in range(2)]
        traced = trace(volume, camera, lights, samples=192, seed=number).planes.sum(1)[..., 0]
        made = make_inputs(volume, light_smoke(volume, camera, lights, orders_march(volume)), ambient(volume, camera))
        for inputs, light in zip(made, traced, strict=True):
            both = (psnr(model.light(inputs, (1.0,) * 3, network=n)[..., 0], light) for n in (True, False))
            gains.append(next(both) - next(both))
    assert min(gains) > -0.01 and np.mean(gains) > 0.1


@pytest.mark.parametrize("kind", ["directional", "point", "perspective"])
def test_other_smoke_other_lights_other_cameras(device: str, kind: str):
    """A plume of another maker, in a box that isn't a cube: 6 dB nearer to all light than single scattering."""
    volume = plume(device=device)
    camera = Camera.around(volume, toward=(0.5, 0.2, 1.0), pixels=24, perspective=kind == "perspective")
    light = Light((1.0, 0.5, 0.6)) if kind != "point" else PointLight((1.0, 1.4, 1.2), (4 * math.pi,) * 3)
    wanted = trace(volume, camera, [light], albedo=(1.0, 0.95, 0.9), samples=192)
    made = scatter(volume, camera, [light], (1.0, 0.95, 0.9))
    scale = 1.0 / float(wanted.total.max())
    once = made.lit.shade(albedo=(1.0, 0.95, 0.9))
    assert psnr(scale * made.shade(), scale * wanted.total) > psnr(scale * once, scale * wanted.total) + 6.0


@pytest.mark.parametrize(("g", "least"), [(-0.3, 30.0), (0.3, 30.0), (0.6, 23.0)])
def test_light_that_is_scattered_onward_or_back(device: str, g: float, least: float):
    """Of a phase function that the filter wasn't fitted to: 8 dB nearer than light scattered once."""
    volume = plume(device=device)
    camera = Camera.around(volume, toward=(0.5, 0.2, 1.0), pixels=24)
    lights = [Light((1.0, 0.5, 0.6), (6.0, 6.0, 6.0)), Light((-0.2, 0.3, -1.0), (4.0, 4.0, 4.0))]
    wanted = trace(volume, camera, lights, albedo=(0.95,) * 3, g=g, samples=256).total
    made = scatter(volume, camera, lights, (0.95,) * 3, march=March(step=1.0, jitter=0.0, g=g))
    found, once = (psnr(image, wanted) for image in (made.shade(), made.lit.shade(albedo=(0.95,) * 3)))
    assert found > max(least, once + 8.0)


@pytest.mark.slow
def test_a_filter_is_fitted_and_a_network_trained(unseen, lessons):
    """From noisy references alone: the fit helps at once, training lowers the error, one seed gives one model."""
    noisy = make_sample(5, 1, samples=32, pixels=32, lights=2)
    known = [*make_lessons(noisy), *make_lessons(make_sample(5, 2, samples=32, pixels=32, lights=2))]
    model = fit_filter(known, pixels=400)
    errors: list[float] = []
    steps = {"steps": 120, "pixels": 256, "report": lambda step, error: errors.append(error)}
    trained = train_network(model, known, known, **steps)
    again = train_network(model, known, known, **steps)
    assert all(torch.equal(trained.arrays[name], again.arrays[name]) for name in trained.arrays)
    assert errors[1] < 0.9 * errors[0] and not torch.equal(trained.arrays["last"], model.arrays["last"])
    mean = np.mean([psnr(trained.light(x.inputs, (1.0,) * 3)[..., 0], x.light[-1]) for x in known])
    single = np.mean([psnr(x.inputs.single, x.light[-1]) for x in known])
    assert mean > single + 6.0


def test_views_are_of_their_numbers():
    (a, b, c), (d, e, f) = draw_view(3, 5), draw_view(3, 5)
    assert torch.equal(a.density, d.density) and b == e
    assert [light.toward for light in c] == [light.toward for light in f]
    assert not torch.equal(a.density, draw_view(3, 6)[0].density[: a.shape[0], : a.shape[1], : a.shape[2]])


@pytest.mark.parametrize("sigma", [0.7, 2.0, 5.0, 11.0])
def test_a_blur_keeps_light_and_spreads_it(sigma: float):
    """Of a point: its sum, its middle, and its spread within 6%."""
    plane = torch.zeros(1, 97, 93)
    plane[0, 48, 44] = 1.0
    made = blur(plane, sigma)[0].double()
    rows = torch.arange(97.0).double()
    along = made.sum(1)
    middle = (along * rows).sum() / along.sum()
    assert float(made.sum()) == pytest.approx(1.0, rel=0.01) and float(middle) == pytest.approx(48, abs=0.25 * sigma)
    assert float(((along * (rows - middle) ** 2).sum() / along.sum()).sqrt()) == pytest.approx(sigma, rel=0.06)


def test_features_are_blurred_and_shifted_planes(device: str):
    """Each against torch's own Gaussian, bilinear and shifted sampling: light moves away from the light."""
    random = torch.Generator().manual_seed(3)
    shape, light = (44, 52), Light((0.6, 0.5, 0.62))
    planes = F.interpolate(torch.rand(2, 2, 11, 13, generator=random), shape, mode="bilinear").to(device)
    clear = (0.3 + 0.4 * planes[0, 0] * planes[1, 0]).clamp(0, 1)
    volume = plume(device=device)
    camera = Camera.around(volume, toward=(0.1, 0.2, 1.0), pixels=44)
    camera = replace(camera, width=52)
    lit = LitSmoke((light,), planes[:1, 0], planes[:1, 1], clear, None, clear, camera, orders_march(volume))
    inputs = make_inputs(volume, lit, planes[1, 1])[0]
    single, opposite, opacity = planes[0, 0], planes[0, 1], 1 - clear
    bases = [single, opposite, planes[1, 1], opacity, opacity**2, -clear.log() / 9, single**2, single * opacity]
    bases = torch.stack([*bases, single.sqrt()])
    across, rise, _ = camera.axes @ unit(light.toward)
    expected = [bases]
    for scale in (1 / 64, 1 / 32, 1 / 16, 1 / 8):
        pixels = scale * volume.voxel * max(volume.shape) / camera.pitch
        blurred = blur(bases, pixels)
        rows = (torch.arange(44) + 0.5 + pixels * rise) / 44 * 2 - 1
        columns = (torch.arange(52) + 0.5 - pixels * across) / 52 * 2 - 1
        grid = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)[None].to(blurred)
        expected += [blurred, F.grid_sample(blurred[None, [0, 3, 5]], grid, align_corners=False)[0]]
    expected = torch.cat(expected)
    assert inputs.features.shape == (FEATURES, *shape) and 2 * len(expected) == FEATURES
    assert torch.allclose(inputs.features[: len(expected)], expected, atol=0.015)
    assert torch.allclose(inputs.features[len(expected) :], inputs.features[: len(expected)] * opacity, atol=1e-6)


@pytest.mark.parametrize("sigma", [30.0, 1e3, 1e7])
def test_a_blur_wider_than_the_image(sigma: float):
    """An image of ones, outside of which there is nothing: in its middle what the Gaussian has over it."""
    made = blur(torch.ones(1, 16, 16), sigma)
    assert float(made[0, 8, 8]) == pytest.approx(math.erf(8 / (sigma * math.sqrt(2))) ** 2, rel=0.1)


def test_hard_smoke(device: str):
    """No smoke, albedo 0 and in colour, smoke ten times as thick as any that was learned, and half floats."""
    camera = Camera.around(plume(), pixels=12)
    empty = scatter(from_array(np.zeros((4, 4, 4)), device=device), camera, [Light((1, 1, 1))])
    assert not empty.shade().any()
    assert not scatter(plume(device=device), camera, [Light((1, 1, 1))], (0.0, 0.0, 0.0)).shade().any()
    tinted = scatter(plume(device=device), camera, [Light((1, 1, 1))], (1.0, 0.9, 0.3)).planes
    assert (tinted[..., 0] >= tinted[..., 1]).all() and (tinted[..., 1] >= tinted[..., 2]).all()
    thick = replace(plume(device=device), extinction=1000.0)
    made = scatter(thick, camera, [Light((1, 1, 1))]).shade()
    assert torch.isfinite(made).all() and 0.1 < float(made.max()) <= 6.0
    half = replace(plume(device=device), density=plume(device=device).density.half())
    assert torch.isfinite(scatter(half, camera, [Light((1, 1, 1))]).shade()).all()
    with pytest.raises(ValueError, match="albedo"):
        scatter(plume(), camera, [Light((1, 1, 1))], (1.0, 2.0, 0.0))


@pytest.mark.parametrize("within", ["light", "camera", "both"])
def test_a_light_and_a_camera_in_the_smoke(device: str, within: str):
    """No less than light scattered once, and no more than there is; of a light from outside it is all there is."""
    volume = make_plume(20, hot=False, extinction=12.0, device=device)
    inside = Camera.look_at((0.5, 0.6, 0.5), (0.5, 0.6, 0.0), extent=1.0, height=12, width=12, perspective=True)
    camera = Camera.around(volume, toward=(0.2, 0.1, 1.0), pixels=12) if within == "light" else inside
    lamp = PointLight((0.48, 0.55, 0.42), (4 * math.pi,) * 3, radius=0.1)
    light = Light((1.0, 0.7, 0.3)) if within == "camera" else lamp
    made = scatter(volume, camera, [light], (1.0, 1.0, 0.0))
    wanted = trace(volume, camera, [light], albedo=(1.0, 1.0, 0.0), samples=256).total
    once, picture = made.lit.shade(albedo=(1.0, 1.0, 0.0)), made.shade()
    assert torch.isfinite(picture).all() and (picture >= 0.999 * once).all() and not picture[..., 2].any()
    share = float(picture[..., 0].mean() / wanted[..., 0].mean())
    assert share == pytest.approx(1.0, abs=0.2)


def test_files_of_models(tmp_path):
    """A model comes back as it went; every wrong one is a line that names the part."""
    model = load_orders()
    model.save(tmp_path / "a.npz")
    again = load_orders(tmp_path / "a.npz")
    assert all(torch.equal(model.arrays[name], again.arrays[name]) for name in model.arrays)
    with pytest.raises(WlmError, match="npz"):
        model.save(tmp_path / "a.bin")
    wrong = {
        "weights": torch.zeros(3, 3),
        "spread": torch.zeros_like(model.arrays["spread"]),
        "gate_spread": torch.zeros(FACTS),
        "range": torch.tensor([2.0, 1.0]),
        "first": model.arrays["first"] * math.inf,
    }
    for name, array in wrong.items():
        OrdersModel(model.arrays | {name: array}).save(tmp_path / "b.npz")
        with pytest.raises(WlmError, match=rf"b.npz: {name}: expected"):
            load_orders(tmp_path / "b.npz")
    missing = {name: array for name, array in model.arrays.items() if name != "last"}
    OrdersModel(missing).save(tmp_path / "b.npz")
    with pytest.raises(WlmError, match="last is missing"):
        load_orders(tmp_path / "b.npz")
    with pytest.raises(WlmError, match="absent.npz"):
        load_orders(tmp_path / "absent.npz")


def test_inputs_hold_for_any_image(device: str):
    """At twice the pixels the filter says the same: its scales are the smoke's and not the image's."""
    volume, model = plume(device=device), load_orders().to(device)
    made = []
    for pixels in (24, 48, 96):
        camera = Camera.around(volume, pixels=pixels)
        lit = light_smoke(volume, camera, [Light((1.0, 0.5, 0.6))], orders_march(volume))
        inputs = make_inputs(volume, lit, ambient(volume, camera))[0]
        made.append(torch.nn.functional.avg_pool2d(model.filtered(inputs), pixels // 24))
    for finer in made[1:]:
        assert float((made[0] - finer).square().mean().sqrt() / finer.square().mean().sqrt()) < 0.12
