"""The figures in the documents are those of the committed benchmarks."""

from pathlib import Path

import pytest

from wlm.bench import Row, read_json
from wlm.bench.report import report

ROOT = Path(__file__).resolve().parents[1]
GPU = ROOT / "benchmarks" / "nvidia-h200.json"
FILES = [GPU, ROOT / "benchmarks" / "cpu.json"]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def rows_of(path: Path) -> dict[tuple[str, str], Row]:
    return {(row.method, row.option): row for row in read_json(path)[0]}


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


def test_images_are_there():
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        for line in page.read_text(encoding="utf-8").splitlines():
            if line.startswith("!["):
                assert (page.parent / line.split("](")[1].split(")")[0]).is_file(), line
