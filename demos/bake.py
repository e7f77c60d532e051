"""Goes from a scene to compressed light: the bakes of a room, its lightmaps and probes over the day, and checks both.

`demos/data/cornell` is what `wlm bake` makes of `demos/cornell/room.yaml`; with --bake the room is baked again first,
which needs the extra `bake` and some minutes, and the new light is held to it.

    python demos/bake.py
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

import wlm
from wlm.cli.console import quiet_warp, show_figures
from wlm.errors import WlmError
from wlm.formats.atomic import atomic_write
from wlm.interop import check_device
from wlm.lightmap import LightmapSet
from wlm.view.display import white_of
from wlm.view.pictures import contact_sheet, encode

HERE = Path(__file__).resolve().parent
ROOM, DATA = HERE / "cornell" / "room.yaml", HERE / "data" / "cornell"
STEPS, SAMPLES, VIEWS = 600, 1024, 4
KEY = "20h"  # of the probes: the lamp is lit

# On the CPU seed 0 gave 44.8 dB, 46.7 as seen, and probes of 50.0 dB.
LEAST_DB = {"psnr": 43.3, "seen": 45.0}  # of the lightmaps' `Report`
LEAST_PROBES_DB = 49.0
MOST_DIFFERENCE = 0.02  # of a new bake's mean light at an hour


def bake(out: Path, device: str) -> Path:
    """Bakes the room into a folder and returns it: what the two commands of `wlm bake` do."""
    task = wlm.bake.open_task(ROOM)
    folder = out / "cornell"
    wlm.bake.write_lightmaps(folder, task, wlm.bake.bake_lightmaps(task, device=device))
    wlm.bake.write_probes(folder / "probes.npz", wlm.bake.bake_probes(task, device=device))
    new, old = wlm.lightmap.load(folder), wlm.lightmap.load(DATA)
    for hour, one, other in zip(old.times, _means(new), _means(old), strict=True):
        if not abs(one - other) <= MOST_DIFFERENCE * other:
            raise WlmError(f"demo: light at {hour:g} h: expected {other:.4f} on the mean, baked {one:.4f}")
    return folder


def _means(lightmaps: LightmapSet) -> list[float]:
    light = lightmaps.light
    return [float(frame[light.mask].mean()) for frame in light.frames]


def run(out: Path, data: Path, device: str) -> dict[str, float]:
    """Compresses the bakes of a folder, scores the files, draws them, and returns the figures."""
    seconds = {}
    clock = time.perf_counter()

    def lap(name: str) -> None:
        nonlocal clock
        seconds[name], clock = time.perf_counter() - clock, time.perf_counter()

    lightmaps = wlm.lightmap.load(data)
    path = out / "cornell.wlm"
    size = wlm.lightmap.compress(lightmaps, "M", device=device, steps=STEPS, samples=SAMPLES).save(path)
    lap("fit lightmaps")
    # From here on everything comes from the files.
    model = wlm.load(path)
    report = wlm.lightmap.evaluate(model, lightmaps, views=VIEWS, device=device)
    lap("evaluate them")
    decoder = model.decoder(device)
    decoded = np.stack([decoder.frame(stamp) for stamp in model.times])
    light = lightmaps.light
    white = white_of(light.frames[:, light.mask])
    rows = {"original": light.frames, "decoded": decoded, "error x 8": 8.0 * np.abs(decoded - light.frames)}
    pictures = {name: [encode(frame, light.mask, white) for frame in frames] for name, frames in rows.items()}
    contact_sheet(out / "cornell.png", pictures, [f"{hour:g} h" for hour in light.times])
    lap("draw")
    probes = wlm.probe.load(data / "probes.npz", key=KEY)
    path = out / "cornell_probes.wlm"
    probe_size = wlm.probe.compress(probes, device=device).save(path)
    values = wlm.load(path).decoder(device, position=probes.position).decode_probes()
    score = wlm.probe.score(values, probes, probe_size)
    lap("fit probes")
    atomic_write(out / "cornell_report.json", (json.dumps(report.to_json(), indent=1) + "\n").encode())
    figures = {
        "lightmaps, PSNR dB": report.psnr,
        "lightmaps, seen, dB": report.seen,
        "lightmaps, bytes": size,
        "probes": len(probes.position),
        "probes, PSNR dB": score.psnr,
        "probes, bytes": probe_size,
    }
    for name, least in LEAST_DB.items():
        if not getattr(report, name) >= least:
            raise WlmError(f"demo: expected {name} of at least {least} dB, got {getattr(report, name):.2f}")
    if not score.psnr >= LEAST_PROBES_DB:
        raise WlmError(f"demo: expected probes of at least {LEAST_PROBES_DB} dB, got {score.psnr:.2f}")
    return figures | {f"seconds to {name}": value for name, value in seconds.items()}


def main() -> None:
    """Reads the command line, runs the demo and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=HERE / "out", help="the folder to write to")
    parser.add_argument("--device", default="cpu", help='"cpu" or "cuda:0"')
    parser.add_argument("--bake", action="store_true", help="bake the room first")
    args = parser.parse_args()
    quiet_warp()
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        device = check_device(args.device)
        data = bake(args.out, args.device.partition(":")[0]) if args.bake else DATA
        figures = run(args.out, data, device)
    except (WlmError, OSError) as error:
        sys.exit(f"error: {error}")
    show_figures(f"{args.out.name}/cornell*.wlm", ["", "value"], figures.items())


if __name__ == "__main__":
    main()
