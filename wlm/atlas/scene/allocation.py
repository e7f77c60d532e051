"""How many components each tile of a scene is given, at which size, and where they lie."""

import math
from dataclasses import dataclass

import numpy as np

from wlm.atlas.layout import allocate
from wlm.atlas.model import BLOCK_SIDE, BLOCKS, COLOUR_BITS, TEXELS
from wlm.atlas.scene.curves import MOST_MIXTURES, Tried, costs
from wlm.atlas.scene.model import FACTOR_BITS, TEXEL_BITS, SceneProfile
from wlm.atlas.scene.packing import packed
from wlm.errors import WlmError

_TRIES, _FULL = 12, 0.995  # of placing all tiles, and how much of the room is full enough
_LEAST_GAIN = 2.0**-24
NO_ROOM = "budget: {:g} is less than the smallest tiles and their table take: expected more"


@dataclass(frozen=True, eq=False)
class Allocated:
    """What each tile is given.

    Attributes:
        rank: int [T], its number in the list of `Tried`.
        count: int [T], its components.
        component: int [T], its mixture's first in `factors`.
        factors: float64 [C, M, 3], of each mixture a constant and then its components.
        coarse: int [T], how many of its components are coarse.
        size: int [T, 2], texels of one of the others.
        second: bool [T], whether they are in the second texture.
        first: int64 [T, 2], place of the first component's on the page.
        page: int64 [T].
        shapes: Pages, rows and columns of both textures.
        error: Weighted, mean over the states.
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
    error: float


def allocated(tried: list[Tried], bits: float, profile: SceneProfile) -> Allocated:
    """Allocates components and sizes to the tiles of all sheets, and places them."""
    error, cost = np.concatenate([each.error for each in tried]), costs(tried)
    states, tiles = tried[0].mixtures.factor.shape[1], np.arange(error.shape[1])
    ranks, number = np.array([each.rank for each in tried]), np.stack([each.number for each in tried])
    choices = [choice for each in tried for choice in each.choices]
    of = np.repeat(np.arange(len(tried)), [len(each.choices) for each in tried])
    sides = np.array([(choice.size.nx, choice.size.ny) for choice in choices])
    extents, seconds = (np.array(each) for each in zip(*((c.extent, c.size.second) for c in choices), strict=True))
    fewest, budget, found = len(tiles) * float(TEXEL_BITS), bits, None
    for _ in range(_TRIES):
        chosen = allocate(error, cost, budget, _LEAST_GAIN / TEXEL_BITS / len(tiles))
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
                first[at], page[at], side = packed(extents[chosen[at]] // step)
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
            left = float(error[chosen, tiles].sum())
            coarse = np.array([choice.coarse for choice in choices])[chosen]
            places = (coarse, size, second, first, page, tuple(shapes))
            best = Allocated(rank, ranks[rank], component, factors, *places, left)
            if found is None or left < found.error:
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
