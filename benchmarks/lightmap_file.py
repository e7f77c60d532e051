"""Measures a large lightmap file that is read tile by tile: how long, how many bytes, and in how much memory.

The file repeats the fitted tiles of the demo's city in as many sheets of 4096 x 4096 texels at 26 times as make 200 MB,
six with profile M. The file is in the cache of the operating system: a disk adds the time of its reads.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import numpy as np

from benchmarks import tile_by_tile
from benchmarks.rows import Row
from benchmarks.runner import Bench, Note, demo_data
from wlm.formats import zstd
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.lightmap.codec import encode
from wlm.lightmap.data import load
from wlm.lightmap.fit import compress
from wlm.lightmap.model import LightmapModel
from wlm.lightmap.tiles import TILE
from wlm.system import load as load_model

_SIDE = 4096 // TILE  # tiles along a side of a sheet
_BYTES = 200_000_000
_STEPS = 100  # of the fit: neither times nor sizes depend on them
_QUICK_TILES = 64
_OPENS, _TILES = 20, 200


def run(*, quick: bool, device: str, progress: Note | None = None) -> list[Row]:
    """Writes a file of 200 MB and measures what a program waits for that needs one tile, or all tiles one by one.

    Args:
        quick: Whether to decode only some of the tiles one by one, at all times.
        device: "cpu" or "cuda:0".
        progress: Called with a line before each part of the work.

    Returns:
        One row.

    Raises:
        WlmError: The demo's set or the device isn't there.
    """
    bench = Bench("lightmap", device, progress, scene="a file of 200 MB")
    bench.note(f"fitting the city for {_STEPS} steps")
    model = compress(load(demo_data("city", "")), "M", device=device, frames="never", steps=_STEPS)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "large.wlm")
        bench.note("writing the file")
        size = write_large(model, path)
        bench.note("opening it and decoding a tile")
        figures = _one_tile(path, device)
        bench.note("decoding a sheet tile by tile")
        tiles = _QUICK_TILES if quick else _SIDE * _SIDE
        # By its path: the package of the benchmarks imports torch.
        command = [sys.executable, "-P", tile_by_tile.__file__, str(path), device, str(tiles)]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(place or os.getcwd() for place in sys.path)}
        told = subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout
    notes = (
        f"medians; a stored hour; memory of the process that decodes {tiles} tiles of a sheet at 26 hours one by one"
    )
    return [bench.row("ours", "M", notes, disk_bytes=size, **figures, **json.loads(told.splitlines()[-1]))]


def write_large(model: LightmapModel, path: Path, least: int = _BYTES) -> int:
    """Writes a file of at least `least` bytes that repeats the tiles of a model with one sheet; returns its size."""
    settings, parts, source = encode(model)
    count = len(model.light.kind)
    copies = -(-_SIDE * _SIDE // count)
    grid = model.light.grid
    mask = np.pad(model.light.mask, ((0, grid.rows * TILE - grid.height), (0, grid.cols * TILE - grid.width)))
    mask = np.tile(mask, (_SIDE // grid.rows, _SIDE // grid.cols))
    sheet: dict[str, object] = {}
    for name, part in parts.items():
        own = name.partition(".")[2]
        if own and own != "mask":
            sheet[own] = np.concatenate([part] * copies) if isinstance(part, np.ndarray) else list(part) * copies
    sheets = -(-least // sum(map(len, sheet["tiles"])))
    content = {"times": parts["times"]} | {f"{n}.{own}": part for n in range(sheets) for own, part in sheet.items()}
    packed = np.frombuffer(zstd.compress(np.packbits(mask).tobytes()), np.uint8)
    content |= {f"{number}.mask": packed for number in range(sheets)}
    settings["sheets"] = [
        settings["sheets"][0] | {"name": f"city {n}", "atlas": str(n), "size": [_SIDE * TILE] * 2}
        for n in range(sheets)
    ]
    return write_artifact(path, model.SYSTEM, settings, content, source)


@contextmanager
def _counted() -> Iterator[list[int]]:
    """Counts the bytes that are read by `os.pread`."""
    sizes, pread = [], os.pread

    def counted(handle: int, size: int, place: int) -> bytes:
        data = pread(handle, size, place)
        sizes.append(len(data))
        return data

    with mock.patch.object(os, "pread", counted):
        yield sizes


def _one_tile(path: Path, device: str) -> dict[str, float]:
    """Measures opening the file, opening it with the decode of one tile, and loading one tile of an open file."""
    artifact = read_artifact(path)
    index = artifact.file_bytes - sum(int(pieces.sizes.sum()) for pieces in artifact.pieces.values())
    opened, decoded, loaded = [], [], []
    numbers = np.random.default_rng(0).permutation(_SIDE * _SIDE).tolist()
    with _counted() as sizes:
        for number in numbers[: _OPENS + 1]:
            sizes.clear()
            start = time.perf_counter()
            model = load_model(path)
            opened.append(time.perf_counter() - start)
            sheet = list(model.sheets)[number % len(model.sheets)]
            model.decoder(device, tiles={sheet: [number]}).sheets[sheet].tiles([number], 12.0)
            decoded.append(time.perf_counter() - start)
    for number in numbers[:_TILES]:
        start = time.perf_counter()
        model.light.only([number])
        loaded.append(time.perf_counter() - start)
    # The first call compiles or loads the kernels.
    times = {"open_ms": opened[1:], "open_tile_ms": decoded[1:], "load_ms": loaded}
    return {"read_bytes": index + sum(sizes)} | {name: 1e3 * float(np.median(own)) for name, own in times.items()}
