"""What light of all orders is predicted from: light scattered once, and what diffusion makes of each light."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from wlm.fluid.volume import DensityVolume
from wlm.interop import to_warp
from wlm.smoke.camera import Camera, unit
from wlm.smoke.shading import Light
from wlm.smoke.transport.diffusion import Spreading
from wlm.smoke.transport.lighting import LitSmoke, light_in, marching
from wlm.smoke.transport.lights import AnyLight, PointLight
from wlm_kernels.smoke import orders
from wlm_kernels.smoke.orders import FEATURES, THINNEST
from wlm_kernels.smoke.settings import March

_STEPS = 130  # through the box, of a march for light of all orders
_NODES = 64  # gaps of its lattice through the box, at least
_SHORTEST = 0.25  # voxels: of a march in shorter steps nothing is left to gain


@dataclass(frozen=True, eq=False)
class Inputs:
    """What all light of L lights is predicted from, of irradiance 4 pi; that of point lights at the smoke's centre.

    Attributes:
        single: float32 tensor [L, H, W], S, light scattered once.
        opposite: float32 tensor [L, H, W], the same under lights from the opposite directions.
        diffused: float32 tensor [L, A, H, W], R by diffusion, light scattered more than once over an albedo's square.
        from_thin: float32 tensor [L, A, H, W], what thin smoke has in it.
        albedos: The A albedos.
        transparency: float32 tensor [H, W].
        thin: float32 tensor [H, W], opacity of thin smoke.
        cosines: Of the angles between the directions to the lights and to the camera.
        depth: float32 tensor [1], the logarithm of the smoke's mean optical depth along rays, weighed by opacity.
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

    def features(self, light: int) -> torch.Tensor:
        """What the weights of one light are for, float32 [A, FEATURES, H, W]."""
        size = (len(self.albedos), FEATURES, *self.transparency.shape)
        out = torch.empty(size, device=self.transparency.device)
        of_light = (part[light] for part in (self.single, self.opposite, self.diffused, self.from_thin))
        planes = (*of_light, self.transparency, self.thin)
        orders.features(*map(to_warp, planes), to_warp(out))
        return out

    def by_diffusion(self, albedo: float) -> torch.Tensor:
        """Light scattered once, and by diffusion what was scattered more often, at one of the albedos, [L, H, W]."""
        return albedo * self.single + albedo**2 * self.diffused[:, self.albedos.index(albedo)]

    def of(self, light: int) -> "Inputs":
        """Those of one light."""
        names = ("single", "opposite", "diffused", "from_thin")
        planes = {name: getattr(self, name)[light : light + 1] for name in names}
        return replace(self, **planes, cosines=self.cosines[light : light + 1])

    def at(self, albedo: float) -> "Inputs":
        """Those at one of the albedos."""
        n = self.albedos.index(albedo)
        planes = {name: getattr(self, name)[:, n : n + 1] for name in ("diffused", "from_thin")}
        return replace(self, **planes, albedos=(albedo,))


def orders_march(volume: DensityVolume, g: float = 0.0) -> March:
    """The march whose planes light of all orders is made of: in steps of a 130th of the smoke's longest edge, but of no
    less than a quarter of a voxel, and with a lattice whose nodes are as far apart, but at least a voxel or, on small
    grids, a 64th of the edge: more of them take far more time, and bring a tenth of a decibel."""
    edge = max(volume.shape)
    step = max(_SHORTEST, edge / _STEPS)
    return March(step=step, spacing=max(min(1.0, edge / _NODES), step), jitter=0.0, g=g)


def make_inputs(
    volume: DensityVolume, camera: Camera, lights: Sequence[AnyLight], albedos: Sequence[float], march: March
) -> tuple[LitSmoke, Inputs]:
    """Marches to lights and spreads their light, inside `wlm.interop.stream`.

    Args:
        volume: The smoke.
        camera: Any.
        lights: Any number.
        albedos: Any number.
        march: Of a g of 0.

    Returns:
        The smoke under light scattered once, and the inputs.
    """
    ways = [aim(light, volume) for light in lights]
    with marching(volume, camera, march) as scene:
        spreading = Spreading(scene, volume, lights)
        lit = light_in(scene, volume, camera, lights, spreading.add)
        diffused, thin = spreading.seen(albedos)
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
    # At least that of a tenth of a pixel's smoke.
    mean = (thickness * opacity).sum() / opacity.sum().clamp(min=0.1)
    cosines = tuple(float(camera.axes[2] @ toward) for toward, _ in ways)
    depth = mean.clamp(min=1e-3).log().reshape(1)
    return lit, Inputs(single, opposite, *diffused, tuple(albedos), lit.transparency, thin, cosines, depth)


def aim(light: AnyLight, volume: DensityVolume) -> tuple[np.ndarray, float]:
    """The direction to a light from the smoke's centre, and what gives its plane the irradiance 4 pi there."""
    if isinstance(light, Light):
        return unit(light.toward), 1.0
    way = np.asarray(light.position, np.float64) - volume.centre
    length = float(np.linalg.norm(way))
    least = 0.5 * volume.voxel * max(volume.shape)
    return way / length if length > 0 else np.array([0.0, 1.0, 0.0]), max(length, least) ** 2
