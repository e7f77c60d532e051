"""The plots of the documents, drawn from the committed result files (`python -m benchmarks plots`).

`PLOTS` says which rows each shows. `images/sources.json` has a digest of the points that each was drawn from; a test
compares it with the result files.
"""

import functools
import hashlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from benchmarks import kernels
from benchmarks.figures import FIGURES
from benchmarks.plot import COLOURS, MARKERS
from benchmarks.rows import Row, read_runs
from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path, atomic_write

RESULTS = Path(__file__).parent
IMAGES = RESULTS.parent / "docs" / "images"
SOURCES = "sources.json"


@dataclass(frozen=True)
class Curve:
    """The points of a curve, or of a panel of kernels: rows of a system in a result file.

    Attributes:
        file: Result file in `benchmarks/`, without its suffix.
        system: System of the rows.
        scene: Scene of the rows.
        pattern: Regular expression that matches a row's method and option, with a space between.
    """

    file: str
    system: str
    scene: str
    pattern: str

    def rows(self) -> list[Row]:
        """Returns the rows in the order of the file; those of quick runs are left out.

        Raises:
            WlmError: There is no such row, or the file can't be read.
        """
        rows = [row for row in _rows(self.file) if (row.system, row.scene) == (self.system, self.scene)]
        rows = [row for row in rows if re.fullmatch(self.pattern, f"{row.method} {row.option}".strip())]
        if not rows:
            raise WlmError(f"{self.file}.json: expected rows of {self.scene} that match {self.pattern}, found none")
        return rows


@functools.cache
def _rows(file: str) -> list[Row]:
    runs = read_runs(RESULTS / f"{file}.json")
    return [row for run in runs if "--quick" not in str(run.environment) for row in run.rows]


@dataclass(frozen=True)
class Lines:
    """A plot of PSNR over a cost.

    Attributes:
        title: What was measured, and on what.
        x: Figure on the x axis.
        curves: Curves by their labels; the points of "ours" show their options.
    """

    title: str
    x: str
    curves: Mapping[str, Curve]

    def points(self) -> dict[str, list[tuple[float, float, str]]]:
        """Returns the points of each curve by rising cost: cost, PSNR and the row's option."""
        found = {}
        for label, curve in self.curves.items():
            rows = [row for row in curve.rows() if {self.x, "psnr"} <= row.figures.keys()]
            found[label] = sorted((row[self.x], row["psnr"], row.option) for row in rows)
        return found


def _atlas(pattern: str, file: str = "nvidia-h200") -> Curve:
    return Curve(file, "atlas", "mean over 18 lightmaps", pattern)


def _sweep(setting: str) -> Curve:
    scene = "mean over 18 lightmaps, ablation of cascade"
    return Curve("nvidia-h200", "atlas", scene, f"(ablation whole|sweep {setting} .*)")


def _city(pattern: str, file: str = "nvidia-h200") -> Curve:
    return Curve(file, "lightmap", "city", pattern)


def _room(pattern: str, file: str = "cpu") -> Curve:
    return Curve(file, "probe", "livingroom 12.00", pattern + " .*")


def _smoke(pattern: str) -> Curve:
    return Curve("nvidia-h200", "smoke-network", "unseen smoke", f"time against error {pattern}")


KERNELS = "bench-kernels.png"
PLOTS: dict[str, Lines] = {
    "bench-atlas.png": Lines(
        "mean over 18 lightmaps of meshes (CR: compression ratio)",
        "bpp",
        {
            "ours": _atlas("ours standard(, CR .*)?"),
            "ours, bc6h": _atlas("ours bc6h"),
            "ours, astc": _atlas("ours astc", "cpu"),
            "ours, cascade": _atlas("ours cascade"),
            "ASTC": _atlas("ASTC bits of standard.*"),
            "BC6H, our encoder": _atlas("BC6H, our encoder bits of standard.*"),
            "BC6H": _atlas("BC6H bits of standard.*"),
            "downsampling": _atlas("downsampling bits of standard.*"),
        },
    ),
    "bench-atlas-sweep.png": Lines(
        "sizes of the cascade (the paper's figure 7), mean over 18 lightmaps",
        "bpp",
        {
            "ε from 0.3 to 0.7": _sweep("scale"),
            "ε_p from 0.2 to 0.8": _sweep("colour_scale"),
            "ε_c from 0.3 to 1.0": _sweep("lut_scale"),
        },
    ),
    "bench-lightmap.png": Lines(
        "a city at 26 hours",
        "bpp",
        {
            "ours": _city("ours .*"),
            "ours, L, M64 and H": _city("ours (L|M64|H)", "nvidia-h100"),
            "the paper's M": _city("ours M-paper", "nvidia-h100"),
            "NTC": _city("NTC .*"),
            "ASTC": _city("ASTC .*", "cpu"),
            "BC7": _city("BC7", "cpu"),
            "BC6H": _city("BC6H", "cpu"),
            "PCA in BC4": _city("PCA in BC4 .*", "cpu"),
        },
    ),
    "bench-probe-livingroom.png": Lines(
        "light probes of a living room at noon",
        "bpp",
        {
            "ours, paper and standard": Curve("nvidia-h200", "probe", "livingroom 12.00", "ours (paper|standard)"),
            "ours, PCA, absolute": _room("PCA, absolute"),
            "ours, Gaussians, absolute": _room("Gaussians, absolute", "nvidia-h100"),
            "CPCA by signal": _room("CPCA by signal"),
            "clustered PCA": _room("clustered PCA"),
            "moving basis": _room("moving basis"),
            "global PCA": _room("global PCA"),
            "CPCA in halves": _room("CPCA in halves"),
        },
    ),
    "bench-smoke-network.png": Lines(
        "six-way lightmaps of smoke that no network has seen, H200",
        "time_ms",
        {
            "six marches, by their steps": _smoke("six ways, .*"),
            "coarse march, by its steps": _smoke("coarse, h [0-9]+"),
            "ours, fast: 16 and 32 bits": _smoke("smoke-six-fast, .*"),
            "the paper's network": _smoke("smoke-paper-16, .*"),
        },
    ),
}


def _kernel_rows() -> list[Row]:
    return Curve("nvidia-h200", "kernels", "cuda", ".*").rows()


def digests() -> dict[str, str]:
    """Returns the digest of the points of each plot by the picture's name."""
    kernel_points = [(row.method, row.get("size"), row.get("time_ms"), row.get("floor_ms")) for row in _kernel_rows()]
    points = {KERNELS: kernel_points} | {name: lines.points() for name, lines in PLOTS.items()}
    return {name: digest(json.dumps(each).encode()) for name, each in points.items()}


def digest(content: bytes) -> str:
    """Returns 16 hexadecimal digits of the SHA-256 of what a picture is made from."""
    return hashlib.sha256(content).hexdigest()[:16]


def stamp(folder: Path, new: Mapping[str, str]) -> None:
    """Writes the digests of pictures that were made to the folder's `sources.json`, beside those of the others."""
    path = folder / SOURCES
    old = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    atomic_write(path, (json.dumps(old | dict(new), indent=1, sort_keys=True) + "\n").encode())


def draw_all(folder: Path = IMAGES) -> list[str]:
    """Draws the plots of the documents, and writes their digests.

    Returns:
        The names of the pictures.
    """
    made = digests()
    drawings: dict[str, Callable[[Path], None]] = {KERNELS: lambda path: kernels.draw(_kernel_rows(), path)}
    drawings |= {name: lambda path, lines=lines: _draw(lines, path) for name, lines in PLOTS.items()}
    for name, drawing in drawings.items():
        drawing(folder / name)
    stamp(folder, made)
    return list(drawings)


def _draw(lines: Lines, path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    figure = Figure(figsize=(8.0, 4.6), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for number, (label, points) in enumerate(lines.points().items()):
        colour, marker = COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)]
        costs, heights, _ = zip(*points, strict=True)
        axes.plot(costs, heights, marker=marker, color=colour, label=label, mec="white", mew=0.8, ms=8.0)
        for *place, option in points if label == "ours" else ():
            text, side = option.rpartition(", ")[2], {"xytext": (-6, 7), "textcoords": "offset points", "ha": "right"}
            axes.annotate(text, place, fontsize=10, color=colour, **side)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_title(lines.title, fontsize=11)
    axes.set_xlabel(FIGURES[lines.x].label)
    axes.set_ylabel(FIGURES["psnr"].label)
    axes.margins(x=0.12, y=0.1)
    axes.grid(True, color="#e4e4e4", linewidth=0.7)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside right upper", fontsize=10, frameon=False)
    with atomic_path(path) as part:
        figure.savefig(part, format="png")
