"""What the parts of the networks' benchmark share: sizes, held-out frames, networks, scores."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from benchmarks.runner import Bench, Note
from benchmarks.timing import Timing
from wlm.errors import WlmError
from wlm.fluid.solver import Solver
from wlm.fluid.volume import DensityVolume
from wlm.interop import stream
from wlm.metrics.error import psnr_from_mse
from wlm.smoke.camera import DIRECTIONS, Camera
from wlm.smoke.codec import open_network
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.fine import bake
from wlm.smoke.march.motion import motion
from wlm.smoke.model import SmokeModel
from wlm.smoke.network.planes import decode_lightmaps, encode_lightmaps, render_guide
from wlm.smoke.network.scenes import draw_scene
from wlm.smoke.network.settings import DatasetSettings, Profile
from wlm.smoke.network.unet import SixWayNetwork
from wlm.smoke.scene import CameraSettings, Scene, make_camera
from wlm.smoke.simulation import make_solver, volume_of

SCENE = "unseen smoke"
EXACT = 0.5
"""Voxels, the step of the reference march."""

_DRAWN = 64  # scenes, of which the first one of each kind is taken
_TURN = 20.0  # degrees by which the camera is off the box's axis
_EXTENT = 1.1  # of the image over the box's edge
_EARLY = 0.35  # of the time before the first frame, where the smoke's source soon stops


@dataclass(frozen=True)
class NetworkSizes:
    """Grids, steps and repeats."""

    cells: int  # of the air along the box's edge
    refine: int  # voxels along a cell's edge
    resolution: int  # pixels along an image's edge
    kinds: tuple[str, ...]  # of scenes, one scene of each
    frames: int  # of each scene
    six: tuple[float, ...]  # steps in voxels of the fine march
    coarse: tuple[float, ...]  # and of the coarse one, whose nodes are as far apart
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
    """A pair of frames, a moment apart.

    Attributes:
        earlier, later: The smoke.
        motion: [2, H, W], as `Pool.motion`, from the bench's camera.
        seed: Of the guiding map's jitter, one more for the later frame.
    """

    earlier: DensityVolume
    later: DensityVolume
    motion: torch.Tensor
    seed: int

    @property
    def smoke(self) -> tuple[DensityVolume, DensityVolume]:
        """Both, in order."""
        return self.earlier, self.later

    def scaled(self, factor: float) -> "Frame":
        """The pair with another density."""
        parts = (replace(part, extinction=part.extinction * factor) for part in self.smoke)
        return Frame(*parts, self.motion, self.seed)


@dataclass(frozen=True, eq=False)
class Subject:
    """A network, and how its guiding maps are made.

    Attributes:
        name: In tables.
        model: On the CPU.
        settings: Of the samples of its training.
        trained: False where its weights are random and only its time is measured.
    """

    name: str
    model: SmokeModel
    settings: DatasetSettings
    trained: bool


class NetworkBench(Bench):
    """Sizes, networks, a camera, and held-out frames."""

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
        """The networks that are scored."""
        return [subject for subject in self.subjects if subject.trained]

    def turned(self, degrees: float) -> Camera:
        """The camera, turned about the smoke's centre."""
        view = CameraSettings(extent=_EXTENT, resolution=self.sizes.resolution).turned(_TURN + degrees)
        return make_camera(view, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))

    def reference(self, volume: DensityVolume, camera: Camera | None = None) -> torch.Tensor:
        """Planes [8, H, W] by the finest march."""
        return encode_lightmaps(bake(volume, camera or self.camera, step=EXACT, estimate=False))

    def replayed(self, calls: Mapping[str, Callable[[], object]], *, few: bool = False) -> dict[str, Timing]:
        """Times calls as graphs; on a CPU there is nothing to replay."""
        if self.device == "cpu":
            return {}
        return self.time({key: self.replay(call) for key, call in calls.items()}, few=few)

    def _simulate(self) -> None:
        """Takes frames of the first scene of each kind, drawn with the seed that is held out from model selection."""
        kinds, frames, trouble = self.sizes.kinds, {}, None
        for index in range(_DRAWN):
            scene = draw_scene(self.settings, self.settings.test_seed, index, validation=True)
            kind = scene.name.split()[0]
            if kind in frames or kind not in kinds:
                continue
            self.note(f"simulates {scene.name}")
            try:
                frames[kind] = self._run(scene)
            except WlmError as error:
                trouble = str(error)  # another scene of this kind is drawn
            if len(frames) == len(kinds):
                break
        if len(frames) < len(kinds):
            raise WlmError(f"bench: expected scenes of {', '.join(kinds)}, got {', '.join(frames)}; last: {trouble}")
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
    """The whole way from smoke to lightmaps by a network: guiding map, network, and planes decoded to light.

    Attributes:
        subject: The network.
        decoder: The network as it is used.
    """

    def __init__(self, bench: NetworkBench, subject: Subject, *, half: bool) -> None:
        size = bench.sizes.resolution
        self.subject, self.camera = subject, bench.camera
        self.decoder = subject.model.decoder(bench.device, height=size, width=size, half=half)
        self._bench = bench

    def planes(self, volume: DensityVolume, camera: Camera, seed: int) -> torch.Tensor:
        """The planes that the network predicts, [8, H, W]; a copy."""
        look = self.subject.settings.look(volume.shape, seed)
        with stream(self._bench.device):
            return self.decoder(render_guide(volume, camera, self.decoder.guide, look)).clone()

    def parts(self, frame: Frame) -> dict[str, Callable[[], object]]:
        """Calls that make a frame's guiding map, planes and lightmaps, each from the result of the one before."""
        look = self.subject.settings.look(frame.later.shape, frame.seed + 1)
        kind, hot = self.decoder.guide, frame.later.temperature is not None
        encoded = render_guide(frame.later, self.camera, kind, look)
        planes = self.decoder(encoded)

        def guided() -> None:
            encoded.copy_(render_guide(frame.later, self.camera, kind, look))

        def decoded() -> SixWay:
            return decode_lightmaps(planes, hot=hot and self.decoder.emission)

        return {
            "guide": self._bench.replay(guided),
            # A graph by itself.
            "network": lambda: self.decoder(encoded),
            "decode": self._bench.replay(decoded),
        }


def score(predicted: Sequence[torch.Tensor], references: Sequence[torch.Tensor]) -> dict[str, float]:
    """Scores planes [8, H, W]: the PSNR of images, each over its six lightmaps in sRGB, their mean, least and most."""
    lightmaps = slice(len(DIRECTIONS))
    psnr = [
        psnr_from_mse(float((a[lightmaps].double() - b[lightmaps].double()).square().mean()), 1.0)
        for a, b in zip(predicted, references, strict=True)
    ]
    return {"psnr": sum(psnr) / len(psnr), "psnr_min": min(psnr), "psnr_max": max(psnr)}


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
