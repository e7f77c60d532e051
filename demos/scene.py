"""Draws the street over its day: pictures at four hours, and a film of the minutes in which the lamps go on.

The pictures are compared with those under the original lightmaps; in the film, the first frame after the switch of the
lamps must be lit.

    python demos/scene.py
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from demo_command import run_demo
from PIL import Image

import wlm
from wlm.errors import WlmError
from wlm.view.scene_run import run as draw

HERE = Path(__file__).resolve().parent
STREET = HERE / "data" / "street" / "street.yaml"
HOURS = (7.0, 12.0, 18.55, 22.0)
SIZE = {"height": 144, "width": 256, "samples": 2}
DUSK, FRAMES = {"first": 18.42, "last": 18.66, "seconds": 1.0}, 4
LIT = 3  # the last frame, of 18.6 h: the lamps go on at 18.55 h, and a frame is 0.06 h long

LEAST_DB, MOST_FLIP = 44.0, 0.04  # of each view; 45.8 and 0.029 or better on the CPU
LEAST_JUMP = 1.5  # change of the mean level from the frame before the switch, over the largest other change


def run(out: Path, device: str) -> dict[str, float]:
    """Runs the demo and returns its figures."""
    with wlm.scene.load(STREET) as scene:
        views = draw(scene, out / "street", hours=HOURS, frames=0, device=device, **SIZE)["views"]
        dusk = replace(scene, day=scene.day.model_copy(update=DUSK), originals={})
        film = draw(dusk, out / "dusk", hours=[], frames=FRAMES, device=device, **SIZE)
    for view in views:
        if not (view["psnr"] >= LEAST_DB and view["flip"] <= MOST_FLIP):
            raise WlmError(
                f"demo: expected a PSNR of at least {LEAST_DB} dB and FLIP of at most {MOST_FLIP} of each view, got "
                f"{view['psnr']:.1f} dB and {view['flip']:.3f} at {view['hour']:g} h"
            )
    changes = np.diff(_levels(out / "dusk" / film["film"]["file"]))
    jump = changes[LIT - 1] / np.abs(np.delete(changes, LIT - 1)).max()
    if not jump >= LEAST_JUMP:
        raise WlmError(f"demo: expected the lamps to go on in frame {LIT} of the film, got changes of level {changes}")
    return {
        **{f"PSNR at {view['hour']:g} h, dB": view["psnr"] for view in views},
        **{f"FLIP at {view['hour']:g} h": view["flip"] for view in views},
        "change when the lamps go on, over the largest other": jump,
        "points at their page, mean": film["current"]["mean"],
        "pages decoded in a frame, mean": film["decoded"]["mean"],
        "ms of a frame, mean": film["frame_ms"]["total"]["mean"],
        "bytes on the device": sum(film["memory"].values()),
    }


def _levels(path: Path) -> np.ndarray:
    """Returns the mean level of each frame of the film, from 0 to 255."""
    with Image.open(path) as film:
        levels = []
        for number in range(film.n_frames):
            film.seek(number)
            levels.append(np.asarray(film.convert("RGB"), np.float64).mean())
    if len(levels) != FRAMES:
        raise WlmError(f"demo: expected a film of {FRAMES} frames, got {len(levels)}")
    return np.array(levels)


if __name__ == "__main__":
    run_demo(__doc__, run, lambda out: f"{out.name}/street")
