"""The figures in the documents are those of the committed benchmarks."""

import csv
import json
import re
from pathlib import Path

import pytest

from wlm.bench import Row, read_json
from wlm.bench.atlas import PROFILES as ATLAS_PROFILES
from wlm.bench.probe import PANELS
from wlm.bench.report import figures, report

ROOT = Path(__file__).resolve().parents[1]
GPU = ROOT / "benchmarks" / "nvidia-h200.json"
FILES = [GPU, ROOT / "benchmarks" / "cpu.json"]
README = (ROOT / "README.md").read_text(encoding="utf-8")
ATLAS = (ROOT / "docs" / "atlas.md").read_text(encoding="utf-8")
ATLAS_RIVALS = ("downsampling", "downsampling bilinear", "BC6H", "ASTC", "single colour")
ATLAS_MEAN = "mean over 18 lightmaps"


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


def atlas_rows(path: Path = FILES[1]) -> dict[tuple[str, str, str], Row]:
    return {(row.scene, row.method, row.option): row for row in read_json(path)[0] if row.system == "atlas"}


def noted(row: Row, pattern: str) -> float:
    """A figure that a row has in its notes alone."""
    return float(re.search(pattern, row.notes)[1])


def atlas_line(title: str, row: Row) -> str:
    ratio, seams = noted(row, r"CR ([\d.]+)%"), noted(row, r"seam ratio [^;]*mean ([\d.]+)")
    return f"| {title} | {ratio:.1f}% | {row.psnr:.2f} | {1 - row.ssim:.4f} | {seams:.2f} |"


@pytest.mark.parametrize("name", ["standard", "astc", "compact"])
def test_readme_atlas(name):
    rows = atlas_rows()
    for title, method, option in [
        (name, "ours", name),
        *((f"{rival}, as `{name}`", rival, f"bits of {name}") for rival in ATLAS_RIVALS),
    ]:
        assert atlas_line(title, rows[ATLAS_MEAN, method, option]) in README


def test_readme_cascade():
    rows = atlas_rows(GPU)
    cascade, tiles, compact = (
        rows[ATLAS_MEAN, "ours", name] for name in ("cascade", "standard, bits of cascade", "compact")
    )
    assert atlas_line("cascade", cascade) in README
    assert atlas_line("half-float tiles, as `cascade`", tiles) in README
    # What the text says of them.
    assert tiles.psnr < cascade.psnr < compact.psnr and compact.bpp < cascade.bpp == pytest.approx(tiles.bpp, rel=0.01)
    found = " ".join(README.split())
    assert f"`cascade` takes {cascade.bytes / 1000:.0f} kB a lightmap, `compact` {compact.bytes / 1000:.0f}." in found


def test_readme_seams():
    found, rows, highest = " ".join(README.split()), atlas_rows(GPU), 0.0
    for name, words in (
        ("standard", "Seams of `standard` are {} times"),
        ("astc", "`astc` {}, "),
        ("compact", "`compact` {}; "),
    ):
        notes = rows[ATLAS_MEAN, "ours", name].notes
        low, high = map(float, re.search(r"seam ratio ([\d.]+) to ([\d.]+)", notes).groups())
        assert words.format(f"{low:.2f} to {high:.2f}") in found
        assert (high <= 1.5) is (name == "standard")
        highest = max(highest, high)
    assert f"up to {highest:.1f} times; `standard` stays below" in ATLAS


@pytest.mark.parametrize("name", ["standard", "astc", "compact", "cascade"])
def test_readme_atlas_times(name):
    row, slow = (atlas_rows(path).get((ATLAS_MEAN, "ours", name)) for path in FILES)
    alone = "" if slow is None else f"{slow.encode_seconds:.1f}"
    cells = [f"{row.encode_seconds:.1f}", alone, f"{row.decode_ms:.3f}", f"{row.max_error:.0e}"]
    assert f"| {name} | {' | '.join(cells)} |".replace("|  |", "| |") in README


def test_readme_reading_the_lightmap_itself():
    row = atlas_rows(GPU)[ATLAS_MEAN, "lightmap", "half floats"]
    assert f"| the lightmap itself | | | {row.decode_ms:.3f} | {row.max_error:.0e} |" in README


def test_readme_tuning_of_the_cascade():
    rows = atlas_rows(GPU)
    views, uv = (rows["AntiqueCamera day", "fit", f"cascade, space {space}"] for space in ("views", "uv"))
    found = " ".join(README.split())
    assert f"{views.encode_seconds:.2f} s in views, as the paper tunes, for {views.psnr:.2f} dB" in found
    words = "s at points of the surface, as the profile does, for"
    assert f"{uv.encode_seconds:.2f} {words} {uv.psnr:.2f} dB" in found


@pytest.mark.parametrize("name", ATLAS_PROFILES)
def test_atlas_profiles(name):
    row = atlas_rows(GPU)["AntiqueCamera day", "ours", name]
    ratio, seams = noted(row, r"CR ([\d.]+)%"), noted(row, r"seam ratio ([\d.]+)")
    cells = [f"{ratio:.1f}%", f"{row.psnr:.2f}", f"{seams:.2f}", f"{row.bytes / 1000:.0f}"]
    cells += [f"{row.encode_seconds:.1f}", f"{row.decode_ms:.3f}"]
    assert f"| {name} | {' | '.join(cells)} |" in ATLAS


@pytest.mark.parametrize("mesh", sorted({scene.rsplit(" ", 1)[0] for scene, *_ in atlas_rows() if scene[0].isupper()}))
def test_readme_meshes(mesh):
    rows, cells = atlas_rows(), []
    for time in ("day", "night"):
        both = rows[f"{mesh} {time}", "ours", "standard"], rows[f"{mesh} {time}", "downsampling", "bits of standard"]
        cells += [*(f"{row.psnr:.2f}" for row in both), *(f"{1 - row.ssim:.4f}" for row in both)]
    assert f"| {mesh} | {' | '.join(cells)} |" in README


# Where the README's figures of smoke are from, and the columns of its tables.
SMOKE = FILES[0]
EVALUATION = ROOT / "benchmarks" / "smoke-network.json"
SMOKE_TABLES = {
    "lattice": ("cells", "ms", "MLUPS", "of the copy"),
    "lattice storage": ("cells", "RMS", "largest", "mass drift"),
    "advection": ("voxels", "ms", "of the copy", "RMS", "smoke gained"),
    "guide": ("voxels", "pixels", "ms", "replayed, ms", "light RMS", "transparency RMS"),
    "frame": ("of", "ms"),
}


def smoke_rows(method: str) -> list[Row]:
    return [row for row in read_json(SMOKE)[0] if (row.system, row.method) == ("smoke", method)]


def smoke_line(row: Row) -> str:
    known = figures(row)
    if row.decode_ms is not None:
        known["ms"] = f"{row.decode_ms:.3g}"
    if row.max_error is not None:
        known["largest error"] = f"{row.max_error:.1g}"
    cells = [row.option, *(known.get(title, "") for title in SMOKE_TABLES[row.method])]
    return f"| {' | '.join(cells)} |"


@pytest.mark.parametrize("method", SMOKE_TABLES)
def test_readme_smoke(method):
    lines = [smoke_line(row) for row in smoke_rows(method) if row.option not in ("a copy", "dense")]
    assert lines
    assert [line for line in lines if line not in README] == []


def test_readme_and_docs_smoke_text():
    (copy,) = (row for row in smoke_rows("lattice") if row.option == "a copy")
    assert f"{figures(copy)['GB/s']} GB/s" in README
    rules = {row.option: figures(row) for row in smoke_rows("weights")}
    page = " ".join((ROOT / "docs" / "smoke.md").read_text(encoding="utf-8").split())
    assert f"off by {rules['squared']['RMS']} RMS and {rules['squared']['bias']} in brightness" in page
    assert f"eq. 5 by {rules['absolute']['RMS']} and {rules['absolute']['bias']}." in page


NETWORK_TABLES = {
    "time against error": ("ms", "as calls, ms", "PSNR dB", "least dB", "most dB", "opacity dB"),
    "frame": ("of", "ms"),
}


def network_rows(method: str) -> dict[str, Row]:
    found = (row for row in read_json(SMOKE)[0] if (row.system, row.method) == ("smoke-network", method))
    return {row.option: row for row in found}


def network_line(row: Row) -> str:
    known = figures(row) | {"ms": f"{row.decode_ms:.3g}", "PSNR dB": "" if row.psnr is None else f"{row.psnr:.2f}"}
    return f"| {' | '.join([row.option, *(known.get(title, '') for title in NETWORK_TABLES[row.method])])} |"


@pytest.mark.parametrize("method", NETWORK_TABLES)
def test_readme_network(method):
    lines = [network_line(row) for row in network_rows(method).values()]
    assert lines
    assert [line for line in lines if line not in README] == []


def test_readme_network_evaluation():
    """And that the network that comes with wlm holds what it has to."""
    sets = {one["name"]: one for one in json.loads(EVALUATION.read_text(encoding="utf-8"))["sets"]}
    assert list(sets) == ["density x 0.5", "density x 1", "density x 2", "smoke.npz"]
    for name, one in sets.items():
        for method, found in one["methods"].items():
            ratio = "" if found["flicker_ratio"] is None else f"{found['flicker_ratio']:.3f}"
            cells = [name, method, *(f"{found[key]:.2f}" for key in ("psnr", "lowest", "highest")), ratio]
            assert f"| {' | '.join(cells)} |" in README
        assert abs(one["half_loss"]) < 0.1 and (one["methods"]["network"]["flicker_ratio"] or 0) < 1.3
    assert sets["density x 1"]["methods"]["network"]["psnr"] > 36


def test_readme_network_text():
    rows, text = network_rows("time against error"), " ".join(README.split())

    def told(name: str, first: bool = False) -> str:
        row = rows[name]
        return f"{row.psnr:.1f}{' dB' * first} in {row.decode_ms:.2f}{' ms' * first}"

    ours, like, far = rows["smoke-six-fast, fp16"], rows["coarse, h 2, nodes 3"], rows["smoke-six-24, fp16"]
    first, sooner, later = told("coarse, h 5, nodes 3", True), told("coarse, h 3"), told("coarse, h 2, nodes 3")
    assert f"{first} and {sooner}; `smoke-six-fast` has {told('smoke-six-fast, fp16')}," in text
    assert f"as near, {later}; and {told('coarse, h 3, nodes 2')} and {told('coarse, h 1, nodes 2')} are beyond" in text
    assert ours.decode_ms < like.decode_ms and ours.psnr > like.psnr and rows["coarse, h 3"].psnr < ours.psnr
    assert f"from {rows['coarse, h 3, nodes 2'].decode_ms:.1f} ms on the march again" in text
    assert rows["coarse, h 3, nodes 2"].psnr > ours.psnr
    assert far.decode_ms > ours.decode_ms and far.psnr < ours.psnr
    assert f"The network adds {ours.psnr - rows['coarse, h 5, nodes 3'].psnr:.1f} dB to its own guiding map" in text
    assert f'"six ways" has {told("six ways, step 7", True)} and {told("six ways, step 5")}.' in text
    assert f"than {rows['smoke-paper-16, fp16'].psnr:.0f} dB in" in text
    traced = network_rows("path tracing").values()
    found = [f"{row.psnr:.1f}{unit} in {row.decode_ms:.0f}" for row, unit in zip(traced, (" dB", ""), strict=True)]
    assert f"has {found[0]} ms, and {found[1]} with OIDN" in text
    assert f"30° aside, {network_rows('flip book')['turned 30°'].psnr:.1f}." in text


def test_docs_training():
    page = " ".join((ROOT / "docs" / "smoke.md").read_text(encoding="utf-8").split())
    for name, told in (
        ("smoke-six-fast", ("{psnr:.2f} dB after {step:,} steps and {seconds:.0f} s", True)),
        ("smoke-six-fast", ("after {step:,} steps and {seconds:.0f} s it had {psnr:.2f} dB", False)),
        ("smoke-six-24", ("{psnr:.2f} dB after {step:,} steps and {seconds:.0f} s", True)),
        ("smoke-paper-16", ("{psnr:.2f} dB after {step:,} steps and {seconds:.0f} s", True)),
    ):
        with open(ROOT / "benchmarks" / f"{name}.csv", encoding="utf-8") as file:
            lines = [{key: float(value) for key, value in line.items()} for line in csv.DictReader(file)]
        validated = [line | {"step": int(line["step"])} for line in lines if line["psnr"] == line["psnr"]]
        best = max(validated, key=lambda line: line["psnr"])
        assert told[0].format(**(best if told[1] else validated[0])) in page


def test_docs_limits_of_the_network():
    page = " ".join((ROOT / "docs" / "smoke.md").read_text(encoding="utf-8").split())
    found = {}
    for name in ("256", "smooth"):
        sets = json.loads((ROOT / "benchmarks" / f"smoke-network-{name}.json").read_text(encoding="utf-8"))["sets"]
        for one in sets:
            march, network = (one["methods"][method]["psnr"] for method in ("coarse march", "network"))
            found[name, one["name"]] = march, network - march
    worse = found["256", "smoke.npz"][1]
    found = {name: found[name, "density x 1"] for name in ("256", "smooth")}
    assert f"of 256 pixels {found['256'][1]:.1f}, and it leaves `smoke.npz` {-worse:.1f} dB worse" in page
    assert f"whose guide has {found['smooth'][0]:.1f} dB, it adds {found['smooth'][1]:.1f} ([report]" in page
    assert f"it adds {found['256'][1]:.1f} dB, and takes {-worse:.1f} from `smoke.npz`" in " ".join(README.split())


def test_docs_ablation():
    page = (ROOT / "docs" / "smoke.md").read_text(encoding="utf-8")
    rows, columns = network_rows("ablation"), ("least dB", "most dB", "flicker over the reference's", "parameters")
    for row in rows.values():
        known = figures(row)
        cells = [row.option, f"{row.psnr:.2f}", *(known.get(title, "") for title in (*columns, "ms a step"))]
        assert f"| {' | '.join(cells)} |" in page
    lights = rows["base"].psnr - max(rows[f"guide of {name}"].psnr for name in ("the paper", "the front"))
    assert f"are worth {lights:.0f} dB" in page
    assert abs(rows["base"].psnr - min(rows["no adapters"].psnr, rows["one level less"].psnr)) < 0.1
    assert rows["no temporal loss"].psnr < rows["base"].psnr - 1
    slower = float(figures(rows["stem 1"])["ms a step"]) / float(figures(rows["base"])["ms a step"])
    told = f"worth {rows['stem 1'].psnr - rows['base'].psnr:.1f} dB, for {slower:.1f} times the time of a step"
    assert told in " ".join(page.split())


def test_no_line_of_commands_is_there_twice():
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        lines = page.read_text(encoding="utf-8").splitlines()
        assert not [a for a, b in zip(lines, lines[1:], strict=False) if a == b and a.startswith("    wlm ")]


def test_images_are_there():
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        for line in page.read_text(encoding="utf-8").splitlines():
            if line.startswith("!["):
                assert (page.parent / line.split("](")[1].split(")")[0]).is_file(), line
