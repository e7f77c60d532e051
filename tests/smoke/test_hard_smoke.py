"""Every march with extreme input: no smoke, opaque smoke, one voxel, NaN, and a camera inside or turned away."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from builders.smoke_plumes import facing

from benchmarks.smoke_tracing import trace
from demos.plume import make_plume
from wlm.fluid.volume import DensityVolume, from_array
from wlm.smoke.camera import Camera
from wlm.smoke.march.six_way import bake, bake_coarse, guide
from wlm.smoke.shading import Light, PointLight
from wlm.smoke.transport.lighting import light_smoke
from wlm.smoke.transport.orders import scatter
from wlm_kernels.smoke.settings import March

STEPS = March(2.0, jitter=0.0, threshold=1e-6)
MARCHES = {
    "bake": lambda volume, camera: bake(volume, camera, step=0.25),
    "march": lambda volume, camera: bake_coarse(volume, camera, STEPS),
    "march in bricks": lambda volume, camera: bake_coarse(volume, camera, March(0.25, jitter=0.0)),
    "guide": lambda volume, camera: guide(volume, camera, STEPS),
}
CLEAR = ("empty", "not a number", "away", "beside")


def _case(name: str, dtype: type, device: str) -> tuple[DensityVolume, Camera]:
    density, extinction = np.ones((6, 6, 6), dtype), 1.0
    if name == "empty":
        density[:] = 0
    elif name == "opaque":
        extinction = 1e6
    elif name == "one voxel":
        density = density[:1, :1, :1]
    elif name == "not a number":
        density[:] = np.nan
    volume = from_array(density, extinction=extinction, device=device)
    distance = {"away": -30.0, "inside": 0.1}.get(name, 30.0)
    eye = volume.centre + [500.0 if name == "beside" else 0.0, 0.0, distance]
    target = eye - [0.0, 0.0, 1.0]
    return volume, Camera.look_at(eye, target, extent=2.25, height=9, width=9)


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
@pytest.mark.parametrize("name", [*CLEAR, "opaque", "one voxel", "inside"])
@pytest.mark.parametrize("way", MARCHES)
def test_hard_smoke(device: str, way: str, name: str, dtype: type):
    volume, camera = _case(name, dtype, device)
    assert len(volume.warnings) == (name == "not a number")
    result = MARCHES[way](volume, camera)
    light = result.light[None] if way == "guide" else result.lightmaps
    clear, centre = result.transparency, result.transparency[4, 4].item()
    most = 2.5 if way == "guide" else 1.0
    assert torch.isfinite(light).all() and light.min() >= 0 and light.max() <= most
    assert clear.min() >= 0 and clear.max() <= 1
    if way == "bake":
        assert np.isfinite(result.error.rms) and (result.error.rms == 0 or name not in CLEAR)
    else:
        assert torch.isfinite(result.depth).all() and (result.depth > 0).any() == (name not in CLEAR)
    if name in CLEAR:
        assert not light.any() and (clear == 1).all()
    elif name == "opaque":
        assert centre < 1e-4
        if way != "guide":
            # A wall is lit from the front alone.
            assert result["front"][4, 4].item() == pytest.approx(0.5, abs=1e-3)
            assert way == "march" or light[[0, 1, 2, 3, 5], 4, 4].max() < 1e-3
    elif name == "one voxel":
        # Tent functions: the integral of the density along the middle is that of one voxel.
        if "guide" != way != "march":
            assert centre == pytest.approx(np.exp(-1.0), rel=0.02)
            assert result["front"][4, 4].item() == pytest.approx(-np.expm1(-2.0) / 2, rel=0.02)
        assert way == "bake" or 29 < result.depth[4, 4].item() < 31
    else:
        assert centre < 0.9 and light[:, 4, 4].max() > 0.05


WHITE = (1.0, 1.0, 1.0)
PICTURES = {
    "trace": lambda *smoke, albedo=WHITE: trace(*smoke, albedo=albedo, samples=64).total,
    "march": lambda *smoke, albedo=WHITE: light_smoke(*smoke).shade(albedo=albedo),
    "orders": lambda *smoke, albedo=WHITE: scatter(*smoke, albedo).shade(),
}


@pytest.mark.parametrize("way", PICTURES)
def test_pictures_of_hard_smoke(device: str, way: str):
    """No smoke and black smoke scatter nothing; opaque smoke, one voxel and smoke around the camera finite light."""
    picture, lights = PICTURES[way], [Light(WHITE), PointLight((0.5, 0.5, 0.4), radius=0.1)]
    fire = make_plume(10, extinction=10.0, device=device)
    smoke, camera = replace(fire, temperature=None), facing(fire, size=6)
    assert not picture(replace(smoke, density=torch.zeros_like(smoke.density)), camera, lights).any()
    assert not picture(smoke, camera, lights, albedo=(0.0, 0.0, 0.0)).any()
    within = Camera.look_at((0.5, 0.5, 0.5), (0.5, 0.5, 0.0), extent=1.0, height=6, width=6, perspective=True)
    voxel = from_array(np.ones((1, 1, 1)), device=device)
    seen = ((replace(smoke, extinction=1000.0), camera), (voxel, facing(voxel, size=6)), (smoke, within))
    for made in (*(picture(*each, lights) for each in seen), picture(fire, camera, [])):
        assert torch.isfinite(made).all() and (made >= 0).all() and made.any()
