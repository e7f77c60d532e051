"""A scene as pictures, in memory: each frame is simulated, lit and drawn before the next, with no file between.

On CUDA the light of a frame, from its march to its picture, is one graph, but where a network makes the lightmaps: that
has a graph of its own.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import warp as wp

from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import Camera
from wlm.smoke.coarse import march
from wlm.smoke.guiding import guide
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.prediction import SmokePredictor
from wlm.smoke.replay import VolumeGraph
from wlm.smoke.scene import Scene, make_camera
from wlm.smoke.simulation import advance, make_solver, volume_of
from wlm.system import Meter, OnProgress
from wlm.view.smoke import to_bytes
from wlm.view.smoke_drawing import Drawing
from wlm_kernels.smoke.settings import March

SIMULATION, LIGHTMAPS, DRAWING, GRAPH, BYTES = "simulation", "lightmaps", "shadows and picture", "one graph", "bytes"
"""Stages of a frame. A graph is of the lightmaps and the picture; it is measured beside them, which come before it."""

MARCH = 130
"""Steps of the march along the longest edge, where none are given."""

_STAGED = 4  # frames of which each stage is measured before a graph takes over
_SURFACE = March(step=2.0, jitter=0.0)  # of the depth at which shadows fall, where a network makes the lightmaps


@dataclass(frozen=True)
class Lighting:
    """How the lightmaps of a frame are made.

    Attributes:
        step: Of the march, in voxels; None: 1 / `MARCH` of the longest edge.
        network: Makes them in place of the march; None: the march.
        seed: Of the march's jitter.
    """

    step: float | None = None
    network: SmokePredictor | None = None
    seed: int = 0

    def __call__(self, volume: DensityVolume, camera: Camera, surface: bool) -> SixWay:
        """Makes them, on the smoke's device; with the depth of the smoke's surface if it is asked for."""
        if self.network is None:
            longest = max(volume.shape)
            return march(volume, camera, March(longest / MARCH if self.step is None else self.step, seed=self.seed))
        six = self.network(volume, camera, self.seed)
        return replace(six, depth=guide(volume, camera, _SURFACE).depth) if surface else six


@dataclass
class Frame:
    """A frame as it comes out.

    Attributes:
        number: From 1.
        pixels: uint8 [H, W, 3] in sRGB.
        seconds: What each stage took, by its name.
    """

    number: int
    pixels: np.ndarray
    seconds: dict[str, float] = field(default_factory=dict)


def run(
    scene: Scene,
    lighting: Lighting = Lighting(),
    *,
    white: float = 1.0,
    device: str = "cpu",
    progress: OnProgress | None = None,
) -> Iterator[Frame]:
    """Simulates a scene and draws each of its frames.

    Args:
        scene: The scene; its camera is orthographic.
        lighting: How lightmaps are made.
        white: The light that becomes white.
        device: As `wlm.interop.check_device` returns it.
        progress: Called after each frame.

    Yields:
        The frames. Each stage waits for the device, so that its time is its own.

    Raises:
        ValueError: The camera is in perspective.
        WlmError: As `wlm.smoke.simulation.make_solver`; an obstacle is too fast; the air blew up.
    """
    solver = make_solver(scene, device=device)
    camera = make_camera(scene.camera, scene.grid.origin, scene.grid.size)
    looks = scene.looks(1)
    parts = {"background": looks.background, "ramp": looks.ramp, "obstacles": looks.obstacles}
    drawing = Drawing(camera, [light.light() for light in looks.lights], **parts, device=device)
    graph = None
    if lighting.network is None and device != "cpu":
        # Frames before have loaded the kernels.
        graph = VolumeGraph(lambda volume: drawing(lighting(volume, camera, True)), device, warmup=1)
    meter = Meter(progress, "run", scene.frames)
    for number in range(1, scene.frames + 1):
        clock = _Clock(device)
        advance(scene, solver, number)
        solver.check()
        volume = volume_of(scene, solver)
        clock.stop(SIMULATION)
        drawing.move(scene.time(number))
        if graph is not None and number > _STAGED:
            graph(volume)
            clock.stop(GRAPH)
        else:
            six = lighting(volume, camera, bool(scene.obstacles))
            clock.stop(LIGHTMAPS)
            drawing(six)
            clock.stop(DRAWING)
        pixels = to_bytes(drawing.image, white)
        clock.stop(BYTES)
        yield Frame(number, pixels, clock.seconds)
        meter.report(number)


class _Clock:
    """Seconds of stages, each to the end of what the device has to do."""

    def __init__(self, device: str) -> None:
        self._device, self.seconds = device, {}
        self._begin = self._now()

    def stop(self, stage: str) -> None:
        end = self._now()
        self.seconds[stage] = end - self._begin
        self._begin = end

    def _now(self) -> float:
        wp.synchronize_device(self._device)
        return time.perf_counter()


def write_all(frames: Iterator[Frame], write: Callable[[int, np.ndarray], None]) -> dict[str, list[float]]:
    """Writes frames as they come.

    Args:
        frames: From `run`.
        write: Takes a frame's number and its pixels.

    Returns:
        The seconds of each stage, one for each frame that had it, "writing" among them.
    """
    seconds: dict[str, list[float]] = {}
    for frame in frames:
        begin = time.perf_counter()
        write(frame.number, frame.pixels)
        for stage, taken in (frame.seconds | {"writing": time.perf_counter() - begin}).items():
            seconds.setdefault(stage, []).append(taken)
    return seconds
