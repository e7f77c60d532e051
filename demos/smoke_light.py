"""Lights a plume by single scattering, by light of all orders (diffusion and fitted weights), and by path tracing.

Writes a contact sheet of the three under lights from four sides, and compares the first two with the third.

    python demos/smoke_light.py
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
from demo_command import run_command
from plume import make_plume

from wlm.cli.console import show_figures
from wlm.errors import WlmError
from wlm.formats.atomic import atomic_write
from wlm.metrics import psnr_from_mse
from wlm.smoke.camera import Camera
from wlm.smoke.network.planes import to_srgb
from wlm.smoke.shading import Light
from wlm.smoke.transport import load_orders, scatter
from wlm.view.pictures import contact_sheet, to_bytes

PIXELS, SAMPLES = 96, 64
ALBEDO = (0.97, 0.95, 0.92)  # light that was scattered more often is warmer
SIDES = (0.0, 90.0, 180.0, 270.0)  # degrees around the plume; 0 is behind the camera

# Least mean PSNR in sRGB over the four sides, in dB: 23.3 for single scattering, 38.1 for all orders when measured.
LEAST_ALL, LEAST_GAIN = 35.0, 12.0


def run(out: Path, device: str) -> dict[str, float]:
    """Runs the demo and returns its figures."""
    sys.path.append(str(Path(__file__).resolve().parents[1]))  # the benchmarks are not installed
    from benchmarks.smoke_tracing import trace

    volume = make_plume(hot=False, extinction=25.0, seed=7, device=device)
    camera = Camera.around(volume, toward=(0.3, 0.2, 1.0), pixels=PIXELS)
    model, seconds = load_orders(), {"all orders": 0.0, "path tracing": 0.0}
    drawn: dict[str, list[np.ndarray]] = {"scattered once": [], "all orders": [], "path-traced": []}
    scores: dict[str, list[float]] = {"scattered once": [], "all orders": []}
    for degrees in SIDES:
        angle = np.radians(degrees)
        lights = [Light((np.sin(angle), 0.5, np.cos(angle)), (2.0, 1.9, 1.7)), Light((0.0, 1.0, 0.0), (0.3, 0.4, 0.6))]
        clock = time.perf_counter()
        lit = scatter(volume, camera, lights, ALBEDO, model=model)
        seconds["all orders"] += time.perf_counter() - clock
        clock = time.perf_counter()
        traced = trace(volume, camera, lights, albedo=ALBEDO, samples=SAMPLES)
        seconds["path tracing"] += time.perf_counter() - clock
        truth, once = traced.total, lit.lit.shade(albedo=ALBEDO)
        for name, image in (("scattered once", once), ("all orders", lit.shade()), ("path-traced", truth)):
            drawn[name].append(to_bytes(image))
            if name in scores:
                error = (to_srgb(image) - to_srgb(truth)).double().square().mean()
                scores[name].append(psnr_from_mse(float(error), 1.0))
    contact_sheet(out / "smoke_light.png", drawn, [f"{degrees:g}°" for degrees in SIDES])
    single, every = (float(np.mean(scores[name])) for name in scores)
    if not (every >= LEAST_ALL and every - single >= LEAST_GAIN):
        raise WlmError(
            f"demo: expected {LEAST_ALL} dB of all orders, and {LEAST_GAIN} above light scattered once, "
            f"got {every:.4g} and {every - single:.3g}"
        )
    return {
        "scattered once, dB": single,
        "all orders, dB": every,
        "seconds of all orders": seconds["all orders"],
        "seconds to trace": seconds["path tracing"],
    }


def run_and_write(out: Path, device: str) -> dict[str, float]:
    """Runs the demo and writes its figures to `light_report.json`."""
    figures = run(out, device)
    atomic_write(out / "light_report.json", (json.dumps(figures, indent=1) + "\n").encode())
    return figures


def main() -> None:
    """Reads the command line, runs the demo and prints a table."""
    out, figures = run_command(__doc__, run_and_write, "smoke")
    show_figures(str(out), ["", "value"], figures.items())


if __name__ == "__main__":
    main()
