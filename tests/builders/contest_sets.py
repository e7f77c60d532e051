"""A folder as the contest HPRC lays them out: two maps of two sizes, three hours, masks."""

import json
from pathlib import Path

import numpy as np

SIZES = {"1": (4, 6), "17": (300, 20)}  # rows and columns
HOURS = (1.0, 18.0, 24.0)


def contest_light(which: str) -> np.ndarray:
    """float32 [3, H, W, 3], no two texels alike."""
    shape = (len(HOURS), *SIZES[which], 3)
    return np.arange(1, np.prod(shape) + 1, dtype=np.float32).reshape(shape) / 64


def contest_mask(which: str) -> np.ndarray:
    """bool [H, W]: all but the first row."""
    return np.arange(SIZES[which][0])[:, None].repeat(SIZES[which][1], axis=1) > 0


def write_contest(folder: Path, parts: int = 1) -> Path:
    """Writes the maps 1 and 17 by their names, each file in `parts` of equally many rows."""
    entries = []
    for which, (height, width) in SIZES.items():
        resolution = {"width": width, "height": height}
        entries.append({"id": which, "resolution": resolution, "parts": parts, "note": "ignored"})
        name = f"Dilate_VirtualTexture0_{which}_HQ_{width}_{height}"
        coverage = np.where(contest_mask(which), 127, -1).astype(np.int8)
        _write(folder / "Mask" / f"lightmapCoverage_{name}_1.00.bin", coverage, parts)
        for hour, frame in zip(HOURS, contest_light(which), strict=True):
            _write(folder / "Original" / f"lightmapRawData_{name}_{hour:.2f}.bin", frame, parts)
    (folder / "config.json").write_text(json.dumps({"lightmap_count": len(entries), "lightmap_list": entries}))
    return folder


def _write(path: Path, array: np.ndarray, parts: int) -> None:
    path.parent.mkdir(exist_ok=True)
    for part, rows in enumerate(np.split(array, parts)):
        rows.tofile(f"{path}_{part}")
