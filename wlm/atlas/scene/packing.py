"""Where the rectangles of a scene's tiles lie on the pages of T_p."""

import math

import numpy as np

from wlm.atlas.layout import place
from wlm.atlas.model import MOST_SIZE
from wlm.atlas.scene.model import MOST_PAGES
from wlm.errors import WlmError

WIDTHS = np.linspace(0.7, 1.5, 9)
"""Of a page, or a table, over the square root of its area, that are tried."""


def packed(size: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Packs rectangles on as few pages as hold them, which have one size.

    Args:
        size: int [T, 2], texels along x and y of each.

    Returns:
        First texels, int64 [T, 2]; pages, int64 [T]; rows and columns of a page.

    Raises:
        WlmError: They are too many for all pages.
    """
    order, pages = np.lexsort((size[:, 0], size[:, 1])), max(1, -(-int(size.prod(1).sum()) // MOST_SIZE**2))
    while pages <= MOST_PAGES:
        page = np.empty(len(size), np.int64)
        page[order] = np.arange(len(size)) % pages  # as many of each size on each
        first, shape = _on_pages(size, page, pages)
        if max(shape) <= MOST_SIZE:
            return first, page, shape
        pages += 1
    raise WlmError(f"budget: expected at most {MOST_PAGES} pages of {MOST_SIZE} texels along a side")


def _on_pages(size: np.ndarray, page: np.ndarray, pages: int) -> tuple[np.ndarray, tuple[int, int]]:
    groups = [np.flatnonzero(page == number) for number in range(pages)]
    most = max(float(size[group].prod(1).sum()) for group in groups)
    best = None
    for share in WIDTHS:
        width = max(int(size[:, 0].max()), round(share * math.sqrt(most)))
        first, height, widest = np.zeros((len(size), 2), np.int64), 0, 0
        for group in groups:
            first[group], tall = place(size[group], width)
            height = max(height, tall)
            widest = max(widest, int((first[group, 0] + size[group, 0]).max(initial=0)))
        if best is None or widest * height < best[0]:
            best = widest * height, first, (height, widest)
    return best[1:]
