"""Simulates a jet of smoke past a sphere, at rest and moving, lights a plume from all round, and checks the results.

The scenes are `jet-sphere` and `jet-moving` on a quarter of their cells along each axis, cut in two and not in four,
so that the demo ends soon. The plume is made up of noise and stands for a volume from elsewhere. Each leaves a
sequence of PNGs and a contact sheet, the plume a flip book too.

    python demos/smoke.py
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
from wlm.smoke.guide import guide
from wlm.smoke.simulate import simulate

from wlm.cli.console import quiet_warp, show_figures
from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume, load_volume, save_volume
from wlm.formats.atomic import atomic_write
from wlm.interop import check_device
from wlm.smoke.baking import SixWay, lit, six_way
from wlm.smoke.camera import DIRECTIONS, axis_faults
from wlm.smoke.data import open_footage, open_frames
from wlm.smoke.exporter import read_flipbook, write_flipbook
from wlm.smoke.learn.synthetic import make_plume
from wlm.smoke.scene import CameraSettings, Grid, LightSettings, Scene, load_scene, make_camera
from wlm.smoke.shading import shade
from wlm.view.smoke import contact_sheet, guide_pictures, picture, six_pictures, to_bytes, write_sequence

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
    simulate(frames, device=device, progress=lambda frame, figures: amounts.append(figures["smoke"]))
    simulated, clock = time.perf_counter() - clock, time.perf_counter()
    footage = open_footage(out / name, device=device)
    lights = [given.light() for given in scene.lights]
    drawn, maps, coverage = [], [], []
    for number in footage.numbers:
        volume = footage.load(number)
        _check_solids(f"{name}, frame {number}", scene, volume, scene.time(number))
        camera = make_camera(scene.camera, scene.grid.origin, scene.grid.size)
        six = six_way(volume, camera, step=1.0, estimate=number == FRAMES)
        _check_lightmaps(f"{name}, frame {number}", six)
        surface = guide(volume, camera, step=1.0, jitter=0.0)
        shown = {"background": scene.background, "obstacles": scene.obstacles, "time": scene.time(number)}
        drawn.append(to_bytes(picture(six, camera, lights, depth=surface.depth, **shown)))
        maps.append({key: pixels for key, pixels in six_pictures(six).items() if key in ("right", "top", "front")})
        coverage.append(float((six.transparency < 0.99).float().mean()))
    write_sequence(out / f"{name}_frames", drawn)
    rows = {"lit": drawn} | {key: [each[key] for each in maps] for key in maps[0]}
    contact_sheet(out / f"{name}.png", rows, [f"{scene.time(number):g} s" for number in footage.numbers])
    if not all(later > earlier > 0 for earlier, later in zip(amounts, amounts[1:], strict=False)):
        raise WlmError(f"demo: {name}: expected smoke that only grows, got {amounts}")
    if not LEAST_COVERAGE <= coverage[-1] <= MOST_COVERAGE:
        raise WlmError(f"demo: {name}: expected {LEAST_COVERAGE} to {MOST_COVERAGE} covered, got {coverage[-1]:.3g}")
    return {
        "covered at the end": coverage[-1],
        "error of the step, RMS": six.error.rms,
        "seconds to simulate": simulated,
        "seconds to bake and draw": time.perf_counter() - clock,
    }


def plume(out: Path, device: str) -> dict[str, float]:
    """Makes a volume, lights it from all round with one bake, and packs the bakes of four sides into a flip book."""
    clock = time.perf_counter()
    path = out / "plume.npz"
    save_volume(path, make_plume())
    volume = load_volume(path, extinction=14.0, emission=6.0, device=device)
    size = volume.voxel * np.array(volume.shape)
    settings = CameraSettings(resolution=RESOLUTION)
    camera = make_camera(settings, volume.origin, size)
    six = six_way(volume, camera, step=0.5)
    _check_lightmaps("plume", six)
    lights = [LightSettings(toward=(np.sin(a), 0.4, np.cos(a))).light() for a in np.arange(8) * np.pi / 4]
    drawn = [to_bytes(picture(six, camera, [light], background=(0.03, 0.04, 0.055))) for light in lights]
    write_sequence(out / "plume_frames", drawn)
    shown = [*six_pictures(six).values()]
    contact_sheet(out / "plume.png", {"light from round it": drawn, "six ways, alpha, glow": shown})
    contact_sheet(out / "plume_guide.png", {"guide": [*guide_pictures(guide(volume, camera, step=4.0)).values()]})
    # What weighing six lightmaps loses against marching to the light itself, of an oblique one.
    small = make_camera(settings.model_copy(update={"resolution": 32}), volume.origin, size)
    oblique = (1.0, 0.7, 0.8)
    exact = lit(volume, small, oblique, step=1.0)
    cold = six_way(volume, small, step=1.0, estimate=False)
    weighed = shade(SixWay(cold.lightmaps, None), small, [LightSettings(toward=oblique).light()])[..., 0]
    error = float((weighed - exact).square().mean().sqrt() / exact.square().mean().sqrt())
    brightness = float(weighed.mean() / exact.mean())
    if not (error <= MOST_LIGHT_ERROR and abs(brightness - 1.0) <= MOST_BRIGHTNESS_ERROR):
        raise WlmError(
            f"demo: plume: expected an oblique light to {MOST_LIGHT_ERROR} and its mean to {MOST_BRIGHTNESS_ERROR}, "
            f"got {error:.3g} and {brightness:.3g}"
        )
    sides = []
    for degrees in (0.0, 30.0, 60.0, 90.0):
        seen = make_camera(settings.turned(degrees), volume.origin, size)
        sides.append(six_way(volume, seen, step=1.0, estimate=False))
    books = (out / "plume_1.png", out / "plume_2.png")
    brightest = max(float(plane.max()) for side in sides for plane in (side.lightmaps, side.emission))
    cells = {"rows": 2, "columns": 2, "gain": 1.0 / brightest}
    clipped = write_flipbook(books, sides, "unity", **cells)
    found = read_flipbook(books, "unity", **cells)
    lost = max(float((a.lightmaps - b.lightmaps.cpu()).abs().max()) for a, b in zip(found, sides, strict=True))
    if clipped or not lost <= MOST_BOOK_ERROR * brightest:
        raise WlmError(f"demo: plume: flip book: expected at most half a level lost, got {lost:.3g}, {clipped} clipped")
    return {
        "covered": float((six.transparency < 0.99).float().mean()),
        "error of the step, RMS": six.error.rms,
        "error of an oblique light, RMS": error,
        "its brightness": brightness,
        "seconds": time.perf_counter() - clock,
    }


def _check_lightmaps(name: str, six: SixWay) -> None:
    """Names fit what is bright where, no map gives off more light than there is, and the step is fine enough."""
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
        # It moved half of a step since the solver looked, and a cell belongs to it by its centre.
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
    rows = [(name, *figure) for name, found in figures.items() for figure in found.items()]
    show_figures(str(args.out), ["", "", "value"], rows, text=[""])


if __name__ == "__main__":
    main()
