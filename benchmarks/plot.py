"""Plots of quality or error against decode time or size, with the Pareto front."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.figures import FIGURES
from benchmarks.rows import Row
from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.transforms import Bbox

# Okabe and Ito 2008, "Color Universal Design": told apart with any common colour vision. Its yellow is too
# pale for white.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
# A second sign for the method, so that a plot survives grey printing; their number shares no factor with the
# colours'.
_MARKERS = ("o", "s", "^", "D", "v", "P")
# Above this ratio of largest to smallest, a linear axis squeezes the small ones together.
_LOG_RATIO = 8.0
_MARKER_POINTS = 7.0
_LABEL_POINTS = 9.0
# How far from its marker a label may stand, in points; beyond the first it gets a leader.
_RINGS = (0.0, 14.0, 30.0, 48.0, 70.0, 96.0)
# Orange and sky blue have too little contrast with white to be read as letters; three quarters of them has
# enough.
_INK = 0.75
_FRONT_COLOUR = "#707070"


@dataclass(frozen=True)
class Panel:
    """One figure of some methods against another.

    Attributes:
        x: The cost, a figure of which less is better, such as `"decode_ms"` or `"bpp"`.
        y: `"psnr"`, or an error, of which less is better.
        methods: Those that it shows; None for all.
    """

    x: str
    y: str = "psnr"
    methods: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        for name in (self.x, self.y):
            if name not in FIGURES:
                raise WlmError(f"plot: unknown figure {name!r}")

    def position(self, row: Row) -> tuple[float, float] | None:
        """Where a row stands; None if it doesn't belong here, or lacks one of the two."""
        if self.methods is not None and row.method not in self.methods:
            return None
        return (row[self.x], row[self.y]) if {self.x, self.y} <= row.figures.keys() else None


def pareto_front(points: Iterable[tuple[float, float]]) -> list[int]:
    """Points that no other dominates: none costs no more, is no worse, and is better in one of the two.

    Args:
        points: `(cost, quality)` pairs; less cost and more quality are better. A pair with a NaN is never on the
            front.

    Returns:
        Indices of the front by rising cost (and so rising quality). Of equal points only the first.
    """
    finite = [(x, -y, i) for i, (x, y) in enumerate(points) if not (math.isnan(x) or math.isnan(y))]
    front, best = [], math.inf
    for _, negated, index in sorted(finite):
        if negated < best or not front:
            front.append(index)
            best = negated
    return front


def plot(rows: Sequence[Row], path: str | Path, x: str | Panel | Sequence[str | Panel] = ("decode_ms", "bpp")) -> None:
    """Draws quality against cost: one line of panels for each scene.

    Rows of one method share a colour and a marker; each is labelled; the Pareto front is drawn as steps. Rows without
    one of a panel's two figures are left out of it.

    Args:
        rows: The results.
        path: Picture to write, `.png`, `.svg` or `.pdf`.
        x: One panel or several; a name stands for the PSNR of all methods against that figure.

    Raises:
        WlmError: The figure or the file's suffix is unknown, no row has what a panel needs, or the file can't be
            written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    path = Path(path)
    quantities = (x,) if isinstance(x, str | Panel) else x
    panels = [Panel(quantity) if isinstance(quantity, str) else quantity for quantity in quantities]
    if path.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise WlmError(f"{path}: expected a picture's name that ends in .png, .svg or .pdf")
    scenes = list(dict.fromkeys(row.scene for row in rows))
    methods = list(dict.fromkeys(row.method for row in rows))
    for panel in panels:
        if not any(panel.position(row) for row in rows):
            raise WlmError(f"plot: no row has both a {panel.y} and a {panel.x}")

    # A Figure of its own canvas, not pyplot: no global state, no window, nothing to close.
    figure = Figure(figsize=(5.0 * len(panels), 3.9 * len(scenes)), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(scenes), len(panels), squeeze=False)
    drawn = []
    for i, scene in enumerate(scenes):
        for j, panel in enumerate(panels):
            members = [row for row in rows if row.scene == scene and panel.position(row)]
            _draw_panel(grid[i, j], members, panel, methods)
            grid[i, j].set_title(scene, fontsize=11)
            drawn.append((grid[i, j], members, panel))
    # The layout must be settled before labels can be placed in pixels, and must not move afterwards.
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for axes, members, panel in drawn:
        _label_points(figure, axes, members, panel, methods)
    with atomic_path(path) as part:
        figure.savefig(part, format=path.suffix[1:].lower())


def _style(method: str, methods: Sequence[str]) -> tuple[str, str]:
    index = methods.index(method)
    return _COLOURS[index % len(_COLOURS)], _MARKERS[index % len(_MARKERS)]


def _ink(colour: str) -> tuple[float, ...]:
    """The colour, dark enough for thin letters on white."""
    from matplotlib.colors import to_rgb

    return tuple(_INK * channel for channel in to_rgb(colour))


def _draw_panel(axes: Axes, rows: Sequence[Row], panel: Panel, methods: Sequence[str]) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    points = [panel.position(row) for row in rows]
    axes.set_xlabel(FIGURES[panel.x].label)
    axes.set_ylabel(FIGURES[panel.y].label)
    axes.grid(True, color="#e4e4e4", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    if not points:
        axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", color=_FRONT_COLOUR)
        return
    costs, heights = zip(*points, strict=True)
    if _wide(costs):
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
    falling = panel.y != "psnr"
    if falling and _wide(heights):
        axes.set_yscale("log")
    # Room around the points for their labels.
    axes.margins(x=0.2, y=0.14)
    for row, (cost, quality) in zip(rows, points, strict=True):
        colour, marker = _style(row.method, methods)
        axes.plot(cost, quality, marker, color=colour, ms=_MARKER_POINTS, mec="white", mew=0.8, zorder=3)
    front = [points[i] for i in pareto_front([(cost, -height if falling else height) for cost, height in points])]
    # To the right of its best point a front goes on level: more cost buys nothing.
    axes.autoscale_view()
    right = axes.get_xlim()[1]
    steps = [*front, (right, front[-1][1])]
    axes.set_xlim(right=right)
    axes.step(
        [cost for cost, _ in steps],
        [quality for _, quality in steps],
        where="post",
        color=_FRONT_COLOUR,
        linewidth=1.2,
        linestyle=(0, (4, 2)),
        zorder=2,
    )
    axes.annotate(
        "Pareto front",
        (right, front[-1][1]),
        xytext=(-2, 3),
        textcoords="offset points",
        ha="right",
        va="bottom",
        fontsize=8,
        style="italic",
        color=_FRONT_COLOUR,
    )


def _wide(values: Sequence[float]) -> bool:
    """Whether numbers are too far apart for a linear axis."""
    return min(values) > 0.0 and max(values) / min(values) > _LOG_RATIO


def _label_points(figure: Figure, axes: Axes, rows: Sequence[Row], panel: Panel, methods: Sequence[str]) -> None:
    """Puts each row's name beside its marker, where it covers least of what else is drawn."""
    if not rows:
        return
    pixels = figure.dpi / 72.0
    renderer = figure.canvas.get_renderer()
    frame = axes.get_window_extent(renderer)
    centres = axes.transData.transform([panel.position(row) for row in rows])
    half = 0.5 * _MARKER_POINTS * pixels
    taken = [(cx - half, cy - half, cx + half, cy + half) for cx, cy in centres]
    taken += [_box(text.get_window_extent(renderer)) for text in axes.texts]
    front = axes.transData.transform(axes.lines[-1].get_xydata())  # what _draw_panel drew last
    edges = [_segment_box(a, b) for a, b in itertools.pairwise(_corners(front))]

    labels: list[_Box] = []
    leaders: list[_Box] = []
    # The crowded points choose first; a lonely one finds room anywhere.
    gaps = np.linalg.norm(centres[:, None] - centres[None], axis=2) + np.diag(np.full(len(rows), np.inf))
    for index in np.argsort(gaps.min(axis=1), kind="stable"):
        row, (cx, cy) = rows[index], centres[index]
        colour, _ = _style(row.method, methods)
        name = f"{row.method} {row.option}".strip()
        label = axes.annotate(
            name,
            (cx, cy),
            xycoords="figure pixels",
            xytext=(cx, cy),
            textcoords="figure pixels",
            ha="center",
            va="center",
            fontsize=_LABEL_POINTS,
            color=_ink(colour),
            zorder=4,
        )
        extent = label.get_window_extent(renderer)
        area = extent.width * extent.height
        best = None
        for ring, direction in itertools.product(_RINGS, range(16)):
            angle = direction * math.pi / 8.0
            dx, dy = math.cos(angle), math.sin(angle)
            # The box touches the ring from outside, whatever its shape.
            x = cx + dx * (half + (3.0 + ring) * pixels + extent.width / 2.0)
            y = cy + dy * (half + (1.0 + ring) * pixels + extent.height / 2.0)
            # Pushed back inside the frame: what is cut off can't be read.
            x = min(max(x, frame.x0 + extent.width / 2.0), frame.x1 - extent.width / 2.0)
            y = min(max(y, frame.y0 + extent.height / 2.0), frame.y1 - extent.height / 2.0)
            box = (x - extent.width / 2, y - extent.height / 2, x + extent.width / 2, y + extent.height / 2)
            leader = _leader(cx, cy, box) if ring > 0.0 else []
            cost = 4.0 * sum(_overlap(_grown(box, pixels), other) for other in taken)
            # A thin leader has next to no area, so its crossings count by the piece, old under new and new
            # over old.
            crossings = sum(_overlap(piece, other) > 0.0 for piece in leader for other in labels)
            crossings += sum(_overlap(box, piece) > 0.0 for piece in leaders)
            cost += 0.05 * area * crossings
            cost += 0.5 * sum(_overlap(box, edge) for edge in edges)
            # Among free places, the nearest, and right or left of the marker before above or below.
            cost += 0.01 * area * (ring / _RINGS[1] + 0.5 * abs(dy))
            if best is None or cost < best[0]:
                best = (cost, x, y, box, leader)
        _, x, y, box, leader = best
        label.set_position((x, y))
        taken.append(box)
        labels.append(box)
        leaders += leader
        if leader:
            line = axes.transData.inverted().transform([(cx, cy), leader[-1][:2]])
            axes.plot(*line.T, color=colour, linewidth=0.6, zorder=1.5, scalex=False, scaley=False)


_Box = tuple[float, float, float, float]


def _box(extent: Bbox) -> _Box:
    return extent.x0, extent.y0, extent.x1, extent.y1


def _overlap(a: _Box, b: _Box) -> float:
    """Area that two boxes share, in square pixels."""
    return max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))


def _grown(box: _Box, margin: float) -> _Box:
    return box[0] - margin, box[1] - margin, box[2] + margin, box[3] + margin


def _leader(x: float, y: float, box: _Box) -> list[_Box]:
    """The line from a marker to the nearest point of its label, as small boxes, the last one at the label."""
    end_x, end_y = min(max(x, box[0]), box[2]), min(max(y, box[1]), box[3])
    points = [(x + t * (end_x - x), y + t * (end_y - y)) for t in np.linspace(0.125, 1.0, 8)]
    return [(px, py, px + 1.0, py + 1.0) for px, py in points]


def _corners(points: np.ndarray) -> list[tuple[float, float]]:
    """The points of a step line that goes right before it goes up or down."""
    corners = [tuple(points[0])]
    for (x0, y0), (x1, y1) in itertools.pairwise(points):
        del x0
        corners += [(x1, y0), (x1, y1)]
    return corners


def _segment_box(a: tuple[float, float], b: tuple[float, float]) -> _Box:
    """A level or upright segment as a box of two pixels' width."""
    return min(a[0], b[0]) - 1.0, min(a[1], b[1]) - 1.0, max(a[0], b[0]) + 1.0, max(a[1], b[1]) + 1.0
