"""The figures in the documents are those of the committed benchmarks."""

import re
from pathlib import Path

import pytest

from wlm.bench import Row, read_json
from wlm.bench.atlas import PANELS as ATLAS_PANELS
from wlm.bench.probe import PANELS
from wlm.bench.report import report

ROOT = Path(__file__).resolve().parents[1]
GPU = ROOT / "benchmarks" / "nvidia-h200.json"
FILES = [GPU, ROOT / "benchmarks" / "cpu.json"]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def rows_of(path: Path) -> dict[tuple[str, str], Row]:
    return {(row.method, row.option): row for row in read_json(path)[0] if row.system == "lightmap"}


def probe_rows(path: Path) -> dict[tuple[str, str, str], Row]:
    return {(row.scene, row.method, row.option): row for row in read_json(path)[0] if row.system == "probe"}


def test_results_page_is_made_from_the_benchmarks():
    assert (ROOT / "docs" / "results.md").read_text(encoding="utf-8") == report(FILES)


@pytest.mark.parametrize("name", ["L", "M", "H", "M64", "M-paper"])
def test_readme_profiles(name):
    row = rows_of(GPU)["ours", name]
    assert (
        f"| {name} | {row.bpp:.2f} | {row.psnr:.2f} | {row.ssim:.4f} | {row.flip:.3f} | {row.encode_seconds:.1f} |"
        in README
    )


@pytest.mark.parametrize(
    ("name", "method", "option"),
    [("BC7", "BC7", ""), ("BC6H", "BC6H", ""), ("ASTC 10x10", "ASTC", "10x10"), ("ASTC 12x12", "ASTC", "12x12")],
)
def test_readme_codecs(name, method, option):
    row = rows_of(GPU)[method, option]
    assert (
        f"| {name} | {row.bpp:.2f} | {row.psnr:.2f} | {row.ssim:.4f} | {row.flip:.3f} | {row.encode_seconds:.1f} |"
        in README
    )


@pytest.mark.parametrize(
    ("path", "gelu"), [("strip", "fast tanh"), ("strip", "erf"), ("strip", "tanh"), ("exact", "tanh"), ("exact", "erf")]
)
def test_readme_decode_options(path, gelu):
    row = rows_of(GPU)[path, gelu]
    assert f"| {path}, {gelu} | {row.decode_ms:.3f} | {row.psnr:.2f} | {row.max_error * 255:.2f} |" in README


def test_readme_speed_of_the_fit():
    rows = rows_of(GPU)
    ours, plain = rows["fit", "M 20,000 steps"], rows["fit in plain torch", "M 20,000 steps"]
    ratio = plain.encode_seconds / ours.encode_seconds
    assert f"{ours.encode_seconds:.1f} s against {plain.encode_seconds:.0f} s, {ratio:.0f} times" in README


@pytest.mark.parametrize(
    ("name", "option"),
    [
        ("0.02", "ratio 0.02"),
        ("0.05", "standard"),
        ("0.10", "ratio 0.10"),
        ("0.15", "ratio 0.15"),
        ("0.20", "ratio 0.20"),
        ("0.05, `compact`", "compact"),
        ("0.05, `paper`", "paper"),
    ],
)
def test_readme_probes(name, option):
    rows, cells = probe_rows(GPU), []
    for scene in ("livingroom", "city"):
        ours = [rows[f"{scene} {hour}", "ours", option] for hour in ("09.00", "12.00", "21.00")]
        cells += [f"{ours[1].bpp / (27 * 32):.2%}", *(f"{row.psnr:.2f}" for row in ours)]
    assert f"| {name} | {' | '.join(cells)} |" in README


@pytest.mark.parametrize("rival", PANELS[0].methods[1:])
def test_readme_probe_rivals(rival):
    rows = probe_rows(FILES[1])
    cells = [
        f"{rows[f'{scene} 12.00', rival, size].psnr:.2f}"
        for scene in ("livingroom", "city")
        for size in ("same bytes", "3x bytes")
    ]
    assert f"| {rival} | {' | '.join(cells)} |" in README


@pytest.mark.parametrize(
    "way", ["exact", "box", "sphere lists", "none", "exact, given order", "cut 2.5", "cut 2", "sphere"]
)
def test_readme_probe_decode_options(way):
    rows = [probe_rows(GPU)[f"{scene} 12.00", "decode", way] for scene in ("livingroom", "city")]
    cells = [f"{row.decode_ms:.3f} | {row.psnr:.2f} | {row.max_error:.0e}" for row in rows]
    assert f"| {way} | {' | '.join(cells)} |" in README


def test_readme_speed_of_the_probes_fit():
    rows = probe_rows(GPU)
    ours, plain = (rows["livingroom 12.00", method, "standard 12,000 steps"] for method in ("fit", "dense torch"))
    ratio = plain.encode_seconds / ours.encode_seconds
    assert f"{ours.encode_seconds:.1f} s against {plain.encode_seconds:.0f} s, {ratio:.0f} times" in README


def atlas_rows() -> dict[tuple[str, str, str], Row]:
    return {(row.scene, row.method, row.option): row for row in read_json(FILES[1])[0] if row.system == "atlas"}


@pytest.mark.parametrize("name", ["standard", "astc", "compact"])
def test_readme_atlas(name):
    rows = atlas_rows()
    for title, method, option in [
        (name, "ours", name),
        *((f"{rival}, as `{name}`", rival, f"bits of {name}") for rival in ATLAS_PANELS[0].methods[1:]),
    ]:
        row = rows["mean over 18 lightmaps", method, option]
        ratio, different, seams = (
            float(re.search(pattern, row.notes)[1])
            for pattern in (r"CR ([\d.]+)%", r"1-SSIM [^;]*mean ([\d.e-]+)", r"seam ratio [^;]*mean ([\d.]+)")
        )
        assert f"| {title} | {ratio:.1f}% | {row.psnr:.2f} | {different:.4f} | {seams:.2f} |" in README


@pytest.mark.parametrize("mesh", sorted({scene.rsplit(" ", 1)[0] for scene, *_ in atlas_rows() if scene[0].isupper()}))
def test_readme_meshes(mesh):
    rows, cells = atlas_rows(), []
    for time in ("day", "night"):
        both = rows[f"{mesh} {time}", "ours", "standard"], rows[f"{mesh} {time}", "downsampling", "bits of standard"]
        cells += [*(f"{row.psnr:.2f}" for row in both), *(f"{1 - row.ssim:.4f}" for row in both)]
    assert f"| {mesh} | {' | '.join(cells)} |" in README


def test_images_are_there():
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        for line in page.read_text(encoding="utf-8").splitlines():
            if line.startswith("!["):
                assert (page.parent / line.split("](")[1].split(")")[0]).is_file(), line
