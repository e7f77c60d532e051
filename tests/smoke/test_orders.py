"""Light of all orders by diffusion and fitted weights, against path tracing."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from builders.checks import error_of
from builders.smoke_plumes import plume

from benchmarks.smoke import make_cloud
from benchmarks.smoke_learning import (
    Lesson,
    at,
    draw_view,
    features,
    fit_orders,
    learn,
    make_lessons,
    psnr,
    save_orders,
)
from benchmarks.smoke_tracing import trace
from demos.plume import make_plume
from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import Camera
from wlm.smoke.shading import Light, PointLight
from wlm.smoke.transport.orders import ALBEDOS, Inputs, OrdersModel, load_orders, make_inputs, orders_march, scatter
from wlm_kernels.smoke.orders import FEATURES, MIXES
from wlm_kernels.smoke.settings import March


@pytest.fixture(scope="module")
def lessons() -> list[Lesson]:
    """Two views that are not in the training, with little noise."""
    views = [draw_view(90_000, number, pixels=32, lights=2) for number in (0, 1)]
    return [lesson for seed, view in enumerate(views) for lesson in make_lessons(view, samples=256, seed=seed)]


def diffused(inputs: Inputs, albedo: float) -> torch.Tensor:
    """Returns single scattering and diffusion, the input of the prediction, [H, W]."""
    return inputs.by_diffusion(albedo)[0]


def input_alone() -> OrdersModel:
    """Makes a mix that returns its input: single scattering and diffusion, the feature 18."""
    model = load_orders()
    weights = torch.zeros(model.weights.shape)
    weights[:, 0, 18] = 1.0
    return OrdersModel(weights, model.known)


def mixed(model: OrdersModel, inputs: Inputs, albedo: float) -> torch.Tensor:
    """Returns all light of one light, [H, W]."""
    return model.light(at(inputs, albedo), (albedo,) * 3)[0, ..., 0]


def test_the_mix_is_worth_its_name_and_never_worse(lessons):
    """The shipped weights improve every light; untrained weights and the identity fail the same check."""
    model = load_orders()

    def holds(model: OrdersModel) -> bool:
        found = []
        for lesson in lessons:
            for albedo in (0.8, 1.0):
                light = lesson.light[ALBEDOS.index(albedo)]
                one, other = mixed(model, lesson.inputs, albedo), diffused(lesson.inputs, albedo)
                found.append(psnr(one, light) - psnr(other, light))
        return min(found) > 0.0 and np.mean(found) > 2.0

    assert holds(model)
    random = torch.Generator().manual_seed(1)
    untrained = 0.1 * torch.randn(model.weights.shape, generator=random)
    assert not holds(OrdersModel(untrained, model.known))
    # Nor does one that hands on its input.
    assert not holds(input_alone())
    inputs = lessons[0].inputs
    assert torch.allclose(mixed(input_alone(), inputs, 0.9), diffused(inputs, 0.9), atol=1e-6)


def gains(volume: DensityVolume, camera: Camera, lights: list[Light], samples: int, seed: int = 0) -> list[float]:
    """Returns for each light how much nearer the shipped mix is to the traced light than its input, in dB."""
    traced = trace(volume, camera, lights, samples=samples, seed=seed).planes.sum(1)[..., 0]
    _, inputs = make_inputs(volume, camera, lights, [1.0], orders_march(volume))
    pairs = ((light, inputs.of(n)) for n, light in enumerate(traced))
    return [psnr(mixed(load_orders(), each, 1.0), light) - psnr(diffused(each, 1.0), light) for light, each in pairs]


@pytest.mark.slow
@pytest.mark.parametrize("cells", [32, 64])
def test_on_no_grid_is_the_mix_worse_than_its_input(cells: int):
    """Other smoke and a plume, at both ends of the fitted thickness, on coarse and fine grids."""
    found = []
    cloud = DensityVolume(make_cloud(cells, "cpu"), 8.0, 1.0 / cells)
    for number, volume in enumerate((cloud, make_plume(cells, seed=12, hot=False, extinction=40.0))):
        random = np.random.default_rng([cells, number])
        camera = Camera.around(volume, toward=random.normal(size=3), pixels=20)
        lights = [Light(tuple(map(float, random.normal(size=3)))) for _ in range(2)]
        found += gains(volume, camera, lights, 192, number)
    assert min(found) > 0.0 and np.mean(found) > 1.0


@pytest.mark.parametrize("extinction", [0.3, 400.0])
def test_smoke_thinner_and_thicker_than_any_that_was_learned(extinction: float):
    """Outside the fitted range the result is no worse than its input."""
    volume = make_plume(32, seed=3, hot=False, extinction=extinction)
    camera = Camera.around(volume, toward=(0.3, 0.1, 1.0), pixels=20 if extinction < 1.0 else 12)
    lights = [Light((1.0, 0.6, 0.2)), Light((-0.4, 0.5, -0.8))]
    assert min(gains(volume, camera, lights, 4096 if extinction < 1.0 else 256)) > -0.02


@pytest.mark.parametrize("kind", ["directional", "point", "perspective"])
def test_other_smoke_other_lights_other_cameras(device: str, kind: str):
    """Another plume in a box that is not a cube is 6 dB nearer to all light than single scattering."""
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
    """With an anisotropic phase function the result is 8 dB nearer than single scattering."""
    volume = plume(device=device)
    camera = Camera.around(volume, toward=(0.5, 0.2, 1.0), pixels=24)
    lights = [Light((1.0, 0.5, 0.6), (6.0, 6.0, 6.0)), Light((-0.2, 0.3, -1.0), (4.0, 4.0, 4.0))]
    wanted = trace(volume, camera, lights, albedo=(0.95,) * 3, g=g, samples=256).total
    made = scatter(volume, camera, lights, (0.95,) * 3, march=March(step=1.0, jitter=0.0, g=g))
    found, once = (psnr(image, wanted) for image in (made.shade(), made.lit.shade(albedo=(0.95,) * 3)))
    assert found > max(least, once + 8.0)


@pytest.mark.slow
def test_a_mix_is_fitted(lessons):
    """A fit to noisy references helps, and one seed gives one model."""
    model, again = (learn(6, samples=32, seed=5) for _ in range(2))
    assert torch.equal(model.weights, again.weights) and torch.equal(model.known, again.known)
    found = np.mean([psnr(mixed(model, x.inputs, 1.0), x.light[-1]) for x in lessons])
    single = np.mean([psnr(x.inputs.single[0], x.light[-1]) for x in lessons])
    assert found > single + 6.0


def test_a_mix_finds_the_weights_that_light_is_made_with(lessons):
    """A fit to a known combination of features reproduces its light."""
    random = torch.Generator().manual_seed(4)
    made = []
    for lesson in lessons:
        x = features(lesson.inputs, 0)
        multiple = x[:, 18] + 0.3 * x[:, 7] + 0.2 * lesson.inputs.cosines[0] * x[:, 1]
        albedo = torch.tensor(ALBEDOS)[:, None, None]
        light = albedo * lesson.inputs.single + albedo**2 * multiple
        noise = 1.0 + 0.01 * torch.randn(light.shape, generator=random)
        made.append(Lesson(lesson.inputs, light * noise))
    model = fit_orders(made)
    for lesson in made:
        assert psnr(mixed(model, lesson.inputs, 0.95), lesson.light[ALBEDOS.index(0.95)]) > 45.0


def test_light_is_the_mix_of_its_features(device: str):
    """Several lights in colour against NumPy in float64."""
    random = torch.Generator().manual_seed(3)
    single, opposite = 1.5 * torch.rand(2, 2, 6, 7, generator=random)
    diffused, (clear, thin) = 2.0 * torch.rand(2, 2, 3, 6, 7, generator=random), torch.rand(2, 6, 7, generator=random)
    clear[0, 0], single[:, 0, 0] = 0.0, 0.0
    albedos, colour = (0.3, 0.85, 0.95), (0.95, 0.3, 0.85)
    planes = (part.to(device) for part in (single, opposite, *diffused))
    flat, depth = (clear.to(device), thin.to(device)), torch.tensor([0.2], device=device)
    inputs = Inputs(*planes, albedos, *flat, (0.4, -0.7), depth)
    weights = 0.3 * torch.randn(len(ALBEDOS), MIXES, FEATURES, generator=random)
    model = OrdersModel(weights, torch.tensor([-1.0, 2.0])).to(device)
    found = model.light(inputs, colour).cpu().double().numpy()
    depth = (2.0 * 0.2 - 1.0) / 3.0
    s, o, d, t, e = (part.double().numpy() for part in (single, opposite, diffused, clear, thin))
    a = 1.0 - t
    for n, c in enumerate((0.4, -0.7)):
        mix = [1, c, c * c, depth, depth**2, c * depth, c**3, depth**3, c * c * depth, c * depth**2]
        for channel, albedo in enumerate(colour):
            r, few = d[:, n, albedos.index(albedo)]
            x = [s[n], o[n], a, a * a, -np.log(np.maximum(t, 1e-4)) / 9, s[n] ** 2, s[n] * a, s[n] ** 0.5, r**0.5]
            x += [part * a for part in x]
            x += [r, r * a, r * r, r * a * a, (s[n] * r) ** 0.5, (o[n] * r) ** 0.5, few, few * a, e, e * a]
            at = np.interp(albedo, ALBEDOS, range(len(ALBEDOS)))
            before = min(int(at), len(ALBEDOS) - 2)
            part = weights[before].double() * (1 - at + before) + weights[before + 1].double() * (at - before)
            multiple = np.tensordot(mix @ part.numpy(), np.stack(x), 1).clip(0)
            wanted = np.minimum(albedo * s[n] + albedo**2 * multiple, 6.0 * a)
            assert np.allclose(found[n, ..., channel], np.maximum(wanted, albedo * s[n]), atol=2e-5)
    planes = features(inputs, 1)
    assert planes.shape == (3, FEATURES, 6, 7) and torch.allclose(planes[2, 18].cpu(), diffused[0, 1, 2])


def test_hard_smoke(device: str):
    camera = Camera.around(plume(), pixels=12)
    tinted = scatter(plume(device=device), camera, [Light((1, 1, 1))], (1.0, 0.9, 0.3)).planes
    assert (tinted[..., 0] >= tinted[..., 1]).all() and (tinted[..., 1] >= tinted[..., 2]).all()
    thick = replace(plume(device=device), extinction=1000.0)
    made = scatter(thick, camera, [Light((1, 1, 1))]).shade()
    assert torch.isfinite(made).all() and 0.1 < float(made.max()) <= 6.0
    half = replace(plume(device=device), density=plume(device=device).density.half())
    assert torch.isfinite(scatter(half, camera, [Light((1, 1, 1))]).shade()).all()


@pytest.mark.parametrize("within", ["light", "camera", "both"])
def test_a_light_and_a_camera_in_the_smoke(device: str, within: str):
    """The result is at least single scattering, and the total is near the traced one."""
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
    """A saved model is read back; a part that is missing is named."""
    model = load_orders()
    save_orders(model, tmp_path / "a.npz")
    again = load_orders(tmp_path / "a.npz")
    assert torch.equal(model.weights, again.weights) and torch.equal(model.known, again.known)
    np.savez(tmp_path / "b.npz", weights=model.weights.numpy())
    assert "range is missing" in error_of(load_orders, tmp_path / "b.npz")
