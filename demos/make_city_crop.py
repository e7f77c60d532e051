"""Cuts a rectangle out of a lightmap set and writes it as a set of its own, small enough for a repository.

`demos/data/city` is the upper left corner of a bake of 512x512 texels:

    python demos/make_city_crop.py .../city/set.json demos/data/city --y 0 --x 0 --height 256 --width 128
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path, atomic_write
from wlm.formats.exr import write_exr
from wlm.lightmap.data import LightmapSet, load


def crop(lightmaps: LightmapSet, out: Path, y: int, x: int, height: int, width: int) -> int:
    """Writes a rectangle of a set: one half-float EXR a time, `mask.png` and `set.json`.

    Args:
        lightmaps: The whole set.
        out: The folder to write to; made if it is missing.
        y: Row of the first texel.
        x: Column of the first texel.
        height: In texels.
        width: In texels.

    Returns:
        Bytes written.

    Raises:
        WlmError: The rectangle is not inside the map or has no valid texel, two times share a file's name,
            or a file cannot be written.
    """
    light = lightmaps.light
    rows, columns = light.mask.shape
    place = f"{width}x{height} at row {y}, column {x}"
    if min(y, x) < 0 or min(height, width) < 1 or y + height > rows or x + width > columns:
        raise WlmError(f"crop: {place} is not inside the map of {columns}x{rows}")
    window = (slice(y, y + height), slice(x, x + width))
    mask = light.mask[window]
    if not mask.any():
        raise WlmError(f"crop: {place} has no valid texel")
    names = [f"lightmap_{time:05.2f}h.exr".replace(".", "_", 1) for time in lightmaps.times]
    if len(set(names)) < len(names):
        raise WlmError("crop: two times are closer than 0.01, which the names of the files cannot tell apart")

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WlmError(f"{out}: cannot make the folder: {error.strerror or error}") from error
    for name, frame in zip(names, light.frames, strict=True):
        # Nobody reads the gaps; zeros cost no bytes.
        write_exr(out / name, np.where(mask[..., None], frame[window], 0.0), half=True)
    with atomic_path(out / "mask.png") as temporary:
        Image.fromarray(np.where(mask, np.uint8(255), np.uint8(0))).save(temporary, "PNG", optimize=True)
    description = {"name": lightmaps.name, "width": width, "height": height, "mask": "mask.png"}
    if lightmaps.period is not None:
        description["period_hours"] = lightmaps.period
    description["lightmaps"] = [
        {"time_hours": float(time), "file": name} for time, name in zip(lightmaps.times, names, strict=True)
    ]
    description["note"] = f"{place} of a map of {columns}x{rows}"
    # Last: a set that was cut short has no list of its files.
    atomic_write(out / "set.json", (json.dumps(description, indent=1) + "\n").encode())
    return sum((out / name).stat().st_size for name in [*names, "mask.png", "set.json"])


def main() -> None:
    """Reads the command line, crops and says what was written."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("set", type=Path, metavar="SRC_SET_JSON", help="the set.json of the whole set")
    parser.add_argument("out", type=Path, metavar="OUT_DIR", help="the folder to write to")
    for name, text in (("y", "row of the first texel"), ("x", "column of the first texel")):
        parser.add_argument(f"--{name}", type=int, required=True, help=text)
    for name in ("height", "width"):
        parser.add_argument(f"--{name}", type=int, required=True, help=f"{name} of the crop in texels")
    args = parser.parse_args()
    try:
        lightmaps = load(args.set)
        size = crop(lightmaps, args.out, args.y, args.x, args.height, args.width)
    except WlmError as error:
        sys.exit(f"error: {error}")
    print(f"{args.out}: {len(lightmaps.times)} times, {args.width}x{args.height}, {size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
