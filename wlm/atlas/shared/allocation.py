"""Chooses how many components each tile is a weighted sum of, and their size; places them in the colour texture."""

import math
from dataclasses import dataclass

import numpy as np

from wlm.atlas.model import BLOCK_SIDE, BLOCKS, COLOUR_BITS, FACTOR_BITS, MOST_PAGES, MOST_SIZE, TEXELS, Profile
from wlm.atlas.shared.curves import MOST_MIXTURES, Candidate, costs
from wlm.atlas.tiles.layout import allocate, packed
from wlm.errors import WlmError

_TRIES, _FULL = 12, 0.995  # attempts to place all tiles, and the used fraction of the bits that ends them
_LEAST_GAIN = 2.0**-24
_LESS = 0.95  # fraction of the bits at which the error is measured again, for the value of a bit
_DROPPED = 8  # one in eight of the mixtures that aren't worth their factors is removed per round
NO_ROOM = "budget: {:g} of the lightmaps' bits is less than the smallest tiles and lookup texture take; give more"


@dataclass(frozen=True, eq=False)
class Allocated:
    """Components, sizes and places chosen for all T tiles.

    Attributes:
        rank: int [T], index in the list of `Candidate` that was chosen for each tile.
        count: int [T], number of components.
        component: int [T], row in `factors` of the tile's constant, which its components' factors follow.
        factors: float64 [C, M, 3], for each mixture (factors that a group of tiles shares) a constant and then a factor
            of each component, in M states.
        coarse: int [T], number of coarse components, which have a single block each.
        size: int [T, 2], width and height in texels of each component that isn't coarse.
        second: bool [T], whether the tile is in the second texture, of compressed blocks.
        first: int64 [T, 2], place of the first component on the page.
        page: int64 [T], the page.
        shapes: Numbers of pages, rows and columns of both textures.
        error: float64 [T], weighted squared error of each tile, mean over the states.
    """

    rank: np.ndarray
    count: np.ndarray
    component: np.ndarray
    factors: np.ndarray
    coarse: np.ndarray
    size: np.ndarray
    second: np.ndarray
    first: np.ndarray
    page: np.ndarray
    shapes: tuple[tuple[int, int, int], ...]
    error: np.ndarray


def allocated(tried: list[Candidate], bits: float, profile: Profile) -> Allocated:
    """Chooses number and size of all tiles' components, and places them; `bits` is the budget of tiles and factors."""
    error, cost = np.concatenate([each.error for each in tried]), costs(tried)
    states, tiles = tried[0].mixtures.factor.shape[1], np.arange(error.shape[1])
    ranks, number = np.array([each.rank for each in tried]), np.stack([each.number for each in tried])
    choices = [choice for each in tried for choice in each.choices]
    of = np.repeat(np.arange(len(tried)), [len(each.choices) for each in tried])
    sides = np.array([(choice.size.nx, choice.size.ny) for choice in choices])
    extents, seconds = (np.array(each) for each in zip(*((c.extent, c.size.second) for c in choices), strict=True))
    error = _worth(error, cost, of, number, ranks * states + states, bits)
    fewest, budget, found = len(tiles) * float(COLOUR_BITS[TEXELS]), bits, None
    for _ in range(_TRIES):
        chosen = allocate(error, cost, budget, _LEAST_GAIN / COLOUR_BITS[TEXELS] / len(tiles))
        rank = of[chosen]
        used, mixture = np.unique(rank * MOST_MIXTURES + number[rank, tiles], return_inverse=True)
        begin = np.cumsum([0, *(ranks[used // MOST_MIXTURES] + 1)])
        size, second = sides[chosen], seconds[chosen]
        first, page = np.zeros((len(tiles), 2), np.int64), np.zeros(len(tiles), np.int64)
        shapes, area = [], 0
        for texture in (False, True):
            at = np.flatnonzero(second == texture)
            step, shape = (BLOCK_SIDE if texture else 1), (0, 0, 0)
            if len(at):
                first[at], page[at], side = _on_pages(extents[chosen[at]] // step)
                first[at] *= step
                shape = (int(page[at].max()) + 1, *(step * each for each in side))
            elif not texture:
                shape = (1, 1, 1)
            shapes.append(shape)
            area += math.prod(shape) * COLOUR_BITS[BLOCKS if texture else TEXELS]
        rest = bits - int(begin[-1]) * states * FACTOR_BITS
        total = float(cost[chosen].sum())
        if area <= rest:
            component = begin[mixture.ravel()]
            pairs = (divmod(each, MOST_MIXTURES) for each in used.tolist())
            factors = np.concatenate([tried[r].mixtures.factors(g) for r, g in pairs])
            left = error[chosen, tiles]
            coarse = np.array([choice.coarse for choice in choices])[chosen]
            places = (coarse, size, second, first, page, tuple(shapes))
            best = Allocated(rank, ranks[rank], component, factors, *places, left)
            if found is None or left.sum() < found.error.sum():
                found = best
            if area > _FULL * rest or total >= float(cost[error.argmin(0)].sum()):
                return found
            budget = total * min(0.998 * rest / area, 1.1)
        elif total <= fewest and found is None:
            raise WlmError(NO_ROOM.format(profile.budget))
        else:
            # The area lost between shelves is about the same next time.
            budget = min(budget, total) * min(max(0.999 * rest / area, 0.1), 0.99)
    if found is None:
        raise WlmError(NO_ROOM.format(profile.budget))
    return found


def _worth(
    error: np.ndarray, cost: np.ndarray, of: np.ndarray, number: np.ndarray, factors: np.ndarray, bits: float
) -> np.ndarray:
    """Removes mixtures (factors shared by a group of tiles), the least useful first, until each saves more error than
    its bits would save elsewhere. Returns `error`, with a very large value where a tile's mixture was removed."""
    tiles = np.arange(error.shape[1])
    both = [allocate(error, cost, share * bits, 0.0) for share in (1.0, _LESS)]
    ends = [(error[chosen, tiles].sum(), cost[chosen].sum()) for chosen in both]
    gain = (ends[1][0] - ends[0][0]) / max(ends[0][1] - ends[1][1], 1.0)  # error that one bit saves
    if len(number) == 1 or not gain > 0.0:
        return error
    # The least sum of error and priced bits with each number of components.
    least = np.stack([(error[of == r] + gain * cost[of == r, None]).min(0) for r in range(len(number))])
    pair, price = number + MOST_MIXTURES * np.arange(len(number))[:, None], gain * FACTOR_BITS * factors
    while True:
        best, second = np.argsort(least, axis=0)[:2]
        worse = least[second, tiles] - least[best, tiles]
        used, at = np.unique(pair[best, tiles], return_inverse=True)
        ratio = np.bincount(at.ravel(), worse) / price[used // MOST_MIXTURES]
        # Mixtures of the fewest components stay, so that each tile has one.
        drop = np.flatnonzero((ratio < 1.0) & (used >= MOST_MIXTURES))
        if not len(drop):
            break
        drop = drop[np.argsort(ratio[drop])][: -(-len(drop) // _DROPPED)]
        least = np.where(np.isin(pair, used[drop]), np.inf, least)
    never = 1e3 * float(error.max()) + 1.0
    return np.where(np.isinf(least)[of], never, error)


def _on_pages(size: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Packs rectangles, int [T, 2] texels along x and y, on as few pages of equal size as possible. Returns the first
    texel of each, int64 [T, 2]; its page, int64 [T]; and rows and columns of a page."""
    order, page = np.lexsort((size[:, 0], size[:, 1])), np.empty(len(size), np.int64)
    for pages in range(max(1, -(-int(size.prod(1).sum()) // MOST_SIZE**2)), MOST_PAGES + 1):
        page[order] = np.arange(len(size)) % pages  # the sizes are spread evenly over the pages
        first, shape = packed(size, [np.flatnonzero(page == number) for number in range(pages)])
        if max(shape) <= MOST_SIZE:
            return first, page, shape
    raise WlmError(
        f"budget: too large: tiles fill more than {MOST_PAGES} pages of {MOST_SIZE} x {MOST_SIZE} texels; give less"
    )
