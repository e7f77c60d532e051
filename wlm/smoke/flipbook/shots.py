"""Frames to render: lightmaps, baked from smoke or read from files, with a scene's obstacles and colours."""

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import Camera
from wlm.smoke.data import SCENE_FILE, Frames, numbered, read_shaded, spread
from wlm.smoke.flipbook.textures import is_straight, read_flipbook
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.coarse import guide
from wlm.smoke.march.fine import bake
from wlm.smoke.scene import CameraSettings, Looks
from wlm.system import Meter, OnProgress
from wlm_kernels.smoke.settings import March

_SURFACE = March(step=1.0, jitter=0.0)  # march for the depth at which shadows of obstacles fall


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame to render.

    Attributes:
        number: Number of the frame.
        six: Lightmaps with their camera; if there are obstacles, also with their depth.
        looks: Lights, colours and obstacles of the scene; None: there is no scene.
        warnings: Repairs of the volume, one line each.
    """

    number: int
    six: SixWay
    looks: Looks | None = None
    warnings: tuple[str, ...] = ()


def with_surface(six: SixWay, volume: DensityVolume, looks: Looks | None) -> SixWay:
    """Returns the lightmaps with the depth at which obstacles and their shadows are drawn, if there are obstacles.

    The depth is always that of a march in steps of a voxel.
    """
    if looks is None or not looks.obstacles:
        return replace(six, depth=None)
    return replace(six, depth=guide(volume, six.camera, _SURFACE).depth)


@dataclass(frozen=True)
class FramesToBake:
    """Smoke whose lightmaps are baked frame by frame.

    Attributes:
        frames: The smoke.
        camera: Orthographic.
        step, supersample: As for `bake`.
    """

    frames: Frames
    camera: CameraSettings
    step: float = 1.0
    supersample: int = 1

    @property
    def single(self) -> bool:
        """Whether this is a single file instead of a folder."""
        return self.frames.single

    def shots(self, count: int | None = None, progress: OnProgress | None = None) -> Iterator[Shot]:
        """Bakes frames one after the other.

        Args:
            count: Largest number of frames, evenly spread; None: all.
            progress: Called after each frame.

        Raises:
            WlmError: A frame is missing or damaged.
        """
        for number, volume in self.frames.volumes(spread(self.frames.numbers, count), progress):
            camera = self.frames.view(self.camera, volume)
            six = bake(volume, camera, step=self.step, supersample=self.supersample, estimate=False)
            looks = self.frames.looks(number)
            yield Shot(number, with_surface(six, volume, looks), looks, volume.warnings)


@dataclass(frozen=True)
class BakedFiles:
    """Lightmaps that `bake` or `predict` wrote.

    Attributes:
        files: EXR files by number.
        single: Whether this is a single file instead of a folder.
        device: Device of the lightmaps.
    """

    files: dict[int, Path]
    single: bool
    device: str = "cpu"

    def shots(self, count: int | None = None, progress: OnProgress | None = None) -> Iterator[Shot]:
        """Reads frames one after the other; arguments as for `FramesToBake.shots`.

        Raises:
            WlmError: A file is damaged or of another kind.
        """
        numbers = spread(tuple(self.files), count)
        meter = Meter(progress, "read", len(numbers))
        for done, number in enumerate(numbers, 1):
            yield Shot(number, *read_shaded(self.files[number], self.device))
            meter.report(done)


@dataclass(frozen=True)
class FlipBook:
    """Lightmaps in an engine's textures; the camera is unknown and taken to be in front.

    Attributes:
        files: Two textures, and optionally one of opacity.
        layout, rows, columns, straight: As for `wlm.smoke.flipbook.textures.read_flipbook`.
        device: Device of the lightmaps.
    """

    files: tuple[Path, ...]
    layout: str
    rows: int
    columns: int
    straight: bool = False
    device: str = "cpu"

    @property
    def single(self) -> bool:
        """Whether there is only one frame."""
        return self.rows * self.columns == 1

    def shots(self, count: int | None = None, progress: OnProgress | None = None) -> Iterator[Shot]:
        """Reads the textures and yields their cells; arguments as for `FramesToBake.shots`.

        Raises:
            WlmError: A file is damaged, of another size, or lacks a channel.
        """
        frames = read_flipbook(self.files, self.layout, rows=self.rows, columns=self.columns, straight=self.straight)
        warnings: tuple[str, ...] = ()
        if not self.straight and is_straight(frames):
            warnings = (f"{self.files[0]}: light where there is no smoke: is it straight (--straight)?",)
        height, width = frames[0].lightmaps.shape[1:]
        camera = Camera.look_at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), extent=1.0, height=height, width=width)
        numbers = spread(range(1, len(frames) + 1), count)
        meter = Meter(progress, "read", len(numbers))
        for done, number in enumerate(numbers, 1):
            six, planes = frames[number - 1], ("lightmaps", "transparency", "emission")
            moved = {name: plane.to(self.device) for name in planes if (plane := getattr(six, name)) is not None}
            yield Shot(number, replace(six, **moved, camera=camera), warnings=warnings if done == 1 else ())
            meter.report(done)


def baked_files(path: str | os.PathLike[str], device: str = "cpu") -> BakedFiles | None:
    """Finds files that `bake` or `predict` wrote: the path itself, or files in the folder.

    Returns:
        None if the path is another file or folder.
    """
    path = Path(path)
    if path.suffix.lower() == ".exr":
        return BakedFiles({1: path}, True, device)
    if not path.is_dir() or (path / SCENE_FILE).exists():
        return None
    files = numbered(path, "six", ".exr")
    return BakedFiles(files, False, device) if files else None
