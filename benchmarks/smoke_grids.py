"""What the learned mix of light of all orders adds to diffusion, on grids of every size: on no light should it take.

Each row of "gain by grid" is of one grid: plumes and clouds that it hasn't learned from, of extinctions in and out of
the training's, under single lights, from any side. A gain is the mix's PSNR less that of single scattering and
diffusion, which are its input, in sRGB against path tracing, of one light at one albedo.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from benchmarks.rows import Row
from benchmarks.runner import Bench
from benchmarks.smoke_light import make_cloud
from wlm.fluid.volume import DensityVolume
from wlm.interop import stream
from wlm.smoke.camera import Camera
from wlm.smoke.shading import Light
from wlm.smoke.synthetic import make_plume
from wlm.smoke.transport.learning import psnr
from wlm.smoke.transport.orders import OrdersModel, load_orders, make_inputs, orders_march
from wlm.smoke.transport.tracing import trace

METHOD = "gain by grid"
"""The table of these rows."""

_ALBEDOS = (0.9, 1.0)
_PLUMES, _CLOUDS = (11, 12), (0, 5)  # seeds
_DRAWN = 128  # voxels of a plume, which is resampled to more
_LIGHTS = 3
_ORDERS = 40


@dataclass(frozen=True)
class GridSizes:
    """Grids, pictures and samples.

    Attributes:
        grids: Voxels along an edge.
        extinctions: Of density 1, over the box's edge.
        pixels: H and W.
        samples: Paths a pixel of a reference.
    """

    grids: tuple[int, ...]
    extinctions: tuple[float, ...]
    pixels: int
    samples: int


def grid_rows(bench: Bench, sizes: GridSizes, model: OrdersModel | None = None) -> list[Row]:
    """The rows.

    Args:
        bench: The benchmark.
        sizes: What is measured.
        model: None: the one that comes with wlm.
    """
    model = (load_orders() if model is None else model).to(bench.device)
    rows = []
    for cells in sizes.grids:
        bench.note(f"grid of {cells}^3")
        diffused, mixed = (np.array(part) for part in zip(*_scores(bench.device, sizes, cells, model), strict=True))
        gains = mixed - diffused
        figures = {"psnr": mixed.mean(), "psnr_min": mixed.min(), "gain": gains.mean(), "gain_min": gains.min()}
        note = f"{len(gains)} lights, gains within {np.quantile(gains, 0.05):+.3f} and {gains.max():+.3f} dB"
        settings = {"voxels": cells, "pixels": sizes.pixels, "samples": sizes.samples}
        rows.append(bench.row(METHOD, f"{cells} voxels", note, scene="single lights", **figures, **settings))
    return rows


def _scores(device: str, sizes: GridSizes, cells: int, model: OrdersModel) -> Iterator[tuple[float, float]]:
    """Of each light at each albedo the PSNR of diffusion and of the mix."""
    for number, (density, extinction) in enumerate(_smoke(device, sizes, cells)):
        random = np.random.default_rng([cells, number])
        volume = DensityVolume(density, extinction, 1.0 / cells)
        camera = Camera.around(volume, toward=random.normal(size=3), pixels=sizes.pixels)
        lights = [Light(tuple(map(float, random.normal(size=3)))) for _ in range(_LIGHTS)]
        traced = trace(volume, camera, lights, samples=sizes.samples, orders=_ORDERS, seed=number)
        with stream(device):
            _, inputs = make_inputs(volume, camera, lights, _ALBEDOS, orders_march(volume))
            for albedo in _ALBEDOS:
                diffused = inputs.by_diffusion(albedo)
                mixed = model.light(inputs.at(albedo), (albedo,) * 3)[..., 0]
                truth = (traced if albedo == 1.0 else traced.with_albedo((albedo,) * 3)).planes.sum(1)[..., 0]
                for one, other, wanted in zip(diffused, mixed, truth, strict=True):
                    yield psnr(one, wanted), psnr(other, wanted)


def _smoke(device: str, sizes: GridSizes, cells: int) -> Iterator[tuple[torch.Tensor, float]]:
    """Densities [X, Y, Z] and extinctions."""
    for seed in _PLUMES:
        drawn = make_plume(min(cells, _DRAWN), seed=seed, hot=False).density.to(device)
        size = (cells,) * 3
        density = torch.nn.functional.interpolate(drawn[None, None], size, mode="trilinear")[0, 0].contiguous()
        yield from ((density, extinction) for extinction in sizes.extinctions)
    for seed in _CLOUDS:
        density = make_cloud(cells, device, seed)
        yield from ((density, extinction) for extinction in sizes.extinctions)
