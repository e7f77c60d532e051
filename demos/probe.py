"""Compresses the light probes of a street, decodes them, walks down the street, and checks the result.

2,262 probes on the surfaces round a junction at noon, 551 of them dark and dead. The profile is `small` with fewer
steps, so that the demo ends soon.

    python demos/probe.py
"""

from __future__ import annotations

import json
import time
from pathlib import Path

from demo_command import run_demo

import wlm
from wlm.errors import WlmError
from wlm.formats.atomic import atomic_write
from wlm.probe.volume.walk import camera_path, settle, walk
from wlm.view.opening import open_scene
from wlm.view.window import Window

HERE = Path(__file__).resolve().parent
STEPS = 3500
KEY = "12.00"
FRAMES = 100

# On the CPU seed 0 gives 7,569 bytes, 39.8 dB, and 34.8 dB of the irradiance; seeds differ by 0.4 dB.
MOST_BYTES = 8_300
MOST_OFF = 0.01  # share of the live probes off by more than half of their light
LEAST_PSNR = 39.3
LEAST_IRRADIANCE_PSNR = 34.3
LEAST_RATIO = 28.0  # size of the probes in float32 over that of the file
LEAST_COVERAGE = 0.99  # share of the probes near the viewer, mean over the frames
LEAST_VOLUME_PSNR = 37.0  # of the light read there


def run(out: Path, device: str) -> dict[str, float]:
    """Runs the demo and returns its figures."""
    seconds = {}
    clock = time.perf_counter()

    def lap(name: str) -> None:
        nonlocal clock
        seconds[name], clock = time.perf_counter() - clock, time.perf_counter()

    source = HERE / "data" / "probes" / "street.npz"
    probes = wlm.probe.load(source, key=KEY)
    lap("load")
    path = out / "street.wlm"
    size = wlm.probe.compress(probes, "small", method="gaussians", seed=0, device=device, steps=STEPS).save(path)
    lap("fit")
    # From here on only the file is used, and the positions, which an engine has.
    model = wlm.load(path)
    decoder = model.decoder(device, position=probes.position)
    decoded = decoder.decode_probes()
    wlm.probe.save_probes(out / "street_decoded.npz", probes.position, decoded)
    lap("decode")
    report = wlm.probe.score(decoded, probes, size)
    lap("evaluate")
    live = probes.live
    volume = wlm.probe.Volume(probes.position, decoder.light(probes.position), live=live)
    path = camera_path(probes.position[live], FRAMES)
    settle(volume, path[0])
    figures = walk(volume, path, probes.values)
    lap("walk")
    content = {"report": report.to_json(), "walk": figures}
    atomic_write(out / "street_report.json", (json.dumps(content, indent=1) + "\n").encode())
    try:
        scene = open_scene(out / "street.wlm", original=source, key=KEY)
        window = Window(scene, size=(1800, 640))
        window.screenshot(out / "street.png")
        window.close()
    except WlmError as error:
        # A picture needs pyvista and an OpenGL library; all else here does not.
        print(error)
    lap("draw")
    result = {
        "PSNR dB": report.psnr,
        "PSNR dB of the irradiance": report.irradiance_psnr,
        "off by more than half": report.off,
        "bytes": size,
        "bits per probe": report.bits_per_probe,
        "times smaller": 1.0 / report.ratio,
        "bytes of GPU memory": model.content.nbytes,
        "Gaussians": model.content.count,
        "covered by the volume": figures["coverage"]["mean"],
        "PSNR dB through the volume": figures["psnr"],
        "blocks decoded a frame": figures["updated"]["mean"],
    }
    _check(result, bool(decoded[~live].any()))
    return result | {f"seconds to {name}": value for name, value in seconds.items()}


def _check(result: dict[str, float], dead_probes_lit: bool) -> None:
    """Holds the result to the bounds above; an error names the figure."""
    if dead_probes_lit:
        raise WlmError("demo: expected dead probes to decode to zero")
    if not result["bytes"] <= MOST_BYTES:
        raise WlmError(f"demo: bytes: expected at most {MOST_BYTES}, got {result['bytes']:.4g}")
    if not result["off by more than half"] <= MOST_OFF:
        raise WlmError(
            f"demo: off by more than half: expected at most {MOST_OFF}, got {result['off by more than half']}"
        )
    least = {
        "PSNR dB": LEAST_PSNR,
        "PSNR dB of the irradiance": LEAST_IRRADIANCE_PSNR,
        "times smaller": LEAST_RATIO,
        "covered by the volume": LEAST_COVERAGE,
        "PSNR dB through the volume": LEAST_VOLUME_PSNR,
    }
    for name, bound in least.items():
        if not result[name] >= bound:
            raise WlmError(f"demo: {name}: expected at least {bound}, got {result[name]:.4g}")


if __name__ == "__main__":
    run_demo(__doc__, run, lambda out: f"{out.name}/street.wlm")
