"""Compresses the day of a small city, decodes it at an hour between two stored ones, and checks the result.

Two tiles of 128 x 128 texels at 26 hours, among them 18:27 and 18:33 with the lamps switched on between. The profile
is M with fewer and smaller steps, so that the demo ends soon.

    python demos/lightmap.py
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
from demo_command import run_demo

import wlm
from wlm.errors import WlmError
from wlm.formats.atomic import atomic_write
from wlm.formats.exr import read_exr, write_exr
from wlm.lightmap import LightmapSet, Report
from wlm.view.display import white_of
from wlm.view.pictures import contact_sheet, encode

HERE = Path(__file__).resolve().parent
STEPS, SAMPLES = 1500, 2048
BETWEEN = 18.5  # the lamps are being switched on

# On the CPU 0.68 bits and, in the order below, 44.6, 45.9, 40.4 and 46.5 dB; seeds differ by 0.2 dB.
MOST_BPP = 0.72
LEAST_DB = {"psnr": 43.2, "seen": 44.5, "ring": 38.5, "between": 45.0}  # of `Report`
LEAST_RATIO = 67.0  # of half-float RGB


def run(out: Path, device: str) -> dict[str, float]:
    """Runs the demo and returns its figures."""
    seconds = {}
    clock = time.perf_counter()

    def lap(name: str) -> None:
        nonlocal clock
        seconds[name], clock = time.perf_counter() - clock, time.perf_counter()

    lightmaps = wlm.lightmap.load(HERE / "data" / "city")
    lap("load")
    path = out / "city.wlm"
    size = wlm.lightmap.compress(lightmaps, "M", device=device, steps=STEPS, samples=SAMPLES).save(path)
    lap("fit")
    # From here on everything comes from the file.
    model = wlm.load(path)
    decoder = model.decoder(device)
    write_exr(out / "city_18_50h.exr", decoder.frame(BETWEEN))
    lap("decode")
    report = wlm.lightmap.evaluate(model, lightmaps, device=device)
    atomic_write(out / "report.json", (json.dumps(report.to_json(), indent=1) + "\n").encode())
    lap("evaluate")
    decoded = np.stack([decoder.frame(stamp) for stamp in model.times])
    light = lightmaps.light
    white = white_of(light.frames[:, light.mask])
    rows = {"original": light.frames, "decoded": decoded, "error x 8": 8.0 * np.abs(decoded - light.frames)}
    pictures = {name: [encode(frame, light.mask, white) for frame in frames] for name, frames in rows.items()}
    contact_sheet(out / "city.png", pictures, [f"{hour:g} h" for hour in light.times])
    lap("draw")
    _check(lightmaps, report, out)
    return {
        "PSNR dB": report.psnr,
        "seen, dB": report.seen,
        "half-way between hours, dB": report.between,
        "SSIM": report.ssim,
        "FLIP": report.flip,
        "bytes": size,
        "bits per texel and hour": report.bpp,
        "times smaller": _half_bytes(lightmaps) / size,
    } | {f"seconds to {name}": value for name, value in seconds.items()}


def _half_bytes(lightmaps: LightmapSet) -> int:
    """Returns the bytes of the input as half-float RGB."""
    return lightmaps.light.frames.size * 2


def _check(lightmaps: LightmapSet, report: Report, out: Path) -> None:
    """Checks the result against the bounds above; an error names the figure."""
    ratio = _half_bytes(lightmaps) / report.bytes
    if not report.bpp <= MOST_BPP:
        raise WlmError(f"demo: expected at most {MOST_BPP} bits per texel, got {report.bpp:.3f}")
    for name, least in LEAST_DB.items():
        if not getattr(report, name) >= least:
            raise WlmError(f"demo: expected {name} of at least {least} dB, got {getattr(report, name):.2f}")
    if not ratio >= LEAST_RATIO:
        raise WlmError(f"demo: expected a file {LEAST_RATIO:g} times smaller than its input, got {ratio:.1f}")
    # Halfway between 18.45 and 18.55 in time is halfway in light: half of the lamps' strength.
    between, _ = read_exr(out / "city_18_50h.exr")
    light = lightmaps.light
    before, after = (light.frames[_index(lightmaps, stamp)][light.mask].mean() for stamp in (18.45, 18.55))
    mean = float(between[light.mask].mean())
    half = 0.5 * float(before + after)
    if not 0.97 * half <= mean <= 1.03 * half:
        raise WlmError(f"demo: the mean at {BETWEEN:g} h is {mean:.4f}; expected {half:.4f}, half-way")


def _index(lightmaps: LightmapSet, stamp: float) -> int:
    return int(np.argmin(np.abs(lightmaps.times - stamp)))


if __name__ == "__main__":
    run_demo(__doc__, run, lambda out: f"{out.name}/city.wlm")
