"""PNG files: single pictures, sequences, contact sheets, and decoded lightmaps beside their input."""

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path
from wlm.metrics import PSNR_CAP_DB, psnr
from wlm.view.display import Display, heat, white_of

MOST_COLUMNS = 8
"""Pictures in a row of a contact sheet."""

MOST_TIMES = 6
"""Times on a sheet of `before_after_error`."""

_GREY = 128  # texels outside charts, and pixels outside a mesh
_SHEET = 96  # grey of a contact sheet's background
_MARGIN, _FONT = 4, 14  # pixels
_CELL, _LARGEST_ASPECT = 280, 4.0  # width in pixels of a lightmap on a sheet, and its largest aspect ratio
_ERROR_PERCENTILE = 99.9  # share of the errors that the gain leaves unclipped


def to_bytes(light: torch.Tensor | np.ndarray, white: float = 1.0) -> np.ndarray:
    """Converts linear light to sRGB bytes.

    Args:
        light: [H, W, 3], or [H, W] for grey.
        white: The light that becomes white; brighter light is clipped.

    Returns:
        uint8 [H, W, 3].

    Raises:
        ValueError: `white` is not above 0.
    """
    if not 0 < white < math.inf:
        raise ValueError(f"white: expected a number above 0, got {white}")
    pixels = np.asarray(light.cpu() if isinstance(light, torch.Tensor) else light, np.float32)
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=2)
    return Display(1.0 / white).picture(pixels)


def encode(light: np.ndarray, hit: np.ndarray, white: float) -> np.ndarray:
    """Converts linear light [H, W, 3] to sRGB bytes, grey where `hit` [H, W] is false."""
    return np.where(hit[..., None], to_bytes(light, white), np.uint8(_GREY))


def save_png(path: str | os.PathLike[str], pixels: np.ndarray) -> None:
    """Writes uint8 [H, W, 3] as a PNG, atomically.

    Raises:
        WlmError: The file cannot be written.
    """
    with atomic_path(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG")


def write_sequence(folder: str | os.PathLike[str], pictures: Iterable[np.ndarray], stem: str = "frame") -> list[Path]:
    """Writes pictures as `STEM_0001.png` and so on, each atomically.

    Args:
        folder: The folder; made if its parent exists.
        pictures: uint8 [H, W, 3].
        stem: First part of the names.

    Returns:
        The files.

    Raises:
        WlmError: A file cannot be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise WlmError(f"{folder}: cannot write there: {error.strerror or error}") from error
    paths = []
    for number, pixels in enumerate(pictures, 1):
        paths.append(folder / f"{stem}_{number:04d}.png")
        save_png(paths[-1], pixels)
    return paths


def spread(count: int, most: int) -> list[int]:
    """Indices of at most `most` of `count` items, evenly spread, the first and the last among them."""
    return [int(i) for i in np.unique(np.linspace(0, count - 1, min(most, count)).round())]


def contact_sheet(
    path: str | os.PathLike[str],
    rows: Mapping[str, Sequence[np.ndarray]],
    titles: Sequence[str] = (),
    *,
    columns: int = MOST_COLUMNS,
) -> tuple[int, ...]:
    """Writes a PNG of pictures in labelled rows; if there are too many for a row, evenly spread ones are chosen.

    Args:
        path: The PNG to write; its folder must exist.
        rows: Pictures uint8 [H, W, 3] by label, the same number in each row, those of a row of one size.
        titles: Titles of the columns, one for each picture of a row; or none.
        columns: Most pictures in a row.

    Returns:
        Indices of the chosen pictures.

    Raises:
        ValueError: There is no picture, or they differ in size or number.
        WlmError: The file cannot be written.
    """
    counts = {len(row) for row in rows.values()}
    uneven = any(len({cell.shape for cell in row}) > 1 for row in rows.values())
    if len(counts) != 1 or 0 in counts or columns < 1 or uneven:
        raise ValueError(f"expected rows of as many pictures of one size, got {sorted(counts)}")
    (count,) = counts
    if titles and len(titles) != count:
        raise ValueError(f"titles: expected {count}, got {len(titles)}")
    chosen = spread(count, columns)
    width, heights = max(row[0].shape[1] for row in rows.values()), [row[0].shape[0] for row in rows.values()]
    font = ImageFont.load_default(_FONT)
    label = max(math.ceil(font.getlength(text)) for text in rows) + 2 * _MARGIN
    lines = max((title.count("\n") + 1 for title in titles), default=0)
    y = lines * _FONT + (_FONT if lines else _MARGIN)
    size = (label + len(chosen) * (width + _MARGIN), y + sum(heights) + len(heights) * _MARGIN)
    sheet = Image.new("RGB", size, (_SHEET,) * 3)
    pen = ImageDraw.Draw(sheet)
    for column, i in enumerate(chosen):
        if titles:
            middle = label + column * (width + _MARGIN) + width // 2
            pen.multiline_text((middle, y // 2), titles[i], "white", font, anchor="mm", align="center", spacing=0)
    for (text, cells), height in zip(rows.items(), heights, strict=True):
        pen.text((_MARGIN, y + height // 2), text, "white", font, anchor="lm")
        for column, i in enumerate(chosen):
            left = label + column * (width + _MARGIN) + (width - cells[i].shape[1]) // 2
            sheet.paste(Image.fromarray(cells[i]), (left, y))
        y += height + _MARGIN
    save_png(path, np.asarray(sheet))
    return tuple(chosen)


def before_after_error(
    path: str | os.PathLike[str],
    reference: np.ndarray,
    decoded: np.ndarray,
    mask: np.ndarray,
    times: Sequence[float] | np.ndarray,
    columns: int = MOST_TIMES,
) -> tuple[int, ...]:
    """Writes a contact sheet of reference lightmaps, decoded lightmaps and their absolute error, one column a time.

    Reference and decoded share one exposure in each column: the white in the title is the 99.5th percentile of the
    reference. The error is the mean absolute difference over the channels, divided by the column's white and
    multiplied by one gain for the whole sheet: the largest power of two that clips at most a thousandth of the texels.
    The PSNR is masked, with the reference's range at that time as the peak (neural-dynamic-gi, section 10.2).

    If there are more times than columns, evenly spread ones are shown, and the time of the lowest PSNR replaces the
    one nearest to it.

    Args:
        path: The PNG to write; its folder must exist.
        reference: [T, H, W, 3], linear.
        decoded: [T, H, W, 3], linear.
        mask: [H, W], true for valid texels; the others are grey.
        times: [T], in hours.
        columns: Most times shown, 1 to 6.

    Returns:
        Indices of the times shown, rising.

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
    if not 1 <= columns <= MOST_TIMES:
        raise WlmError(f"sheet: expected 1 to {MOST_TIMES} columns, got {columns}")
    reference, decoded = (np.where(mask[..., None], light, np.float32(0)) for light in (reference, decoded))
    scores = np.array([psnr(ref, dec, mask) for ref, dec in zip(reference, decoded, strict=True)])
    chosen = spread(len(scores), columns)
    if len(chosen) < len(scores) and not np.isnan(scores).all():
        worst = int(np.nanargmin(scores))
        chosen[min(range(len(chosen)), key=lambda k: abs(chosen[k] - worst))] = worst
        chosen = sorted(chosen)
    whites = [white_of(reference[i][mask]) for i in chosen]
    errors = [np.abs(decoded[i] - reference[i]).mean(axis=2) / white for i, white in zip(chosen, whites, strict=True)]
    high = float(np.percentile([error[mask] for error in errors], _ERROR_PERCENTILE))
    high = high or max(float(error[mask].max()) for error in errors)
    gain = 2.0 ** math.floor(-math.log2(high)) if high > 0 else 1.0
    rows = {
        "reference": [encode(reference[i], mask, white) for i, white in zip(chosen, whites, strict=True)],
        "decoded": [encode(decoded[i], mask, white) for i, white in zip(chosen, whites, strict=True)],
        f"error × {gain:g}": [np.where(mask[..., None], heat(error * gain), np.uint8(_GREY)) for error in errors],
    }
    titles = [
        f"{times[i]:g} h, white = {white:.3g}\n{_score(scores[i])}" for i, white in zip(chosen, whites, strict=True)
    ]
    height = round(_CELL * min(max(shape[1] / shape[2], 1.0 / _LARGEST_ASPECT), _LARGEST_ASPECT))
    contact_sheet(path, {name: [_resized(cell, height) for cell in row] for name, row in rows.items()}, titles)
    return tuple(chosen)


def _resized(pixels: np.ndarray, height: int) -> np.ndarray:
    """A picture at the size of a sheet's cell, with texels as squares."""
    return np.asarray(Image.fromarray(pixels).resize((_CELL, height), Image.Resampling.NEAREST))


def _score(value: float) -> str:
    """A PSNR as text. An image of one value has none; the cap stands for an exact copy."""
    if math.isnan(value):
        return "no range, no PSNR"
    return f"PSNR {value:.1f} dB" if value < PSNR_CAP_DB else "exact"
