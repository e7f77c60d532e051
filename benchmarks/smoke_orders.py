"""Multiple scattering ("all orders") in smoke: our method and its rivals against path tracing, with times per picture.

The scenes, each with two albedos:

- "plumes": plumes and clouds that were not used in training, from random directions, each under three directional
  lights of random colours.
- "jet": a simulated jet past a sphere from several cameras, two frames from each to measure flicker.

The options of method "all orders"; PSNR and FLIP of a picture are in sRGB, against path tracing with many samples:

- "single scattering", and "single x gain", which multiplies it by one factor;
- "three octaves" (Wrenninge) and "fitted octaves", fifteen of them;
- "fitted filter", a linear filter of planes blurred at four scales;
- "1 sample, denoised": our path tracer and Open Image Denoise, only with the extra `bake`;
- "diffusion", the sum of diffusion on a grid of 32^3 cells and single scattering;
- "learned mix", a sum of these two with learned weights, the result of `wlm.smoke.transport.scatter`.

The gain and the weights of the fitted octaves and of the fitted filter are fitted to the references of the score
itself: weights fitted to other smoke could not score higher. A reference is the mean of two pictures that are traced
independently; the row "path tracing" is its noise, estimated from their difference. Flicker is the RMS change from
one frame to the next where smoke is visible, after the earlier picture is warped by the motion of the smoke, and its
ratio to the references' change, which is a mean product of the changes of their two pictures, so that noise cancels.

Method "gain by grid" has one row for each grid: plumes and clouds that the mix was not trained on, with extinctions
inside and outside the range of the training, under single lights, from random sides. The gain is the PSNR of the mix
minus the PSNR of single scattering plus diffusion, for one light at one albedo.

Methods "phase functions" and "light in smoke" measure cases that the mix was not trained on: several mean cosines g of
the Henyey-Greenstein phase function; and a point light in the middle or at a random point of a plume and of a cloud,
and a burning plume without another light. The PSNR of "light in smoke" is of pictures scaled to their maximum, and the
bias is that of all light that reaches the camera. A gain is the PSNR of the mix minus that of single scattering, or
for fire minus that of its emission alone.

A time is that of a whole picture, from the smoke to the shaded image. On CUDA it is the replay of one graph, except for
the path tracer with the denoiser.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
import torch.nn.functional as F

from benchmarks.path_tracer import denoised_picture, denoiser_device, has_denoiser
from benchmarks.rivals.smoke_orders import diffused, filter_planes, octaves, three_octaves
from benchmarks.rows import Row
from benchmarks.runner import Bench, Note
from benchmarks.smoke import make_cloud
from benchmarks.smoke_learning import FAINT, at, draw_view, psnr
from benchmarks.smoke_tracing import Transport, trace
from benchmarks.timing import Timing
from demos.plume import make_plume
from wlm.fluid.volume import DensityVolume
from wlm.interop import stream
from wlm.metrics import flip_display
from wlm.smoke.camera import Camera, unit
from wlm.smoke.march.motion import motion
from wlm.smoke.network.losses import warp
from wlm.smoke.network.planes import to_srgb
from wlm.smoke.scene import load_scene
from wlm.smoke.shading import Light, PointLight
from wlm.smoke.simulation import advance, make_solver, volume_of
from wlm.smoke.transport.lighting import LitSmoke, light_smoke
from wlm.smoke.transport.orders import OrdersModel, load_orders, make_inputs, orders_march, scatter

METHOD, GRIDS, PHASES, INSIDE = "all orders", "gain by grid", "phase functions", "light in smoke"
"""The tables of the rows."""

ALBEDOS = (0.9, 1.0)

_SEED = 8  # seed of views that are not in the training
_LIGHTS = 3
_POWERS = 3  # powers of the cosine between light and camera in the fit of octaves
_FOUR_PI = 4.0 * math.pi
_KEPT = 40  # orders that an albedo below 1 is made of: at 0.9 what is left out is less than a thousandth
_CURVE = 1.16  # as the mix's fit weighs errors
_RIDGE = 1e-6
_VISIBLE = 0.05  # opacity
_OF_MEAN = 20.0 * math.log10(2.0)  # dB, by which the mean of two has less noise than their difference
_TRACED, _DENOISED, _GAIN = "path tracing", "1 sample, denoised", "single x gain"
_OCTAVES, _FILTER = "fitted octaves", "fitted filter"
_PLUMES, _CLOUDS = (11, 12), (0, 5)  # seeds of the smoke of "gain by grid"
_DRAWN = 128  # largest edge in voxels at which a plume is drawn before it is resampled
_G = (-0.3, 0.3, 0.6, 0.8)  # mean cosines of the phase functions
_VIEWS, _PIXELS, _SAMPLES, _CELLS = 6, 32, 512, 64  # of "phase functions" and "light in smoke"
_EXTINCTIONS = (8.0, 30.0)
_BURNING, _GLOW = 20.0, 10.0  # extinction and emission of the fire


@dataclass(frozen=True)
class GridSizes:
    """Sizes of the grids and pictures of the method "gain by grid".

    Attributes:
        grids: Voxels along an edge of each grid.
        extinctions: Optical depths of smoke of density 1 across the whole box.
        pixels: Width and height of a picture in pixels.
        samples: Paths for each pixel of a reference picture.
    """

    grids: tuple[int, ...]
    extinctions: tuple[float, ...]
    pixels: int
    samples: int


@dataclass(frozen=True)
class OrdersSizes:
    """Sizes of the smoke and the pictures, and numbers of samples. The defaults are for a GPU.

    Attributes:
        plumes: Number of plumes.
        cells: Voxels along the edge of a plume as it is made; None: random numbers from 40 to 64.
        voxels: Voxels along the edge to which a plume is resampled; None: it is not resampled.
        pixels: Width and height of a picture in pixels.
        samples: Paths for each pixel of a reference picture.
        scale: Factor on the number of cells along an edge of the scene `jet-sphere`.
        frames: Frames of the scene before the first measured frame.
        sides: Number of cameras around the scene.
        repeats: Number of samples of each measured time.
        single: Sizes for `grid_rows`.
        other: Arguments of `other_rows`, by name.
    """

    plumes: int = 12
    cells: int | None = 128
    voxels: int | None = 400
    pixels: int = 512
    samples: int = 3072
    scale: float = 1.0
    frames: int = 60
    sides: int = 4
    repeats: int = 10
    single: GridSizes = GridSizes(
        (32, 64, 128, 256, 400, 512), extinctions=(2.5, 8.0, 25.0, 80.0), pixels=192, samples=512
    )
    other: Mapping[str, int] = field(default_factory=dict)


QUICK = OrdersSizes(
    plumes=4,
    cells=None,
    voxels=None,
    pixels=32,
    samples=1536,
    scale=0.12,
    frames=40,
    sides=2,
    repeats=2,
    single=GridSizes((32, 64, 128), extinctions=(8.0, 25.0), pixels=24, samples=256),
)
"""Sizes for a CPU."""


@dataclass(frozen=True, eq=False)
class Shot:
    """Smoke seen by one camera under some lights.

    Attributes:
        volume: Smoke that does not glow.
        camera: Orthographic camera.
        lights: Directional lights with their irradiance.
        seed: Seed of the random paths.
        motion: Motion of the smoke since the previous shot in pixels, float32 [2, H, W]; None: it shows other smoke.
    """

    volume: DensityVolume
    camera: Camera
    lights: tuple[Light, ...]
    seed: int
    motion: torch.Tensor | None = None


def run(
    *, quick: bool = False, device: str, sizes: OrdersSizes | None = None, progress: Note | None = None
) -> list[Row]:
    """Measures methods that compute multiple scattering in smoke. Returns the rows, in the order of the scenes.

    Args:
        quick: Whether to use the sizes `QUICK`, for a minute or two on a CPU, instead of 400^3 voxels at 512 x 512
            pixels, for a GPU.
        device, sizes, progress: As for `benchmarks.smoke.run`.
    """
    sizes = sizes or (QUICK if quick else OrdersSizes())
    bench = Bench("smoke", device, progress, clock="time_ms", repeats=sizes.repeats, few=2)
    if not has_denoiser():
        bench.note(f"{_DENOISED}: left out, because pyoidn is not installed: install wlm[bake]")
    plumes, jet = [_plume(sizes, number, bench.device) for number in range(sizes.plumes)], _jet(sizes, bench)
    rows = []
    for name, shots in (("plumes", plumes), ("jet", jet)):
        rows += _scored(bench, name, shots, sizes)
    return rows + grid_rows(bench, sizes.single) + other_rows(bench, **sizes.other)


def _scored(bench: Bench, name: str, shots: Sequence[Shot], sizes: OrdersSizes) -> list[Row]:
    """Measures all methods on the shots of one scene; returns a row for each method at each albedo of `ALBEDOS`."""
    found: dict[float, dict[str, list[torch.Tensor]]] = {albedo: {} for albedo in ALBEDOS}
    traced: list[tuple[dict[float, torch.Tensor], ...]] = []
    opacity = []
    for number, shot in enumerate(shots, 1):
        bench.note(f"{name}: picture {number} of {len(shots)}")
        traced.append(tuple(_trace(shot, sizes.samples // 2, salt) for salt in (0, 1)))
        once = _once(shot)
        opacity.append(1.0 - once.transparency)
        each = [octaves(shot.volume, shot.camera, [light]) for light in shot.lights]
        by_angle = {_OCTAVES: _by_angle(shot, each), _FILTER: _by_angle(shot, _planes(shot))}
        fitted = {_GAIN: once.shade()[None]} | by_angle
        for albedo in ALBEDOS:
            pictures = {way: make(shot, albedo) for way, make in _ways().items()}
            for way, picture in (pictures | fitted).items():
                found[albedo].setdefault(way, []).append(picture)
    bench.note(f"{name}: timing the methods")
    times = _times(bench, shots[0], sizes)
    rows = []
    settings = {"voxels": max(shots[0].volume.shape), "pixels": sizes.pixels, "lights": _LIGHTS}
    for albedo in ALBEDOS:
        halves = [tuple(half[albedo] for half in pair) for pair in traced]
        truth = [0.5 * (one + other) for one, other in halves]
        for way in (_GAIN, _OCTAVES, _FILTER):
            found[albedo][way] = _fitted(found[albedo][way], truth)
        scene, notes = f"{name}, albedo {albedo:g}", f"{len(shots)} pictures"
        for way, timing in times.items():
            pictures = found[albedo][way]
            figures = _score(pictures, truth) | _flicker(shots, pictures, halves, opacity) | settings
            on_cpu = way == _DENOISED and denoiser_device(bench.device) == "cpu" != bench.device
            note = f"{notes}, denoised on the CPU" if on_cpu else notes
            rows.append(bench.row(METHOD, way, note, scene=scene, timing=timing, **figures))
        noise = [psnr(*pair) + _OF_MEAN for pair in halves]
        noise = {"psnr": float(np.mean(noise)), "psnr_min": min(noise), "psnr_max": max(noise)}
        figures = noise | {"samples": sizes.samples} | settings
        rows.append(bench.row(METHOD, _TRACED, "the references' noise", scene=scene, **figures))
    return rows


def _ways() -> dict[str, Callable[[Shot, float], torch.Tensor]]:
    """Returns the methods without fitted weights by name: functions of a shot and an albedo that return a picture."""
    ways = {
        "single scattering": lambda shot, albedo: _once(shot).shade(albedo=(albedo,) * 3),
        "three octaves": lambda shot, albedo: three_octaves(shot.volume, shot.camera, shot.lights, albedo),
        "diffusion": lambda shot, albedo: diffused(shot.volume, shot.camera, shot.lights, albedo),
        "learned mix": lambda shot, albedo: scatter(shot.volume, shot.camera, shot.lights, (albedo,) * 3).shade(),
    }
    return ways | ({_DENOISED: _denoised} if has_denoiser() else {})


def _once(shot: Shot) -> LitSmoke:
    return light_smoke(shot.volume, shot.camera, shot.lights, orders_march(shot.volume))


def _denoised(shot: Shot, albedo: float) -> torch.Tensor:
    settings = {"albedo": (albedo,) * 3, "samples": 1, "orders": 0, "seed": shot.seed}
    return denoised_picture(trace(shot.volume, shot.camera, shot.lights, **settings).total)


def _planes(shot: Shot) -> list[torch.Tensor]:
    """Returns for each light the P planes of the filter in the light's colour, [P, H, W, 3]."""
    pairs = zip(filter_planes(shot.volume, shot.camera, shot.lights), shot.lights, strict=True)
    return [each[..., None] * torch.tensor(light.irradiance, device=each.device) / _FOUR_PI for each, light in pairs]


def _by_angle(shot: Shot, planes: Sequence[torch.Tensor]) -> torch.Tensor:
    """Multiplies the N planes [N, H, W, 3] of each light by powers 0, 1 and 2 of the cosine between light and camera,
    and returns their sums over the lights, [3 N, H, W, 3]."""
    parts = 0.0
    for light, each in zip(shot.lights, planes, strict=True):
        cosine = float(unit(light.toward) @ np.asarray(shot.camera.toward))
        parts = parts + torch.cat([cosine**power * each for power in range(_POWERS)])
    return parts


def _trace(shot: Shot, samples: int, salt: int) -> dict[float, torch.Tensor]:
    """Returns a path-traced picture [H, W, 3] for each albedo of `ALBEDOS`; `salt` varies the random seed."""
    seed = 2 * shot.seed + salt
    made = trace(shot.volume, shot.camera, shot.lights, samples=samples, orders=_KEPT, seed=seed)
    return {albedo: _at_albedo(made, albedo).sum((0, 1)) for albedo in ALBEDOS}


def _at_albedo(made: Transport, albedo: float) -> torch.Tensor:
    """Returns light of each scattering order at an albedo; below 1 without light scattered over `_KEPT` times."""
    powers = albedo ** torch.arange(_KEPT + 2, device=made.planes.device)
    powers[-1] *= albedo == 1.0
    return made.planes * powers[:, None, None, None]


def _fitted(features: Sequence[torch.Tensor], truth: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    """Fits N weights, the same for all pictures, of feature images [N, H, W, 3] to the true pictures [H, W, 3] by
    least squares, with errors weighted about as in sRGB. Returns the weighted sum of each picture's features.
    """
    left, right = 0.0, 0.0
    for parts, wanted in zip(features, truth, strict=True):
        weights = ((wanted.clamp(min=0.0) + FAINT) ** -_CURVE).flatten().double()
        rows = parts.flatten(1).double()
        left = left + (rows * weights) @ rows.T
        right = right + rows @ (weights * wanted.flatten().double())
    left = left + _RIDGE * torch.diag(left.diagonal())
    mix = torch.linalg.solve(left, right).float()
    return [torch.einsum("n,nhwc->hwc", mix, parts).clamp(min=0.0) for parts in features]


def _times(bench: Bench, shot: Shot, sizes: OrdersSizes) -> dict[str, Timing]:
    """Times one picture by each method, on CUDA as a replayed graph unless the method waits for the device."""
    ways, albedo = _ways(), ALBEDOS[0]
    calls = {way: lambda make=make: make(shot, albedo) for way, make in ways.items()}
    calls[_OCTAVES] = lambda: octaves(shot.volume, shot.camera, shot.lights)
    calls[_FILTER] = lambda: filter_planes(shot.volume, shot.camera, shot.lights)
    waiting = {way: calls.pop(way) for way in (_DENOISED,) if way in calls}
    if bench.device != "cpu":
        calls = {way: bench.replay(call) for way, call in calls.items()}
    times = bench.time(calls) | (bench.time(waiting, few=True) if waiting else {})
    times[_GAIN] = times["single scattering"]
    order = ("single scattering", _GAIN, "three octaves", _OCTAVES, _FILTER, _DENOISED, "diffusion", "learned mix")
    return {way: times[way] for way in order if way in times}


def _score(pictures: Sequence[torch.Tensor], truth: Sequence[torch.Tensor]) -> dict[str, float]:
    values = [psnr(*pair) for pair in zip(pictures, truth, strict=True)]
    flips = []
    for pair in zip(truth, pictures, strict=True):
        seen = (to_srgb(light).clamp(max=1.0).cpu().numpy() for light in pair)
        flips.append(float(flip_display(*seen).mean()))
    best = {"psnr": float(np.mean(values)), "psnr_min": min(values), "psnr_max": max(values)}
    return best | {"flip": float(np.mean(flips)), "flip_max": max(flips)}


def _flicker(
    shots: Sequence[Shot],
    pictures: Sequence[torch.Tensor],
    halves: Sequence[tuple[torch.Tensor, torch.Tensor]],
    opacity: Sequence[torch.Tensor],
) -> dict[str, float]:
    """Computes the RMS change between consecutive shots in levels of 255, and its ratio to the references' change.

    The ratio is left out if the references change by no more than their noise.
    """
    power, wanted, count = 0.0, 0.0, 0
    for n, shot in enumerate(shots):
        if shot.motion is None:
            continue

        def change(before: torch.Tensor, after: torch.Tensor, n: int = n, moved: torch.Tensor = shot.motion):
            before, after = (to_srgb(light).clamp(max=1.0).permute(2, 0, 1)[None] for light in (before, after))
            warped, inside = warp(before, moved[None])
            return 255.0 * (after - warped)[0][:, (opacity[n] > _VISIBLE) & (inside[0, 0] > 0)]

        changed = change(pictures[n - 1], pictures[n])
        one, other = (change(halves[n - 1][half], halves[n][half]) for half in (0, 1))
        power += float(changed.square().sum())
        wanted += float((one * other).sum())
        count += changed.numel()
    if not count:
        return {}
    own = {"flicker": (power / count) ** 0.5}
    return own | {"flicker_ratio": (power / wanted) ** 0.5} if wanted > 0 else own


def _lights(random: np.random.Generator, ways: Sequence[Sequence[float]]) -> tuple[Light, ...]:
    colours = random.dirichlet(np.ones(3), len(ways)) * 3.0 / len(ways) * _FOUR_PI
    return tuple(Light(tuple(way), tuple(map(float, colour))) for way, colour in zip(ways, colours, strict=True))


def _plume(sizes: OrdersSizes, number: int, device: str) -> Shot:
    volume, camera, lights = draw_view(_SEED, number, pixels=sizes.pixels, lights=_LIGHTS, cells=sizes.cells)
    density = volume.density.to(device)
    if sizes.voxels is not None:
        size = (sizes.voxels,) * 3
        density = F.interpolate(density[None, None], size, mode="trilinear", align_corners=False)[0, 0].contiguous()
        volume = replace(volume, voxel=volume.voxel * volume.shape[0] / sizes.voxels)
    random = np.random.default_rng([_SEED, number, 1])
    coloured = _lights(random, [light.toward for light in lights])
    return Shot(replace(volume, density=density), camera, coloured, number)


def _jet(sizes: OrdersSizes, bench: Bench) -> list[Shot]:
    """Simulates a jet and returns shots of two consecutive frames from each of several cameras."""
    bench.note("simulating the jet")
    scene = load_scene("jet-sphere").scaled(sizes.scale)
    solver = make_solver(scene, device=bench.device)
    for frame in range(1, sizes.frames + 1):
        advance(scene, solver, frame)
    volumes = []
    for frame in (sizes.frames + 1, sizes.frames + 2):
        advance(scene, solver, frame)
        solver.check()
        smoke = volume_of(scene, solver)
        volumes.append(DensityVolume(smoke.density.clone(), smoke.extinction, smoke.voxel, smoke.origin))
    random = np.random.default_rng([_SEED, 2])
    shots = []
    for side in range(sizes.sides):
        toward = random.normal(size=3)
        camera = Camera.around(volumes[1], toward=toward, pixels=sizes.pixels)
        lights = _lights(random, random.normal(size=(_LIGHTS, 3)).tolist())
        moved = motion(volumes[1], solver.velocity, camera, reach=scene.grid.cell * scene.steps)
        shots.append(Shot(volumes[0], camera, lights, 100 + 2 * side))
        shots.append(Shot(volumes[1], camera, lights, 101 + 2 * side, moved))
    return shots


def grid_rows(bench: Bench, sizes: GridSizes, model: OrdersModel | None = None) -> list[Row]:
    """Returns the rows of the method "gain by grid", one for each grid.

    Args:
        bench: The benchmark.
        sizes: Sizes of the grids and pictures, and numbers of samples.
        model: The model with the learned weights; None: the one that wlm ships.
    """
    model = (load_orders() if model is None else model).to(bench.device)
    rows = []
    for cells in sizes.grids:
        bench.note(f"measuring a grid of {cells}^3 voxels")
        diffused, mixed = (np.array(part) for part in zip(*_scores(bench.device, sizes, cells, model), strict=True))
        gains = mixed - diffused
        figures = {"psnr": mixed.mean(), "psnr_min": mixed.min(), "gain": gains.mean(), "gain_min": gains.min()}
        note = f"{len(gains)} lights, gains within {np.quantile(gains, 0.05):+.3f} and {gains.max():+.3f} dB"
        settings = {"voxels": cells, "pixels": sizes.pixels, "samples": sizes.samples}
        rows.append(bench.row(GRIDS, f"{cells} voxels", note, scene="single lights", **figures, **settings))
    return rows


def _scores(device: str, sizes: GridSizes, cells: int, model: OrdersModel) -> Iterator[tuple[float, float]]:
    """Yields, for each light at each albedo, the PSNR by diffusion and the PSNR by the learned mix."""
    for number, (density, extinction) in enumerate(_smoke(device, sizes, cells)):
        random = np.random.default_rng([cells, number])
        volume = DensityVolume(density, extinction, 1.0 / cells)
        camera = Camera.around(volume, toward=random.normal(size=3), pixels=sizes.pixels)
        lights = [Light(tuple(map(float, random.normal(size=3)))) for _ in range(_LIGHTS)]
        traced = trace(volume, camera, lights, samples=sizes.samples, orders=_KEPT, seed=number)
        with stream(device):
            _, inputs = make_inputs(volume, camera, lights, ALBEDOS, orders_march(volume))
            for albedo in ALBEDOS:
                diffused = inputs.by_diffusion(albedo)
                mixed = model.light(at(inputs, albedo), (albedo,) * 3)[..., 0]
                truth = _at_albedo(traced, albedo).sum(1)[..., 0]
                for one, other, wanted in zip(diffused, mixed, truth, strict=True):
                    yield psnr(one, wanted), psnr(other, wanted)


def _smoke(device: str, sizes: GridSizes, cells: int) -> Iterator[tuple[torch.Tensor, float]]:
    """Yields pairs of a smoke density [X, Y, Z] and the extinction of density 1, for plumes and clouds."""
    for seed in _PLUMES:
        drawn = make_plume(min(cells, _DRAWN), seed=seed, hot=False).density.to(device)
        size = (cells,) * 3
        density = torch.nn.functional.interpolate(drawn[None, None], size, mode="trilinear")[0, 0].contiguous()
        yield from ((density, extinction) for extinction in sizes.extinctions)
    for seed in _CLOUDS:
        density = make_cloud(cells, device, seed)
        yield from ((density, extinction) for extinction in sizes.extinctions)


def other_rows(bench: Bench, *, views: int = _VIEWS, samples: int = _SAMPLES, cells: int = _CELLS) -> list[Row]:
    """Returns the rows of the methods "phase functions" and "light in smoke".

    Args:
        bench: The benchmark.
        views: Number of pictures for each phase function.
        samples: Paths for each pixel of a reference picture.
        cells: Voxels along an edge of the smoke that contains a light.
    """
    rows = []
    settings = {"pixels": _PIXELS, "samples": samples}
    for g in _G:
        bench.note(f"measuring the phase function of mean cosine {g:g}")
        for albedo in ALBEDOS:
            values, once = np.array([_phase(bench.device, n, g, albedo, samples) for n in range(views)]).T
            figures = {"psnr": values.mean(), "psnr_min": values.min(), "gain": (values - once).mean()}
            option = f"g {g:g}, albedo {albedo:g}"
            rows.append(bench.row(PHASES, option, f"{views} pictures", scene="plumes", **figures, **settings))
    bench.note("measuring light in smoke")
    for option, wanted, found, once in _inside(bench.device, samples, cells):
        scale = 1.0 / float(wanted.max())
        value, plain = (psnr(scale * picture, scale * wanted) for picture in (found, once))
        figures = {"psnr": value, "gain": value - plain, "bias": float(found.sum() / wanted.sum()) - 1.0}
        rows.append(bench.row(INSIDE, option, scene="plume and cloud", **figures, voxels=cells, **settings))
    return rows


def _phase(device: str, number: int, g: float, albedo: float, samples: int) -> tuple[float, float]:
    """Returns the PSNR of the learned mix and of single scattering, for one plume under three lights."""
    volume, camera, ways = draw_view(_SEED, number, pixels=_PIXELS, lights=3)
    volume = replace(volume, density=volume.density.to(device))
    lights = [Light(way.toward, (_FOUR_PI / 3,) * 3) for way in ways]
    grey = (albedo,) * 3
    wanted = trace(volume, camera, lights, albedo=grey, g=g, samples=samples, orders=0, seed=number).total
    made = scatter(volume, camera, lights, grey, march=orders_march(volume, g))
    return psnr(made.shade(), wanted), psnr(made.lit.shade(albedo=grey), wanted)


def _inside(device: str, samples: int, cells: int) -> Iterator[tuple[str, torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Yields the name of each case, and its pictures by path tracing, the learned mix and single scattering."""
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
