"""Files of scenes of earlier versions: one mixture for all tiles, each component on a layer of its own; or entries that
don't say which components are coarse."""

import numpy as np

from wlm.atlas.layout import texels_of
from wlm.atlas.model import NO_BLOCKS, unpack_entries
from wlm.atlas.scene.model import COARSE_BITS, COUNT_BITS, MOST_PAGES, pack_tiles
from wlm.atlas.scene.packing import packed


def side_by_side(texels: np.ndarray, lut: np.ndarray, count: int, page: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Puts the components of each tile beside each other; every texel stays as it was.

    Args:
        texels: uint32 [pages K, Hp, Wp].
        lut: uint16 [Hc, Wc, 2], entries within a page.
        count: K.
        page: int [Hc, Wc], the page of each entry, -1 where no sheet reads it.

    Returns:
        T_p and T_c of `SceneModel`.

    Raises:
        ValueError: The tiles have more texels than their pages.
    """
    first, size, _ = unpack_entries(lut, NO_BLOCKS)
    of = np.flatnonzero(page.ravel() >= 0)
    keys = np.concatenate([page.reshape(-1, 1), first.reshape(-1, 2), size.reshape(-1, 2)], 1)[of]
    tiles, number = np.unique(keys, axis=0, return_inverse=True)
    if tiles[:, 3:].prod(1).sum() > texels.size // count + len(of):
        raise ValueError("part lut: tiles have more texels than there are")
    place, on, shape = packed(tiles[:, 3:] * [count, 1])
    result = np.zeros((int(on.max()) + 1, *shape), np.uint32)
    for nx, ny in np.unique(tiles[:, 3:], axis=0).tolist():
        at = np.flatnonzero((tiles[:, 3:] == (nx, ny)).all(1))
        for k in range(count):
            layer = tiles[at, 0] * count + k
            row, column = texels_of(place[at] + [k * nx, 0], nx, ny)
            result[on[at, None, None], row, column] = texels[layer[:, None, None], *texels_of(tiles[at, 1:3], nx, ny)]
    cells = page.size
    corner, side = np.zeros((cells, 2), int), np.ones((cells, 2), int)
    corner[of], side[of] = place[number.ravel()], tiles[number.ravel(), 3:]
    counts, pages = np.zeros(cells, int), np.zeros(cells, int)
    counts[of], pages[of] = count, on[number.ravel()]
    return result, pack_tiles(corner, side, np.zeros(cells, int), counts, pages).reshape(*page.shape, 4)


def without_coarse(lut: np.ndarray) -> np.ndarray:
    """Entries [Hc, Wc, 4] whose pages are right above the number of components, as they are now.

    Raises:
        ValueError: There are more pages than there may be.
    """
    page, count = lut[..., 3] >> COUNT_BITS, lut[..., 3] & ((1 << COUNT_BITS) - 1)
    if (page >= MOST_PAGES).any():
        raise ValueError(f"part lut: page {page.max()}: expected one below {MOST_PAGES}")
    last = (page << (COUNT_BITS + COARSE_BITS)) + count
    return np.concatenate([lut[..., :3], last[..., None].astype(np.uint16)], 2)
