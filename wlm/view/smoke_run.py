"""Simulation, lighting and drawing of a scene frame by frame, in memory."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import warp as wp

from wlm.fluid.volume import DensityVolume
from wlm.interop import StepGraph
from wlm.smoke.camera import Camera
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.launch import in_bricks
from wlm.smoke.march.six_way import guide
from wlm.smoke.network.prediction import SmokePredictor, predict
from wlm.smoke.scene import Scene, make_camera
from wlm.smoke.shading import AnyLight
from wlm.smoke.simulation import advance, make_solver, volume_of
from wlm.smoke.transport.orders import ScatteredSmoke, scatter
from wlm.system import Meter, OnProgress
from wlm.view.pictures import to_bytes
from wlm.view.smoke import Drawing
from wlm_kernels.smoke.settings import March

SIMULATION, DRAWING, BYTES = "simulation", "shadows and picture", "bytes"
"""Names of the stages of a frame, besides that of the lighting."""

_SURFACE = March(step=2.0, jitter=0.0)  # march to the surface on which shadows fall, where lightmaps have no depth


@dataclass(frozen=True)
class Lighting:
    """A way to light the smoke of a frame. With an `albedo`, multiple scattering of all lights and of fire; else single
    scattering by six-way lightmaps, as engines show it, made by `predict` with a network or, without one, a march."""

    albedo: Sequence[float] | None = (1.0, 1.0, 1.0)
    network: SmokePredictor | None = None

    @property
    def stage(self) -> str:
        """Name of the stage in the table of durations."""
        return "lightmaps" if self.albedo is None else "light of all orders"

    def __call__(self, volume: DensityVolume, camera: Camera, lights: Sequence[AnyLight]) -> SixWay | ScatteredSmoke:
        """Lights the smoke on its device. Lightmaps are made of smoke without obstacles, and include the depth of its
        surface, on which a `Drawing` draws their shadows."""
        volume = in_bricks(volume)
        if self.albedo is not None:
            return scatter(volume, camera, lights, self.albedo)
        six = predict(volume, camera, self.network)
        return replace(six, depth=guide(volume, camera, _SURFACE).depth) if six.depth is None else six


@dataclass
class Frame:
    """A finished frame: its number from 1, and its pixels, uint8 [H, W, 3] in sRGB. `smoke` tells whether this frame or
    an earlier one has smoke; `seconds` are the durations of the stages by name."""

    number: int
    pixels: np.ndarray
    smoke: bool
    seconds: dict[str, float] = field(default_factory=dict)


def run(
    scene: Scene,
    lighting: Lighting | None = None,
    *,
    white: float = 1.0,
    device: str = "cpu",
    progress: OnProgress | None = None,
) -> Iterator[Frame]:
    """Simulates a scene and draws each of its frames; six-way lighting needs an orthographic camera.

    Without `lighting` it is light of all orders with the scene's albedo; `white` is the radiance that becomes white.
    Each stage waits for the device, so that its duration is measured separately. On CUDA the stages of lighting and of
    drawing are a graph each, unless a network makes the lightmaps, which waits for the device.
    """
    lighting = Lighting(scene.smoke.albedo) if lighting is None else lighting
    solver = make_solver(scene, device=device)
    camera = make_camera(scene.camera, scene.grid.origin, scene.grid.size)
    looks = scene.looks(1)
    lights = [light.light() for light in (looks if lighting.albedo is None else scene).lights]
    seen = {"background": looks.background, "ramp": looks.ramp, "obstacles": looks.obstacles}
    drawing = Drawing(camera, lights, albedo=looks.albedo, **seen, device=device)
    made: SixWay | ScatteredSmoke | None = None

    def light() -> None:
        nonlocal made
        volume = volume_of(scene, solver)
        # Obstacles shadow the surface of lightmaps when these are drawn.
        made = lighting(volume if lighting.albedo is None else drawing.among(volume), camera, lights)

    graphs: dict[tuple, list[Callable[[], None]]] = {}
    smoke = False
    meter = Meter(progress, "run", scene.frames)
    for number in range(1, scene.frames + 1):
        clock = _Clock(device)
        advance(scene, solver, number)
        solver.check()
        clock.stop(SIMULATION)
        drawing.move(scene.time(number))
        # The solver alternates between buffers, and larger ones may replace them.
        frame = solver.frame()
        place = (frame.density.data_ptr(), frame.density.shape)
        if place not in graphs:
            steps = light, lambda: drawing(made)
            graphs[place] = [step if lighting.network else StepGraph(step, device, 1) for step in steps]
        for stage, step in zip((lighting.stage, DRAWING), graphs[place], strict=True):
            step()
            clock.stop(stage)
        pixels = to_bytes(drawing.image, white)
        clock.stop(BYTES)
        smoke = smoke or any(bool(slab.any()) for slab in frame.slabs(frame.density))
        yield Frame(number, pixels, smoke, clock.seconds)
        meter.report(number)


class _Clock:
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


def write_all(frames: Iterator[Frame], write: Callable[[int, np.ndarray], None]) -> tuple[dict[str, list[float]], bool]:
    """Passes each frame of `run` to `write`, a function of its number and its pixels. Returns the durations of each
    stage, "writing" among them, one for each frame that had the stage; and whether any frame has smoke."""
    smoke = False
    seconds: dict[str, list[float]] = {}
    for frame in frames:
        begin = time.perf_counter()
        write(frame.number, frame.pixels)
        for stage, taken in (frame.seconds | {"writing": time.perf_counter() - begin}).items():
            seconds.setdefault(stage, []).append(taken)
        smoke = frame.smoke
    return seconds, smoke
