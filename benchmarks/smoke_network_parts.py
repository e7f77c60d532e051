"""The stages of a frame with a network, the time of each profile, and other densities and motion."""

from collections.abc import Callable, Sequence
from functools import partial

import torch

from benchmarks.rivals.smoke import coarse
from benchmarks.rows import Row
from benchmarks.smoke_network_setup import Frame, NetworkBench, Pipeline
from wlm.config import profile_names
from wlm.smoke.evaluation import of_decoder, score
from wlm.smoke.model import SmokeModel, parameter_count
from wlm.smoke.network.planes import GUIDES, decode_lightmaps, render_guide
from wlm.smoke.network.pool import Pool
from wlm.smoke.network.settings import DatasetSettings, Profile
from wlm.smoke.network.unet import SixWayNetwork
from wlm.smoke.scene import LightSettings

_LIGHTS = (
    LightSettings(toward=(1.0, 0.8, 0.6), irradiance=(11.0, 10.3, 9.4)),
    LightSettings(toward=(-1.0, 0.3, 0.5), irradiance=(1.6, 2.2, 3.2)),
)
_BACKGROUND = (0.03, 0.04, 0.055)
_LEVELS = 255.0
_MARCHES = (1.0, 0.5, 0.3)  # steps of the coarse march beside the networks, over the guiding map's


def frame_rows(bench: NetworkBench) -> list[Row]:
    """The parts of a frame: guiding map, network and decoding of each network, shading, and the simulation."""
    bench.note("frame")
    count, size = len(bench.frames), bench.sizes.resolution
    half = bench.device != "cpu"
    calls: dict[tuple[str, str], Callable[[], object]] = {}
    notes = {}
    for subject in bench.subjects:
        pipeline = Pipeline(bench, subject, half=half)
        parts = [pipeline.parts(frame) for frame in bench.frames]
        step = subject.settings.look(bench.frames[0].later.shape).step
        stages = {
            "guide": f"{subject.settings.guide}, {size}², h {step:.3g}",
            "network": f"{size}², {'fp16' if half else 'fp32'}",
            "decode": f"{size}²",
        }
        for name, note in stages.items():
            calls[subject.name, name] = _all_of(parts, name)
            notes[subject.name, name] = note
    # Its weights come from the host, which a graph can't hold.
    calls["", "shade"] = _shading(bench)
    notes["", "shade"] = f"{size}², {len(_LIGHTS)} lights, as calls"
    times = bench.time(calls, few=bench.device == "cpu")
    scene, solver = bench.simulation
    steps = bench.settings.steps // scene.smoke.substeps
    simulation = bench.time({"": lambda: solver.step(steps)}, few=True)[""]
    rows = [
        bench.row("frame", ", ".join(filter(None, key)), notes[key], timing=timing, calls=count)
        for key, timing in times.items()
    ]
    for subject in bench.subjects:
        keys = [*((subject.name, name) for name in ("guide", "network", "decode")), ("", "shade")]
        total = sum(times[key].median_ms for key in keys) / count
        rows.append(bench.row("frame", f"{subject.name}, all four", "guide to shade", time_ms=total))
    voxels = "x".join(map(str, scene.grid.shape))
    note = f"{scene.name}, {voxels}, {bench.settings.steps} steps of air, {steps} of smoke"
    return [*rows, bench.row("frame", "simulation", note, timing=simulation)]


def profile_rows(bench: NetworkBench) -> list[Row]:
    """The time of each profile's network alone."""
    bench.note("profiles")
    size, cuda = bench.sizes.profile, bench.device != "cpu"
    settings = {name: Profile.load(name).network for name in profile_names(Profile.FILES)}
    calls, counts = {}, {}
    for name, setting in settings.items():
        torch.manual_seed(0)
        model = SmokeModel(SixWayNetwork(setting), {})
        counts[name] = parameter_count(model.network)
        for half in (True, False) if cuda else (False,):
            decoder = model.decoder(bench.device, height=size, width=size, half=half)
            encoded = torch.rand(len(GUIDES[setting.guide]), size, size, device=bench.device)
            calls[name, "fp16" if half else "fp32"] = partial(decoder, encoded)
    times = bench.time(calls, few=not cuda)
    rows = []
    for (name, kind), timing in times.items():
        # The file holds half floats.
        figures = {"pixels": size, "parameters": counts[name], "file_size": 2e-6 * counts[name]}
        rows.append(bench.row("profiles", f"{name}, {kind}", timing=timing, **figures))
    return rows


def density_rows(bench: NetworkBench) -> list[Row]:
    """The networks and the coarse march on thinner and denser smoke, and how much they flicker."""
    bench.note("density")
    size, step = bench.sizes.resolution, bench.settings.look(bench.frames[0].later.shape).step
    rows = []
    for scale in bench.sizes.scales:
        frames = [frame.scaled(scale) for frame in bench.frames]
        targets = torch.stack([torch.stack([bench.reference(smoke) for smoke in frame.smoke]) for frame in frames])
        evaluations = {}
        for subject in bench.trained:
            decoder = subject.model.decoder(bench.device, height=size, width=size)
            pool = _pool(bench, frames, targets, subject.settings)
            evaluations[subject.name] = score(of_decoder(decoder), pool)
        for share in _MARCHES:
            changed = {"guide": "six", "guide_step": share * bench.settings.guide_step}
            pool = _pool(bench, frames, targets, bench.settings.model_copy(update=changed))
            evaluations[f"coarse, h {share * step:g}"] = score(coarse, pool)
        for name, evaluation in evaluations.items():
            row = bench.row(
                "density",
                f"{name}, x{scale:g}",
                psnr=evaluation.psnr,
                psnr_min=evaluation.lowest,
                psnr_max=evaluation.highest,
                flicker=_LEVELS * evaluation.flicker,
                flicker_ratio=evaluation.flicker_ratio,
            )
            rows.append(row)
    return rows


def _pool(bench: NetworkBench, frames: Sequence[Frame], targets: torch.Tensor, settings: DatasetSettings) -> Pool:
    """The frames as samples with guiding maps of some settings."""
    guides = []
    for frame in frames:
        shape = frame.later.shape
        pair = [
            render_guide(smoke, bench.camera, settings.guide, settings.look(shape, seed))
            for seed, smoke in enumerate(frame.smoke, frame.seed)
        ]
        guides.append(torch.stack(pair))
    motion = torch.stack([frame.motion for frame in frames])
    number = torch.arange(len(frames), device=targets.device)
    return Pool(torch.stack(guides).half(), targets.half(), motion.half(), number)


def _shading(bench: NetworkBench) -> Callable[[], object]:
    lights = [settings.light() for settings in _LIGHTS]
    pairs = zip(bench.frames, bench.references, strict=True)
    six = [
        decode_lightmaps(planes, hot=frame.later.temperature is not None, camera=bench.camera)
        for frame, planes in pairs
    ]
    return lambda: [lightmaps.shade(lights, background=_BACKGROUND) for lightmaps in six]


def _all_of(parts: Sequence[dict[str, Callable[[], object]]], name: str) -> Callable[[], object]:
    return lambda: [part[name]() for part in parts]
