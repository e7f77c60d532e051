"""Computes the error of each tile of a scene with one, two and more components, at each size.

A mixture is a matrix F of factors by which a group of tiles sums its components. For a tile, a mixture and a size, the
squared error over all states is the error of unrounded components plus

    sum_m || sum_k f[m, k] r_k ||² = sum_k || r_k ||²,    since F^T F = 1,

with r_k the error of component k after it is stored: clipped at 0 and rounded, as texels or as blocks. So each
component has a separate curve, and the last ones, which have the least energy, may be coarse, with one block each.
"""

import functools
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

from wlm.atlas.colour import stored
from wlm.atlas.model import BLOCK_SIDE, COLOUR_BITS, FACTOR_BITS, MOST_COARSE, extent
from wlm.atlas.shared.mixture import Mixtures, find_mixtures, moments
from wlm.atlas.stages import Stages
from wlm.atlas.tiles.fit import Tiles, errors, sample_weights, solve, tile_light
from wlm.atlas.tiles.layout import Size, allocate
from wlm.dispatch import Task, Whole, gathered
from wlm.formats.float_texels import MOST_SIDE
from wlm.formats.parts import Part
from wlm.interop import check_device, moved, one_thread
from wlm.system import Meter

_RANKS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)  # candidate numbers of components
MOST_MIXTURES = 128
"""Largest number of mixtures with the same number of components."""

_FACTOR_SHARE = 0.15  # largest fraction of the budget for the factors of all candidate mixtures
# Tiles from which mixtures are found, limit on the size of their moments, and texels per tile for the bounds.
_SAMPLES, _MOMENTS, _SAMPLE_TEXELS = 8192, 1 << 24, 16
_PAYS = 0.99  # more components must reduce the error below this fraction, or no more are tried
_ROUGH, _MEDIUM = 3, 10  # rounds of conjugate gradients for a curve, and for one of blocks
_AT_ONCE = 1024  # tiles
_PIECES = 1_000_000  # numbers in the checkpoint for the tiles of each number of components


@dataclass(frozen=True, eq=False)
class SceneTiles:
    """All T tiles of sheets (UV layouts) and their mip levels that have a weight above 0, of B = `size` texels along a
    side.

    `texels`, float32 [T, B + 1, B + 1, M, 3], is light divided by a unit for each of M states; `weight`, float32 [T,
    P], has the weights of the tiles' points, which all add up to 1. `plane`, int [T], ascending, numbers the sheets and
    mip levels, and `index`, int64 [T], the tiles in each, row by row.
    """

    texels: torch.Tensor
    weight: torch.Tensor
    plane: np.ndarray
    index: np.ndarray
    size: int
    device: str

    @cached_property
    def weights(self) -> np.ndarray:
        """The weight of each tile, float64 [T]."""
        return self.weight.double().sum(1).cpu().numpy()

    def part(self, at: np.ndarray) -> "SceneTiles":
        """Returns the tiles of some numbers alone."""
        return replace(self, **{name: getattr(self, name)[at] for name in ("texels", "weight", "plane", "index")})

    def light(self, at: np.ndarray | slice) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the texels of the tiles `at` and the weights of their points, copied to the device."""
        return self.texels[at].to(self.device), self.weight[at].to(self.device)

    def points(self, texels: torch.Tensor) -> torch.Tensor:
        """Returns light at the points of each tile, [T, N, 3, P], interpolated from texels [T, B + 1, B + 1, N, 3]."""
        return tile_light(texels.flatten(3)).unflatten(1, (-1, 3))

    def components(self, texels: torch.Tensor, mixtures: Mixtures, number: torch.Tensor) -> torch.Tensor:
        """Returns the texels of K components, [T, B + 1, B + 1, K, 3], computed from the texels of all states."""
        parts = torch.einsum("tmkc,tyxmc->tyxkc", mixtures.factor[number], texels)
        return (parts + mixtures.offset[number][:, None, None]).clamp(min=0.0)


@dataclass(frozen=True, eq=False)
class Choice:
    """A size and a number of components that a tile may have; the last `coarse` ones take a single block each."""

    size: Size
    count: int
    coarse: int

    @property
    def extent(self) -> tuple[int, int]:
        """Width and height in texels of the rectangle that a tile's components take."""
        return tuple(extent(np.array([self.size.nx, self.size.ny]), np.array(self.count), self.coarse).tolist())

    @property
    def bits(self) -> float:
        """The number of bits of all components."""
        return float(math.prod(self.extent) * COLOUR_BITS[self.size.format])


@dataclass(frozen=True, eq=False)
class Candidate:
    """The errors of all T tiles with a certain number of components: the mixtures (sets of factors that tiles share)
    and each tile's mixture, int [T]; the sizes of the components, and the squared error of each tile for each choice of
    them, float64 [choices, T], mean over the states; `left` estimates the error of the whole scene if tiles may have up
    to this number of components."""

    mixtures: Mixtures
    number: np.ndarray
    choices: list[Choice]
    error: np.ndarray
    left: float

    @property
    def rank(self) -> int:
        """The number of components."""
        return self.mixtures.factor.shape[2]


def choices_of(count: int, sizes: list[Size]) -> list[Choice]:
    """Lists the choices for `count` components: all are of one size, or, in block formats, the last ones are coarse:
    stored as a single block each."""
    few = [count - rank for rank in _RANKS if 0 < count - rank <= MOST_COARSE]
    return [
        Choice(size, count, coarse)
        for size in sizes
        for coarse in (0, *(few if size.second and size.nx * size.ny > BLOCK_SIDE**2 else ()))
    ]


def candidates(
    tiles: SceneTiles, sizes: list[Size], bits: float, seed: int, stages: Stages, batch: int
) -> list[Candidate]:
    """Computes every tile's error with one component, with two and so on, until a further component gains nothing.
    `bits` is the budget for all tiles and the factors that they share. The checkpoint of `stages` saves the result for
    each number of components as one batch, the first with the number `batch`."""
    count, states = tiles.texels.shape[0], tiles.texels.shape[3]
    most = min(states, _RANKS[-1])
    ranks = [*(rank for rank in _RANKS if rank < most), most]
    many = int(min(_FACTOR_SHARE * bits / (states * FACTOR_BITS), MOST_SIDE) / sum(rank + 1 for rank in ranks))
    random = np.random.default_rng(seed)
    samples = min(count, _SAMPLES, _MOMENTS // (3 * states**2))
    few = np.sort(random.choice(count, max(samples, 1), replace=False))
    moment = []
    for at in np.array_split(few, -(-len(few) // _AT_ONCE)):
        texels, weight = tiles.light(at)
        moment.append(moments(tiles.points(texels), weight).cpu().numpy())
    row, column = random.integers(0, tiles.size + 1, (2, _SAMPLE_TEXELS))
    moment, bounds = np.concatenate(moment), tiles.texels[few][:, row, column].numpy()
    meter, tried, before, eager = Meter(stages.progress, "curves", len(ranks) * count), [], math.inf, np.arange(count)
    for done, rank in enumerate(ranks):
        # With as many components as states any tile is exact; mixtures then differ in the energy of their first
        # components.
        like = ranks[done - 1] if rank == states and done else rank
        mixtures = find_mixtures(moment, bounds, rank, min(max(many, 1), MOST_MIXTURES), seed, like)
        choices, number = choices_of(rank, sizes), np.zeros(count, int)
        # A tile that isn't tried gains nothing.
        error = np.repeat(tried[0].error.max(0)[None], len(choices), 0) if tried else np.zeros((len(choices), count))
        step = max(1, min(2 * _AT_ONCE, 8 * _AT_ONCE // rank))
        pieces, tasks = np.split(eager, range(step, len(eager), step)), []
        for i, piece in enumerate(pieces, (batch + done) * _PIECES):
            table = {"number": Part(np.int64, (len(piece),), least=0, most=len(mixtures.factor) - 1)}
            table["error"] = Part(np.float64, (len(choices), len(piece)), least=0.0)
            job = functools.partial(_job, tiles, piece, mixtures, sizes, choices)
            tasks.append(Task((i,), len(piece), job, table=table))
        options = stages.place, stages.checkpoint, done * count
        for i, kept in gathered((CurveMaker,), tasks, meter, *options).items():
            piece = pieces[i - (batch + done) * _PIECES]
            number[piece], error[:, piece] = kept["number"], kept["error"]
        tried.append(Candidate(mixtures, number, choices, error, 0.0))
        left, chosen = _left(tried, bits)
        tried[-1] = replace(tried[-1], left=left)
        # A tile that uses fewer components than allowed will not use more, unless more represent it exactly.
        eager = np.arange(count) if ranks[done + 1 : done + 2] == [states] else np.flatnonzero(chosen == done)
        if left > _PAYS * before or not len(eager):
            break
        before = left
    return tried


def _job(tiles: SceneTiles, piece: np.ndarray, *settings: Any) -> tuple[Any, ...]:
    return tiles.part(piece), *settings


class CurveMaker(Whole):
    """Computes the errors of groups of tiles for each choice of their components."""

    def __init__(self, device: str) -> None:
        self._device = check_device(device)

    def run(self, job: tuple[SceneTiles, Mixtures, list[Size], list[Choice]]) -> dict[str, np.ndarray]:
        """Returns for T tiles their mixtures, int [T], and errors for each choice, [choices, T], by name."""
        tiles, mixtures, sizes, choices = replace(job[0], device=self._device), *job[1:]
        with one_thread(self._device):
            device, (_, states, rank, _) = tiles.device, mixtures.factor.shape
            mixtures = moved(mixtures, device)
            factor, offset = mixtures.factor, mixtures.offset
            block = next((i for i, size in enumerate(sizes) if size.second and size.nx * size.ny == BLOCK_SIDE**2), 0)
            place = {size: i for i, size in enumerate(sizes)}
            texels, weight = tiles.light(slice(None))
            light = tiles.points(texels)
            chosen = mixtures.nearest(moments(light, weight))
            components = tiles.points(tiles.components(texels, mixtures, chosen))
            rest = torch.einsum("tmkc,tkcp->tmcp", factor[chosen], components - offset[chosen][..., None]) - light
            lost = (rest.square().mean((1, 2)) * weight).double().sum(1)
            whole, shares = chosen.repeat_interleave(rank), weight.repeat_interleave(rank, 0)
            piece = Tiles(whole, components.flatten(0, 1).contiguous(), shares, tiles.size)
            # The error of each component alone.
            alone = torch.empty((len(sizes), len(chosen), rank), dtype=torch.float64, device=device)
            for i, size in enumerate(sizes):
                samples = solve(piece, size.nx, size.ny, _MEDIUM if size.second else _ROUGH).clamp(min=0.0)
                held = stored(samples, sample_weights(piece, size.nx, size.ny), size.format)
                alone[i] = errors(piece, held).unflatten(0, (-1, rank)) / states
            error = np.zeros((len(choices), len(chosen)))
            for i, choice in enumerate(choices):
                whole = rank - choice.coarse
                left = alone[place[choice.size], :, :whole].sum(1) + alone[block, :, whole:].sum(1)
                error[i] = (left + lost).cpu().numpy()
            return {"number": chosen.cpu().numpy(), "error": error}


def costs(tried: list[Candidate]) -> np.ndarray:
    """Returns the bits of every choice of all candidates, in one array."""
    return np.array([choice.bits for each in tried for choice in each.choices])


def _left(tried: list[Candidate], bits: float) -> tuple[float, np.ndarray]:
    """Estimates the whole scene's error within `bits`; also returns the candidate that each tile uses, int [T]."""
    error = np.concatenate([each.error for each in tried])
    chosen = allocate(error, costs(tried), bits, 0.0)
    of = np.repeat(np.arange(len(tried)), [len(each.choices) for each in tried])
    return float(error[chosen, np.arange(len(chosen))].sum()), of[chosen]
