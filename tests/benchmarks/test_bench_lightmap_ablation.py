"""The ablation of feature maps on a set of a dynamic tile and one that needs no fit."""

import numpy as np
import pytest
from builders.bench_rows import check_outputs
from builders.small_sets import moving_light, tiny_profile

from benchmarks import Panel
from benchmarks.lightmap_ablation import HELD_OUT, KERNELS, VARIANTS, run_rows
from wlm.lightmap.data import from_arrays


@pytest.fixture(scope="module")
def lightmaps():
    """The first tile is constant; of the second, the map has 64 x 50 texels."""
    moving = moving_light(64, 50).light
    frames = np.pad(moving.frames, ((0, 0), (0, 0), (128, 0), (0, 0)), constant_values=0.5)
    return from_arrays(frames, moving.times, period=24.0, name="two")


@pytest.fixture(scope="module")
def made(lightmaps):
    """All rows, and what was told while they were made."""
    lines, counts = [], []
    options = {"progress": lines.append, "done": lambda rows: counts.append(len(rows))}
    rows = run_rows(lightmaps, tiny_profile(steps=30), device="cpu", **options)
    return rows, lines, counts


def test_every_row_has_its_figures(made, lightmaps, tmp_path):
    check_outputs(made[0], tmp_path, (Panel("bpp"),))
    rows, lines, counts = made
    names = [*VARIANTS, KERNELS, *HELD_OUT]
    assert [row.option for row in rows] == names and counts == list(range(1, len(names) + 1))
    assert lines == [f"two, ablation: fitting {name}" for name in names]
    for row in rows[-len(HELD_OUT) :]:  # 5 is left out; 11 and 13.5 are close to each other
        assert row["psnr"] > 10.0 and row["stored_psnr"] > row["mixed_psnr"] > 10.0 and "1 of 5 times" in row.notes
    for row in rows[: -len(HELD_OUT)]:
        assert (row.system, row.scene, row.method) == ("lightmap", "two, ablation", "ablation")
        assert row["psnr"] > 10.0 and 0.0 < row["ssim"] < 1.0 and row["dynamic_tiles"] == 1
        assert row["step_ms"] == pytest.approx(1e3 * row["encode_seconds"] / 30)
        # The dynamic tile alone is weighed, over what the map has of it.
        assert row["bpp"] == pytest.approx(8 * row["bytes"] / (64 * 50 * 5))
    by_name = {row.option: row for row in rows}
    network = {name: 2 * (features.inputs * 16 + 16 * 16 + 16 * 3 + 35) for name, features in VARIANTS.items()}
    for name, features in VARIANTS.items():
        assert by_name[name]["bytes"] == features.bytes + network[name] + 4 * 5 + 12
