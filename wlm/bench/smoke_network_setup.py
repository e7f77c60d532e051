"""What the parts of the networks' benchmark share: sizes, frames that no network has learned from, networks, scores."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from wlm.bench.runner import Row
from wlm.bench.smoke_setup import Bench
from wlm.bench.smoke_setup import row as smoke_row
from wlm.bench.timing import Timing
from wlm.errors import WlmError
from wlm.fluid.solver import Solver
from wlm.fluid.volume import DensityVolume
from wlm.interop import StepGraph, stream
from wlm.metrics.error import psnr_from_mse
from wlm.smoke.baking import bake
from wlm.smoke.camera import DIRECTIONS, Camera
from wlm.smoke.codec import open_network
from wlm.smoke.learn.scenes import draw_scene
from wlm.smoke.learn.settings import DatasetSettings
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.model import Profile, SixWayNetwork, SmokeModel
from wlm.smoke.motion import motion
from wlm.smoke.planes import decode_lightmaps, encode_lightmaps, render_guide
from wlm.smoke.scene import CameraSettings, Scene, make_camera
from wlm.smoke.simulation import make_solver, volume_of

__all__ = [
    "EXACT",
    "FULL",
    "QUICK",
    "SCENE",
    "Frame",
    "NetworkBench",
    "NetworkSizes",
    "Scores",
    "Subject",
    "Whole",
    "open_subjects",
    "row",
    "score",
]

SCENE = "unseen smoke"
EXACT = 0.5
"""Voxels, the step of the march that all is held against."""

_DRAWN = 64  # scenes, of which the first of each kind is taken
_TURN = 20.0  # degrees by which the camera is off the box's axis
_EXTENT = 1.1  # of the image over the box's edge
_EARLY = 0.35  # of the time before the first frame, where the smoke's source soon stops


@dataclass(frozen=True)
class NetworkSizes:
    """Grids, steps and repeats.

    Attributes:
        cells, refine: Cells of the air along the box's edge, and voxels along a cell's.
        resolution: Pixels along an image's edge.
        kinds: Of scenes, one of each.
        frames: Of each scene.
        six, coarse: Steps in voxels of the fine march and of the coarse one, whose nodes are as far apart.
        swept: Steps of the coarse march and distances of its nodes, in voxels.
        turns: Degrees by which the camera turns away from what a flip book was baked from.
        scales: Of the density.
        profile: Pixels along the edge of the images that profiles are timed with.
        samples: A pixel, of the path tracer.
        warmup, repeats: Calls before the first that is timed, and samples.
        few: Samples of what takes long.
    """

    cells: int
    refine: int
    resolution: int
    kinds: tuple[str, ...]
    frames: int
    six: tuple[float, ...]
    coarse: tuple[float, ...]
    swept: tuple[tuple[float, float], ...]
    turns: tuple[float, ...]
    scales: tuple[float, ...]
    profile: int
    samples: tuple[int, ...]
    warmup: int
    repeats: int
    few: int


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
    """Smoke twice, a moment apart.

    Attributes:
        name: Of its scene.
        earlier, later: The smoke.
        motion: [2, H, W], as `Pool.motion`, from the first camera.
        seed: Of the guiding map's jitter, one more for the later one.
    """

    name: str
    earlier: DensityVolume
    later: DensityVolume
    motion: torch.Tensor
    seed: int

    @property
    def smoke(self) -> tuple[DensityVolume, DensityVolume]:
        """Both, in order."""
        return self.earlier, self.later

    def scaled(self, factor: float) -> Frame:
        """With as many times the density."""
        parts = (replace(part, extinction=part.extinction * factor) for part in self.smoke)
        return Frame(self.name, *parts, self.motion, self.seed)


@dataclass(frozen=True, eq=False)
class Subject:
    """A network, and how its guiding maps look at smoke.

    Attributes:
        name: In tables.
        model: On the CPU.
        settings: Of the samples that it learned from, or would.
        trained: Otherwise its weights are random, and its time alone says something.
    """

    name: str
    model: SmokeModel
    settings: DatasetSettings
    trained: bool


@dataclass(frozen=True)
class Scores:
    """PSNR of images, each over its six lightmaps in sRGB: mean, least and most, decibels."""

    mean: float
    least: float
    most: float

    @property
    def figures(self) -> dict[str, str]:
        """For a table, beside the mean."""
        return {"least dB": f"{self.least:.2f}", "most dB": f"{self.most:.2f}"}


class NetworkBench(Bench):
    """A device, sizes, networks, a camera, and frames of scenes that nothing has learned from."""

    def __init__(
        self,
        device: str,
        sizes: NetworkSizes,
        subjects: Sequence[Subject],
        progress: Callable[[str], None] | None = None,
    ) -> None:
        super().__init__(device, sizes, progress)
        self.subjects = tuple(subjects)
        self.settings = DatasetSettings(cells=sizes.cells, refine=sizes.refine, resolution=sizes.resolution)
        self.camera = self.turned(0.0)
        self.frames: list[Frame] = []
        self.simulation: tuple[Scene, Solver] | None = None
        """The last scene, to go on with."""
        self._simulate()
        self.references = [self.reference(frame.later) for frame in self.frames]
        """Planes [8, H, W] of the later frames."""

    @property
    def trained(self) -> list[Subject]:
        """Those that have learned."""
        return [subject for subject in self.subjects if subject.trained]

    def turned(self, degrees: float) -> Camera:
        """The camera, turned about the smoke's middle."""
        view = CameraSettings(extent=_EXTENT, resolution=self.sizes.resolution).turned(_TURN + degrees)
        return make_camera(view, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))

    def reference(self, volume: DensityVolume, camera: Camera | None = None) -> torch.Tensor:
        """Planes [8, H, W] by the finest march."""
        return encode_lightmaps(bake(volume, camera or self.camera, step=EXACT, estimate=False))

    def replayed(self, calls: Mapping[str, Callable[[], object]], *, few: bool = False) -> dict[str, Timing]:
        """Times calls as graphs; on a CPU there is nothing to replay."""
        if self.device == "cpu":
            return {}
        return self.time({key: StepGraph(call, self.device, warmup=1) for key, call in calls.items()}, few=few)

    def _simulate(self) -> None:
        """Takes frames of the first scene of each kind among those of the seed by which no network is chosen."""
        kinds, found, trouble = self.sizes.kinds, {}, None
        for index in range(_DRAWN):
            scene = draw_scene(self.settings, self.settings.test_seed, index, validation=True)
            kind = scene.name.split()[0]
            if kind in found or kind not in kinds:
                continue
            self.note(f"simulates {scene.name}")
            try:
                found[kind] = self._run(scene)
            except WlmError as error:
                trouble = str(error)  # of which another is drawn
            if len(found) == len(kinds):
                break
        if len(found) < len(kinds):
            raise WlmError(f"bench: expected scenes of {', '.join(kinds)}, got {', '.join(found)}; the last: {trouble}")
        self.frames = [frame for kind in kinds for frame in found[kind]]

    def _run(self, scene: Scene) -> list[Frame]:
        settings, solver = self.settings, make_solver(scene, device=self.device)
        sources = solver.sources
        always = [True] * len(scene.inlets)

        def advance(steps: int) -> None:
            for _ in range(steps // scene.smoke.substeps):
                now = solver.steps * scene.smoke.substeps * scene.step
                works = [*always, *(source.active(now) for source in scene.sources)]
                solver.sources = tuple(source for source, on in zip(sources, works, strict=True) if on)
                solver.step()

        def smoke() -> DensityVolume:
            seen = volume_of(scene, solver)
            heat = None if seen.temperature is None else seen.temperature.clone()
            return replace(seen, density=seen.density.clone(), temperature=heat)

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
                frames.append(Frame(scene.name, earlier, later, moved, 2 * number))
            solver.check()
        self.simulation = scene, solver
        return frames


class Whole:
    """From smoke to lightmaps by a network: guiding map, network, and planes decoded to light, as graphs on a GPU.

    Attributes:
        subject: The network.
        decoder: It at work.
        guided: The guiding map, written in place.
    """

    def __init__(self, bench: NetworkBench, subject: Subject, *, half: bool) -> None:
        size = bench.sizes.resolution
        self.subject, self.camera = subject, bench.camera
        self.decoder = subject.model.decoder(bench.device, height=size, width=size, half=half)
        self._device = bench.device

    def planes(self, volume: DensityVolume, camera: Camera, seed: int) -> torch.Tensor:
        """What the network makes of smoke, [8, H, W]; a copy."""
        look = self.subject.settings.look(volume.shape, seed)
        with stream(self._device):
            return self.decoder(render_guide(volume, camera, self.decoder.guide, look)).clone()

    def parts(self, frame: Frame) -> dict[str, Callable[[], object]]:
        """Calls that make a frame's guiding map, planes and lightmaps, each from what the one before left."""
        look = self.subject.settings.look(frame.later.shape, frame.seed + 1)
        kind, hot = self.decoder.guide, frame.later.temperature is not None
        encoded = render_guide(frame.later, self.camera, kind, look)
        made = self.decoder(encoded)

        def guided() -> None:
            encoded.copy_(render_guide(frame.later, self.camera, kind, look))

        def decoded() -> SixWay:
            return decode_lightmaps(made, hot=hot and self.decoder.emission)

        return {
            "guide": StepGraph(guided, self._device, warmup=1),
            # A graph by itself.
            "network": lambda: self.decoder(encoded),
            "decode": StepGraph(decoded, self._device, warmup=1),
        }


def score(made: Sequence[torch.Tensor], references: Sequence[torch.Tensor]) -> Scores:
    """Of planes [8, H, W] against others."""
    lightmaps = slice(len(DIRECTIONS))
    found = [
        psnr_from_mse(float((a[lightmaps].double() - b[lightmaps].double()).square().mean()), 1.0)
        for a, b in zip(made, references, strict=True)
    ]
    return Scores(sum(found) / len(found), min(found), max(found))


def open_subjects(networks: Sequence[str | Path], profiles: Sequence[str]) -> list[Subject]:
    """Reads networks, and makes untrained ones of profiles.

    Raises:
        WlmError: A file or a profile can't be read, a file lacks the settings of its samples, or two have one name.
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
            raise WlmError(f"bench: expected networks of different names, got {name} {names.count(name)} times")
    return subjects


def row(method: str, option: str, figures: Mapping[str, str] | None = None, note: str = "", **values) -> Row:
    """A row of this benchmark; the rest as for `smoke_setup.row`."""
    return smoke_row(SCENE, method, option, figures, note, system="smoke-network", **values)
