"""Simulates a jet of smoke past a sphere, at rest and moving, lights a plume from all round, and checks the results.

The scenes are `jet-sphere` and `jet-moving` on a quarter of their cells along each axis, cut in two and not in four,
so that the demo ends soon. The plume is made of noise and stands for a volume from elsewhere. Each leaves a sequence of
PNGs and a contact sheet, the plume a flip book too.

    python demos/smoke.py
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from wlm.cli.console import quiet_warp, show_figures
from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume, load_volume, save_volume
from wlm.formats.atomic import atomic_write
from wlm.interop import check_device
from wlm.smoke.camera import DIRECTIONS, Camera, axis_faults
from wlm.smoke.data import load_frames, open_frames, write_six_way
from wlm.smoke.flipbook.shots import FramesToBake
from wlm.smoke.flipbook.textures import brightest_gain, read_flipbook, write_flipbook
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.coarse import guide
from wlm.smoke.march.fine import bake, lit
from wlm.smoke.scene import CameraSettings, Grid, Scene, load_scene
from wlm.smoke.shading import Light
from wlm.smoke.simulation import simulate
from wlm.smoke.synthetic import make_plume
from wlm.system import Progress
from wlm.view.pictures import contact_sheet, to_bytes
from wlm.view.smoke import guide_pictures, picture, six_pictures
from wlm_kernels.smoke.settings import March

HERE = Path(__file__).resolve().parent
SCALE, REFINE, SUBSTEPS = 0.24, 2, 4
FRAMES, RATE = 8, 2.0  # four seconds, in which the jet crosses the box
RESOLUTION = 96

# Measured on the CPU; see `_check` for what each is.
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
            amounts.append(progress.figures["smoke"])

    simulate(frames, device=device, progress=note_smoke)
    simulated, clock = time.perf_counter() - clock, time.perf_counter()
    frames = load_frames(out / name, device=device)
    for number, volume in frames.volumes():
        _check_solids(f"{name}, frame {number}", scene, volume, scene.time(number))
    lights = [settings.light() for settings in scene.lights]
    drawn, maps, coverage = [], [], []
    for shot in FramesToBake(frames, scene.camera).shots():
        _check_lightmaps(f"{name}, frame {shot.number}", shot.six)
        options = {"background": scene.background, "obstacles": scene.obstacles, "time": shot.looks.time}
        drawn.append(to_bytes(picture(shot.six, lights, **options)))
        pictures = six_pictures(shot.six)
        maps.append({key: pictures[key] for key in ("right", "top", "front")})
        coverage.append(float((shot.six.transparency < 0.99).float().mean()))
    error = bake(frames.load(FRAMES), shot.six.camera, step=1.0).error
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
    """Makes a volume, lights it from all round with one bake, and packs the bakes of four sides into a flip book."""
    clock = time.perf_counter()
    path = out / "plume.npz"
    save_volume(path, make_plume())
    volume = load_volume(path, extinction=14.0, emission=6.0, device=device)
    camera = Camera.around(volume, pixels=RESOLUTION)
    six = bake(volume, camera)
    _check_lightmaps("plume", six)
    lights = [Light((np.sin(angle), 0.4, np.cos(angle))) for angle in np.arange(8) * np.pi / 4]
    drawn = [to_bytes(six.shade([light], background=(0.03, 0.04, 0.055))) for light in lights]
    planes = [*six_pictures(six).values()]
    contact_sheet(out / "plume.png", {"light from round it": drawn, "six ways, alpha, glow": planes})
    contact_sheet(out / "plume_guide.png", {"guide": [*guide_pictures(guide(volume, camera, March(4.0))).values()]})
    # The error of weighing six lightmaps for an oblique light, against marching to the light itself.
    small = Camera.around(volume, pixels=32)
    oblique = (1.0, 0.7, 0.8)
    exact = lit(volume, small, oblique, step=1.0)
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
    books = (out / "plume_1.png", out / "plume_2.png")
    cells = {"rows": 2, "columns": 2, "gain": brightest_gain(sides)}
    clipped = write_flipbook(books, sides, "unity", **cells)
    read = read_flipbook(books, "unity", **cells)
    lost = max(float((a.lightmaps - b.lightmaps.cpu()).abs().max()) for a, b in zip(read, sides, strict=True))
    if clipped or not lost <= MOST_BOOK_ERROR / cells["gain"]:
        raise WlmError(f"demo: plume: flip book: expected at most half a level lost, got {lost:.3g}, {clipped} clipped")
    return {
        "covered": float((six.transparency < 0.99).float().mean()),
        "error of the step, RMS": six.error.rms,
        "error of an oblique light, RMS": error,
        "its brightness": brightness,
        "seconds": time.perf_counter() - clock,
    }


def _check_lightmaps(name: str, six: SixWay) -> None:
    """Each map is bright where its name says, none has more light than there is, and the step is fine enough."""
    maps = six.lightmaps.cpu().numpy()
    for fault in axis_faults(maps):
        raise WlmError(f"demo: {name}: {fault}")
    for direction, plane in zip(DIRECTIONS, maps, strict=True):
        most = MOST_LIGHT["front" if direction == "front" else "side"]
        if not 0 <= plane.min() <= plane.max() <= most:
            raise WlmError(f"demo: {name}: {direction}: expected light of 0 to {most}, got {plane.max():.4g}")
        # Scattered light passes through what hides the background.
        if (plane > 1.0 - six.transparency.cpu().numpy() + 1e-3).any():
            raise WlmError(f"demo: {name}: {direction}: expected no more light than opacity")
    if six.error is not None and not six.error.rms <= MOST_STEP_ERROR:
        raise WlmError(f"demo: {name}: expected a step's error of at most {MOST_STEP_ERROR}, got {six.error.rms:.3g}")


def _check_solids(name: str, scene: Scene, volume: DensityVolume, at: float) -> None:
    """No smoke within an obstacle, but for the voxels of cells that its surface cuts."""
    axes = [volume.origin[i] + volume.voxel * (np.arange(n) + 0.5) for i, n in enumerate(volume.shape)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    density = volume.density.cpu().numpy()
    for obstacle in scene.obstacles:
        # The solver placed it half a step ago, and a cell belongs to it by its centre.
        slack = 1.5 * scene.grid.cell + obstacle.fastest * scene.step * scene.smoke.substeps
        inside = np.linalg.norm(places - obstacle.centre(at), axis=-1) < obstacle.radius - slack
        if density[inside].any():
            raise WlmError(f"demo: {name}: expected no smoke in an obstacle, got {density[inside].max():.3g}")


def main() -> None:
    """Reads the command line, runs the demo and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=HERE / "out" / "smoke", help="the folder to write to")
    parser.add_argument("--device", default="cpu", help='"cpu" or "cuda:0"')
    args = parser.parse_args()
    quiet_warp()
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        device = check_device(args.device)
        figures = {name: jet(args.out, name, device) for name in ("jet-sphere", "jet-moving")}
        figures["plume"] = plume(args.out, device)
        atomic_write(args.out / "report.json", (json.dumps(figures, indent=1) + "\n").encode())
    except (WlmError, OSError) as error:
        sys.exit(f"error: {error}")
    rows = [(name, *figure) for name, values in figures.items() for figure in values.items()]
    show_figures(str(args.out), ["", "", "value"], rows, text=[""])


if __name__ == "__main__":
    main()
