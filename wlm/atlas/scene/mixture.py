"""What the states of a tile's light have in common: a few components, of which each state is a sum.

Over the hours the light of a whole room has many dimensions, since each place of the sun lights others; that of one
tile has few. Tiles are dealt to mixtures: subspaces of the states, each the one of least error for its tiles, each tile
in the one that has least error for it (k-plane clustering, Bradley and Mangasarian 2000, with subspaces for planes).

In a mixture of K components with orthonormal directions v_0 to v_(K-1), light x in the states is close to

    sum_k v_k b_k = sum_k v_k c_k - sum_k v_k o_k,    b_k = v_k x,    c_k = b_k + o_k.

Light isn't negative, nor then is v_0 (Perron), nor b_0. The others are as often negative, and samples of least squares
overshoot. With o_k above what most of them are below 0, no component c_k is negative, so that textures of unsigned
texels hold them, while factors have any sign; a constant for each state takes the o_k away. As the directions are
orthonormal, an error of one component is no error of another, and none is made larger.
"""

from dataclasses import dataclass, fields

import numpy as np
import torch

_ROUNDS = 12
_ALIKE = 1e-6  # of light: less of it decides nothing
_PERCENT = 0.1  # of a component: it is as low as that, and as high as all but that
_MARGIN, _MARGIN_FIRST = 0.1, 0.02  # of its range and, of the first, of its height, that o_k is more


@dataclass(frozen=True, eq=False)
class Mixtures:
    """Mixtures of one number of components.

    Attributes:
        factor: float32 [G, M, K, 3], the directions. Components are these times the states, plus `offset`, not
            below 0.
        offset: float32 [G, K, 3]: the states are `factor` times the components less this.
        kept: float32 [G, 3 M M], flat projections onto the subspaces: times a tile's moments, how much light they keep;
            of the first components alone where the others follow.
    """

    factor: torch.Tensor
    offset: torch.Tensor
    kept: torch.Tensor

    def to(self, device: str) -> "Mixtures":
        """The same on a device."""
        return Mixtures(*(getattr(self, each.name).to(device) for each in fields(self)))

    def factors(self, number: int) -> np.ndarray:
        """Of one of them the constant that the offsets come to, and the factors: float64 [1 + K, M, 3]."""
        factor, offset = (each[number].cpu().numpy().astype(np.float64) for each in (self.factor, self.offset))
        constant = -np.einsum("mkc,kc->mc", factor, offset)
        return np.concatenate([constant[None], factor.transpose(1, 0, 2)])

    def nearest(self, moment: torch.Tensor) -> torch.Tensor:
        """The mixture that keeps most of each tile's light, int64 [T], by `moments`; the first where some are alike."""
        energy = moment.diagonal(dim1=2, dim2=3).sum((1, 2))
        return _first_best(moment.flatten(1) @ self.kept.T, energy)


def moments(light: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Products of the states' light, summed over the points of each tile, float32 [T, 3, M, M].

    Args:
        light: float32 [T, M, 3, P].
        weight: float32 [T, P].
    """
    part = (light * weight.sqrt()[:, None, None]).transpose(1, 2)
    return part @ part.transpose(2, 3)


def find_mixtures(
    moment: np.ndarray, texels: np.ndarray, rank: int, count: int, seed: int, like: int | None = None
) -> Mixtures:
    """Finds mixtures of some tiles.

    Args:
        moment: float [T, 3, M, M], `moments`.
        texels: float [T, N, M, 3], texels of the same tiles, not negative.
        rank: K, 1 to M.
        count: Mixtures, at least 1; fewer where that many have no tile.
        seed: Of the tiles that they begin with.
        like: Of how many components mixtures are found, the others follow; None: K.
    """
    random, moment, few = np.random.default_rng(seed), np.asarray(moment, np.float64), like or rank
    flat, energy = moment.reshape(len(moment), -1), np.trace(moment, axis1=2, axis2=3).sum(1)

    def best_of(kept: np.ndarray) -> np.ndarray:
        return _first_best(torch.from_numpy(kept), torch.from_numpy(energy)).numpy()

    spaces = [_subspace(moment.sum(0), few)]
    lost = energy - _kept(flat, spaces)[:, 0]
    while len(spaces) < min(count, len(moment)):
        share = lost.clip(min=0.0)
        if not share.sum() > _ALIKE * energy.sum():
            break
        spaces.append(_subspace(moment[random.choice(len(share), p=share / share.sum())], few))
        lost = np.minimum(lost, energy - _kept(flat, spaces[-1:])[:, 0])
    for _ in range(_ROUNDS):
        nearest = best_of(_kept(flat, spaces))
        spaces = [_subspace(moment[nearest == g].sum(0), few) for g in np.unique(nearest)]
    kept = [_projection(space) for space in spaces]
    nearest = best_of(flat @ np.stack(kept).T)
    if few < rank:
        # One that lost its tiles in the last round has any directions.
        spaces = [_subspace(moment[nearest == g].sum(0), rank) for g, space in enumerate(spaces)]
    offset = np.stack([_offset(space, texels[nearest == g]) for g, space in enumerate(spaces)])
    factor = np.stack([space.transpose(1, 2, 0) for space in spaces])
    parts = factor, offset, np.stack(kept)
    return Mixtures(*(torch.from_numpy(np.ascontiguousarray(each)).float() for each in parts))


def _first_best(kept: torch.Tensor, energy: torch.Tensor) -> torch.Tensor:
    """Of what each mixture keeps [T, G], of so much [T], the first that keeps about the most, int64 [T]: rounding must
    not deal tiles to others than those whose offsets are made for them."""
    return (kept >= kept.amax(1, keepdim=True) - _ALIKE * energy[:, None]).to(torch.int8).argmax(1)


def _subspace(moment: np.ndarray, rank: int) -> np.ndarray:
    """The directions [3, M, K] that most of the light is in, the first not negative."""
    space = np.linalg.eigh(moment)[1][:, :, ::-1][:, :, :rank].copy()
    space[:, :, 0] *= np.where(space[:, :, 0].sum(1) < 0.0, -1.0, 1.0)[:, None]
    return space


def _projection(space: np.ndarray) -> np.ndarray:
    return np.einsum("cmk,cnk->cmn", space, space).ravel()


def _kept(flat: np.ndarray, spaces: list[np.ndarray]) -> np.ndarray:
    """How much of each tile's light each subspace keeps, [T, G]."""
    return flat @ np.stack([_projection(each) for each in spaces]).T


def _offset(space: np.ndarray, texels: np.ndarray) -> np.ndarray:
    """What is added to components so that they aren't negative, [K, 3]."""
    # Of one state the one direction is the light itself, and black stays black.
    if not len(texels) or space.shape[1] == 1:
        return np.zeros((space.shape[2], len(space)))
    parts = np.einsum("nmc,cmk->nkc", texels.reshape(-1, *texels.shape[2:]), space)
    low, high = np.percentile(parts, [_PERCENT, 100.0 - _PERCENT], axis=0)
    offset = (_MARGIN * (high - low) - low).clip(min=0.0)
    offset[0] = _MARGIN_FIRST * high[0].clip(min=0.0)
    return offset
