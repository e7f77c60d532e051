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

# Okabe and Ito 2008, "Color Universal Design": told apart with any common colour vision. Its yellow is too
# pale for white.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
# A second sign for the method, so that a plot survives grey printing; their number shares no factor with the
# colours'.
MARKERS = ("o", "s", "^", "D", "v", "P")
# Above this ratio of largest to smallest, a linear axis squeezes the small ones together.
_LOG_RATIO = 8.0
_MARKER_POINTS = 7.0
_LABEL_POINTS = 9.0
# Distances of a label from its marker, in points.
_RINGS = (0.0, 14.0, 30.0, 48.0, 70.0, 96.0)
# Orange and sky blue have too little contrast with white to be read as letters; three quarters of them has
# enough.
_INK = 0.75
_FRONT_COLOUR = "#707070"


@dataclass(frozen=True)
class Panel:
    """A panel of a plot, which shows one measured figure against another.

    Attributes:
        x: Name of the figure on the x axis, a cost such as `"decode_ms"` or `"bpp"`; lower is better.
        y: Name of the figure on the y axis: `"psnr"`, or an error, of which lower is better.
        methods: Methods that the panel shows; None for all.
    """

    x: str
    y: str = "psnr"
    methods: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        for name in (self.x, self.y):
            if name not in FIGURES:
                raise WlmError(f"plot: unknown measured quantity {name!r}: see FIGURES in benchmarks/figures.py")

    def position(self, row: Row) -> tuple[float, float] | None:
        """Returns a row's values on the x and y axis; None if the panel does not show the row or it lacks a value."""
        if self.methods is not None and row.method not in self.methods:
            return None
        return (row[self.x], row[self.y]) if {self.x, self.y} <= row.figures.keys() else None


def pareto_front(points: Iterable[tuple[float, float]]) -> list[int]:
    """Finds the points that no other point dominates: no other is at least as good in both and better in one.

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
    """Draws quality against cost: for each scene, panels side by side.

    Rows of one method share a colour and a marker; each is labelled; the Pareto front is drawn as steps. A panel leaves
    out rows that lack its x or its y value.

    Args:
        rows: The results.
        path: Picture to write, `.png`, `.svg` or `.pdf`.
        x: One panel or several. The name of a figure stands for a panel of PSNR against this figure, of all methods.

    Raises:
        WlmError: The figure or the file's suffix is unknown, no row has both values of a panel, or the file can't be
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
            raise WlmError(f"plot: expected results with both {panel.y} and {panel.x}, found none in the result files")

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
    return COLOURS[index % len(COLOURS)], MARKERS[index % len(MARKERS)]


def _ink(colour: str) -> tuple[float, ...]:
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
    return min(values) > 0.0 and max(values) / min(values) > _LOG_RATIO


def _label_points(figure: Figure, axes: Axes, rows: Sequence[Row], panel: Panel, methods: Sequence[str]) -> None:
    """Places each row's name near its marker, where it overlaps other labels and markers least."""
    from matplotlib.text import Text

    if not rows:
        return
    pixels = figure.dpi / 72.0
    renderer = figure.canvas.get_renderer()
    frame = axes.get_window_extent(renderer)
    centres = axes.transData.transform([panel.position(row) for row in rows])
    half = 0.5 * _MARKER_POINTS * pixels
    taken = [(cx - half, cy - half, cx + half, cy + half) for cx, cy in centres]
    taken += [tuple(text.get_window_extent(renderer).extents) for text in axes.texts]
    # Points with near neighbours are labelled first, because they have the fewest free positions.
    gaps = np.linalg.norm(centres[:, None] - centres[None], axis=2) + np.diag(np.full(len(rows), np.inf))
    for index in np.argsort(gaps.min(axis=1), kind="stable"):
        row, (cx, cy) = rows[index], centres[index]
        colour, _ = _style(row.method, methods)
        label = axes.annotate(
            f"{row.method} {row.option}".strip(),
            (cx, cy),
            xycoords="figure pixels",
            xytext=(cx, cy),
            textcoords="figure pixels",
            ha="center",
            va="center",
            fontsize=_LABEL_POINTS,
            color=_ink(colour),
            zorder=4,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5},
            arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.6, "shrinkA": 0.0, "shrinkB": 0.0},
        )
        extent = Text.get_window_extent(label, renderer)  # without the line to the marker
        width, height = extent.width, extent.height
        places = []
        for ring, direction in itertools.product(_RINGS, range(16)):
            dx, dy = math.cos(direction * math.pi / 8.0), math.sin(direction * math.pi / 8.0)
            x = cx + dx * (half + (3.0 + ring) * pixels + width / 2.0)
            y = cy + dy * (half + (1.0 + ring) * pixels + height / 2.0)
            # A label stays inside the axes, where nothing of it is cut off.
            x = min(max(x, frame.x0 + width / 2.0), frame.x1 - width / 2.0)
            y = min(max(y, frame.y0 + height / 2.0), frame.y1 - height / 2.0)
            box = (x - width / 2.0, y - height / 2.0, x + width / 2.0, y + height / 2.0)
            cost = 4.0 * sum(_overlap(box, other, pixels) for other in taken)
            # Of free positions the nearest is taken, and one beside the marker before one above or below it.
            cost += 0.01 * width * height * (ring / _RINGS[1] + 0.5 * abs(dy))
            places.append((cost, (x, y), box))
        _, place, box = min(places, key=lambda each: each[0])
        label.set_position(place)
        taken.append(box)


_Box = tuple[float, float, float, float]


def _overlap(a: _Box, b: _Box, margin: float) -> float:
    """Returns the area of the intersection of a box with a margin and another box, in square pixels."""
    width = min(a[2] + margin, b[2]) - max(a[0] - margin, b[0])
    height = min(a[3] + margin, b[3]) - max(a[1] - margin, b[1])
    return max(0.0, width) * max(0.0, height)
