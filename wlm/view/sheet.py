"""A contact sheet: what went in, what came out, and the error between them, over time."""

import math
import os
from collections.abc import Sequence

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path
from wlm.metrics import PSNR_CAP_DB, psnr

MAX_COLUMNS = 6  # more of them are stamps at the 900 pixels of a README

_WHITE_PERCENTILE = 99.5  # the brightest half percent may clip: a lamp's foot must not darken the picture
_ERROR_PERCENTILE = 99.9  # the gain leaves this share of the errors unclipped
_DISPLAY_GAMMA = 2.2
_GREY = (0.5, 0.5, 0.5)  # no error map and few lightmaps hold it, so gaps are not taken for light
_INK = "#24292f"
_COLOURS = "magma"
_WIDTH_INCHES, _DPI = 9.0, 200  # 1,800 pixels: twice a README's width, for sharp screens
_LEFT, _RIGHT, _GAP = 0.30, 0.75, 0.07  # inches: row labels, colour bar, between pictures
_HEAD, _TITLE, _FOOT = 0.08, 0.34, 0.26
_LARGEST_ASPECT = 4.0  # a strip of a map is squeezed no further than this, so that labels fit


def before_after_error(
    path: str | os.PathLike[str],
    reference: np.ndarray,
    decoded: np.ndarray,
    mask: np.ndarray,
    times: Sequence[float] | np.ndarray,
    columns: int = MAX_COLUMNS,
) -> tuple[int, ...]:
    """Writes a PNG of reference, decoded and absolute error, one column a time.

    Reference and decoded share one exposure a column: the white that its title states is the reference's 99.5
    percentile, and light is shown as `(irradiance / white) ** (1 / 2.2)`. The error is the mean of its
    absolute value over the channels, as a share of the column's white, times one gain for the whole sheet:
    the largest power of two at which a thousandth of the texels clip. The PSNR is masked, over the picture as
    one tile, with the reference's range at that time as the peak (neural-dynamic-gi, section 10.2).

    With more times than columns, those shown are spread evenly from the first to the last, and the one of
    them nearest in order to the time of the lowest PSNR gives way to it: a sheet always shows the worst.

    Args:
        path: The PNG to write, whole or not at all; its folder must exist.
        reference: `[T, H, W, 3]`, linear.
        decoded: `[T, H, W, 3]`, linear.
        mask: `[H, W]`, true where a texel is valid; the rest is shown in grey.
        times: `[T]`, in hours.
        columns: The most times to show, 1 to 6.

    Returns:
        The numbers of the times shown, in order.

    Raises:
        WlmError: Shapes differ, the mask is empty, a valid texel is NaN or infinite, the number of columns is
            outside 1 to 6, or the file cannot be written.
    """
    reference, decoded = np.asarray(reference, np.float32), np.asarray(decoded, np.float32)
    mask, times = np.asarray(mask).astype(bool), np.asarray(times, np.float64)
    shape = reference.shape
    if len(shape) != 4 or shape[3] != 3 or 0 in shape or decoded.shape != shape:
        raise WlmError(f"sheet: expected two sets [T, H, W, 3] of one shape, got {shape} and {decoded.shape}")
    if mask.shape != shape[1:3] or times.shape != shape[:1]:
        raise WlmError(f"sheet: expected mask [H, W] and times [T], got {mask.shape} and {times.shape}")
    if not mask.any():
        raise WlmError("sheet: the mask is empty: there is nothing to show")
    if not 1 <= columns <= MAX_COLUMNS:
        raise WlmError(f"sheet: expected 1 to {MAX_COLUMNS} columns, got {columns}")

    scores = np.array([psnr(ref, dec, mask) for ref, dec in zip(reference, decoded, strict=True)])
    chosen = _choose(scores, columns)
    whites = [_white(reference[i][mask]) for i in chosen]
    absolute = [np.abs(decoded[i] - reference[i]).mean(axis=2) for i in chosen]
    errors = [error / white for error, white in zip(absolute, whites, strict=True)]
    gain = _gain(np.concatenate([error[mask] for error in errors]))

    figure, axes, bar = _layout(len(chosen), *mask.shape)
    colours = ScalarMappable(Normalize(0.0, 1.0 / gain), _COLOURS)
    for column, (i, white, error) in enumerate(zip(chosen, whites, errors, strict=True)):
        pictures = (_expose(reference[i], white), _expose(decoded[i], white), colours.to_rgba(error)[..., :3])
        for axis, picture in zip(axes[:, column], pictures, strict=True):
            axis.imshow(np.where(mask[..., None], picture, _GREY), interpolation="nearest", aspect="auto")
        axes[0, column].set_title(f"{times[i]:g} h\nwhite = {white:.3g}", fontsize=7, color=_INK, pad=3)
        axes[2, column].set_title(_score(scores[i]), fontsize=7, color=_INK, pad=3)
    for axis, label in zip(axes[:, 0], ("reference", "decoded", f"error × {gain:g}"), strict=True):
        axis.set_ylabel(label, fontsize=8, color=_INK, labelpad=3)
    scale = figure.colorbar(colours, cax=bar)
    scale.set_label("error / white", fontsize=7, color=_INK)
    scale.ax.tick_params(labelsize=6, colors=_INK, length=2)
    scale.outline.set_visible(False)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=_DPI)
    return tuple(chosen)


def _choose(scores: np.ndarray, columns: int) -> list[int]:
    """Picks times evenly, the worst among them."""
    count = len(scores)
    chosen = [int(i) for i in np.unique(np.linspace(0, count - 1, min(columns, count)).round())]
    if len(chosen) == count or np.isnan(scores).all():
        return chosen
    worst = int(np.nanargmin(scores))
    nearest = min(range(len(chosen)), key=lambda k: abs(chosen[k] - worst))
    chosen[nearest] = worst
    return sorted(chosen)


def _score(value: float) -> str:
    """Writes a PSNR; a range of 0 has none, and one at the cap stands for an exact copy."""
    if math.isnan(value):
        return "no range, no PSNR"
    return f"PSNR {value:.1f} dB" if value < PSNR_CAP_DB else "exact"


def _white(valid: np.ndarray) -> float:
    """Returns the irradiance that is shown as white; 1 where all is black."""
    white = float(np.percentile(valid, _WHITE_PERCENTILE))
    return white if white > 0 else float(valid.max()) or 1.0


def _gain(errors: np.ndarray) -> float:
    """Returns the power of two that brings nearly all errors up to, not over, 1; 1 where there are none."""
    high = float(np.percentile(errors, _ERROR_PERCENTILE)) or float(errors.max())
    return 2.0 ** math.floor(-math.log2(high)) if high > 0 else 1.0


def _expose(image: np.ndarray, white: float) -> np.ndarray:
    """Turns linear light [H, W, 3] into display values."""
    return np.clip(np.nan_to_num(image) / white, 0.0, 1.0) ** (1.0 / _DISPLAY_GAMMA)


def _layout(columns: int, height: int, width: int) -> tuple[Figure, np.ndarray, object]:
    """Makes the figure, its axes [3, columns] without ticks, and the axis of the colour bar."""
    # Few columns are not blown up to the whole width: no picture is wider than with three.
    cell = (_WIDTH_INCHES - _LEFT - _RIGHT) / max(columns, 3) - _GAP
    tall = cell * min(max(height / width, 1.0 / _LARGEST_ASPECT), _LARGEST_ASPECT)
    figure_width = _LEFT + columns * (cell + _GAP) + _RIGHT
    # Rows from the top: titles of two lines, reference, decoded, a title of one line, error.
    figure_height = _HEAD + _TITLE + 3 * tall + _GAP + _FOOT + _HEAD
    figure = Figure(figsize=(figure_width, figure_height), facecolor="white")
    FigureCanvasAgg(figure)

    def place(left: float, top: float, wide: float, high: float) -> object:
        bottom = figure_height - top - high
        box = (left / figure_width, bottom / figure_height, wide / figure_width, high / figure_height)
        return figure.add_axes(box)

    first = _HEAD + _TITLE
    tops = (first, first + tall + _GAP, first + 2 * tall + _GAP + _FOOT)
    lefts = [_LEFT + column * (cell + _GAP) for column in range(columns)]
    axes = np.array([[place(left, top, cell, tall) for left in lefts] for top in tops])
    for axis in axes.flat:
        axis.set_xticks([])
        axis.set_yticks([])
        for spine in axis.spines.values():
            spine.set_visible(False)
    bar = place(_LEFT + columns * (cell + _GAP) + 0.03, tops[2], 0.12, tall)
    return figure, axes, bar
