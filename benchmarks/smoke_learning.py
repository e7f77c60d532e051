"""Fits the weights of `wlm.smoke.transport.orders` to path-traced light of random smoke, cameras and lights.

The traced light may be noisy as long as it has no bias: least squares fits its mean.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
import warp as wp

from benchmarks.smoke import make_noise
from benchmarks.smoke_tracing import trace
from demos.plume import make_plume
from wlm.fluid.volume import DensityVolume
from wlm.formats.atomic import atomic_path
from wlm.interop import device_name, stream, to_warp
from wlm.metrics import psnr_from_mse
from wlm.smoke.camera import Camera
from wlm.smoke.network.planes import to_srgb
from wlm.smoke.shading import Light
from wlm.smoke.transport.orders import ALBEDOS, Inputs, OrdersModel, make_inputs, orders_march
from wlm_kernels.smoke import orders
from wlm_kernels.smoke.orders import FEATURES, MIXES

_ORDERS = 40
_THIN, _THICK = 5.0, 60.0  # range of the optical depth across the box
_SIZES = (40, 48, 56, 64)
_THINNEST, _THICKEST = 2.0, 100.0
_ALL_SIZES = (24, 32, 48, 64, 96)
_PIXELS = (32, 48, 64, 96)
_SMALL, _HAZY = 0.4, 0.4  # probabilities of smoke that fills a part of its box, and of smoke in haze
_RIDGE = 1e-5
_RARE, _NARROWEST = 0.02, 0.1  # share of depths at either end outside the range, and the least range
_CLEAR = 1e-3  # opacity below which pixels are ignored
_OCTAVES = range(1, 6)
_SHAPES = ("ball", "column", "shell", "fog")
_CURVE = 1.16  # exponent of the light in the weight, from the slope of sRGB's curve

FAINT = 0.03
"""Light below which errors have the same weight."""


def _billows(n: int, seed: int) -> torch.Tensor:
    """Makes the density [n, n, n] of smoke in the shape of a ball, column, shell or fog, rotated and stretched, with
    edges perturbed by noise; n is at least 2."""
    random = np.random.default_rng(seed)
    shape = _SHAPES[int(random.integers(len(_SHAPES)))]
    roughness, wisps = random.uniform(0.35, 0.75), random.uniform(0.0, 0.6)
    sharpness = float(np.exp(random.uniform(np.log(0.7), np.log(8.0))))
    noise = make_noise(random, n, _OCTAVES, roughness)
    noise /= noise.std(correction=0).clamp(min=1e-6)
    turn, _ = np.linalg.qr(random.standard_normal((3, 3)))
    radii = random.uniform(0.2, 0.5, 3)
    axis = (np.arange(n) + 0.5) / n
    place = np.stack(np.meshgrid(axis, axis, axis, indexing="ij")) - random.uniform(0.4, 0.6, (3, 1, 1, 1))
    along = np.einsum("ij,jxyz->ixyz", turn, place) / radii[:, None, None, None]
    across = np.sqrt((along[:2] ** 2).sum(0))
    away = np.sqrt(across**2 + along[2] ** 2)
    distance = {"ball": away, "column": across, "shell": 2.5 * np.abs(away - 0.7), "fog": np.full_like(away, 0.5)}
    density = np.clip(sharpness * (1.0 - distance[shape] + wisps * noise.numpy()), 0.0, 1.0)
    return torch.from_numpy(density.astype(np.float32))


def draw_view(
    seed: int, number: int, *, pixels: int = 64, lights: int = 6, cells: int | None = None
) -> tuple[DensityVolume, Camera, tuple]:
    """Draws random smoke, a camera and lights, which depend only on the seed and the number.

    Args:
        seed, number: Seed and number of the view, at least 0.
        pixels: Height and width of the image in pixels.
        lights: Number of lights.
        cells: Number of voxels along an edge of the smoke's box; None: random, 40 to 64.
    """
    random = np.random.default_rng([seed, number])
    extinction = float(np.exp(random.uniform(np.log(_THIN), np.log(_THICK))))
    drawn = int(random.choice(_SIZES))
    n = drawn if cells is None else cells
    volume = make_plume(n, seed=int(random.integers(2**31)), hot=False, extinction=extinction)
    volume = replace(volume, density=volume.density ** float(random.uniform(0.5, 2.0)))
    return _seen(volume, random, pixels, lights)


def draw_lesson(seed: int, number: int, *, lights: int = 4) -> tuple[DensityVolume, Camera, tuple]:
    """Draws smoke, a camera and lights for the fit, like `draw_view` but of more kinds and sizes."""
    random = np.random.default_rng([seed, number])
    extinction = float(np.exp(random.uniform(np.log(_THINNEST), np.log(_THICKEST))))
    n, pixels = int(random.choice(_ALL_SIZES)), int(random.choice(_PIXELS))
    fills = int(n * random.uniform(0.3, 0.8)) if random.random() < _SMALL else n
    density = _any_smoke(random, fills)
    if random.random() < _HAZY:
        density = density + float(np.exp(random.uniform(np.log(0.02), 0.0))) * _any_smoke(random, fills)
    density = density ** float(np.exp(random.uniform(np.log(0.5), np.log(4.0))))
    before = random.integers(0, n - fills + 1, 3)
    sides = [int(part) for first in before[::-1] for part in (first, n - fills - first)]
    density = torch.nn.functional.pad(density, sides)
    volume = DensityVolume(density, extinction * n / fills, 1.0 / n)
    return _seen(volume, random, pixels, lights)


def _any_smoke(random: np.random.Generator, n: int) -> torch.Tensor:
    """Returns the density [n, n, n] of billows or of a plume, each in half of the cases, from a random seed."""
    seed = int(random.integers(2**31))
    return _billows(n, seed) if random.random() < 0.5 else make_plume(n, seed=seed, hot=False).density


def _seen(
    volume: DensityVolume, random: np.random.Generator, pixels: int, lights: int
) -> tuple[DensityVolume, Camera, tuple]:
    density = volume.density.permute(tuple(int(i) for i in random.permutation(3)))
    density = density.flip([axis for axis in range(3) if random.random() < 0.5]).contiguous()
    volume = replace(volume, density=density)
    ways = random.normal(size=(lights + 1, 3))
    camera = Camera.around(volume, toward=ways[0], pixels=pixels)
    return volume, camera, tuple(Light(tuple(map(float, way))) for way in ways[1:])


@dataclass(frozen=True, eq=False)
class Lesson:
    """Data of the fit for one light: inputs of the prediction, and path-traced light [A, H, W] at the A `ALBEDOS`."""

    inputs: Inputs
    light: torch.Tensor

    def multiple(self) -> torch.Tensor:
        """Returns light scattered more than once, divided by the squared albedo, at each of A albedos, [A, H, W]."""
        albedo = torch.tensor(ALBEDOS).to(self.light)[:, None, None]
        return (self.light - albedo * self.inputs.single[0]) / albedo**2

    def weights(self) -> torch.Tensor:
        """Returns the weights, [A, H, W], with which squared errors of `multiple` approximate errors in sRGB."""
        albedo = torch.tensor(ALBEDOS).to(self.light)[:, None, None]
        seen = self.inputs.transparency < 1.0 - _CLEAR
        near = F.avg_pool2d(self.light[None], 3, 1, 1, count_include_pad=False)[0]
        return seen * albedo**4 / (near.clamp(min=0.0) + FAINT) ** _CURVE


def make_lessons(
    view: tuple[DensityVolume, Camera, tuple], *, samples: int, seed: int, device: str = "cpu"
) -> list[Lesson]:
    """Traces paths for the lights of a view and computes the inputs of the prediction, for one lesson per light.

    Args:
        view: Result of `draw_view`: smoke, camera and directional lights of irradiance 4 pi.
        samples: Number of paths per pixel.
        seed: Seed of the paths.
        device: "cpu" or "cuda:N".
    """
    volume, camera, lights = view
    volume = replace(volume, density=volume.density.to(device))
    grey = trace(volume, camera, lights, samples=samples, orders=_ORDERS, seed=seed).planes[..., 0]
    powers = torch.tensor(ALBEDOS, device=grey.device)[:, None] ** torch.arange(_ORDERS + 2, device=grey.device)
    with stream(device_name(volume.device)):
        _, inputs = make_inputs(volume, camera, lights, ALBEDOS, orders_march(volume))
    return [Lesson(inputs.of(n), light) for n, light in enumerate(torch.einsum("ak,lkhw->lahw", powers, grey))]


def fit_orders(lessons: Sequence[Lesson], *, pixels: int = 1024, seed: int = 0) -> OrdersModel:
    """Fits the weights of the prediction to path-traced light and returns them as a model.

    Args:
        lessons: Data of the fit, at least one lesson.
        pixels: Number of random pixels used of each lesson.
        seed: Seed of these pixels.
    """
    device, size = lessons[0].light.device, FEATURES * MIXES
    depths = torch.tensor([float(lesson.inputs.depth) for lesson in lessons], dtype=torch.float64)
    low, high = (float(torch.quantile(depths, share)) for share in (_RARE, 1.0 - _RARE))
    known = torch.tensor([low, max(high, low + _NARROWEST)], device=device)
    model = OrdersModel(torch.zeros(len(ALBEDOS), MIXES, FEATURES, device=device), known)
    left = torch.zeros(len(ALBEDOS), MIXES, FEATURES, MIXES, FEATURES, dtype=torch.float64, device=device)
    right = torch.zeros(len(ALBEDOS), MIXES, FEATURES, dtype=torch.float64, device=device)
    random = torch.Generator().manual_seed(seed)
    for lesson in lessons:
        x = features(lesson.inputs, 0).flatten(2).double()
        chosen = torch.randperm(x.shape[2], generator=random)[:pixels].to(device)
        x = x[..., chosen]
        target, weights = (part.flatten(1)[:, chosen].double() for part in (lesson.multiple(), lesson.weights()))
        # All pixels of a lesson have the same polynomial terms, so that the normal matrix is a product.
        mix = model.mixes(lesson.inputs)[0].double()
        weighed = x * weights[:, None]
        squares = weighed @ x.transpose(1, 2)
        left += (mix[:, None] * mix)[None, :, None, :, None] * squares[:, None, :, None, :]
        right += mix[None, :, None] * (weighed @ target[..., None])[:, None, :, 0]
    left, right = left.reshape(len(ALBEDOS), size, size), right.reshape(len(ALBEDOS), size)
    diagonal = left.diagonal(dim1=1, dim2=2)
    left += _RIDGE * torch.diag_embed(diagonal + 1e-3 * diagonal.mean(1, keepdim=True))
    weights = torch.linalg.solve(left, right).reshape(len(ALBEDOS), MIXES, FEATURES)
    return OrdersModel(weights.float(), known)


def learn(
    views: int, *, samples: int = 512, seed: int = 0, device: str = "cpu", report: Callable[[int], None] | None = None
) -> OrdersModel:
    """Draws random smoke, traces its light and fits the weights; the weights that ship with wlm are from 2000 views.

    Args:
        views: Number of views, with four lights each.
        samples: Number of paths per pixel.
        seed: Seed of the views and their paths.
        device: "cpu" or "cuda:N".
        report: Called with the number of each view, from 0, before it is traced.
    """
    lessons = []
    for number in range(views):
        if report is not None:
            report(number)
        lessons += make_lessons(draw_lesson(seed, number), samples=samples, seed=number, device=device)
    return fit_orders(lessons)


@wp.kernel(enable_backward=False)
def _features(
    # in:
    single: wp.array2d[float],
    opposite: wp.array2d[float],
    diffused: wp.array3d[float],
    from_thin: wp.array3d[float],
    transparency: wp.array2d[float],
    thin: wp.array2d[float],
    # out:
    out: wp.array4d[float],
):
    a, i, j = wp.tid()
    d, e = diffused[a, i, j], from_thin[a, i, j]
    x = orders.features(single[i, j], opposite[i, j], d, e, transparency[i, j], thin[i, j])
    for n in range(FEATURES):
        out[a, n, i, j] = x[n]


def features(inputs: Inputs, light: int) -> torch.Tensor:
    """Returns the features of one light for the weighted sum, float32 [A, FEATURES, H, W]."""
    out = torch.empty((len(inputs.albedos), FEATURES, *inputs.thin.shape), device=inputs.thin.device)
    of_light = (part[light] for part in (inputs.single, inputs.opposite, inputs.diffused, inputs.from_thin))
    planes = [to_warp(plane) for plane in (*of_light, inputs.transparency, inputs.thin)]
    wp.launch(_features, (len(out), *inputs.thin.shape), planes, [to_warp(out)], device=planes[0].device)
    return out


def at(inputs: Inputs, albedo: float) -> Inputs:
    """Returns a copy of the inputs that keeps the light by diffusion of one albedo alone, which must be among them."""
    n = inputs.albedos.index(albedo)
    planes = {name: getattr(inputs, name)[:, n : n + 1] for name in ("diffused", "from_thin")}
    return replace(inputs, **planes, albedos=(albedo,))


def save_orders(model: OrdersModel, path: str | os.PathLike[str]) -> None:
    """Writes weights as `.npz` for `load_orders`, atomically.

    Raises:
        WlmError: The file cannot be written.
    """
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, weights=model.weights.cpu().numpy(), range=model.known.cpu().numpy())


def psnr(light: torch.Tensor, reference: torch.Tensor) -> float:
    """Returns the PSNR in dB of two linear images, computed in sRGB with a peak of 1."""
    return psnr_from_mse(float((to_srgb(light) - to_srgb(reference)).double().square().mean()), 1.0)
