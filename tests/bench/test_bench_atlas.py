"""The atlas benchmark on two small lightmaps: every row has its figures, and they agree with what they are of."""

import numpy as np
import pytest
from builders.atlas_meshes import charts, constant, image, sheet, soft
from typer.testing import CliRunner

import wlm.bench.atlas as bench
from wlm.atlas.data import LightmappedMesh, write_mesh
from wlm.atlas.evaluation import compare
from wlm.atlas.fit import compress
from wlm.atlas.model import Profile
from wlm.bench import plot, read_json, table, write_json
from wlm.bench.atlas import PANELS, plotted, run, run_rivals, run_rows
from wlm.bench.atlas_inputs import Lightmap, load
from wlm.errors import WlmError
from wlm.formats.exr import write_exr

FEW = {"views": 2}
PROFILES = [
    Profile(name="standard", **FEW),
    Profile(name="bc6h", colour="bc6h", budget=0.3, fallback=False, **FEW),
    Profile(name="paper", method="cascade", steps=6, resolution=32, fallback=False, colour_scale=0.6),
]
RIVALS = ["downsampling", "downsampling bilinear", "BC6H", "ASTC", "single colour"]


@pytest.fixture(scope="module")
def lightmaps():
    return [Lightmap("sheet day", sheet(height=64, width=64)), Lightmap("cube night", charts())]


@pytest.fixture(scope="module")
def rows(lightmaps):
    return run_rows(lightmaps, PROFILES, device="cpu", views=3, resolution=64, whole=True, points=5000, repeats=1)


def test_every_row_has_its_figures(rows):
    ours = [("ours", name) for name in ("standard", "bc6h", "paper", "standard, bits of paper")]
    tuned = [("fit", "paper, space views"), ("fit", "paper, space uv")]
    for scene, extra in (("sheet day", tuned), ("cube night", [])):
        own = [(row.method, row.option) for row in rows if row.scene == scene]
        before = [*ours, *extra, ("lightmap", "half floats"), *((name, "bits of standard") for name in RIVALS)]
        assert own[: len(before)] == before
        rest = own[len(before) :]
        assert [option for name, option in rest if name == "downsampling"] == ["bits of bc6h", "bits of paper"]
        assert [option for name, option in rest if name == "ASTC"] == ["bits of bc6h", "bits of paper"]
        assert {name for name, _ in rest} == set(RIVALS)
    means = [(row.method, row.option) for row in rows if row.scene == "mean over 2 lightmaps"]
    assert means[:10] == [*ours, ("lightmap", "half floats"), *((name, "bits of standard") for name in RIVALS)]
    for row in rows:
        assert row.system == "atlas" and row.notes and "not measured" not in row.notes
        assert (row.method == "lightmap") == (row.psnr is None)
        if row.method in ("ours", "lightmap"):
            assert row.decode_ms > 0.0 and row.max_error < 0.5
        if row.method != "lightmap":
            assert row.psnr > 8.0 and row.ssim <= 1.0 and row.encode_seconds > 0.0
        if row.method == "ours":
            # The file has a header besides.
            assert row.bytes > row.bpp * 64 * 48 / 8


def test_rows_are_of_what_they_name(lightmaps, rows):
    """The same compression, scored apart from the others."""
    mesh = lightmaps[0].mesh
    model = compress(mesh, PROFILES[0])
    row = rows[0]
    assert row.bpp == pytest.approx(48 * (1 - model.compression_ratio))
    report = compare(mesh, {"a": bench.Decoder(model)}, views=3, resolution=64)["a"]
    assert row.psnr == pytest.approx(report.psnr) and row.ssim == pytest.approx(1 - report.one_minus_ssim)
    for figure in (f"CR {100 * model.compression_ratio:.1f}%", f"worst view {report.psnr_worst:.2f} dB"):
        assert figure in row.notes


def test_rivals_keep_to_the_bits(rows):
    share = {(row.scene, f"bits of {row.option}"): row.bpp for row in rows if row.method == "ours"}
    checked = [row for row in rows if row.method in RIVALS and row.scene != "mean over 2 lightmaps"]
    assert len(checked) >= 2 * (5 + 2)
    for row in checked:
        assert row.bpp <= share[row.scene, row.option] * (1 + 1e-9)
        assert row.bytes == pytest.approx(row.bpp / 8 * (64 * 64 if row.scene == "sheet day" else 48 * 64), abs=1)


def test_means(rows):
    for row in rows:
        if row.scene == "mean over 2 lightmaps":
            both = [r for r in rows if (r.method, r.option) == (row.method, row.option) and r is not row]
            assert len(both) == 2
            for name in ("bpp", "psnr", "ssim", "decode_ms", "encode_seconds"):
                values = [getattr(r, name) for r in both if getattr(r, name) is not None]
                assert getattr(row, name) == (pytest.approx(np.mean(values)) if values else None), name
            if row.max_error is not None:
                assert row.max_error == max(r.max_error for r in both)


def test_rows_make_a_file_a_table_and_a_plot(rows, tmp_path):
    write_json(tmp_path / "rows.json", rows, {})
    assert read_json(tmp_path / "rows.json")[0] == rows
    assert len(table(rows).splitlines()) == 2 + len(rows)
    assert {row.scene for row in plotted(rows)} == {"mean over 2 lightmaps"}
    assert plotted(rows[:5]) == rows[:5]
    plot(plotted(rows), tmp_path / "rows.png", PANELS)
    assert (tmp_path / "rows.png").stat().st_size > 10_000


def test_a_lightmap_of_one_colour_has_no_scores():
    """There is no range to measure against, and the rows say nothing instead of infinity."""
    lightmap = Lightmap("flat", sheet(constant(0.5, 0.5, 0.5), 32, 32))
    profile = PROFILES[0].model_copy(update={"fallback": False})
    rows = run_rows([lightmap], [profile], device="cpu", views=2, resolution=32, whole=False, points=100, repeats=1)
    assert all(row.psnr is None for row in rows)
    assert [row.method for row in rows] == ["ours", "lightmap", *RIVALS]


def test_no_room_for_a_rival_or_a_table():
    """Eight texels of a lightmap: what doesn't fit is named, and the others are measured."""
    cascade = PROFILES[2].model_copy(update={"scale": 0.2, "colour_scale": 0.2, "lut_scale": 0.2})
    lightmap = Lightmap("small", sheet(height=24, width=24))
    alone = PROFILES[0].model_copy(update={"fallback": False})
    found = run_rows(
        [lightmap], [alone, cascade], device="cpu", views=1, resolution=32, whole=True, points=100, repeats=1
    )
    missing = [row for row in found if "not measured" in row.notes]
    assert ("ours", "standard, bits of paper") in [(row.method, row.option) for row in missing]
    assert all(row.psnr is None and row.bytes is None for row in missing)
    assert found[0].psnr is not None


def _files(folder, mesh: LightmappedMesh, *names: str, masked: bool = False) -> None:
    from PIL import Image

    folder.mkdir()
    write_mesh(folder / "mesh.glb", mesh, mesh.uv[mesh.triangle])
    for i, name in enumerate(names):
        write_exr(folder / f"{name}.exr", image(soft, *mesh.mask.shape) * (i + 1))
    if masked:
        Image.fromarray(mesh.mask.astype(np.uint8) * 255).save(folder / "mask.png")


def test_folders(tmp_path):
    """A folder of a mesh, a folder of such folders, and one mesh with its files named."""
    _files(tmp_path / "Cube", charts(), "day", "night", masked=True)
    _files(tmp_path / "Sheet", sheet(), "day")
    (tmp_path / "notes").mkdir()
    assert [lightmap.scene for lightmap in load(tmp_path)] == ["Cube day", "Cube night", "Sheet day"]
    assert [lightmap.scene for lightmap in load(tmp_path / "Cube")] == ["Cube day", "Cube night"]
    day, night = (lightmap.mesh for lightmap in load(tmp_path / "Cube"))
    np.testing.assert_allclose(night.lightmap, 2 * day.lightmap, rtol=2e-3)
    np.testing.assert_array_equal(day.mask, charts().mask)
    mesh, exr = tmp_path / "Cube" / "mesh.glb", tmp_path / "Cube" / "night.exr"
    (one,) = load(None, mesh, [exr], tmp_path / "Cube" / "mask.png")
    assert one.scene == "Cube night" and one.mesh.source == night.source
    exr.rename(exr.with_stem("Cube"))
    assert [lightmap.scene for lightmap in load(tmp_path / "Cube")] == ["Cube", "Cube day"]


def test_what_is_refused(tmp_path, lightmaps):
    _files(tmp_path / "Cube", charts(), "day")
    mesh, exr = tmp_path / "Cube" / "mesh.glb", tmp_path / "Cube" / "day.exr"
    for paths, line in (
        ((tmp_path / "absent",), "absent: no such folder"),
        ((tmp_path / "Cube", mesh, [exr]), "expected --mesh FILE with --lightmap FILE, or --meshes DIR alone"),
        ((None, mesh), "expected --mesh FILE with --lightmap FILE"),
        ((None, None, [exr]), "--lightmap and --mask need --mesh FILE"),
        ((None, tmp_path / "absent.glb", [exr]), "absent.glb"),
    ):
        with pytest.raises(WlmError, match=line):
            load(*paths)
    (tmp_path / "empty").mkdir()
    with pytest.raises(WlmError, match="expected a .glb and its .exr in it or in folders of it, found none"):
        load(tmp_path / "empty")
    (tmp_path / "Cube" / "second.glb").write_bytes(mesh.read_bytes())
    with pytest.raises(WlmError, match="Cube: expected one .glb a folder, found 2"):
        load(tmp_path)
    with pytest.raises(WlmError, match="device 'tpu'"):
        run(lightmaps, quick=True, device="tpu")
    with pytest.raises(WlmError, match="profile"):
        run(lightmaps, ["absent"], quick=True, device="cpu")
    with pytest.raises(ValueError, match="at least one lightmap and one profile"):
        run_rows(lightmaps, [], device="cpu", views=1, resolution=32, whole=False)


def test_the_command(tmp_path, monkeypatch):
    """What it writes, and the command line that it keeps."""
    from wlm.cli.bench import app

    _files(tmp_path / "Cube", charts(), "day")
    seen = {}

    def measured(lightmaps, names, **options):
        seen.update(options, names=names)
        return run_rows(
            lightmaps, PROFILES[:1], device="cpu", views=1, resolution=32, whole=False, points=50, repeats=1
        )

    monkeypatch.setattr(bench, "run", measured)
    arguments = ["atlas", "--quick", "--meshes", tmp_path / "Cube", "--json", tmp_path / "a.json", "--plot"]
    result = CliRunner().invoke(app, [*map(str, arguments), str(tmp_path / "a.png")])
    assert result.exit_code == 0, result.output
    assert seen["quick"] and seen["device"] == "cpu" and seen["rivals"] and seen["names"] == ()
    rows, environment = read_json(tmp_path / "a.json")
    assert environment["command"] == "wlm bench atlas --quick --device cpu --meshes Cube"
    assert {row.scene for row in rows} == {"Cube day"} and "downsampling bilinear" in result.output
    assert (tmp_path / "a.png").stat().st_size > 1000


def test_the_rivals_alone(lightmaps, rows, tmp_path, monkeypatch):
    """At the bits that a result file has, with the scores that they have in a whole run."""
    monkeypatch.setattr(bench, "_VIEWS", 3)
    monkeypatch.setattr(bench, "_RESOLUTION", 64)
    write_json(tmp_path / "rows.json", rows, {})
    alone = run_rivals(tmp_path / "rows.json", lightmaps[:1])
    beside = [
        row for row in rows if row.scene == "sheet day" and row.method in RIVALS and row.option == "bits of standard"
    ]
    assert [(row.method, row.option, row.bytes, row.psnr) for row in alone] == [
        (row.method, row.option, row.bytes, row.psnr) for row in beside
    ]
    write_json(tmp_path / "few.json", [row for row in rows if row.scene == "cube night"], {})
    with pytest.raises(WlmError, match="expected a row of method ours of sheet day"):
        run_rivals(tmp_path / "few.json", lightmaps)
