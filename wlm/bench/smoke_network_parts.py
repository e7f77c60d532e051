"""Where the time of a network's frame goes, what its profiles cost, and how it stands other densities and motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from wlm.baselines.smoke import coarse
from wlm.bench.runner import Row
from wlm.bench.smoke_network_setup import Frame, NetworkBench, Whole, row
from wlm.bench.smoke_setup import number
from wlm.config import profile_names
from wlm.smoke.decode import Decoder
from wlm.smoke.evaluation import of_decoder, score
from wlm.smoke.learn.pool import Pool
from wlm.smoke.learn.settings import DatasetSettings
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.model import Profile, SixWayNetwork, SmokeModel, parameter_count
from wlm.smoke.planes import GUIDES, decode_lightmaps, render_guide
from wlm.smoke.scene import LightSettings

__all__ = ["density_rows", "frame_rows", "profile_rows"]

_LIGHTS = (
    LightSettings(toward=(1.0, 0.8, 0.6), irradiance=(11.0, 10.3, 9.4)),
    LightSettings(toward=(-1.0, 0.3, 0.5), irradiance=(1.6, 2.2, 3.2)),
)
_BACKGROUND = (0.03, 0.04, 0.055)
_LEVELS = 255.0
_MARCHES = (1.0, 0.5, 0.3)  # of the guiding map's step, those of the coarse march beside the networks


def frame_rows(bench: NetworkBench) -> list[Row]:
    """The parts of a frame: guiding map, network and decoding of each network, shading, and the simulation."""
    bench.note("frame")
    count, size = len(bench.frames), bench.sizes.resolution
    half = bench.device != "cpu"
    calls: dict[tuple[str, str], Callable[[], object]] = {}
    sizes_of = {}
    for subject in bench.subjects:
        whole = Whole(bench, subject, half=half)
        parts = [whole.parts(frame) for frame in bench.frames]
        step = subject.settings.look(bench.frames[0].later.shape).step
        of = {
            "guide": f"{subject.settings.guide}, {size}², h {step:.3g}",
            "network": f"{size}², {'fp16' if half else 'fp32'}",
            "decode": f"{size}²",
        }
        for name in of:
            calls[subject.name, name] = _all_of(parts, name)
            sizes_of[subject.name, name] = of[name]
    # Its weights come from the host, which a graph can't hold.
    calls["", "shade"] = _shading(bench)
    sizes_of["", "shade"] = f"{size}², {len(_LIGHTS)} lights, as calls"
    times = bench.time(calls, few=bench.device == "cpu")
    scene, solver = bench.simulation
    steps = bench.settings.steps // scene.smoke.substeps
    alone = bench.time({"": lambda: solver.step(steps)}, few=True)[""]
    rows = [
        row("frame", ", ".join(filter(None, key)), {"of": sizes_of[key]}, timing=timing, calls=count)
        for key, timing in times.items()
    ]
    for subject in bench.subjects:
        keys = [*((subject.name, name) for name in ("guide", "network", "decode")), ("", "shade")]
        total = sum(times[key].median_ms for key in keys) / count
        rows.append(row("frame", f"{subject.name}, all four", {"of": "guide to shade"}, decode_ms=total))
    voxels = "x".join(map(str, scene.grid.shape))
    of = f"{scene.name}, {voxels}, {bench.settings.steps} steps of air, {steps} of smoke"
    return [*rows, row("frame", "simulation", {"of": of}, timing=alone)]


def profile_rows(bench: NetworkBench) -> list[Row]:
    """The time of each profile's network alone."""
    bench.note("profiles")
    size, cuda = bench.sizes.profile, bench.device != "cpu"
    settings = {name: Profile.load(name).network for name in profile_names(Profile.FILES)}
    calls, counts = {}, {}
    for name, one in settings.items():
        torch.manual_seed(0)
        model = SmokeModel(SixWayNetwork(one), {})
        counts[name] = parameter_count(model.network)
        for half in (True, False) if cuda else (False,):
            decoder = model.decoder(bench.device, height=size, width=size, half=half)
            encoded = torch.rand(len(GUIDES[one.guide]), size, size, device=bench.device)
            calls[name, "fp16" if half else "fp32"] = _decoder_call(decoder, encoded)
    times = bench.time(calls, few=not cuda)
    rows = []
    for (name, kind), timing in times.items():
        figures = {
            "pixels": f"{size}²",
            "parameters": number(counts[name]),
            # As its file has them, in half floats.
            "MB": f"{2e-6 * counts[name]:.2f}",
        }
        rows.append(row("profiles", f"{name}, {kind}", figures, timing=timing))
    return rows


def density_rows(bench: NetworkBench) -> list[Row]:
    """The networks and the coarse march on thinner and denser smoke, and how much they flicker."""
    bench.note("density")
    size, step = bench.sizes.resolution, bench.settings.look(bench.frames[0].later.shape).step
    rows = []
    for scale in bench.sizes.scales:
        frames = [frame.scaled(scale) for frame in bench.frames]
        targets = torch.stack([torch.stack([bench.reference(one) for one in frame.smoke]) for frame in frames])
        found = {}
        for subject in bench.trained:
            decoder = subject.model.decoder(bench.device, height=size, width=size)
            pool = _pool(bench, frames, targets, subject.settings)
            found[subject.name] = score(of_decoder(decoder), pool)
        for share in _MARCHES:
            changed = {"guide": "six", "guide_step": share * bench.settings.guide_step}
            pool = _pool(bench, frames, targets, bench.settings.model_copy(update=changed))
            found[f"coarse, h {share * step:g}"] = score(coarse, pool)
        for name, one in found.items():
            figures = {
                "least dB": f"{one.lowest:.2f}",
                "most dB": f"{one.highest:.2f}",
                "flicker, levels": f"{_LEVELS * one.flicker:.3g}",
                "over the reference's": f"{one.flicker_ratio:.3f}",
            }
            rows.append(row("density", f"{name}, x{scale:g}", figures, psnr=one.psnr))
    return rows


def _pool(bench: NetworkBench, frames: Sequence[Frame], targets: torch.Tensor, settings: DatasetSettings) -> Pool:
    """The frames as samples with guiding maps of some settings."""
    guides = []
    for frame in frames:
        shape = frame.later.shape
        pair = enumerate(frame.smoke, frame.seed)
        guides.append(
            torch.stack(
                [render_guide(one, bench.camera, settings.guide, settings.look(shape, seed)) for seed, one in pair]
            )
        )
    moved = torch.stack([frame.motion for frame in frames])
    number = torch.arange(len(frames), device=targets.device)
    return Pool(torch.stack(guides).half(), targets.half(), moved.half(), number)


def _shading(bench: NetworkBench) -> Callable[[], object]:
    lights = [given.light() for given in _LIGHTS]
    pairs = zip(bench.frames, bench.references, strict=True)
    six: list[SixWay] = [
        decode_lightmaps(planes, hot=frame.later.temperature is not None, camera=bench.camera)
        for frame, planes in pairs
    ]
    return lambda: [one.shade(lights, background=_BACKGROUND) for one in six]


def _all_of(parts: Sequence[dict[str, Callable[[], object]]], name: str) -> Callable[[], object]:
    return lambda: [part[name]() for part in parts]


def _decoder_call(decoder: Decoder, encoded: torch.Tensor) -> Callable[[], object]:
    return lambda: decoder(encoded)
