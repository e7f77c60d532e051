"""Light of all orders from light scattered once: a filter of planes at several scales, and a network that corrects it.

Light that is scattered on spreads through the smoke and comes out blurred. So the planes that a march makes anyway say
most of it: light of the light itself, of the opposite one, from all around, and opacity. They are blurred at scales of
the smoke's box (never of pixels: a filter holds for any image), shifted along the light, and mixed linearly, with
weights that depend on the angle between light and camera and on the smoke's mean depth, and were found by least squares
against path tracing. What is
left a small network predicts from the same planes, pixel by pixel; a gate says how much of its correction is taken.

Of an albedo a all light is a S + a^2 R(a), where S was scattered once and R more often. The filter predicts R at the
albedos of `samples.ALBEDOS`, between which it is linear.
"""

import functools
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume
from wlm.formats.atomic import atomic_path
from wlm.formats.npz import read_npz
from wlm.interop import device_name, stream
from wlm.smoke.camera import Camera
from wlm.smoke.shading import Ramp
from wlm.smoke.transport import gating
from wlm.smoke.transport.diffusion import scattered_again, share_of, thrown_by_fire
from wlm.smoke.transport.features import FEATURES, Inputs, aim, ambient, input_maker, orders_march
from wlm.smoke.transport.gating import FAINT
from wlm.smoke.transport.lighting import LitSmoke, light_smoke, marching
from wlm.smoke.transport.lights import AnyLight, PointLight, checked_albedo
from wlm.smoke.transport.samples import ALBEDOS
from wlm_kernels.smoke.settings import March

HIDDEN = 48
MIXES = 6  # products of powers of the cosine between light and camera and of the depth, which weights are for
CONDITIONS = 3  # that the network has besides the features: that cosine, the albedo, the optical depth
_BRIGHTEST = 6.0  # light of all orders over opacity: a white surface under irradiance 4 pi has 4
_SHIPPED = Path(__file__).resolve().parents[2] / "data" / "smoke-orders.npz"
_LEAST, _WORTH = 0.13, 0.195  # RMS of a correction over the light's: none is taken up to the first, all from the second
_ASIDE, _ALONG = (
    0.75,
    0.9,
)  # cosines between light and camera, up or down: all is taken up to the first, none from the second
_BEYOND = 0.5  # of the logarithm of optical depth beyond training over which a correction fades
_SHAPES = {
    "weights": (len(ALBEDOS), FEATURES * MIXES),
    "mean": (FEATURES,),
    "spread": (FEATURES,),
    "range": (2,),
    "first": (HIDDEN, FEATURES + CONDITIONS),
    "first_bias": (HIDDEN,),
    "second": (HIDDEN, HIDDEN),
    "second_bias": (HIDDEN,),
    "last": (HIDDEN,),
    **gating.FIT,
}
_MOST_NUMBERS = 1 << 20


def all_light(inputs: Inputs, albedo: float, multiple: torch.Tensor) -> torch.Tensor:
    """All light of an albedo, [H, W], of R: no more than a white surface's, and no less than was scattered once."""
    total = albedo * inputs.single + albedo**2 * multiple
    return torch.minimum(total, _BRIGHTEST * inputs.opacity).maximum(albedo * inputs.single)


def mixes(inputs: Inputs, known: torch.Tensor) -> torch.Tensor:
    """What the filter's weights are mixed by, [MIXES].

    Args:
        inputs: Of a light.
        known: The least and the greatest depth that were learned, as in `Inputs`; beyond them it is as there.
    """
    low, high = known
    depth = ((2.0 * inputs.depth - low - high) / (high - low)).clamp(-1.0, 1.0)
    one, cosine = torch.ones_like(depth), inputs.cosine
    return torch.stack([one, cosine * one, cosine**2 * one, depth, depth.square(), cosine * depth])


@dataclass(frozen=True, eq=False)
class OrdersModel:
    """A filter and its network, as they are in a file.

    Attributes:
        arrays: By name float32 tensors: "weights" of the filter, "first" and so on of the network, "mean" and "spread"
            of its inputs, the "range" of the depths that it was trained on, and "gate_weights" and so on of its gate.
    """

    arrays: dict[str, torch.Tensor]

    def to(self, device: torch.device | str) -> "OrdersModel":
        """The same on a device: copied there once."""
        device = torch.device(device)
        if self.arrays["weights"].device == device:
            return self
        if device not in self._elsewhere:
            self._elsewhere[device] = OrdersModel({name: array.to(device) for name, array in self.arrays.items()})
        return self._elsewhere[device]

    @functools.cached_property
    def _elsewhere(self) -> dict[torch.device, "OrdersModel"]:
        return {}

    def filtered(self, inputs: Inputs, nodes: Sequence[int] = range(len(ALBEDOS))) -> torch.Tensor:
        """R by the filter alone, [N, H, W], at some of `ALBEDOS` by number."""
        weights = self.arrays["weights"].reshape(len(ALBEDOS), MIXES, FEATURES)
        mix = mixes(inputs, self.arrays["range"])
        # An index in a list would be copied to the device, which a graph can't capture.
        mixed = torch.stack([mix @ weights[node] for node in nodes])
        return (mixed @ inputs.features.flatten(1)).unflatten(1, inputs.features.shape[1:]).clamp(min=0.0)

    def correction(self, inputs: Inputs, filtered: torch.Tensor, nodes: Sequence[int]) -> torch.Tensor:
        """What the network adds to the filter's R before its gate, [N, H, W]; arguments as for `filtered`.

        On CUDA it computes in half floats, unless it is trained.
        """
        a, x = self.arrays, inputs.features.flatten(1)
        kind = torch.float16 if x.is_cuda and not a["last"].requires_grad else torch.float32
        first = a["first"][:, :FEATURES] / a["spread"]
        bias = a["first_bias"] - first @ a["mean"]
        bias = bias + inputs.cosine * a["first"][:, FEATURES] + inputs.depth * a["first"][:, FEATURES + 2]
        # What is the same at each albedo is computed once.
        common = torch.addmm(bias[:, None].to(kind), first.to(kind), x.to(kind))
        second, second_bias, last = (a[name].to(kind) for name in ("second", "second_bias", "last"))
        found = []
        for node in nodes:
            h = F.silu(common + (10.0 * (ALBEDOS[node] - 0.9) * a["first"][:, FEATURES + 1, None]).to(kind))
            found.append(last @ F.silu(torch.addmm(second_bias[:, None], second, h)))
        added = torch.stack(found).float().reshape(filtered.shape) * (filtered + FAINT)
        # Half floats end where smoke is like none that was learned.
        return torch.nan_to_num(added, 0.0, 0.0, 0.0)

    def trust(self, inputs: Inputs) -> torch.Tensor:
        """Share of the correction that is taken of a light: 1 for smoke of a depth in the range of the training under a
        light from aside; 0 far from that range, and of a light that is behind the camera or before it, under which
        what is seen says least of how deep the smoke is."""
        low, high = self.arrays["range"]
        beyond = torch.maximum(low - inputs.depth, inputs.depth - high).clamp(min=0.0)
        aside = min(max((_ALONG - abs(inputs.cosine)) / (_ALONG - _ASIDE), 0.0), 1.0)
        return aside * (1.0 - beyond / _BEYOND).clamp(min=0.0)

    def share(
        self, inputs: Inputs, filtered: torch.Tensor, correction: torch.Tensor, nodes: Sequence[int]
    ) -> torch.Tensor:
        """What is taken of a correction at each albedo, [N]."""
        told = gating.facts(inputs, filtered, correction, [ALBEDOS[node] for node in nodes])
        return self.trust(inputs) * gating.gate(self.arrays, told)

    def multiple(
        self, inputs: Inputs, nodes: Sequence[int] = range(len(ALBEDOS)), *, network: bool = True
    ) -> torch.Tensor:
        """R at some of `ALBEDOS` by number, [N, H, W]."""
        filtered = self.filtered(inputs, nodes)
        if not network:
            return filtered
        correction = self.correction(inputs, filtered, nodes)
        share = self.share(inputs, filtered, correction, nodes)
        return (filtered + share[:, None, None] * correction).clamp(min=0.0)

    def light(self, inputs: Inputs, albedo: Sequence[float], *, network: bool = True) -> torch.Tensor:
        """All light of one light of irradiance 4 pi, [H, W, 3].

        Args:
            inputs: Of the light.
            albedo: R, G, B, 0 to 1.
            network: Whether the network corrects the filter.
        """
        shares = {value: _shares(value) for value in set(map(float, checked_albedo(albedo)))}
        nodes = sorted({node for share in shares.values() for node in share})
        multiple = dict(zip(nodes, self.multiple(inputs, nodes, network=network), strict=True))
        colours = {}
        for value, share in shares.items():
            colours[value] = all_light(inputs, value, sum(part * multiple[node] for node, part in share.items()))
        return torch.stack([colours[float(value)] for value in albedo], -1)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the model as `.npz`, atomically.

        Raises:
            WlmError: Another suffix, or it can't be written.
        """
        if Path(path).suffix.lower() != ".npz":
            raise WlmError(f"{path}: expected a name that ends in .npz")
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, **{name: array.cpu().numpy() for name, array in self.arrays.items()})


def _shares(albedo: float) -> dict[int, float]:
    """Of which of `ALBEDOS`, by number, an albedo is made, and how much of each."""
    at = min(max(albedo, ALBEDOS[0]), ALBEDOS[-1])
    after = int(np.searchsorted(ALBEDOS, at).clip(1, len(ALBEDOS) - 1))
    share = (at - ALBEDOS[after - 1]) / (ALBEDOS[after] - ALBEDOS[after - 1])
    return {node: part for node, part in ((after - 1, 1.0 - share), (after, share)) if part > 0.0}


def load_orders(path: str | os.PathLike[str] | None = None) -> OrdersModel:
    """Reads a model that `OrdersModel.save` wrote.

    Args:
        path: The file; None: the model that comes with wlm.

    Raises:
        WlmError: The file is missing, damaged or not such a model.
    """
    path = _SHIPPED if path is None else path
    arrays = read_npz(path, lambda names: list(_SHAPES), numbers=_MOST_NUMBERS)
    for name, shape in _SHAPES.items():
        array = arrays[name]
        if array.dtype != np.float32 or array.shape != shape or not np.isfinite(array).all():
            raise WlmError(f"{path}: {name}: expected finite float32 {shape}, found {array.dtype} {array.shape}")
    if not (arrays["spread"] > 0).all():
        raise WlmError(f"{path}: spread: expected numbers above 0")
    if not (arrays["gate_spread"] > 0).all():
        raise WlmError(f"{path}: gate_spread: expected numbers above 0")
    if not arrays["range"][0] < arrays["range"][1]:
        raise WlmError(f"{path}: range: expected the least depth before the greatest, found {arrays['range'].tolist()}")
    return OrdersModel({name: torch.from_numpy(array) for name, array in arrays.items()})


@dataclass(frozen=True, eq=False)
class ScatteredSmoke:
    """Smoke under lights, with light of all orders.

    Attributes:
        lit: Light scattered once.
        planes: float32 tensor [L, H, W, 3], all light of each light, of an irradiance or intensity of 4 pi.
    """

    lit: LitSmoke
    planes: torch.Tensor

    def shade(
        self, *, background: torch.Tensor | Sequence[float] | None = None, ramp: Ramp | None = None
    ) -> torch.Tensor:
        """The picture, float32 [H, W, 3], linear; arguments as for `LitSmoke.shade`."""
        return self.lit.compose(self.planes, background=background, ramp=ramp)


def scatter(
    volume: DensityVolume,
    camera: Camera,
    lights: Sequence[AnyLight],
    albedo: Sequence[float] = (1.0, 1.0, 1.0),
    *,
    march: March | None = None,
    model: OrdersModel | None = None,
    network: bool = True,
) -> ScatteredSmoke:
    """Smoke under its lights with light of all orders, predicted from marches.

    Args:
        volume: The smoke.
        camera: Any.
        lights: Any number. Each is predicted alone; a point light as if its rays were nearly parallel.
        albedo: R, G, B, the share of light that a scattering leaves, 0 to 1.
        march: Of the planes. With a g other than 0 light scattered once is that of its phase function, and what is
            scattered again that of smoke which scatters alike in all directions and is thinner by the share g^2 of
            what goes straight on (delta-Eddington: Joseph, Wiscombe and Weinman 1976); the farther g is from 0, the
            less exact. None: `orders_march`.
        model: None: the one that comes with wlm.
        network: Whether the network corrects the filter.

    Raises:
        ValueError: Not an albedo.
        WlmError: The model that comes with wlm can't be read.
    """
    colour = checked_albedo(albedo)
    march = orders_march(volume) if march is None else march
    model = (_shipped() if model is None else model).to(volume.device)
    with stream(device_name(volume.device)):
        lit = light_smoke(volume, camera, lights, march)
        even, alike, thinner = lit, volume, colour
        if march.g != 0.0:
            # What goes straight on is as if it hadn't been scattered.
            straight = max(march.g, 0.0) ** 2
            left = 1.0 - float(colour.mean()) * straight
            alike = replace(volume, extinction=volume.extinction * left)
            thinner = (colour * (1.0 - straight) / left).clip(0.0, 1.0)
            march = replace(march, g=0.0)
            even = light_smoke(alike, camera, lights, march)
        planes = torch.empty((*lit.planes.shape, 3), device=volume.device)
        make = input_maker(alike, even, ambient(alike, camera, march))
        for n, light in enumerate(lights):
            near = share_of(light, alike)
            if near < 1.0:
                planes[n] = model.light(make(n), thinner, network=network) / aim(light, volume)[1]
            if near > 0.0:
                diffused = _diffused(alike, even, light, n, thinner)
                planes[n] = diffused if near == 1.0 else torch.lerp(planes[n], diffused, near)
            if even is not lit:
                for channel in range(3):
                    once = colour[channel] * lit.planes[n] - thinner[channel] * even.planes[n]
                    planes[n, ..., channel] = (planes[n, ..., channel] + once).clamp(min=0.0)
        if volume.temperature is not None:
            values, places = _apart(thinner)
            with marching(alike, camera, march) as scene:
                thrown = thrown_by_fire(scene, alike, values)
            lit = replace(lit, thrown=torch.stack([thrown[place] for place in places], -1))
    return ScatteredSmoke(lit, planes)


def _diffused(
    volume: DensityVolume, lit: LitSmoke, light: PointLight, number: int, albedo: Sequence[float]
) -> torch.Tensor:
    """All light of a point light by diffusion, [H, W, 3]."""
    values, places = _apart(albedo)
    with marching(volume, lit.camera, lit.march) as scene:
        more = scattered_again(scene, volume, light, values)
    once = lit.planes[number]
    return torch.stack([value * once + more[place] for value, place in zip(albedo, places, strict=True)], -1)


def _apart(albedo: Sequence[float]) -> tuple[list[float], list[int]]:
    """The albedos of the channels, each once, and which of them each channel has."""
    values = sorted(set(map(float, albedo)))
    return values, [values.index(float(value)) for value in albedo]


@functools.cache
def _shipped() -> OrdersModel:
    return load_orders()
