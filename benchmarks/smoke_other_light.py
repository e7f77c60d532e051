"""Light of all orders where the learned mix has learned nothing: other phase functions, lights in smoke, and fire.

Rows of "phase functions" are of plumes under three lights, as those of `smoke_orders`, for several mean cosines g of
the Henyey-Greenstein phase function. Rows of "light in smoke" are of a plume and a cloud with a point light in the
middle of the smoke or at random in it, and of a burning plume without other light; PSNR is of pictures scaled to their
brightest, and the bias that of all light that reaches the camera.

A gain is the PSNR less that of light scattered once, of fire less that of its own light alone.
"""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from benchmarks.rows import Row
from benchmarks.runner import Bench
from benchmarks.smoke_light import make_cloud
from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import Camera
from wlm.smoke.shading import Light
from wlm.smoke.synthetic import make_plume
from wlm.smoke.transport.learning import draw_view, psnr
from wlm.smoke.transport.lights import PointLight
from wlm.smoke.transport.orders import orders_march, scatter
from wlm.smoke.transport.tracing import trace

PHASES, INSIDE = "phase functions", "light in smoke"
"""The tables of these rows."""

_SEED = 8  # of views that nothing was fitted to
_G = (-0.3, 0.3, 0.6, 0.8)
_ALBEDOS = (0.9, 1.0)
_VIEWS, _PIXELS, _SAMPLES = 6, 32, 512
_CELLS = 64
_EXTINCTIONS = (8.0, 30.0)
_BURNING, _GLOW = 20.0, 10.0  # extinction and emission of the fire
_FOUR_PI = 4.0 * math.pi


def other_rows(bench: Bench, *, views: int = _VIEWS, samples: int = _SAMPLES, cells: int = _CELLS) -> list[Row]:
    """The rows.

    Args:
        bench: The benchmark.
        views: Of each phase function.
        samples: Paths a pixel of a reference.
        cells: Voxels along an edge of smoke with light in it.
    """
    rows = []
    settings = {"pixels": _PIXELS, "samples": samples}
    for g in _G:
        bench.note(f"phase function of g {g:g}")
        for albedo in _ALBEDOS:
            values, once = np.array([_phase(bench.device, n, g, albedo, samples) for n in range(views)]).T
            figures = {"psnr": values.mean(), "psnr_min": values.min(), "gain": (values - once).mean()}
            option = f"g {g:g}, albedo {albedo:g}"
            rows.append(bench.row(PHASES, option, f"{views} pictures", scene="plumes", **figures, **settings))
    bench.note(INSIDE)
    for option, wanted, found, once in _inside(bench.device, samples, cells):
        scale = 1.0 / float(wanted.max())
        value, plain = (psnr(scale * picture, scale * wanted) for picture in (found, once))
        figures = {"psnr": value, "gain": value - plain, "bias": float(found.sum() / wanted.sum()) - 1.0}
        rows.append(bench.row(INSIDE, option, scene="plume and cloud", **figures, voxels=cells, **settings))
    return rows


def _phase(device: str, number: int, g: float, albedo: float, samples: int) -> tuple[float, float]:
    """PSNR of a picture of a plume under three lights, and of single scattering's."""
    volume, camera, ways = draw_view(_SEED, number, pixels=_PIXELS, lights=3)
    volume = replace(volume, density=volume.density.to(device))
    lights = [Light(way.toward, (_FOUR_PI / 3,) * 3) for way in ways]
    grey = (albedo,) * 3
    wanted = trace(volume, camera, lights, albedo=grey, g=g, samples=samples, orders=0, seed=number).total
    made = scatter(volume, camera, lights, grey, march=orders_march(volume, g))
    return psnr(made.shade(), wanted), psnr(made.lit.shade(albedo=grey), wanted)


def _inside(device: str, samples: int, cells: int) -> Iterator[tuple[str, torch.Tensor, torch.Tensor, torch.Tensor]]:
    """What is lit, traced, found, and found of light scattered once, [H, W]."""
    random = np.random.default_rng(_SEED)
    plume = make_plume(cells, seed=11, hot=False).density.to(device)
    for name, density in (("plume", plume), ("cloud", make_cloud(cells, device))):
        smoky = (np.argwhere(density.cpu().numpy() > 0.3) + 0.5) / cells
        for extinction in _EXTINCTIONS:
            volume = DensityVolume(density, extinction, 1.0 / cells)
            camera = Camera.around(volume, toward=random.normal(size=3), pixels=_PIXELS)
            for where, place in (("the middle", smoky.mean(0)), ("random", smoky[random.integers(len(smoky))])):
                lamp = PointLight(tuple(map(float, place)), (_FOUR_PI,) * 3, radius=0.05)
                wanted = trace(volume, camera, [lamp], samples=samples, orders=0).total[..., 0]
                made = scatter(volume, camera, [lamp])
                option = f"{name} of extinction {extinction:g}, light at {where}"
                yield option, wanted, made.shade()[..., 0], made.lit.shade()[..., 0]
    fire = replace(make_plume(cells, seed=4, hot=True, extinction=_BURNING, device=device), emission=_GLOW)
    camera = Camera.around(fire, toward=(0.3, 0.2, 1.0), pixels=_PIXELS)
    wanted = trace(fire, camera, [], albedo=(0.9,) * 3, samples=samples, orders=0).total[..., 0]
    made = scatter(fire, camera, [], (0.9,) * 3)
    yield f"fire of extinction {_BURNING:g}", wanted, made.shade()[..., 0], made.lit.emission
