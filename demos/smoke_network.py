"""Lights smoke by a network's six-way lightmaps, beside a fine and a coarse march, and checks the results.

There are two scenes: a jet past a sphere under a turning camera and light, and a glowing explosion. Each leaves a
contact sheet. The network is the shipped one or that of `--network`; `--train` first trains a
small network, for half a minute.

The coarse march is the network's guide. On grids as small as these its steps are shorter than a voxel, so that it is
nearer to the fine march than the network, as the scores show; the network is made for grids of 128 voxels and more.

    python demos/smoke_network.py
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from wlm.cli.console import quiet_warp, show_figures
from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume
from wlm.formats.atomic import atomic_write
from wlm.interop import check_device
from wlm.metrics import psnr_from_mse
from wlm.smoke.camera import DIRECTIONS, Camera
from wlm.smoke.codec import open_network
from wlm.smoke.data import load_frames, open_frames
from wlm.smoke.fit import train
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.six_way import bake, bake_coarse, guide
from wlm.smoke.model import SmokeModel
from wlm.smoke.network.planes import EMISSION_PLANE, encode_lightmaps
from wlm.smoke.network.prediction import SmokePredictor
from wlm.smoke.network.settings import Profile
from wlm.smoke.scene import Grid, LightSettings, Scene, load_scene, make_camera
from wlm.smoke.simulation import simulate
from wlm.view.pictures import contact_sheet, to_bytes
from wlm.view.smoke import picture
from wlm_kernels.smoke.settings import March

HERE = Path(__file__).resolve().parent
SCALE, REFINE, SUBSTEPS = 0.24, 2, 4
STEP = 0.5  # voxels, of the fine march
RESOLUTION, FRAMES = 96, 4
RATES = {"jet-sphere": 1.5, "explosion": 6.0}  # frames a second
TURNED, TURN = "jet-sphere", 90.0  # degrees by which its camera turns; its lights turn the other way

# Least PSNR in dB of a frame by the network.
LEAST = 30.0
# Largest mean light of a network's lightmaps where the fine march sees no smoke.
MOST_STRAY = 1e-3

SMALL = Profile.model_validate(
    {
        "name": "demo",
        "network": {"guide": "six", "width": 8, "levels": 3, "stem": 2},
        "training": {"rounds": 1, "steps": 150, "batch": 4, "warmup": 20, "average": 0.98},
        "dataset": {
            "guide": "six",
            "cells": 16,
            "refine": 3,
            "resolution": 64,
            "sequences": 4,
            "frames": 2,
            "views_a_frame": 2,
            "views": 1,
            "validation_sequences": 1,
        },
    }
)


def render(
    volume: DensityVolume, camera: Camera, model: SmokeModel, predictor: SmokePredictor, seed: int
) -> dict[str, SixWay]:
    """Returns lightmaps by the fine march, the network, and the coarse march that is its guide."""
    return {
        "reference": bake(volume, camera, step=STEP, estimate=False),
        "network": predictor(volume, camera, seed),
        "coarse march": bake_coarse(volume, camera, model.dataset.look(volume.shape, seed)),
    }


def light(out: Path, name: str, scene: Scene, model: SmokeModel, turn: float, device: str) -> dict[str, float]:
    """Simulates a scene, lights its frames by each method, and scores these against the fine march."""
    predictor = SmokePredictor(model, device)
    simulate(open_frames(out / name, scene), device=device)
    footage = load_frames(out / name, device=device)
    rows: dict[str, list[np.ndarray]] = {}
    scores: dict[str, list[float]] = {}
    for number in footage.numbers:
        volume, share = footage.load(number), (number - 1) / (FRAMES - 1)
        camera = make_camera(scene.camera.turned(turn * share), scene.grid.origin, scene.grid.size)
        lights = [turned(settings, -2.0 * turn * share).light() for settings in scene.lights]
        options = {"background": scene.background, "obstacles": scene.obstacles, "time": scene.time(number)}
        depth = guide(volume, camera, March(1.0, jitter=0.0)).depth if scene.obstacles else None
        lightmaps = render(volume, camera, model, predictor, number)
        for method, six in lightmaps.items():
            image = picture(replace(six, depth=depth), lights, ramp=scene.looks(number).ramp, **options)
            rows.setdefault(method, []).append(to_bytes(image))
            if method != "reference":
                for what, value in psnr(six, lightmaps["reference"]).items():
                    scores.setdefault(f"{method}, {what}dB", []).append(value)
        check_clear(f"{name}, frame {number}", lightmaps["network"], lightmaps["reference"])
    contact_sheet(out / f"{name}.png", rows, [f"{scene.time(number):.2g} s" for number in footage.numbers])
    mean = {method: sum(values) / len(values) for method, values in scores.items()}
    worst = min(scores["network, dB"])
    if not worst >= LEAST:
        raise WlmError(f"demo: {name}: expected at least {LEAST:g} dB of each frame by the network, got {worst:.2f} dB")
    return mean | {"network's worst frame, dB": worst}


def few_frames(name: str, scale: float, refine: int, resolution: int) -> Scene:
    """Returns a scene with another grid and few frames."""
    scene = load_scene(name).scaled(scale)
    return scene.model_copy(
        update={
            "grid": Grid(**scene.grid.model_dump() | {"refine": refine}),
            "smoke": scene.smoke.model_copy(update={"substeps": SUBSTEPS}),
            "camera": scene.camera.model_copy(update={"resolution": resolution}),
            "frames": FRAMES,
            "rate": RATES[name],
        }
    )


def turned(light: LightSettings, degrees: float) -> LightSettings:
    """Returns a light that is turned about the vertical axis."""
    x, y, z = light.toward
    angle = np.radians(degrees)
    around = (x * np.cos(angle) + z * np.sin(angle), y, z * np.cos(angle) - x * np.sin(angle))
    return light.model_copy(update={"toward": tuple(map(float, around))})


def psnr(predicted: SixWay, target: SixWay) -> dict[str, float]:
    """Returns the PSNR of the six lightmaps in sRGB, and of the emission if there is any."""
    off = (encode_lightmaps(predicted) - encode_lightmaps(target)).square()
    values = {"": psnr_from_mse(float(off[: len(DIRECTIONS)].mean()), 1.0)}
    if target.emission is not None:
        values["emission, "] = psnr_from_mse(float(off[EMISSION_PLANE].mean()), 1.0)
    return values


def check_clear(name: str, predicted: SixWay, target: SixWay) -> None:
    """Checks that a network's lightmaps are black where there is no smoke."""
    clear = target.transparency > 0.999
    if clear.any():
        stray = predicted.lightmaps[:, clear].mean(1)
        for direction, light in zip(DIRECTIONS, stray.tolist(), strict=True):
            if not light <= MOST_STRAY:
                raise WlmError(f"demo: {name}: {direction}: expected no light beside the smoke, got {light:.3g}")


def main() -> None:
    """Reads the command line, runs the demo and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=HERE / "out" / "smoke_network", help="the folder to write to")
    parser.add_argument("--device", default="cpu", help='"cpu" or "cuda:0"')
    parser.add_argument("--scale", type=float, default=SCALE, help="cells of the scenes, as a multiple of their own")
    parser.add_argument("--refine", type=int, default=REFINE, help="voxels of smoke along a cell's edge")
    parser.add_argument("--resolution", type=int, default=RESOLUTION, help="pixels along a picture's edge")
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--network", type=Path, help="a trained network; default the one that comes with wlm")
    source.add_argument("--train", action="store_true", help="train a small one, which takes half a minute")
    args = parser.parse_args()
    quiet_warp()
    clock = time.perf_counter()
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        device = check_device(args.device)
        if args.train:
            model = train(SMALL, args.out / "network.safetensors", device=device).model
        else:
            model = open_network(args.network)
        figures = {}
        for name in RATES:
            scene = few_frames(name, args.scale, args.refine, args.resolution)
            turn = TURN if name == TURNED else 0.0
            figures[name] = light(args.out, name, scene, model, turn, device)
        figures["all"] = {"seconds": time.perf_counter() - clock}
        atomic_write(args.out / "report.json", (json.dumps(figures, indent=1) + "\n").encode())
    except (WlmError, OSError) as error:
        sys.exit(f"error: {error}")
    rows = [(name, *figure) for name, values in figures.items() for figure in values.items()]
    show_figures(str(args.out), ["", "", "value"], rows, text=[""])


if __name__ == "__main__":
    main()
