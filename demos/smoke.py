"""Simulates a jet of smoke past a sphere, at rest and moving, lights a plume from eight sides, and checks the results.

The scenes are `jet-sphere` and `jet-moving` with a quarter of their cells along each axis and two voxels per cell, so
that the demo takes less time. The plume is procedural, in place of a volume of another program. Each scene is written
as a sequence of PNGs and a contact sheet, the plume also as a flip book.

    python demos/smoke.py
"""

from __future__ import annotations

import itertools
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from demo_command import run_command
from plume import make_plume

from wlm.cli.console import show_figures
from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume, load_volume, save_volume
from wlm.formats.atomic import atomic_write
from wlm.smoke.camera import DIRECTIONS, Camera
from wlm.smoke.data import load_frames, open_frames, write_six_way
from wlm.smoke.flipbook.book import Shot, pack_book, write_book
from wlm.smoke.flipbook.reading import read_flipbook
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.six_way import bake, guide, with_surface
from wlm.smoke.scene import CameraSettings, Grid, Scene, load_scene
from wlm.smoke.shading import Light
from wlm.smoke.simulation import simulate
from wlm.smoke.transport import light_smoke
from wlm.system import Progress
from wlm.view.pictures import contact_sheet, to_bytes
from wlm.view.smoke import picture
from wlm_kernels.smoke.settings import March

SCALE, REFINE, SUBSTEPS = 0.24, 2, 4
FRAMES, RATE = 8, 2.0  # in four seconds the jet crosses the box
RESOLUTION = 96

# Limits of the checks, from measurements on the CPU.
MOST_STEP_ERROR = 0.03
MOST_LIGHT = {"front": 0.501, "side": 1.001}
LEAST_COVERAGE, MOST_COVERAGE = 0.1, 0.6
MOST_LIGHT_ERROR = 0.3
MOST_BRIGHTNESS_ERROR = 0.15
MOST_BOOK_ERROR = 1.0 / 255.0


def jet(out: Path, name: str, device: str) -> dict[str, float]:
    """Simulates a scene, bakes and lights its frames."""
    scene = load_scene(name).scaled(SCALE)
    scene = scene.model_copy(
        update={
            "grid": Grid(**scene.grid.model_dump() | {"refine": REFINE}),
            "smoke": scene.smoke.model_copy(update={"substeps": SUBSTEPS}),
            "camera": scene.camera.model_copy(update={"resolution": RESOLUTION}),
            "frames": FRAMES,
            "rate": RATE,
        }
    )
    clock = time.perf_counter()
    amounts: list[float] = []
    frames = open_frames(out / name, scene)

    def note_smoke(progress: Progress) -> None:
        if progress.figures:  # none within a frame
            amounts.append(progress.figures["smoke m³"])

    simulate(frames, device=device, progress=note_smoke)
    simulated, clock = time.perf_counter() - clock, time.perf_counter()
    frames = load_frames(out / name, device=device)
    for number, volume in frames.volumes():
        _check_solids(f"{name}, frame {number}", scene, volume, scene.time(number))
    lights = [settings.light() for settings in scene.lights]
    drawn, maps, coverage = [], [], []
    for number, volume in frames.volumes():
        six = bake(volume, frames.view(scene.camera, volume), step=1.0, estimate=number == FRAMES)
        six = with_surface(six, volume, frames.looks(number))
        _check_lightmaps(f"{name}, frame {number}", six)
        options = {"background": scene.background, "obstacles": scene.obstacles, "time": scene.time(number)}
        drawn.append(to_bytes(picture(six, lights, **options)))
        maps.append({key: to_bytes(six[key]) for key in ("right", "top", "front")})
        coverage.append(float((six.transparency < 0.99).float().mean()))
    error = six.error
    if not error.rms <= MOST_STEP_ERROR:
        raise WlmError(f"demo: {name}: expected a step's error of at most {MOST_STEP_ERROR}, got {error.rms:.3g}")
    rows = {"lit": drawn} | {key: [each[key] for each in maps] for key in maps[0]}
    contact_sheet(out / f"{name}.png", rows, [f"{scene.time(number):g} s" for number in frames.numbers])
    if not all(later > earlier > 0 for earlier, later in itertools.pairwise(amounts)):
        raise WlmError(f"demo: {name}: expected smoke that only grows, got {amounts}")
    if not LEAST_COVERAGE <= coverage[-1] <= MOST_COVERAGE:
        raise WlmError(f"demo: {name}: expected {LEAST_COVERAGE} to {MOST_COVERAGE} covered, got {coverage[-1]:.3g}")
    return {
        "covered at the end": coverage[-1],
        "error of the step, RMS": error.rms,
        "seconds to simulate": simulated,
        "seconds to bake and draw": time.perf_counter() - clock,
    }


def plume(out: Path, device: str) -> dict[str, float]:
    """Makes a volume, lights it from eight sides with one bake, and packs the bakes of four views into a flip book."""
    clock = time.perf_counter()
    path = out / "plume.npz"
    save_volume(path, make_plume())
    volume = load_volume(path, extinction=14.0, emission=6.0, device=device)
    camera = Camera.around(volume, pixels=RESOLUTION)
    six = bake(volume, camera)
    _check_lightmaps("plume", six)
    lights = [Light((np.sin(angle), 0.4, np.cos(angle))) for angle in np.arange(8) * np.pi / 4]
    drawn = [to_bytes(six.shade([light], background=(0.03, 0.04, 0.055))) for light in lights]
    planes = [to_bytes(plane) for plane in (*six.lightmaps, 1.0 - six.transparency, six.emission)]
    contact_sheet(out / "plume.png", {"light from eight sides": drawn, "six ways, opacity, emission": planes})
    maps = guide(volume, camera, March(4.0)).maps
    contact_sheet(out / "plume_guide.png", {"guide": [to_bytes(plane / plane.max()) for plane in maps]})
    # The error of six weighted lightmaps for an oblique light, against a march to the light.
    small = Camera.around(volume, pixels=32)
    oblique = (1.0, 0.7, 0.8)
    exact = light_smoke(volume, small, [Light(oblique)], March(1.0, jitter=0.0)).planes[0]
    cold = replace(bake(volume, small, step=1.0, estimate=False), emission=None)
    weighed = cold.shade([Light(oblique)])[..., 0]
    error = float((weighed - exact).square().mean().sqrt() / exact.square().mean().sqrt())
    brightness = float(weighed.mean() / exact.mean())
    if not (error <= MOST_LIGHT_ERROR and abs(brightness - 1.0) <= MOST_BRIGHTNESS_ERROR):
        raise WlmError(
            f"demo: plume: expected an oblique light to {MOST_LIGHT_ERROR} and its mean to {MOST_BRIGHTNESS_ERROR}, "
            f"got {error:.3g} and {brightness:.3g}"
        )
    sides = []
    for degrees in (0.0, 30.0, 60.0, 90.0):
        toward = CameraSettings().turned(degrees).toward
        view = Camera.around(volume, toward=toward, pixels=RESOLUTION)
        sides.append(bake(volume, view, step=1.0, estimate=False))
        write_six_way(out / f"plume_{degrees:02.0f}.exr", sides[-1])
    book = pack_book([Shot(number, side) for number, side in enumerate(sides, 1)])
    files, clipped = write_book(book, out / "plume_book.png")
    read = read_flipbook([*files], "unity", rows=2, columns=2)
    pairs = zip(read, sides, strict=True)
    lost = max(float(book.gain * (a.lightmaps - b.lightmaps.cpu()).abs().max()) for a, b in pairs)
    if clipped or not lost <= MOST_BOOK_ERROR:
        raise WlmError(f"demo: plume: flip book: expected an error of half a level, got {lost:.3g}, {clipped} clipped")
    return {
        "covered": float((six.transparency < 0.99).float().mean()),
        "error of the step, RMS": six.error.rms,
        "error of an oblique light, RMS": error,
        "its brightness": brightness,
        "seconds": time.perf_counter() - clock,
    }


def _check_lightmaps(name: str, six: SixWay) -> None:
    """Checks that no lightmap has more light than is possible, and that the step is fine enough."""
    maps = six.lightmaps.cpu().numpy()
    for direction, plane in zip(DIRECTIONS, maps, strict=True):
        most = MOST_LIGHT["front" if direction == "front" else "side"]
        if not 0 <= plane.min() <= plane.max() <= most:
            raise WlmError(f"demo: {name}: {direction}: expected light of 0 to {most}, got {plane.max():.4g}")
        # Only smoke that hides the background scatters light.
        if (plane > 1.0 - six.transparency.cpu().numpy() + 1e-3).any():
            raise WlmError(f"demo: {name}: {direction}: expected no more light than opacity")
    if six.error is not None and not six.error.rms <= MOST_STEP_ERROR:
        raise WlmError(f"demo: {name}: expected a step's error of at most {MOST_STEP_ERROR}, got {six.error.rms:.3g}")


def _check_solids(name: str, scene: Scene, volume: DensityVolume, at: float) -> None:
    """Checks that there is no smoke within an obstacle, except in cells that its surface cuts."""
    axes = [volume.origin[i] + volume.voxel * (np.arange(n) + 0.5) for i, n in enumerate(volume.shape)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    density = volume.density.cpu().numpy()
    for obstacle in scene.obstacles:
        # The obstacle's position is up to one step older, and a cell counts as inside by its centre.
        slack = 1.5 * scene.grid.cell + obstacle.fastest * scene.step * scene.smoke.substeps
        inside = np.linalg.norm(places - obstacle.eased.at(at), axis=-1) < obstacle.radius - slack
        if density[inside].any():
            raise WlmError(f"demo: {name}: expected no smoke in an obstacle, got {density[inside].max():.3g}")


def run(out: Path, device: str) -> dict[str, dict[str, float]]:
    """Runs the jets and the plume, and returns the figures of each, which `report.json` has, too."""
    figures = {name: jet(out, name, device) for name in ("jet-sphere", "jet-moving")}
    figures["plume"] = plume(out, device)
    atomic_write(out / "report.json", (json.dumps(figures, indent=1) + "\n").encode())
    return figures


def main() -> None:
    """Reads the command line, runs the demo and prints a table."""
    out, figures = run_command(__doc__, run, "smoke")
    rows = [(name, *figure) for name, values in figures.items() for figure in values.items()]
    show_figures(str(out), ["", "", "value"], rows, text=[""])


if __name__ == "__main__":
    main()
