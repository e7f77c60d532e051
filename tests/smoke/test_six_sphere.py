"""Six-way lightmaps by least squares over the sphere."""

import numpy as np
import torch
from builders.smoke_plumes import facing, plume

from wlm.fluid.volume import from_array
from wlm.smoke.camera import weights
from wlm.smoke.march.six_way import bake
from wlm.smoke.shading import Light, half_sphere
from wlm.smoke.transport.lighting import light_smoke
from wlm.smoke.transport.orders import scatter
from wlm.smoke.transport.sphere import bake_sphere
from wlm_kernels.smoke.settings import March


def lights(count: int = 12) -> list[Light]:
    ways = np.random.default_rng(5).normal(size=(count, 3))
    return [Light(tuple(map(float, way))) for way in ways]


def rms(six, lamps: list[Light], exact: torch.Tensor) -> float:
    """Returns the relative RMS error of pictures under each light."""
    shaded = torch.stack([six.shade([lamp])[..., 0] for lamp in lamps])
    return float(((shaded - exact).square().mean() / exact.square().mean()).sqrt())


def test_random_lights_are_nearer_than_by_the_axes(device: str):
    volume = plume(device=device)
    camera, lamps = facing(volume, (0.3, 0.2, 1.0), size=12), lights()
    exact = light_smoke(volume, camera, lamps).planes
    made = bake_sphere(volume, camera)
    assert rms(made, lamps, exact) < 0.92 * rms(bake(volume, camera, step=1.0, estimate=False), lamps, exact)
    assert (made.lightmaps >= 0).all() and made.lightmaps.any()
    # No other maps of at least 0 are nearer to the lights that they are fitted to.
    ways = half_sphere(16)
    weigh = torch.tensor(np.concatenate([weights(ways), weights(-ways)]), dtype=torch.float32, device=device)
    fitted = [Light(tuple(map(float, way @ camera.axes))) for way in ways]
    lit = light_smoke(volume, camera, fitted, March(step=1.0, jitter=0.0))
    planes = torch.cat([lit.planes, lit.opposite])

    def error(maps: torch.Tensor) -> torch.Tensor:
        return (torch.einsum("lp,phw->lhw", weigh, maps) - planes).square().sum()

    least = error(made.lightmaps)
    for index in range(6):
        for change in (0.9, 1.1):
            other = made.lightmaps.clone()
            other[index] *= change
            assert error(other) > least


def test_of_all_orders(device: str):
    volume = plume(device=device)
    camera, lamps = facing(volume, size=12), lights(4)
    exact = scatter(volume, camera, lamps, (0.9,) * 3).planes[..., 0]
    made = bake_sphere(volume, camera, lights=12, albedo=0.9)
    once = bake_sphere(volume, camera, lights=12)
    assert rms(made, lamps, exact) < 0.35 < 0.45 < rms(once, lamps, exact)
    assert not bake_sphere(from_array(np.zeros((4, 4, 4)), device=device), camera, lights=12).lightmaps.any()
