"""Time and error of neural six-way lightmaps of smoke, against ray marches, flip books and path tracing, in one run.

All rows are of held-out frames of a jet, a plume, a flame and a burst, from one camera. Errors are against the six-way
ray march in steps of half a voxel. PSNR is over the six lightmaps of an image, in sRGB with a peak of 1: mean, minimum
and maximum over the images. Each method has a table of its own:

- "time against error": the fine ray march ("six ways") and the coarse march at several step sizes in voxels, the coarse
  march also with nodes of its lattice nearer or farther apart than a step; and networks, timed from the guiding map to
  the decoded lightmaps. The error of emission is over frames that glow. Times are means over all frames: on a GPU of
  replayed graphs, and in another column of the calls that a user makes.
- "frame": the stages of a frame, and the simulation. "shade" weights six lightmaps for two lights.
- "flip book": lightmaps baked from one side, on a billboard that turns with the camera; for comparison the coarse march
  and the first network, both computed for the turned camera.
- "path tracing": all six lightmaps by Mitsuba at one bounce on the CPU, with and without a denoiser; only with the
  extra `bake`.
- "profiles": the time of each profile's network, with random weights.
- "density": the same frames, each with the frame a moment before, at other smoke densities. Flicker is the mean change
  of lightmaps between two frames after motion compensation, in levels of 255, and also as a ratio to the reference's.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch

from benchmarks.path_tracer import PathTracer, denoise, has_denoiser, has_tracer
from benchmarks.plot import Panel
from benchmarks.rivals.smoke import billboard
from benchmarks.rows import Row
from benchmarks.runner import Bench, Note
from benchmarks.timing import Timing, time_together
from wlm.config import profile_names
from wlm.errors import WlmError
from wlm.fluid.solver import Solver
from wlm.fluid.volume import DensityVolume
from wlm.interop import stream
from wlm.metrics import psnr_from_mse
from wlm.smoke.camera import DIRECTIONS, Camera
from wlm.smoke.codec import open_network, shipped
from wlm.smoke.evaluation import coarse, of_decoder
from wlm.smoke.evaluation import score as score_pool
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.motion import motion
from wlm.smoke.march.six_way import bake, bake_coarse
from wlm.smoke.model import SmokeModel, parameter_count
from wlm.smoke.network.planes import (
    EMISSION_PLANE,
    GUIDES,
    OPACITY_PLANE,
    Pool,
    decode_lightmaps,
    encode_lightmaps,
    render_guide,
    to_srgb,
)
from wlm.smoke.network.scenes import draw_scene
from wlm.smoke.network.settings import DatasetSettings, Profile
from wlm.smoke.network.unet import SixWayNetwork
from wlm.smoke.scene import CameraSettings, LightSettings, Scene, make_camera
from wlm.smoke.simulation import make_solver, volume_of
from wlm_kernels.smoke.settings import March

PANELS = (Panel("time_ms", "psnr"),)
"""The panels of a plot of `plotted` rows."""

_TABLE = "time against error"
_LONG = 5.0  # voxels: six-way marches with no longer steps take long

SCENE = "unseen smoke"
EXACT = 0.5
"""Voxels, the step of the reference march."""

_DRAWN = 64  # scenes, of which the first one of each kind is taken
_TURN = 20.0  # degrees by which the camera is off the box's axis
_EXTENT = 1.1  # extent of the image over the edge of the box
_EARLY = 0.35  # factor on the time before the first frame, where the source of the smoke soon stops
_LIGHTS = (
    LightSettings(toward=(1.0, 0.8, 0.6), irradiance=(11.0, 10.3, 9.4)),
    LightSettings(toward=(-1.0, 0.3, 0.5), irradiance=(1.6, 2.2, 3.2)),
)
_BACKGROUND = (0.03, 0.04, 0.055)
_LEVELS = 255.0
_MARCHES = (1.0, 0.5, 0.3)  # steps of the coarse march beside the networks, over the guiding map's
_DENOISED = "denoised"


@dataclass(frozen=True)
class NetworkSizes:
    """Grid sizes, step sizes and numbers of repeats."""

    cells: int  # cells of the air along the edge of the box
    refine: int  # voxels along a cell's edge
    resolution: int  # pixels along an image's edge
    kinds: tuple[str, ...]  # kinds of scenes, one scene of each
    frames: int  # frames of each scene
    six: tuple[float, ...]  # steps in voxels of the fine march
    coarse: tuple[float, ...]  # steps of the coarse march, and the distances of its nodes
    swept: tuple[tuple[float, float], ...]  # steps of the coarse march and distances of its nodes
    turns: tuple[float, ...]  # degrees between the camera and the one that a flip book was baked from
    scales: tuple[float, ...]  # factors on the density
    profile: int  # pixels along the edge of the images that profiles are timed with
    samples: tuple[int, ...]  # per pixel, of the path tracer
    warmup: int  # calls before the first that is timed
    repeats: int  # samples of a time
    few: int  # samples of a time that is long


FULL = NetworkSizes(
    cells=100,
    refine=4,
    resolution=512,
    kinds=("jet", "plume", "flame", "burst"),
    frames=2,
    six=(20.0, 15.0, 10.0, 7.0, 5.0, 3.0, 2.0, 1.0, EXACT),
    coarse=(20.0, 15.0, 10.0, 7.0, 5.0, 3.0),
    swept=((10.0, 5.0), (7.0, 3.0), (5.0, 10.0), (5.0, 3.0), (3.0, 5.0), (3.0, 2.0), (2.0, 3.0), (1.0, 2.0)),
    turns=(10.0, 30.0, 60.0, 90.0),
    scales=(0.5, 1.0, 2.0),
    profile=512,
    samples=(1,),
    warmup=2,
    repeats=10,
    few=3,
)
"""The paper's grids: for a GPU."""

QUICK = NetworkSizes(
    cells=16,
    refine=4,
    resolution=64,
    kinds=("jet", "burst"),
    frames=1,
    six=(3.2, 1.6, 1.0, EXACT),
    coarse=(3.2, 2.4, 1.6),
    swept=((1.6, 3.2), (0.8, 1.6)),
    turns=(30.0, 90.0),
    scales=(0.5, 1.0, 2.0),
    profile=64,
    samples=(1, 16),
    warmup=1,
    repeats=2,
    few=1,
)
"""For a CPU: the guiding map's step is the same share of the box, which is 1.6 voxels here."""


@dataclass(frozen=True, eq=False)
class Frame:
    """Two successive frames of simulated smoke.

    Attributes:
        earlier, later: The smoke in the first and in the second frame.
        motion: Motion of the smoke in the image between the frames, in pixels, [2, H, W], as in `Pool.motion`.
        seed: Seed of the jitter of the earlier frame's guiding map; the later frame has the next seed.
    """

    earlier: DensityVolume
    later: DensityVolume
    motion: torch.Tensor
    seed: int

    @property
    def smoke(self) -> tuple[DensityVolume, DensityVolume]:
        """The smoke of the earlier and of the later frame."""
        return self.earlier, self.later

    def scaled(self, factor: float) -> "Frame":
        """Returns the two frames with the smoke's extinction multiplied by a factor."""
        parts = (replace(part, extinction=part.extinction * factor) for part in self.smoke)
        return Frame(*parts, self.motion, self.seed)


@dataclass(frozen=True, eq=False)
class Subject:
    """A network to measure, with the settings of its guiding maps.

    Attributes:
        name: Name of the network, as the results table prints it.
        model: The network, on the CPU.
        settings: Settings with which the network's training samples were made.
        trained: False if its weights are random; then only its time is measured.
    """

    name: str
    model: SmokeModel
    settings: DatasetSettings
    trained: bool


class NetworkBench(Bench):
    """The benchmark of some networks, with one camera and held-out frames of smoke."""

    def __init__(
        self, device: str, sizes: NetworkSizes, subjects: Sequence[Subject], progress: Note | None = None
    ) -> None:
        timing = {"warmup": sizes.warmup, "repeats": sizes.repeats, "few": sizes.few}
        super().__init__("smoke-network", device, progress, scene=SCENE, clock="time_ms", **timing)
        self.sizes, self.subjects = sizes, tuple(subjects)
        self.settings = DatasetSettings(cells=sizes.cells, refine=sizes.refine, resolution=sizes.resolution)
        self.camera = self.turned(0.0)
        self.frames: list[Frame] = []
        self.simulation: tuple[Scene, Solver] | None = None
        """The last scene and its solver, whose simulation goes on."""
        self._simulate()
        self.references = [self.reference(frame.later) for frame in self.frames]
        """Planes [8, H, W] of the later frames."""

    @property
    def trained(self) -> list[Subject]:
        """The trained networks."""
        return [subject for subject in self.subjects if subject.trained]

    def turned(self, degrees: float) -> Camera:
        """Returns the camera, turned by some degrees about the centre of the smoke."""
        view = CameraSettings(extent=_EXTENT, resolution=self.sizes.resolution).turned(_TURN + degrees)
        return make_camera(view, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))

    def reference(self, volume: DensityVolume, camera: Camera | None = None) -> torch.Tensor:
        """Computes the reference image planes [8, H, W] by the finest ray march; by default from `self.camera`."""
        return encode_lightmaps(bake(volume, camera or self.camera, step=EXACT, estimate=False))

    def replayed(self, calls: Mapping[str, Callable[[], object]], *, few: bool = False) -> dict[str, Timing]:
        """Times calls as replays of CUDA graphs. Returns an empty dict on a CPU."""
        if self.device == "cpu":
            return {}
        return self.time({key: self.replay(call) for key, call in calls.items()}, few=few)

    def _simulate(self) -> None:
        """Simulates a random scene of each kind, from a seed not used in model selection, and sets `frames`."""
        kinds, frames, trouble = self.sizes.kinds, {}, None
        for index in range(_DRAWN):
            scene = draw_scene(self.settings, self.settings.test_seed, index, validation=True)
            kind = scene.name.split()[0]
            if kind in frames or kind not in kinds:
                continue
            self.note(f"simulating {scene.name}")
            try:
                frames[kind] = self._run(scene)
            except WlmError as error:
                trouble = str(error)  # another scene of this kind is drawn
            if len(frames) == len(kinds):
                break
        if len(frames) < len(kinds):
            raise WlmError(f"expected scenes of {', '.join(kinds)}, got {', '.join(frames)}; last error: {trouble}")
        self.frames = [frame for kind in kinds for frame in frames[kind]]

    def _run(self, scene: Scene) -> list[Frame]:
        settings, solver = self.settings, make_solver(scene, device=self.device)
        sources = solver.sources
        always = [True] * len(scene.inlets)

        def advance(steps: int) -> None:
            for _ in range(steps // scene.smoke.substeps):
                now = solver.steps * scene.smoke.substeps * scene.step
                active = [*always, *(source.active(now) for source in scene.sources)]
                solver.sources = tuple(source for source, on in zip(sources, active, strict=True) if on)
                solver.step()

        def smoke() -> DensityVolume:
            volume = volume_of(scene, solver)
            heat = None if volume.temperature is None else volume.temperature.clone()
            return replace(volume, density=volume.density.clone(), temperature=heat)

        frames = []
        early = _EARLY if any(source.stop is not None for source in scene.sources) else 1.0
        with stream(self.device):
            advance(settings.lattice_steps(early * settings.warmup))
            for number in range(self.sizes.frames):
                if number:
                    advance(settings.lattice_steps(settings.apart))
                earlier = smoke()
                advance(settings.steps)
                later = smoke()
                reach = scene.grid.cell * settings.steps
                moved = motion(later, solver.velocity, self.camera, reach=reach)
                frames.append(Frame(earlier, later, moved, 2 * number))
            solver.check()
        self.simulation = scene, solver
        return frames


class Pipeline:
    """All stages from smoke to lightmaps by a network: guiding map, network, and decoding of its output planes.

    Attributes:
        subject: The network with its settings.
        decoder: The network, ready to run on the device.
    """

    def __init__(self, bench: NetworkBench, subject: Subject, *, half: bool) -> None:
        size = bench.sizes.resolution
        self.subject, self.camera = subject, bench.camera
        self.decoder = subject.model.decoder(bench.device, height=size, width=size, half=half)
        self._bench = bench

    def planes(self, volume: DensityVolume, camera: Camera, seed: int) -> torch.Tensor:
        """Predicts the image planes [8, H, W] of smoke seen by a camera; the result is a copy."""
        look = self.subject.settings.look(volume.shape, seed)
        with stream(self._bench.device):
            return self.decoder(render_guide(volume, camera, self.decoder.guide, look)).clone()

    def parts(self, frame: Frame) -> dict[str, Callable[[], object]]:
        """Returns the three calls that make a frame's guiding map, its output planes and its lightmaps, by name."""
        look = self.subject.settings.look(frame.later.shape, frame.seed + 1)
        kind, hot = self.decoder.guide, frame.later.temperature is not None
        encoded = render_guide(frame.later, self.camera, kind, look)
        planes = self.decoder(encoded)

        def guided() -> None:
            encoded.copy_(render_guide(frame.later, self.camera, kind, look))

        def decoded() -> SixWay:
            return decode_lightmaps(planes, hot=hot)

        return {
            "guide": self._bench.replay(guided),
            # A graph by itself.
            "network": lambda: self.decoder(encoded),
            "decode": self._bench.replay(decoded),
        }


def score(predicted: Sequence[torch.Tensor], references: Sequence[torch.Tensor]) -> dict[str, float]:
    """Computes the PSNR of each image [8, H, W] over its six lightmaps in sRGB. Returns mean, minimum and maximum."""
    lightmaps = slice(len(DIRECTIONS))
    psnr = [
        psnr_from_mse(float((a[lightmaps].double() - b[lightmaps].double()).square().mean()), 1.0)
        for a, b in zip(predicted, references, strict=True)
    ]
    return {"psnr": sum(psnr) / len(psnr), "psnr_min": min(psnr), "psnr_max": max(psnr)}


def open_subjects(networks: Sequence[str | Path], profiles: Sequence[str]) -> list[Subject]:
    """Reads trained networks from files, and makes untrained networks from profiles.

    Raises:
        WlmError: A file or a profile can't be read, a file lacks its dataset's settings, or two names are the same.
    """
    subjects = []
    for path in map(Path, networks):
        model = open_network(path)
        subjects.append(Subject(path.stem, model, model.dataset, True))
    for name in profiles:
        profile = Profile.load(name)
        torch.manual_seed(0)
        model = SmokeModel(SixWayNetwork(profile.network), {})
        subjects.append(Subject(f"{profile.name} untrained", model, profile.dataset, False))
    names = [subject.name for subject in subjects]
    for name in names:
        if names.count(name) > 1:
            raise WlmError(f"expected networks of different names, got {name} {names.count(name)} times")
    return subjects


def run(
    *,
    networks: Sequence[str | Path] | None = None,
    profiles: Sequence[str] | None = None,
    quick: bool,
    device: str,
    progress: Note | None = None,
) -> list[Row]:
    """Measures neural six-way lightmaps and their rivals.

    Args:
        networks: Files of trained networks; if neither these nor profiles are given, the network that wlm ships.
        profiles: Names of profiles; an untrained network of each is timed.
        quick: Whether to use small grids, for a minute on a CPU, instead of the paper's grids, for a GPU.
        device: "cpu" or "cuda:0".
        progress: Called with a line before each part of the work.

    Returns:
        The rows of each method, in the order in which the module's docstring lists them.

    Raises:
        WlmError: A file cannot be read, or the device does not exist or has not enough memory.
    """
    subjects = open_subjects(networks or ([] if profiles else [shipped()]), profiles or ())
    return run_rows(QUICK if quick else FULL, subjects, device=device, progress=progress)


def run_rows(
    sizes: NetworkSizes, subjects: Sequence[Subject], *, device: str, progress: Note | None = None
) -> list[Row]:
    """Measures networks on grids of the given sizes. Other arguments are as for `run`."""
    bench = NetworkBench(device, sizes, subjects, progress)
    parts = (error_rows, frame_rows, flipbook_rows, traced_rows, profile_rows, density_rows)
    return [row for part in parts for row in part(bench)]


def error_rows(bench: NetworkBench) -> list[Row]:
    """Measures the time and the error of ray marches at several step sizes and of networks."""
    bench.note("measuring time and error")
    marches = {f"six ways, step {step:g}": _six(step) for step in bench.sizes.six}
    steps_of = {f"coarse, h {step:g}": (step, step) for step in bench.sizes.coarse}
    steps_of |= {f"coarse, h {step:g}, nodes {spacing:g}": (step, spacing) for step, spacing in bench.sizes.swept}
    marches |= {name: _coarse(*steps) for name, steps in steps_of.items()}
    predicted = {name: _encoded(method) for name, method in marches.items()}
    reference = f"six ways, step {EXACT:g}"
    notes = {reference: "the reference"}
    calls = {name: _on_all(bench, method) for name, method in marches.items()}
    chains: dict[str, Callable[[], object]] = {}  # replays of the graphs of each network
    for subject in bench.subjects:
        for half in (True, False) if bench.device != "cpu" else (False,):
            name = f"{subject.name}, {'fp16' if half else 'fp32'}"
            pipeline = Pipeline(bench, subject, half=half)
            if subject.trained:
                predicted[name] = pipeline.planes
            else:
                notes[name] = "not trained"
            calls[name] = _on_all(bench, _network(pipeline))
            parts = [part for frame in bench.frames for part in pipeline.parts(frame).values()]
            chains[name] = _in_turn(parts)
    long = {name for name in calls if name.startswith("six ways") and float(name.split()[-1]) <= _LONG}
    short_calls = {name: call for name, call in calls.items() if name not in long}
    long_calls = {name: call for name, call in calls.items() if name in long}
    eager = bench.time(short_calls) | bench.time(long_calls, few=True)
    # The fine march waits for the device to choose its steps, which a graph can't hold.
    coarse = {name: call for name, call in short_calls.items() if name.startswith("coarse")}
    graphs = bench.replayed(coarse)
    if bench.device != "cpu":
        graphs |= bench.time(chains)
    count = len(bench.frames)
    glowing = [i for i, frame in enumerate(bench.frames) if frame.later.temperature is not None]
    rows = []
    for name in calls:
        figures = {}
        if name in predicted and name != reference:
            planes = [predicted[name](frame.later, bench.camera, frame.seed + 1) for frame in bench.frames]
            figures = score(planes, bench.references)
            figures["opacity_psnr"] = _plane_psnr(OPACITY_PLANE, planes, bench.references)
            if glowing:
                parts = ([images[i] for i in glowing] for images in (planes, bench.references))
                figures["emission_psnr"] = _plane_psnr(EMISSION_PLANE, *parts)
        if name in graphs:
            figures["call_ms"] = eager[name].median_ms / count
        timing = graphs.get(name, eager[name])
        rows.append(bench.row(_TABLE, name, notes.get(name, ""), timing=timing, calls=count, **figures))
    return rows


def plotted(rows: Sequence[Row]) -> list[Row]:
    """Returns the rows of "time against error" for a plot, which groups them by the first part of their option."""
    points = []
    for row in rows:
        if row.method == _TABLE:
            method, _, option = row.option.partition(", ")
            points.append(replace(row, method=method, option=option))
    return points


def _plane_psnr(plane: int, predicted: Sequence[torch.Tensor], references: Sequence[torch.Tensor]) -> float:
    """Returns the PSNR of one image plane, given by its index, over all frames."""
    squares = [float((a[plane] - b[plane]).square().mean()) for a, b in zip(predicted, references, strict=True)]
    return psnr_from_mse(sum(squares) / len(squares), 1.0)


_Method = Callable[[DensityVolume, Camera, int], SixWay]
"""Smoke, a camera and a seed to lightmaps."""


def _six(step: float) -> _Method:
    return lambda volume, camera, seed: bake(volume, camera, step=step, estimate=False)


def _coarse(step: float, spacing: float) -> _Method:
    return lambda volume, camera, seed: bake_coarse(volume, camera, March(step, spacing, seed=seed))


def _network(pipeline: Pipeline) -> _Method:
    decoder = pipeline.decoder

    def lightmaps(volume: DensityVolume, camera: Camera, seed: int) -> SixWay:
        look = pipeline.subject.settings.look(volume.shape, seed)
        planes = decoder(render_guide(volume, camera, decoder.guide, look))
        return decode_lightmaps(planes, hot=volume.temperature is not None)

    return lightmaps


def _encoded(method: _Method) -> Callable[[DensityVolume, Camera, int], torch.Tensor]:
    return lambda volume, camera, seed: encode_lightmaps(method(volume, camera, seed))


def _on_all(bench: NetworkBench, method: _Method) -> Callable[[], object]:
    return lambda: [method(frame.later, bench.camera, frame.seed + 1) for frame in bench.frames]


def _in_turn(parts: Sequence[Callable[[], object]]) -> Callable[[], object]:
    return lambda: [part() for part in parts]


def frame_rows(bench: NetworkBench) -> list[Row]:
    """Times the simulation, guiding map, network and decoding for each network, and the shading of a frame."""
    bench.note("timing the stages of a frame")
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
    """Times the network of each profile, with random weights."""
    bench.note("timing the networks of all profiles")
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
    """Measures error and flicker of the networks and of the coarse ray march on thinner and denser smoke."""
    bench.note("measuring thinner and denser smoke")
    size, step = bench.sizes.resolution, bench.settings.look(bench.frames[0].later.shape).step
    rows = []
    for scale in bench.sizes.scales:
        frames = [frame.scaled(scale) for frame in bench.frames]
        targets = torch.stack([torch.stack([bench.reference(smoke) for smoke in frame.smoke]) for frame in frames])
        evaluations = {}
        for subject in bench.trained:
            decoder = subject.model.decoder(bench.device, height=size, width=size)
            pool = _pool(bench, frames, targets, subject.settings)
            evaluations[subject.name] = score_pool(of_decoder(decoder), pool)
        for share in _MARCHES:
            changed = {"guide": "six", "guide_step": share * bench.settings.guide_step}
            pool = _pool(bench, frames, targets, bench.settings.model_copy(update=changed))
            evaluations[f"coarse, h {share * step:g}"] = score_pool(coarse, pool)
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
    """Makes an evaluation sample of each frame: guiding maps by the given settings, motion, and target lightmaps."""
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


def flipbook_rows(bench: NetworkBench) -> list[Row]:
    """Measures the error of a flip book baked for one camera and seen by cameras that are turned from this one."""
    bench.note("measuring the flip book")
    frames = bench.frames[:: bench.sizes.frames]  # one of each scene
    baked = [bake(frame.later, bench.camera, step=EXACT, estimate=False) for frame in frames]
    pivots = [frame.later.centre for frame in frames]
    ours = Pipeline(bench, bench.trained[0], half=True) if bench.trained else None
    settings = bench.settings if ours is None else ours.subject.settings
    step = settings.look(frames[0].later.shape).step
    rows = []
    for degrees in bench.sizes.turns:
        camera = bench.turned(degrees)
        references = [bench.reference(frame.later, camera) for frame in frames]

        def turned(camera=camera) -> list[SixWay]:
            return [billboard(six, bench.camera, camera, at) for six, at in zip(baked, pivots, strict=True)]

        marched = [bake_coarse(frame.later, camera, March(step, seed=frame.seed + 1)) for frame in frames]
        figures = score([encode_lightmaps(six) for six in turned()], references)
        figures["coarse_psnr"] = score([encode_lightmaps(six) for six in marched], references)["psnr"]
        notes = f"coarse march of h {step:g}"
        if ours is not None:
            planes = [ours.planes(frame.later, camera, frame.seed + 1) for frame in frames]
            figures["network_psnr"] = score(planes, references)["psnr"]
            notes += f", network {ours.subject.name}"
        timing = bench.time({"": turned}, few=True)[""]
        rows.append(bench.row("flip book", f"turned {degrees:g}°", notes, timing=timing, calls=len(frames), **figures))
    return rows


def traced_rows(bench: NetworkBench) -> list[Row]:
    """Measures six-way lightmaps by Mitsuba on the CPU, raw and denoised; no rows without the extra `bake`."""
    if not has_tracer():
        bench.note("path tracing is left out, because mitsuba is not installed: install wlm[bake]")
        return []
    bench.note("measuring path tracing")
    numbers = range(0, len(bench.frames), bench.sizes.frames)  # one frame of each scene
    tracers = [PathTracer(bench.frames[i].later, bench.camera) for i in numbers]
    references = [bench.references[i].cpu() for i in numbers]
    traced = {count: [tracer(count)[0] for tracer in tracers] for count in bench.sizes.samples}
    calls: dict[str, Callable[[], object]] = {_samples(count): partial(tracers[0], count) for count in traced}
    if has_denoiser():
        calls[_DENOISED] = partial(denoise, traced[bench.sizes.samples[0]][0])
    times = {name: timing.median_ms for name, timing in time_together(calls, "cpu", 1, bench.sizes.few).items()}
    rows = []
    for count, images in traced.items():
        made = {_samples(count): (images, times[_samples(count)])}
        if _DENOISED in times:
            total = times[_samples(count)] + times[_DENOISED]
            made[f"{_samples(count)}, {_DENOISED}"] = [denoise(image) for image in images], total
        for option, (pictures, time_ms) in made.items():
            planes = [to_srgb(torch.from_numpy(picture)) for picture in pictures]
            figures = score(planes, references) | {"time_ms": time_ms, "pixels": bench.sizes.resolution}
            rows.append(bench.row("path tracing", option, f"on the CPU, {tracers[0].variant}", **figures))
    return rows


def _samples(count: int) -> str:
    return "1 sample" if count == 1 else f"{count} samples"
