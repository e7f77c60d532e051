"""Mixtures: each state of a tile's light is a sum of a few components.

Over a day the light of a whole scene spans many dimensions, since each position of the sun lights other surfaces; the
light of one tile spans few. Tiles are assigned to mixtures, which are subspaces of the states: each subspace has the
least error for its tiles, and each tile is assigned to the subspace with the least error for it (k-plane clustering,
Bradley and Mangasarian 2000, with subspaces for planes).

In a mixture of K components with orthonormal directions v_0 to v_(K-1), light x in the states is close to

    sum_k v_k b_k = sum_k v_k c_k - sum_k v_k o_k,    b_k = v_k x,    c_k = b_k + o_k.

Light isn't negative, so v_0 isn't (Perron), nor is b_0. The other b_k are often negative, and least-squares
samples overshoot. An offset o_k that is larger than most negative values makes every component c_k positive, so that
unsigned texels can store it, while factors have any sign; a constant for each state subtracts the offsets. As the
directions are orthonormal, errors of components are independent, and none is amplified.
"""

from dataclasses import dataclass

import numpy as np
import torch

_ROUNDS = 12
_ALIKE = 1e-6  # fraction of the light's energy: smaller differences count as equal
_PERCENT = 0.1  # percentile of a component that is its low end; its high end likewise
_MARGIN, _MARGIN_FIRST = 0.1, 0.02  # margin of o_k over the component's range; for the first, over its high end


@dataclass(frozen=True, eq=False)
class Mixtures:
    """All G mixtures with the same number of components: the factors by which a group of tiles sums its components.

    Attributes:
        factor: float32 [G, M, K, 3], the directions. A component is the sum of direction times light over the states,
            plus `offset`; it is at least 0.
        offset: float32 [G, K, 3]: light in the states is `factor` times (the components minus `offset`).
        kept: float32 [G, 3 M M], flattened projections onto the subspaces. The product with a tile's moments is the
            energy of the tile's light that remains after projection.
    """

    factor: torch.Tensor
    offset: torch.Tensor
    kept: torch.Tensor

    def factors(self, number: int) -> np.ndarray:
        """Returns a mixture's light if all components are 0, then its factors by component: float64 [1 + K, M, 3]."""
        factor, offset = (each[number].cpu().numpy().astype(np.float64) for each in (self.factor, self.offset))
        constant = -np.einsum("mkc,kc->mc", factor, offset)
        return np.concatenate([constant[None], factor.transpose(1, 0, 2)])

    def nearest(self, moment: torch.Tensor) -> torch.Tensor:
        """Finds for each tile the mixture that keeps most of its light's energy, int64 [T], from its `moments`."""
        energy = moment.diagonal(dim1=2, dim2=3).sum((1, 2))
        return _first_best(moment.flatten(1) @ self.kept.T, energy)


def moments(light: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Returns for each tile and channel the products of light in each pair of M states, summed over its P points with
    weights [T, P]: float32 [T, 3, M, M]. Light is [T, M, 3, P]."""
    part = (light * weight.sqrt()[:, None, None]).transpose(1, 2)
    return part @ part.transpose(2, 3)


def find_mixtures(
    moment: np.ndarray, texels: np.ndarray, rank: int, count: int, seed: int, like: int | None = None
) -> Mixtures:
    """Finds at most `count` mixtures for some tiles: each is a set of K = `rank` components' factors in M states that a
    group of the tiles shares. There are fewer if a group would have no tile.

    `moment`, float [T, 3, M, M], is the result of `moments` for T tiles, and `texels`, float [T, N, M, 3], N texels of
    each, not negative. `seed` chooses the tiles from which the mixtures start; tiles are assigned to mixtures by the
    first `like` components, None: by all.
    """
    random, moment, few = np.random.default_rng(seed), np.asarray(moment, np.float64), like or rank
    flat, energy = moment.reshape(len(moment), -1), np.trace(moment, axis1=2, axis2=3).sum(1)

    def best_of(kept: np.ndarray) -> np.ndarray:
        return _first_best(torch.from_numpy(kept), torch.from_numpy(energy)).numpy()

    spaces = [_subspace(moment.sum(0), few)]
    lost = energy - flat @ _projections(spaces)[0]
    while len(spaces) < min(count, len(moment)):
        share = lost.clip(min=0.0)
        if not share.sum() > _ALIKE * energy.sum():
            break
        spaces.append(_subspace(moment[random.choice(len(share), p=share / share.sum())], few))
        lost = np.minimum(lost, energy - flat @ _projections(spaces[-1:])[0])
    for _ in range(_ROUNDS):
        nearest = best_of(flat @ _projections(spaces).T)
        spaces = [_subspace(moment[nearest == g].sum(0), few) for g in np.unique(nearest)]
    kept = _projections(spaces)
    nearest = best_of(flat @ kept.T)
    if few < rank:
        # A mixture that lost its tiles in the last round has arbitrary directions.
        spaces = [_subspace(moment[nearest == g].sum(0), rank) for g, space in enumerate(spaces)]
    offset = np.stack([_offset(space, texels[nearest == g]) for g, space in enumerate(spaces)])
    factor = np.stack([space.transpose(1, 2, 0) for space in spaces])
    return Mixtures(*(torch.from_numpy(np.ascontiguousarray(each)).float() for each in (factor, offset, kept)))


def _first_best(kept: torch.Tensor, energy: torch.Tensor) -> torch.Tensor:
    """Finds for each tile the first mixture that keeps about the most energy, int64 [T]. `kept` [T, G] is the energy
    that each mixture keeps, `energy` [T] the total energy of each tile. Near ties count as equal, since rounding must
    not assign a tile to a mixture whose offsets were not computed for it."""
    return (kept >= kept.amax(1, keepdim=True) - _ALIKE * energy[:, None]).to(torch.int8).argmax(1)


def _subspace(moment: np.ndarray, rank: int) -> np.ndarray:
    """Returns the K = `rank` directions with most energy, [3, M, K]; the first has no negative numbers."""
    space = np.linalg.eigh(moment)[1][:, :, ::-1][:, :, :rank].copy()
    space[:, :, 0] *= np.where(space[:, :, 0].sum(1) < 0.0, -1.0, 1.0)[:, None]
    return space


def _projections(spaces: list[np.ndarray]) -> np.ndarray:
    """Returns `Mixtures.kept` of G subspaces, [G, 3 M M]; its product with a tile's moments is the energy kept."""
    stack = np.stack(spaces)
    return np.einsum("gcmk,gcnk->gcmn", stack, stack).reshape(len(spaces), -1)


def _offset(space: np.ndarray, texels: np.ndarray) -> np.ndarray:
    """Returns the offsets [K, 3] that make a mixture's components positive."""
    # With one state the only direction is the light itself, and black stays black.
    if not len(texels) or space.shape[1] == 1:
        return np.zeros((space.shape[2], len(space)))
    parts = np.einsum("nmc,cmk->nkc", texels.reshape(-1, *texels.shape[2:]), space)
    low, high = np.percentile(parts, [_PERCENT, 100.0 - _PERCENT], axis=0)
    offset = (_MARGIN * (high - low) - low).clip(min=0.0)
    offset[0] = _MARGIN_FIRST * high[0].clip(min=0.0)
    return offset
