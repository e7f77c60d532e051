"""The atlas benchmark on two small lightmaps: every row has its figures, and they agree with what they are of."""

import numpy as np
import pytest
from builders.atlas_meshes import charts, image, sheet, soft
from builders.bench_rows import check_outputs, keys

import benchmarks.atlas as bench
from benchmarks.atlas import PANELS, Lightmap, plotted, read_lightmaps, run_rows
from wlm.atlas.data import LightmappedScene
from wlm.atlas.evaluation import compare
from wlm.atlas.fit import compress
from wlm.atlas.model import Profile
from wlm.atlas.stored import store
from wlm.formats.exr import write_exr

FEW = {"views": 2}
PROFILES = [
    Profile(name="standard", **FEW),
    Profile(name="bc6h", colour="bc6h", budget=0.3, fallback=False, **FEW),
    Profile(name="paper", method="cascade", steps=6, resolution=32, fallback=False, colour_scale=0.6),
]
RIVALS = ["downsampling", "downsampling bilinear", "BC6H", "BC6H, our encoder", "ASTC"]
SMALLER = ["standard, CR 92.5%", "standard, CR 95%"]
MEANS = "bpp psnr texel_psnr tone_psnr flip one_minus_ssim seam_ratio decode_ms encode_seconds".split()
MEAN = "mean over 2 lightmaps"


@pytest.fixture(scope="module")
def lightmaps():
    return [Lightmap("sheet day", sheet(height=64, width=64)), Lightmap("cube night", charts())]


@pytest.fixture(scope="module")
def rows(lightmaps):
    return run_rows(lightmaps, PROFILES, device="cpu", views=3, resolution=64, whole=True, points=5000, repeats=1)


def test_every_row_has_its_figures(rows, tmp_path):
    check_outputs(rows, tmp_path, PANELS, plotted(rows))
    assert {row.scene for row in plotted(rows)} == {MEAN}
    assert plotted(rows[:5]) == rows[:5]
    ours = [("ours", name) for name in ("standard", "bc6h", "paper", *SMALLER, "standard, bits of paper")]
    tuned = [("fit", "paper, space views"), ("fit", "paper, space uv")]
    for scene, extra in (("sheet day", tuned), ("cube night", [])):
        measured = keys(row for row in rows if row.scene == scene)
        before = [*ours, *extra, ("lightmap", "half floats"), *((name, "bits of standard") for name in RIVALS)]
        assert measured[: len(before)] == before
        rest = measured[len(before) :]
        for method in ("downsampling", "ASTC"):
            options = [option for name, option in rest if name == method]
            # One that has the whole lightmap in the bits of standard isn't measured in more.
            assert options[-3:] == [f"bits of {option}" for option in ("paper", *SMALLER)]
            assert options[:-3] in ([], ["bits of bc6h"])
        assert {name for name, _ in rest} == set(RIVALS)
    means = keys(row for row in rows if row.scene == MEAN)
    rivals = ((name, "bits of standard") for name in RIVALS)
    assert means[: len(ours) + 1 + len(RIVALS)] == [*ours, ("lightmap", "half floats"), *rivals]
    for row in rows:
        assert row.system == "atlas" and "not measured" not in row.notes
        assert (row.method == "lightmap") == (row.get("psnr") is None)
        if row.method in ("ours", "lightmap"):
            assert row["decode_ms"] > 0.0 and row["max_error"] < 0.5
        if row.method != "lightmap":
            assert row["psnr"] > 8.0 and row["one_minus_ssim"] >= 0.0 and row["encode_seconds"] > 0.0
        if row.method == "ours":
            # The file has a header besides, streams, and half floats of three channels where a GPU has four.
            assert row["bytes"] > row["bpp"] * 64 * 48 / 8 * 0.4


def test_rows_are_of_what_they_name(lightmaps, rows):
    """The same compression, scored apart from the others."""
    mesh = lightmaps[0].lit
    model = compress(mesh, PROFILES[0])
    row = rows[0]
    assert row["bpp"] == pytest.approx(48 * (1 - model.compression_ratio))
    assert row["compression_ratio"] == model.compression_ratio
    report = compare(mesh, {"a": bench.Decoder(model)}, views=3, resolution=64)["a"]
    for name in ("psnr", "psnr_worst", "texel_psnr", "one_minus_ssim", "tone_psnr", "flip"):
        assert row[name] == pytest.approx(getattr(report, name)), name
    assert "seam_ratio" not in row.figures  # a sheet has no seam


def test_rivals_keep_to_the_bits(rows):
    bpp = {(row.scene, f"bits of {row.option}"): row["bpp"] for row in rows if row.method == "ours"}
    rivals = [row for row in rows if row.method in RIVALS and row.scene != MEAN]
    assert len(rivals) >= 2 * (len(RIVALS) + 2)
    for row in rivals:
        assert row["bpp"] <= bpp[row.scene, row.option] * (1 + 1e-9)
        assert row["bytes"] == pytest.approx(row["bpp"] / 8 * (64 * 64 if row.scene == "sheet day" else 48 * 64), abs=1)


def test_means(rows):
    for row in rows:
        if row.scene == MEAN:
            both = [r for r in rows if (r.method, r.option) == (row.method, row.option) and r is not row]
            assert len(both) == row["lightmaps"] == 2
            for name in MEANS:
                values = [r[name] for r in both if name in r.figures]
                assert row.get(name) == (pytest.approx(np.mean(values)) if values else None), name
            if row.get("psnr"):
                assert (row["psnr_min"], row["psnr_max"]) == tuple(sorted(r["psnr"] for r in both))
            if row.get("max_error") is not None:
                assert row["max_error"] == max(r["max_error"] for r in both)


def _files(folder, mesh: LightmappedScene, *names: str, masked: bool = False) -> None:
    from PIL import Image

    folder.mkdir()
    (folder / "mesh.glb").write_bytes(store(mesh).glb)
    for i, name in enumerate(names):
        write_exr(folder / f"{name}.exr", image(soft, *mesh.sheets[0].mask.shape) * (i + 1))
    if masked:
        Image.fromarray(mesh.sheets[0].mask.astype(np.uint8) * 255).save(folder / "mask.png")


def test_folders(tmp_path):
    """A folder of a mesh, a folder of such folders, and one mesh with its files named."""
    _files(tmp_path / "Cube", charts(), "day", "night", masked=True)
    _files(tmp_path / "Sheet", sheet(), "day")
    (tmp_path / "notes").mkdir()
    assert [lightmap.scene for lightmap in read_lightmaps(tmp_path)] == ["Cube day", "Cube night", "Sheet day"]
    assert [lightmap.scene for lightmap in read_lightmaps(tmp_path / "Cube")] == ["Cube day", "Cube night"]
    day, night = (lightmap.lit.sheets[0] for lightmap in read_lightmaps(tmp_path / "Cube"))
    np.testing.assert_allclose(night.lightmap, 2 * day.lightmap, rtol=2e-3)
    np.testing.assert_array_equal(day.mask, charts().sheets[0].mask)
    mesh, exr = tmp_path / "Cube" / "mesh.glb", tmp_path / "Cube" / "night.exr"
    (named,) = read_lightmaps(None, mesh, [exr], tmp_path / "Cube" / "mask.png")
    assert named.scene == "Cube night" and named.lit.source == read_lightmaps(tmp_path / "Cube")[1].lit.source
    exr.rename(exr.with_stem("Cube"))
    assert [lightmap.scene for lightmap in read_lightmaps(tmp_path / "Cube")] == ["Cube", "Cube day"]
