"""Writes PNG files: single pictures and contact sheets."""

import functools
import math
import os
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from wlm.formats.atomic import atomic_path
from wlm.view.display import Display

MOST_COLUMNS = 8
"""Pictures in a row of a contact sheet."""

_GREY = 128  # texels outside charts, and pixels outside a mesh
_SHEET = 96  # grey of a contact sheet's background
_MARGIN, _FONT = 4, 14  # pixels


def to_bytes(light: torch.Tensor | np.ndarray, white: float = 1.0) -> np.ndarray:
    """Converts linear light, [H, W, 3], or [H, W] for grey, to sRGB bytes, uint8 [H, W, 3]; light above `white` is
    clipped."""
    if not 0 < white < math.inf:
        raise ValueError(f"white: expected a number above 0, got {white}")
    if isinstance(light, torch.Tensor):
        values = light.float() * (1.0 / white)
        pixels = torch.bucketize(values, _edges(values.device), right=True, out_int32=True).byte().cpu().numpy()
    else:
        pixels = Display(1.0 / white).picture(light)
    return np.repeat(pixels[..., None], 3, axis=2) if pixels.ndim == 2 else pixels


@functools.cache
def _edges(device: torch.device) -> torch.Tensor:
    """Returns the least light that `Display` converts to each byte from 1 to 255, float32 [255]: a GPU need not
    compute the curve as the CPU does."""
    low, high = (np.full(255, value, np.float32).view(np.int32) for value in (0.0, 1.0))
    while (high - low > 1).any():
        middle = low + (high - low) // 2
        over = Display().picture(middle.view(np.float32)) > np.arange(255)
        low, high = np.where(over, low, middle), np.where(over, middle, high)
    return torch.from_numpy(high.view(np.float32)).to(device)


def encode(light: np.ndarray, hit: np.ndarray, white: float) -> np.ndarray:
    """Converts linear light [H, W, 3] to sRGB bytes, grey where `hit` [H, W] is false."""
    return np.where(hit[..., None], to_bytes(light, white), np.uint8(_GREY))


def save_png(path: str | os.PathLike[str], pixels: np.ndarray) -> None:
    """Writes uint8 [H, W, 3] as a PNG, atomically."""
    with atomic_path(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG")


def contact_sheet(
    path: str | os.PathLike[str],
    rows: Mapping[str, Sequence[np.ndarray]],
    titles: Sequence[str] = (),
    *,
    columns: int = MOST_COLUMNS,
) -> tuple[int, ...]:
    """Writes a PNG of rows of pictures uint8 [H, W, 3], as many in each row, of one size within it, with the row's
    label on the left and titles above the columns, if there are any.

    If the rows have more than `columns` pictures, that many are chosen, evenly spread and at the same places in each
    row. Returns these places, from 0.
    """
    counts = {len(row) for row in rows.values()}
    uneven = any(len({cell.shape for cell in row}) > 1 for row in rows.values())
    if len(counts) != 1 or 0 in counts or columns < 1 or uneven:
        raise ValueError(f"rows: expected equally many pictures in each row, of one size, got rows of {sorted(counts)}")
    (count,) = counts
    if titles and len(titles) != count:
        raise ValueError(f"titles: expected one for each of {count} columns, got {len(titles)}")
    chosen = [int(i) for i in np.unique(np.linspace(0, count - 1, min(columns, count)).round())]
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
