"""Six-way lightmaps with the least error for lights from any direction, instead of no error along the six axes.

A least squares fit over lights from all directions minimises the error for a random light, at the cost of an error
along the axes.
"""

import numpy as np
import torch

from wlm.fluid.volume import DensityVolume
from wlm.interop import device_name, stream
from wlm.smoke.camera import Camera, weights
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.shading import Light, half_sphere
from wlm.smoke.transport.lighting import light_smoke
from wlm.smoke.transport.orders import orders_march, scatter
from wlm_kernels.smoke.settings import March

_ROUNDS = 100  # iterations of the non-negative descent, after which it is within 1e-4 of the optimum


def bake_sphere(
    volume: DensityVolume, camera: Camera, *, lights: int = 32, march: March | None = None, albedo: float | None = None
) -> SixWay:
    """Computes the lightmaps with the least squared error over lights spread over the sphere.

    Args:
        volume: The smoke.
        camera: Orthographic.
        lights: Number of directions of the fit, even and at least 12.
        march: Settings of the marches; None: steps of a voxel without jitter, or `orders_march` if there is an albedo.
        albedo: None: light scattered once, of albedo 1, as in other lightmaps. A number of 0 to 1: light of all orders
            at this albedo, predicted by `scatter`.

    Returns:
        The lightmaps on the smoke's device, not negative, with transparency, depth and the emission of hot smoke.

    Raises:
        ValueError: The camera is in perspective, or the number of lights or the albedo is wrong.
    """
    if camera.perspective:
        raise ValueError("camera: expected an orthographic camera for six-way lightmaps, got a perspective camera")
    if lights < 12 or lights % 2:
        raise ValueError(f"lights: expected an even number of at least 12, got {lights}")
    if march is None:
        march = March(step=1.0, jitter=0.0) if albedo is None else orders_march(volume)
    ways = half_sphere(lights // 2)
    lamps = [Light(tuple(map(float, way @ camera.axes))) for way in ways]
    both = torch.tensor(np.stack([weights(ways), weights(-ways)]), dtype=torch.float32, device=volume.device)
    with stream(device_name(volume.device)):
        if albedo is None:
            lit = light_smoke(volume, camera, lamps, march)
            sums = _sums(both[0], lit.planes) + _sums(both[1], lit.opposite)
        else:
            opposite = [Light(tuple(-c for c in lamp.toward)) for lamp in lamps]
            grey = (albedo,) * 3
            made, back = (scatter(volume, camera, each, grey, march=march) for each in (lamps, opposite))
            lit, sums = made.lit, _sums(both[0], made.planes[..., 0]) + _sums(both[1], back.planes[..., 0])
        maps = _not_negative(both.flatten(0, 1).T @ both.flatten(0, 1), sums)
    return SixWay(maps, lit.transparency, lit.emission, camera, lit.depth, method="march, best for all sides")


def _sums(weigh: torch.Tensor, planes: torch.Tensor) -> torch.Tensor:
    return torch.einsum("lp,lhw->phw", weigh, planes)


def _not_negative(gram: torch.Tensor, sums: torch.Tensor) -> torch.Tensor:
    """Solves non-negative least squares per pixel, with normal equations [6, 6] and right-hand sides [6, H, W]."""
    step = 1.0 / float(torch.linalg.eigvalsh(gram.double())[-1])
    right = sums.flatten(1)
    maps = torch.linalg.solve(gram, right).clamp(min=0.0)
    ahead, momentum = maps, 1.0
    for _ in range(_ROUNDS):
        following = (ahead - step * (gram @ ahead - right)).clamp(min=0.0)
        grown = 0.5 * (1.0 + (1.0 + 4.0 * momentum**2) ** 0.5)
        ahead, maps, momentum = following + (momentum - 1.0) / grown * (following - maps), following, grown
    return maps.reshape(sums.shape)
