"""What the states of a tile's light have in common: a few components, of which each state is a sum.

Over the hours the light of a whole room has many dimensions, since each place of the sun lights others; that of one
tile has few. Tiles are dealt to mixtures: subspaces of the states, each the one of least error for its tiles, each tile
in the one that has least error for it (k-plane clustering, Bradley and Mangasarian 2000, with subspaces for planes).

In a mixture of K components with orthonormal directions v_0 to v_(K-1), light x in the states is close to
v_0 a + sum_j v_j b_j, a = v_0 x, b_j = v_j x. Light isn't negative, nor then is v_0 (Perron), nor a; and b_j is at
least l_j a, with l_j the least ratio of all tiles'. So with

    c_0 = a,   c_j = b_j - l_j a,   f_0 = v_0 + sum_j l_j v_j,   f_j = v_j,   x ~ sum_k f_k c_k,

no component is negative, so that textures of unsigned texels hold them, while factors have any sign. Samples of least
squares overshoot, next to shadows below 0; so to each component a constant is added, a tenth of what most are at most,
which a constant for each state takes away.
"""

from dataclasses import dataclass, fields

import numpy as np
import torch

_ROUNDS = 12
_LEAST_PERCENT = 0.02  # of the ratios: what is below the least is clipped
_MARGIN, _BRIGHT_PERCENT = 0.1, 99.0  # what is added to components, of what most texels stay below
_DIM = 1e-3  # of the mean coefficient of v_0: below it a ratio says nothing


@dataclass(frozen=True, eq=False)
class Mixtures:
    """Mixtures of one number of components.

    Attributes:
        factor: float32 [G, M, K, 3], of the components in each state.
        take: float32 [G, K, M, 3]: components are these times the states, plus `offset`, clipped at 0.
        offset: float32 [G, K, 3]: the states are `factor` times the components less this.
        kept: float32 [G, 3 M M], flat projections onto the subspaces: times a tile's moments, how much light they keep.
    """

    factor: torch.Tensor
    take: torch.Tensor
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
        """The mixture that keeps most of each tile's light, int64 [T], by `moments`."""
        return (moment.flatten(1) @ self.kept.T).argmax(1)


def moments(light: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Products of the states' light, summed over the points of each tile, float32 [T, 3, M, M].

    Args:
        light: float32 [T, M, 3, P].
        weight: float32 [T, P].
    """
    part = (light * weight.sqrt()[:, None, None]).transpose(1, 2)
    return part @ part.transpose(2, 3)


def find_mixtures(moment: np.ndarray, texels: np.ndarray, rank: int, count: int, seed: int) -> Mixtures:
    """Finds mixtures of some tiles.

    Args:
        moment: float [T, 3, M, M], `moments`.
        texels: float [T, N, M, 3], texels of the same tiles, not negative.
        rank: K, 1 to M.
        count: Mixtures, at least 1; fewer where that many have no tile.
        seed: Of the tiles that they begin with.
    """
    random, moment = np.random.default_rng(seed), np.asarray(moment, np.float64)
    flat, energy = moment.reshape(len(moment), -1), np.trace(moment, axis1=2, axis2=3).sum(1)
    spaces = [_subspace(moment.sum(0), rank)]
    lost = energy - _kept(flat, spaces)[:, 0]
    while len(spaces) < min(count, len(moment)):
        share = lost.clip(min=0.0)
        if not share.sum() > 1e-9 * energy.sum():
            break
        spaces.append(_subspace(moment[random.choice(len(share), p=share / share.sum())], rank))
        lost = np.minimum(lost, energy - _kept(flat, spaces[-1:])[:, 0])
    for _ in range(_ROUNDS):
        nearest = _kept(flat, spaces).argmax(1)
        spaces = [_subspace(moment[nearest == g].sum(0), rank) for g in np.unique(nearest)]
    nearest = _kept(flat, spaces).argmax(1)
    # One that lost its tiles in the last round has its own directions alone.
    made = [_positive(space, texels[nearest == g]) for g, space in enumerate(spaces)]
    parts = (torch.from_numpy(np.stack(each)).float() for each in zip(*made, strict=True))
    return Mixtures(*parts, torch.from_numpy(np.stack([_projection(each) for each in spaces])).float())


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


def _positive(space: np.ndarray, texels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Factors [M, K, 3], `take` [K, M, 3] and `offset` [K, 3] of components that aren't negative."""
    channels, states, rank = space.shape
    factor, take = np.empty((states, rank, channels)), np.empty((rank, states, channels))
    offset = np.zeros((rank, channels))
    for channel, directions in enumerate(space):
        least = np.zeros(rank)
        part = texels.reshape(-1, states, channels)[:, :, channel] @ directions
        bright = part[:, 0] > _DIM * max(float(part[:, 0].mean()), 0.0) if len(part) else np.zeros(0, bool)
        if rank > 1 and bright.any():
            least[1:] = np.percentile(part[bright, 1:] / part[bright, :1], _LEAST_PERCENT, axis=0)
        factor[:, :, channel] = directions
        factor[:, 0, channel] += directions @ least
        take[:, :, channel] = directions.T - np.outer(least, directions[:, 0])
        take[0, :, channel] = directions[:, 0]
        if len(part):
            components = part - part[:, :1] * least
            offset[:, channel] = _MARGIN * np.percentile(components, _BRIGHT_PERCENT, axis=0).clip(min=0.0)
    return factor, take, offset
