"""Light of all orders of scattering, predicted from light scattered once and from diffusion.

At albedo a all light is a S + a^2 R(a), where S is light scattered once at albedo 1. R is the light scattered more than
once, divided by a^2.

Light scattered many times diffuses, except at the smoke's edges, where it leaves, and in thin parts. R is therefore
predicted per pixel as a weighted sum of features: light from diffusion, light scattered once from the light and from
the opposite direction, opacity, and the shares of light and opacity from thin smoke. The weights depend on the angle
between light and camera and on the smoke's mean optical depth. They were fitted to path-traced light by least squares
(`benchmarks/smoke_learning.py`) at `ALBEDOS`, and are interpolated linearly in between."""

import functools
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume
from wlm.formats.npz import read_npz
from wlm.interop import device_name, stream, to_warp
from wlm.smoke.camera import Camera, unit
from wlm.smoke.march.launch import in_bricks
from wlm.smoke.shading import AnyLight, Light, PointLight, Ramp, checked_albedo
from wlm.smoke.transport.diffusion import Spreading, share_of, thrown_by_fire
from wlm.smoke.transport.lighting import LitSmoke, light_in, light_smoke, marching
from wlm_kernels.smoke import orders
from wlm_kernels.smoke.orders import FEATURES, MIXES, THINNEST
from wlm_kernels.smoke.settings import March

ALBEDOS = (0.5, 0.8, 0.9, 0.95, 1.0)
"""Albedos for which the weights are known."""

_STEPS = 130  # steps through the box of a march for light of all orders
_NODES = 64  # least number of gaps of its lattice through the box
_SHORTEST = 0.25  # voxels; shorter steps do not improve the result


@dataclass(frozen=True, eq=False)
class Inputs:
    """Inputs of the prediction for L lights, each with irradiance 4 pi (a point light: at the smoke's centre).

    Attributes:
        single: float32 tensor [L, H, W], light scattered once at albedo 1.
        opposite: float32 tensor [L, H, W], like `single`, but under lights from the opposite directions.
        diffused: float32 tensor [L, A, H, W], light scattered more than once, computed by diffusion, divided by the
            squared albedo.
        from_thin: float32 tensor [L, A, H, W], the part of `diffused` from thin smoke.
        albedos: The A albedos of `diffused`.
        transparency: float32 tensor [H, W], transparency of the smoke.
        thin: float32 tensor [H, W], opacity of thin smoke.
        cosines: Cosines of the angles between the directions to the lights and to the camera.
        depth: float32 tensor [1], logarithm of the smoke's mean optical depth along rays, weighted by opacity.
    """

    single: torch.Tensor
    opposite: torch.Tensor
    diffused: torch.Tensor
    from_thin: torch.Tensor
    albedos: tuple[float, ...]
    transparency: torch.Tensor
    thin: torch.Tensor
    cosines: tuple[float, ...]
    depth: torch.Tensor

    def by_diffusion(self, albedo: float) -> torch.Tensor:
        """Returns all light, [L, H, W], by diffusion without fitted weights, at an albedo that is one of `albedos`."""
        return albedo * self.single + albedo**2 * self.diffused[:, self.albedos.index(albedo)]

    def of(self, light: int) -> "Inputs":
        """Returns the inputs of the light with index `light` alone."""
        names = ("single", "opposite", "diffused", "from_thin")
        planes = {name: getattr(self, name)[light : light + 1] for name in names}
        return replace(self, **planes, cosines=self.cosines[light : light + 1])


def orders_march(volume: DensityVolume, g: float = 0.0) -> March:
    """Returns the settings of the march that computes the inputs of the prediction.

    Its step is 1/130 of the smoke's longest edge, but at least a quarter of a voxel. The nodes of its lattice are one
    step apart, but at least the smaller of a voxel and 1/64 of the edge.
    """
    edge = max(volume.shape)
    step = max(_SHORTEST, edge / _STEPS)
    return March(step=step, spacing=max(min(1.0, edge / _NODES), step), jitter=0.0, g=g)


def make_inputs(
    volume: DensityVolume, camera: Camera, lights: Sequence[AnyLight], albedos: Sequence[float], march: March
) -> tuple[LitSmoke, Inputs]:
    """Computes light scattered once, whose images it returns, and light by diffusion, and thus the inputs of the
    prediction; `march` has g = 0. To be called inside `wlm.interop.stream`."""
    ways = [aim(light, volume) for light in lights]
    with marching(volume, camera, march) as scene:
        spreading = Spreading(scene, volume, lights)
        lit = light_in(scene, volume, camera, lights, spreading.add)
        diffused, thin = spreading.render(albedos)
        single, opposite = lit.planes, lit.opposite
        points = [n for n, light in enumerate(lights) if isinstance(light, PointLight)]
        if points:
            single, opposite = single.clone(), opposite.clone()
        for n in points:
            toward, factor = ways[n]
            single[n] *= factor
            diffused[:, n] *= factor
            both = torch.empty(2, *single.shape[1:], device=single.device)
            scene.light(scene.reach(-toward, None), both)
            opposite[n] = both[0]
    opacity = 1.0 - lit.transparency
    thickness = -torch.log(lit.transparency.clamp(min=THINNEST))
    # The sum of opacities counts as at least a tenth of a pixel.
    mean = (thickness * opacity).sum() / opacity.sum().clamp(min=0.1)
    cosines = tuple(float(camera.axes[2] @ toward) for toward, _ in ways)
    depth = mean.clamp(min=1e-3).log().reshape(1)
    return lit, Inputs(single, opposite, *diffused, tuple(albedos), lit.transparency, thin, cosines, depth)


def aim(light: AnyLight, volume: DensityVolume) -> tuple[np.ndarray, float]:
    """Returns the direction to a light from the smoke's centre, and the factor that makes its irradiance there 4 pi."""
    if isinstance(light, Light):
        return unit(light.toward), 1.0
    way = np.asarray(light.position, np.float64) - volume.centre
    length = float(np.linalg.norm(way))
    least = 0.5 * volume.voxel * max(volume.shape)
    return way / length if length > 0 else np.array([0.0, 1.0, 0.0]), max(length, least) ** 2


_SHIPPED = Path(__file__).resolve().parents[2] / "data" / "smoke-orders.npz"
_SHAPES = {"weights": (len(ALBEDOS), MIXES, FEATURES), "range": (2,)}
_MOST_NUMBERS = 1 << 16


@dataclass(frozen=True, eq=False)
class OrdersModel:
    """Fitted weights of the prediction.

    Attributes:
        weights: float32 tensor [A, MIXES, FEATURES]: weights of the features, for each of the A `ALBEDOS` as a
            polynomial with MIXES terms in the cosine between light and camera and in the depth of `Inputs`.
        known: float32 tensor [2], smallest and largest depth in the fit.
    """

    weights: torch.Tensor
    known: torch.Tensor

    def to(self, device: torch.device | str) -> "OrdersModel":
        """Returns the model with its tensors on a device; the copy is cached."""
        device = torch.device(device)
        if self.weights.device == device:
            return self
        if device not in self._elsewhere:
            self._elsewhere[device] = OrdersModel(self.weights.to(device), self.known.to(device))
        return self._elsewhere[device]

    @functools.cached_property
    def _elsewhere(self) -> dict[torch.device, "OrdersModel"]:
        return {}

    def mixes(self, inputs: Inputs) -> torch.Tensor:
        """Returns the terms of the weights' polynomial in cosine and depth for each light, float32 [L, MIXES]."""
        out = torch.empty(len(inputs.cosines), MIXES, device=inputs.depth.device)
        depth, known = to_warp(inputs.depth), to_warp(self.known)
        for cosine, row in zip(inputs.cosines, out, strict=True):
            orders.mixes(depth, known, cosine, to_warp(row))
        return out

    def light(self, inputs: Inputs, albedo: Sequence[float]) -> torch.Tensor:
        """Predicts light of all orders of scattering for L lights of irradiance 4 pi, float32 [L, H, W, 3].

        Args:
            inputs: Inputs of the lights; their albedos must include those of all channels.
            albedo: R, G, B, 0 to 1.
        """
        places = [inputs.albedos.index(float(value)) for value in checked_albedo(albedo)]
        lights, device = len(inputs.cosines), inputs.depth.device
        out = torch.empty((*inputs.single.shape, 3), device=device)
        if lights:
            weights = torch.empty(lights, len(inputs.albedos), FEATURES, device=device)
            of_lights = (inputs.single, inputs.opposite, inputs.diffused, inputs.from_thin)
            planes = (*of_lights, inputs.transparency, inputs.thin)
            learned = (self.weights, self.mixes(inputs))
            nodes = [_between(value) for value in inputs.albedos]
            settings = (inputs.albedos, nodes, places, to_warp(weights), to_warp(out))
            orders.light(*map(to_warp, (*planes, *learned)), *settings)
        return out


def _between(albedo: float) -> tuple[int, float]:
    """Returns the index of the last of `ALBEDOS` below an albedo, and the share of the way to the next, 0 to 1."""
    at = min(max(albedo, ALBEDOS[0]), ALBEDOS[-1])
    before = int(np.searchsorted(ALBEDOS, at, side="right").clip(1, len(ALBEDOS) - 1)) - 1
    return before, (at - ALBEDOS[before]) / (ALBEDOS[before + 1] - ALBEDOS[before])


def load_orders(path: str | os.PathLike[str] | None = None) -> OrdersModel:
    """Reads the fitted weights.

    Args:
        path: The file; None: the weights that ship with wlm.

    Raises:
        WlmError: The file is missing, damaged or of another kind.
    """
    path = _SHIPPED if path is None else path
    arrays = read_npz(path, lambda names: list(_SHAPES), numbers=_MOST_NUMBERS)
    for name, shape in _SHAPES.items():
        array = arrays[name]
        if array.dtype != np.float32 or array.shape != shape or not np.isfinite(array).all():
            raise WlmError(f"{path}: {name}: expected finite float32 {shape}, found {array.dtype} {array.shape}")
    if not arrays["range"][0] < arrays["range"][1]:
        raise WlmError(f"{path}: range: expected two increasing numbers, found {arrays['range'].tolist()}")
    return OrdersModel(*(torch.from_numpy(arrays[name]) for name in _SHAPES))


@dataclass(frozen=True, eq=False)
class ScatteredSmoke:
    """Images of smoke under L lights, with light of all orders of scattering.

    Attributes:
        lit: Images with light scattered once.
        planes: float32 tensor [L, H, W, 3], light of all orders under each light of irradiance 4 pi (point light: of
            intensity 4 pi).
    """

    lit: LitSmoke
    planes: torch.Tensor

    def shade(
        self, *, background: torch.Tensor | Sequence[float] | None = None, ramp: Ramp | None = None
    ) -> torch.Tensor:
        """Returns the picture, float32 [H, W, 3], linear; arguments as for `LitSmoke.shade`."""
        return self.lit.compose(self.planes, background=background, ramp=ramp)


def scatter(
    volume: DensityVolume,
    camera: Camera,
    lights: Sequence[AnyLight],
    albedo: Sequence[float] = (1.0, 1.0, 1.0),
    *,
    march: March | None = None,
    model: OrdersModel | None = None,
) -> ScatteredSmoke:
    """Predicts light of all orders of scattering from marches and diffusion.

    Light that was scattered once passes through the obstacles of the volume.

    Args:
        volume: The smoke.
        camera: Any camera.
        lights: Any number of lights, which are predicted separately: point lights in the smoke's box by diffusion
            alone, point lights far outside as if their rays were parallel.
        albedo: R, G, B, share of light that survives a scattering, 0 to 1.
        march: Settings; None: those of `orders_march`. If g is not 0, light scattered once has its phase function, and
            multiple scattering is that of isotropic smoke whose extinction is reduced by the share g^2 of light that is
            not deflected (delta-Eddington: Joseph, Wiscombe and Weinman 1976); the error grows with |g|.
        model: The weights; None: those that ship with wlm.

    Raises:
        ValueError: The albedo is not three numbers from 0 to 1.
        WlmError: The weights that ship with wlm cannot be read.
    """
    colour = checked_albedo(albedo)
    march = orders_march(volume) if march is None else march
    model = (_shipped() if model is None else model).to(volume.device)
    volume = in_bricks(volume)
    with stream(device_name(volume.device)):
        alike, thinner, even = volume, colour, march
        if march.g != 0.0:
            # Light that is not deflected counts as not scattered.
            straight = max(march.g, 0.0) ** 2
            left = 1.0 - float(colour.mean()) * straight
            alike = replace(volume, extinction=volume.extinction * left)
            thinner = (colour * (1.0 - straight) / left).clip(0.0, 1.0)
            even = replace(march, g=0.0)
        values = sorted(set(map(float, thinner)))
        lit, inputs = make_inputs(alike, camera, lights, values, even)
        planes = model.light(inputs, thinner)
        for n, light in enumerate(lights):
            if (near := share_of(light, alike)) > 0.0:
                for channel, value in enumerate(map(float, thinner)):
                    planes[n, ..., channel].lerp_(inputs.of(n).by_diffusion(value)[0], near)
            if (factor := aim(light, alike)[1]) != 1.0:
                planes[n] /= factor
        if march.g != 0.0:
            once = light_smoke(volume, camera, lights, march)
            for channel in range(3):
                planes[..., channel] += colour[channel] * once.planes - thinner[channel] * lit.planes
            planes.clamp_(min=0.0)
            lit = once
        if volume.temperature is not None:
            with marching(alike, camera, even) as scene:
                thrown = thrown_by_fire(scene, alike, values)
            lit = replace(lit, thrown=torch.stack([thrown[values.index(float(value))] for value in thinner], -1))
    return ScatteredSmoke(lit, planes)


@functools.cache
def _shipped() -> OrdersModel:
    return load_orders()
