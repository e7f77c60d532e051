"""Light of all orders from light scattered once: a filter of planes at several scales, and a network that corrects it.

Light that is scattered on spreads through the smoke and comes out blurred. So the planes that a march makes anyway say
most of it: light of the light itself, of the opposite one, from all around, and opacity. They are blurred at scales of
the smoke's box (never of pixels: a filter holds for any image), shifted along the light, and mixed linearly, with
weights that depend on the angle between light and camera and were found by least squares against path tracing. What is
left a small network predicts from the same planes, pixel by pixel; gates say how much of its correction is taken.

Of an albedo a all light is a S + a^2 R(a), where S was scattered once and R more often. The filter predicts R at the
albedos of `samples.ALBEDOS`, between which it is linear.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume
from wlm.formats.atomic import atomic_path
from wlm.formats.npz import read_npz
from wlm.smoke.camera import Camera, unit
from wlm.smoke.shading import Light, Ramp
from wlm.smoke.transport.lighting import LitSmoke, light_smoke
from wlm.smoke.transport.lights import AnyLight, PointLight, checked_albedo
from wlm.smoke.transport.samples import ALBEDOS
from wlm_kernels.smoke.settings import March

COARSE = March(step=1.0, jitter=0.0)
"""The march whose planes the filter was fitted to."""

SCALES = (0.0, 1 / 64, 1 / 32, 1 / 16, 1 / 8)
"""Standard deviations of blurs, in edges of the smoke's box."""

BASES = 9
SHIFTED = (0, 3, 5)  # of the bases: light, opacity, optical depth
FEATURES = 2 * (BASES * len(SCALES) + len(SHIFTED) * (len(SCALES) - 1))
HIDDEN = 48
ANGLES = 3  # powers of the cosine between light and camera
CONDITIONS = 3  # that the network has besides the features: that cosine, the albedo, the optical depth
FAINT = 0.03
"""Light below which an error counts the same."""

_BRIGHTEST = 6.0  # light of all orders over opacity: a white surface under irradiance 4 pi has 4
_THINNEST = 1e-4  # transparency below which depths count the same
_SHIPPED = Path(__file__).resolve().parents[2] / "data" / "smoke-orders.npz"
_BEYOND = 0.5  # of the logarithm of optical depth beyond training over which a correction fades
_SHAPES = {
    "weights": (len(ALBEDOS), FEATURES * ANGLES),
    "mean": (FEATURES,),
    "spread": (FEATURES,),
    "gates": (len(ALBEDOS),),
    "range": (2,),
    "first": (HIDDEN, FEATURES + CONDITIONS),
    "first_bias": (HIDDEN,),
    "second": (HIDDEN, HIDDEN),
    "second_bias": (HIDDEN,),
    "last": (HIDDEN,),
}
_MOST_NUMBERS = 1 << 20


def blur(planes: torch.Tensor, sigma: float) -> torch.Tensor:
    """Blurs planes [C, H, W] by a Gaussian of a standard deviation in pixels; outside the image they are 0."""
    if sigma < 0.3:
        return planes
    height, width = planes.shape[-2:]
    # A wide one at a lower resolution.
    most = max(planes.shape[-2:])
    factor = 1 << min(max(int(math.log2(sigma)) - 1, 0), most.bit_length())
    small = planes[None]
    if factor > 1:
        small = F.avg_pool2d(F.pad(small, (0, -width % factor, 0, -height % factor)), factor)
        sigma = math.sqrt(max(sigma**2 - (factor**2 - 1) / 12.0, 0.0)) / factor
    reach = max(math.ceil(3.0 * sigma), 1)
    # Of a blur far wider than the image only the middle of the kernel meets it.
    near = min(reach, max(small.shape[-2:]))
    kernel = torch.exp(-0.5 * (torch.arange(-near, near + 1, device=planes.device) / sigma) ** 2)
    kernel = (kernel / (kernel.sum() if near == reach else sigma * math.sqrt(2.0 * math.pi))).to(planes)
    reach = near
    small = F.conv2d(small.transpose(0, 1), kernel.reshape(1, 1, 1, -1), padding=(0, reach))
    small = F.conv2d(small, kernel.reshape(1, 1, -1, 1), padding=(reach, 0)).transpose(0, 1)
    if factor > 1:
        size = (small.shape[-2] * factor, small.shape[-1] * factor)
        small = F.interpolate(small, size=size, mode="bilinear", align_corners=False)[..., :height, :width]
    return small[0]


def shift(planes: torch.Tensor, right: float, down: float) -> torch.Tensor:
    """Planes [C, H, W] as they are so many pixels to the right and below."""
    height, width = planes.shape[-2:]
    rows = (torch.arange(height, device=planes.device) + 0.5 + down) / height * 2.0 - 1.0
    columns = (torch.arange(width, device=planes.device) + 0.5 + right) / width * 2.0 - 1.0
    grid = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)[None].to(planes)
    return F.grid_sample(planes[None], grid, align_corners=False)[0]


@dataclass(frozen=True, eq=False)
class Inputs:
    """What all light of one light is predicted from; H x W pixels.

    Attributes:
        single: float32 tensor [H, W], S, light scattered once.
        features: float32 tensor [FEATURES, H, W].
        opacity: float32 tensor [H, W].
        cosine: Of the angle between the directions to the light and to the camera.
        depth: Logarithm of the smoke's mean optical depth along rays, weighed by opacity.
    """

    single: torch.Tensor
    features: torch.Tensor
    opacity: torch.Tensor
    cosine: float
    depth: float


@dataclass(frozen=True, eq=False)
class OrdersModel:
    """A filter and its network, as they are in a file.

    Attributes:
        arrays: By name float32 tensors: "weights" of the filter, "first" and so on of the network, "mean" and "spread"
            of its inputs, the "range" of the depths that it was trained on, and its "gates", 0 to 1 for each albedo.
    """

    arrays: dict[str, torch.Tensor]

    def to(self, device: torch.device | str) -> "OrdersModel":
        """The same on a device."""
        return OrdersModel({name: array.to(device) for name, array in self.arrays.items()})

    def filtered(self, inputs: Inputs) -> torch.Tensor:
        """R at each of `ALBEDOS` by the filter alone, [A, H, W]."""
        powers = torch.tensor([inputs.cosine**n for n in range(ANGLES)]).to(inputs.features)
        weights = (self.arrays["weights"].reshape(len(ALBEDOS), ANGLES, FEATURES) * powers[:, None]).sum(1)
        return torch.einsum("af,fhw->ahw", weights, inputs.features).clamp(min=0.0)

    def correction(self, inputs: Inputs, filtered: torch.Tensor, node: int) -> torch.Tensor:
        """What the network adds to R at one of `ALBEDOS` before its gate, [H, W]."""
        a = self.arrays
        x = (inputs.features - a["mean"][:, None, None]) / a["spread"][:, None, None]
        conditions = torch.tensor([inputs.cosine, 10.0 * (ALBEDOS[node] - 0.9), inputs.depth]).to(x)
        bias = a["first_bias"] + a["first"][:, FEATURES:] @ conditions
        h = F.silu(torch.einsum("of,fhw->ohw", a["first"][:, :FEATURES], x) + bias[:, None, None])
        h = F.silu(torch.einsum("of,fhw->ohw", a["second"], h) + a["second_bias"][:, None, None])
        return torch.einsum("f,fhw->hw", a["last"], h) * (filtered + FAINT)

    def trust(self, inputs: Inputs) -> float:
        """Share of the correction that is taken for smoke of a depth: 1 in the range of the training, 0 far from it."""
        low, high = self.arrays["range"].tolist()
        return min(max(1.0 - max(low - inputs.depth, inputs.depth - high, 0.0) / _BEYOND, 0.0), 1.0)

    def multiple(self, inputs: Inputs, *, network: bool = True) -> torch.Tensor:
        """R at each of `ALBEDOS`, [A, H, W]."""
        filtered = self.filtered(inputs)
        trust = self.trust(inputs) if network else 0.0
        if trust == 0.0:
            return filtered
        planes = []
        for node, plane in enumerate(filtered):
            gate = trust * float(self.arrays["gates"][node])
            planes.append(plane + gate * self.correction(inputs, plane, node) if gate > 0.0 else plane)
        return torch.stack(planes).clamp(min=0.0)

    def light(self, inputs: Inputs, albedo: Sequence[float], *, network: bool = True) -> torch.Tensor:
        """All light of one light of irradiance 4 pi, [H, W, 3].

        Args:
            inputs: Of the light.
            albedo: R, G, B, 0 to 1.
            network: Whether the network corrects the filter.
        """
        multiple = self.multiple(inputs, network=network)
        nodes = np.asarray(ALBEDOS)
        colours = {}
        for value in set(map(float, checked_albedo(albedo))):
            at = min(max(value, nodes[0]), nodes[-1])
            after = int(np.searchsorted(nodes, at).clip(1, len(nodes) - 1))
            share = float((at - nodes[after - 1]) / (nodes[after] - nodes[after - 1]))
            more = torch.lerp(multiple[after - 1], multiple[after], share)
            total = value * inputs.single + value**2 * more
            colours[value] = torch.minimum(total, _BRIGHTEST * inputs.opacity)
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
    if not ((arrays["gates"] >= 0) & (arrays["gates"] <= 1)).all():
        raise WlmError(f"{path}: gates: expected numbers of 0 to 1")
    return OrdersModel({name: torch.from_numpy(array) for name, array in arrays.items()})


def ambient(volume: DensityVolume, camera: Camera, march: March = COARSE) -> torch.Tensor:
    """Light from all around, scattered once: the mean under lights along the camera's six axes, [H, W]."""
    lit = light_smoke(volume, camera, [Light(tuple(map(float, axis))) for axis in camera.axes], march)
    return (lit.planes + lit.opposite).mean(0) * 0.5


def make_inputs(volume: DensityVolume, lit: LitSmoke, around: torch.Tensor) -> list[Inputs]:
    """The filter's inputs for each light of irradiance 4 pi; of a point light that at the smoke's centre.

    Args:
        volume: The smoke.
        lit: It under its lights.
        around: Of `ambient`.
    """
    camera = lit.camera
    edge = volume.voxel * max(volume.shape)
    pitch = camera.pitch
    if camera.perspective:
        away = float(np.linalg.norm(np.asarray(camera.position) - volume.centre))
        pitch *= max(away, 0.5 * edge)
    opacity = 1.0 - lit.transparency
    thickness = -torch.log(lit.transparency.clamp(min=_THINNEST))
    # At least that of a tenth of a pixel's smoke.
    depth = math.log(max(float((thickness * opacity).sum() / opacity.sum().clamp(min=0.1)), 1e-3))
    made = []
    for n, light in enumerate(lit.lights):
        toward, factor = aim(light, volume)
        across, rise, cosine = camera.axes @ toward
        single, opposite = factor * lit.planes[n], factor * lit.opposite[n]
        if isinstance(light, PointLight):
            opposite = light_smoke(volume, camera, [Light(tuple(-toward))], lit.march).planes[0]
        bases = [single, opposite, around, opacity, opacity**2, thickness / 9.0]
        bases += [single**2, single * opacity, single.sqrt()]
        stacked, planes = torch.stack(bases), []
        for scale in SCALES:
            pixels = scale * edge / pitch
            blurred = blur(stacked, pixels)
            planes.append(blurred)
            if scale > 0:
                planes.append(shift(blurred[list(SHIFTED)], -pixels * float(across), pixels * float(rise)))
        features = torch.cat(planes)
        features = torch.cat([features, features * opacity])
        made.append(Inputs(single, features, opacity, float(cosine), depth))
    return made


def aim(light: AnyLight, volume: DensityVolume) -> tuple[np.ndarray, float]:
    """The direction to a light from the smoke's centre, and what gives its plane the irradiance 4 pi there."""
    if isinstance(light, Light):
        return unit(light.toward), 1.0
    way = np.asarray(light.position, np.float64) - volume.centre
    length = float(np.linalg.norm(way))
    least = 0.5 * volume.voxel * max(volume.shape)
    return way / length if length > 0 else np.array([0.0, 1.0, 0.0]), max(length, least) ** 2


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
    march: March = COARSE,
    model: OrdersModel | None = None,
    network: bool = True,
) -> ScatteredSmoke:
    """Smoke under its lights with light of all orders, predicted from marches.

    Args:
        volume: The smoke.
        camera: Any.
        lights: Any number. Each is predicted alone; a point light as if its rays were nearly parallel.
        albedo: R, G, B, the share of light that a scattering leaves, 0 to 1.
        march: Of the planes; its g must be 0, of which the model was fitted.
        model: None: the one that comes with wlm.
        network: Whether the network corrects the filter.

    Raises:
        ValueError: The march's g isn't 0, or not an albedo.
        WlmError: The model that comes with wlm can't be read.
    """
    if march.g != 0.0:
        raise ValueError(f"g: expected 0 for light of all orders, got {march.g}")
    checked_albedo(albedo)
    model = (load_orders() if model is None else model).to(volume.device)
    lit = light_smoke(volume, camera, lights, march)
    planes = torch.zeros((*lit.planes.shape, 3), device=volume.device)
    for n, inputs in enumerate(make_inputs(volume, lit, ambient(volume, camera, march))):
        planes[n] = model.light(inputs, albedo, network=network) / aim(lights[n], volume)[1]
    return ScatteredSmoke(lit, planes)
