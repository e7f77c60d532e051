"""HTML reports: tables, plots and pictures in one file without a script."""

from __future__ import annotations

import base64
import html
import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from wlm.formats.atomic import atomic_write

_WIDTH, _HEIGHT, _DPI = 7.0, 2.6, 160  # inches, dots an inch: sharp on dense screens
_LOOKS = (("#c2571a", "o"), ("#3a6ea5", "s"), ("#5b8c3a", "^"), ("#8a5aa8", "D"))  # of series
_STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 980px; margin: 24px auto; padding: 0 16px; }
h1 { font-size: 22px; } h2 { font-size: 17px; margin-top: 28px; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: 8px 0; }
th, td { padding: 3px 12px 3px 0; text-align: right; border-bottom: 1px solid #8884; }
th:first-child, td:first-child { text-align: left; }
img { max-width: 100%; image-rendering: auto; } .pixels img { image-rendering: pixelated; }
figure { display: inline-block; margin: 0 8px 8px 0; vertical-align: top; }
figcaption { font-size: 13px; opacity: 0.75; }
.scroll { overflow-x: auto; } p.warning { color: #c2571a; }
"""


@dataclass
class Document:
    """An HTML report, to which parts are added in order.

    Attributes:
        title: The heading.
    """

    title: str
    _parts: list[str] = field(default_factory=list)

    def text(self, words: str, *, warning: bool = False) -> None:
        """Adds a paragraph."""
        self._parts.append(f"<p{' class=warning' if warning else ''}>{html.escape(words)}</p>")

    def table(self, heading: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Adds a table."""
        head = "".join(f"<th>{html.escape(column)}</th>" for column in columns)
        lines = ["".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in rows]
        body = "".join(f"<tr>{line}</tr>" for line in lines)
        self._add(heading, f'<div class="scroll"><table><tr>{head}</tr>{body}</table></div>')

    def lines(self, heading: str, unit: str, places: np.ndarray, series: Mapping[str, np.ndarray]) -> None:
        """Adds a line plot over times or other positions [N]; NaN leaves a gap."""
        self._plot(heading, unit, places, series, "-")

    def points(self, heading: str, unit: str, names: Sequence[str], series: Mapping[str, Sequence[float]]) -> None:
        """Adds a plot of one point for each name; NaN leaves a gap."""
        self._plot(heading, unit, names, series, "none")

    def grid(self, heading: str, unit: str, values: np.ndarray) -> None:
        """Adds a colour map of numbers [rows, columns]; NaN stays empty."""
        rows, columns = values.shape
        height = min(max(_WIDTH * 0.8 * rows / columns, 1.2), 3.5)
        figure = Figure(figsize=(_WIDTH, height), layout="constrained")
        axes = figure.add_subplot()
        picture = axes.imshow(values, cmap="viridis")
        axes.set_xticks([]), axes.set_yticks([])
        figure.colorbar(picture, label=unit)
        if values.size <= 256:
            middle = (np.nanmin(values) + np.nanmax(values)) / 2 if np.isfinite(values).any() else 0.0
            for (row, column), value in np.ndenumerate(values):
                if np.isfinite(value):
                    ink = "white" if value < middle else "black"
                    axes.text(column, row, f"{value:.1f}", ha="center", va="center", fontsize=7, color=ink)
        self._add(heading, _png_of(figure))

    def histogram(self, heading: str, unit: str, values: np.ndarray) -> None:
        """Adds a histogram of the finite numbers."""
        figure = Figure(figsize=(_WIDTH, _HEIGHT), layout="constrained")
        axes = figure.add_subplot()
        axes.hist(values[np.isfinite(values)], bins=60, color=_LOOKS[1][0])
        axes.set_xlabel(unit)
        self._add(heading, _png_of(figure))

    def pictures(self, heading: str, pictures: Mapping[str, np.ndarray], width: int | None = None) -> None:
        """Adds pictures uint8 [H, W, 3] with captions, pixels as squares; `width` is in CSS pixels."""
        size = "" if width is None else f' style="width: {width}px"'
        parts = [
            f"<figure>{_image(pixels, size)}<figcaption>{html.escape(caption)}</figcaption></figure>"
            for caption, pixels in pictures.items()
        ]
        self._add(heading, f'<div class="pixels">{"".join(parts)}</div>')

    def write(self, path: str | os.PathLike[str]) -> int:
        """Writes the page atomically; returns its size in bytes.

        Raises:
            WlmError: The file cannot be written.
        """
        title = html.escape(self.title)
        meta = '<meta charset="utf-8">\n<meta name="viewport" content="width=device-width, initial-scale=1">'
        head = f"{meta}\n<title>{title}</title>\n<style>{_STYLE}</style>"
        page = f'<!doctype html>\n<html lang="en">\n{head}\n<h1>{title}</h1>\n'
        return atomic_write(path, (page + "\n".join(self._parts) + "\n</html>\n").encode())

    def _plot(
        self, heading: str, unit: str, places: Sequence[float] | Sequence[str], series: Mapping[str, Any], line: str
    ) -> None:
        figure = Figure(figsize=(_WIDTH, _HEIGHT), layout="constrained")
        axes = figure.add_subplot()
        for i, (name, values) in enumerate(series.items()):
            colour, mark = _LOOKS[i % len(_LOOKS)]
            axes.plot(places, values, mark, linestyle=line, markersize=4, color=colour, label=name)
        axes.set_ylabel(unit)
        axes.grid(alpha=0.3)
        if len(series) > 1:
            axes.legend()
        self._add(heading, _png_of(figure))

    def _add(self, heading: str, content: str) -> None:
        self._parts.append((f"<h2>{html.escape(heading)}</h2>\n" if heading else "") + content)


def _png_of(figure: Figure) -> str:
    stream = io.BytesIO()
    FigureCanvasAgg(figure).print_figure(stream, dpi=_DPI, format="png")
    return f'<img alt="" style="width: {_WIDTH}in" src="data:image/png;base64,{_base64(stream.getvalue())}">'


def _image(pixels: np.ndarray, size: str) -> str:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG")
    return f'<img alt=""{size} src="data:image/png;base64,{_base64(stream.getvalue())}">'


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()
