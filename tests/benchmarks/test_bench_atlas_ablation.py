"""Ablation of the cascade on two small lightmaps: rows are of what they name."""

import pytest
from builders.atlas_meshes import charts, sheet
from builders.bench_rows import check_outputs, keys

from benchmarks import Panel
from benchmarks.atlas import Lightmap
from benchmarks.atlas_ablation import ABLATION, OF_WHOLE, run_rows
from wlm.atlas.model import Profile

PROFILE = Profile(name="small", method="cascade", steps=6, resolution=32, fallback=False, space="uv")
VIEWS = {"views": 2, "resolution": 48}
SWEPT = ["scale 0.3", "colour_scale 0.8", "lut_scale 1"]


@pytest.fixture(scope="module")
def lightmaps():
    return [Lightmap("sheet day", sheet(height=64, width=64)), Lightmap("cube night", charts())]


@pytest.fixture(scope="module")
def rows(lightmaps):
    return run_rows(lightmaps, PROFILE, [*ABLATION, *OF_WHOLE, *SWEPT], device="cpu", **VIEWS)


def test_rows_and_means(rows, tmp_path):
    check_outputs(rows, tmp_path, (Panel("bpp"),))
    names = [*(("ablation", name) for name in (*ABLATION, *OF_WHOLE)), *(("sweep", name) for name in SWEPT)]
    scenes = [f"{scene}, ablation of small" for scene in ("sheet day", "cube night", "mean over 2 lightmaps")]
    assert keys(rows) == names * 3
    assert [row.scene for row in rows] == [scene for scene in scenes for _ in names]
    for row in rows:
        assert row["psnr"] > 5.0 and row["bpp"] == pytest.approx(48 * (1 - row["compression_ratio"]))


def test_each_row_lacks_its_part(rows):
    cube = {row.option: row for row in rows if row.scene.startswith("cube night")}
    whole, kept = cube["whole"], cube["no repacking"]
    # Sides of 48 x 64 by epsilon_p and epsilon_c, without epsilon.
    sides = ("colour_height", "colour_width", "lut_height", "lut_width")
    assert [kept[side] for side in sides] == [19, 26, 34, 45] and kept["steps"] == 6
    assert "pack_seconds" not in kept.figures and "pack_seconds" in whole.figures
    bare = cube["no cascade"]
    assert "lut_width" not in bare.figures and bare["steps"] == 0
    assert bare["colour_width"] > 2 * whole["colour_width"]
    assert cube["not tuned"]["psnr"] != whole["psnr"] and cube["not tuned"]["bpp"] == whole["bpp"]
    assert cube["ASTC"]["bpp"] < whole["bpp"] and cube["ASTC"]["colour_width"] == whole["colour_width"]
    best, paper = cube["downsampling"], cube["downsampling, paper"]
    assert 0.9 * whole["bpp"] < best["bpp"] <= whole["bpp"] and 0.8 * best["bpp"] < paper["bpp"] < best["bpp"]
    assert paper["colour_width"] < best["colour_width"]
    assert cube["scale 0.3"]["lut_width"] < whole["lut_width"] < cube["lut_scale 1"]["lut_width"]
    assert cube["colour_scale 0.8"]["colour_width"] == pytest.approx(2 * whole["colour_width"], abs=1)
