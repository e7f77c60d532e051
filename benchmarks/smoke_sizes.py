"""Time and error of the ways to make six-way lightmaps of smoke, on grids of several sizes and on one clock.

The smoke is a plume that is computed without a simulation; on a GPU, from 64 voxels on, held-out frames of a jet and a
plume, as in `benchmarks.smoke_network`; and a volume from a file. Errors are against `bake` in steps of half a voxel:
PSNR over the six lightmaps in sRGB with a peak of 1. Times are means over the frames: on a GPU of replayed graphs where
a method can be captured, and in another column of the calls that a user makes. "six pictures by diffusion" are of light
of all orders at albedo 1 from the six directions, which is another quantity, and have no error.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from benchmarks.rows import Row
from benchmarks.runner import Bench, Note
from benchmarks.smoke_network import EXACT, FULL, NetworkBench, score
from demos.plume import make_plume
from wlm.fluid.volume import DensityVolume, load_volume
from wlm.interop import stream
from wlm.smoke.camera import VECTORS, Camera
from wlm.smoke.codec import open_network, shipped
from wlm.smoke.march.six_way import bake, bake_coarse
from wlm.smoke.network.planes import decode_lightmaps, encode_lightmaps, render_guide
from wlm.smoke.network.prediction import predict
from wlm.smoke.shading import Light
from wlm.smoke.transport.orders import scatter
from wlm_kernels.smoke.settings import March

_SIZES = (400, 256, 128, 64, 32, 16)  # voxels along an edge
_LEARNED = 64  # the least size of held-out smoke
_PIXELS = {"cpu": (64, 256), "cuda": (512,)}  # along an image's edge
_QUICK = (32, 16)
_BAKES = (1.0, 2.0, 3.0, 4.0)  # voxels, steps of `bake`
_SHARES = (40, 80, 130, 200)  # steps of the coarse march along the longest edge of the smoke
_LEAST = {"cpu": 1.0, "cuda": 0.25}  # voxels, its shortest step; on a CPU `bake` is faster than with shorter ones
_DEPTH = 14.0  # optical depth across the longest edge at the highest density, as of held-out smoke

_Frame = tuple[DensityVolume, Camera, int]
"""Smoke, the camera that sees it, and a seed."""


def run(
    *,
    smoke_path: Path | None = None,
    quick: bool,
    device: str,
    progress: Note | None = None,
    done: Callable[[Sequence[Row]], None] | None = None,
) -> list[Row]:
    """Measures all methods at all sizes.

    Args:
        smoke_path: A file of a volume to measure too.
        quick: Whether to measure only small grids.
        device: "cpu" or "cuda:0".
        progress: Called with a line before each part of the work.
        done: Called with all rows so far after each size.

    Returns:
        A row of each method on each smoke.

    Raises:
        WlmError: The file can't be read, or the device does not exist or has not enough memory.
    """
    kind = device.partition(":")[0]
    rows: list[Row] = []
    for pixels in _PIXELS[kind][: 1 if quick else None]:
        scenes: list[tuple[str, Callable[[], list[_Frame]]]] = []
        if smoke_path is not None:
            scenes.append((smoke_path.name, partial(_from_file, smoke_path, pixels, device)))
        for size in _QUICK if quick else _SIZES:
            simulated = kind == "cuda" and size >= _LEARNED
            name, make = ("unseen smoke", _unseen) if simulated else ("plume", _plume)
            scenes.append((f"{name}, {size}³", partial(make, size, pixels, device)))
        for name, make in scenes:
            bench = Bench("smoke-sizes", device, progress, scene=f"{name}, {pixels}² pixels", clock="time_ms", few=3)
            bench.note("making smoke")
            rows += size_rows(bench, make())
            if done is not None:
                done(rows)
    return rows


def _plume(size: int, pixels: int, device: str) -> list[_Frame]:
    return [_seen(make_plume(size, hot=False, extinction=_DEPTH, device=device), pixels)]


def _from_file(path: Path, pixels: int, device: str) -> list[_Frame]:
    smoke = load_volume(path, device=device)
    return [_seen(replace(smoke, extinction=_DEPTH / (smoke.size.max() * float(smoke.density.max()))), pixels)]


def _seen(smoke: DensityVolume, pixels: int) -> _Frame:
    return smoke, Camera.around(smoke, toward=(0.3, 0.2, 1.0), pixels=pixels), 0


def _unseen(size: int, pixels: int, device: str) -> list[_Frame]:
    sizes = replace(FULL, cells=size // FULL.refine, resolution=pixels, kinds=("jet", "plume"), frames=1)
    bench = NetworkBench(device, sizes, ())
    return [(frame.later, bench.camera, frame.seed + 1) for frame in bench.frames]


def size_rows(bench: Bench, frames: Sequence[_Frame]) -> list[Row]:
    """Measures every method on some frames of one size, in turns."""
    bench.note("measuring")
    longest, pixels, cuda = max(frames[0][0].shape), frames[0][1].height, bench.device != "cpu"
    reference = f"bake, step {EXACT:g}"
    methods: dict[str, Callable[[DensityVolume, Camera, int], object]] = {
        f"bake, step {step:g}": lambda smoke, camera, seed, step=step: bake(smoke, camera, step=step, estimate=False)
        for step in (EXACT, *_BAKES)
    }
    least = _LEAST[bench.device.partition(":")[0]]
    for step in dict.fromkeys(max(longest / share, least) for share in _SHARES):
        methods[f"coarse march, step {step:.3g}"] = lambda smoke, camera, seed, step=step: bake_coarse(
            smoke, camera, March(step, seed=seed)
        )
    methods["predict"] = lambda smoke, camera, seed: predict(smoke, camera, seed=seed)
    model = open_network(shipped())
    decoder = model.decoder(bench.device, height=pixels, width=pixels, half=cuda)

    def guided(smoke: DensityVolume, seed: int, camera: Camera) -> torch.Tensor:
        return render_guide(smoke, camera, decoder.guide, model.dataset.look(smoke.shape, seed))

    def network(smoke: DensityVolume, camera: Camera, seed: int) -> object:
        with stream(bench.device):
            return decode_lightmaps(decoder(guided(smoke, seed, camera)), hot=smoke.temperature is not None)

    methods["network fast"] = network
    calls = {name: partial(_all, method, frames) for name, method in methods.items()}
    lights = [Light(tuple(map(float, way))) for way in VECTORS]
    calls["six pictures by diffusion"] = lambda: [
        scatter(smoke, camera, [light], (1.0, 1.0, 1.0)) for smoke, camera, _ in frames for light in lights
    ]
    eager = bench.time(calls, few=True)
    graphs = {}
    if cuda:
        # `bake` waits for its steps, which a graph can't hold; the network is a graph by itself.
        replays = {name: bench.replay(call) for name, call in calls.items() if name.startswith("coarse")}
        encoded = [guided(smoke, seed, camera) for smoke, camera, seed in frames]
        planes = [decoder(guide).clone() for guide in encoded]
        first = bench.replay(lambda: [guided(smoke, seed, camera) for smoke, camera, seed in frames])
        last = bench.replay(lambda: [decode_lightmaps(each, hot=False) for each in planes])
        replays["network fast"] = lambda: (first(), [decoder(guide) for guide in encoded], last())
        graphs = bench.time(replays, few=True)
    references = [encode_lightmaps(methods[reference](*frame)) for frame in frames]
    rows = []
    for name in calls:
        figures: dict[str, float] = {"pixels": pixels}
        if name in methods and name != reference:
            made = [encode_lightmaps(methods[name](*frame)) for frame in frames]
            scores = score(made, references)
            figures |= {"psnr": scores["psnr"], "psnr_min": scores["psnr_min"]}
        if name in graphs:
            figures["call_ms"] = eager[name].median_ms / len(frames)
        note = "the reference" if name == reference else ""
        timing = graphs.get(name, eager[name])
        rows.append(bench.row("six-way lightmaps", name, note, timing=timing, calls=len(frames), **figures))
    return rows


def _all(method: Callable[..., object], frames: Sequence[_Frame]) -> None:
    for frame in frames:
        method(*frame)
