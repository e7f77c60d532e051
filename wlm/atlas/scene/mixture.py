"""What the states of a scene's light have in common: a few components that are mixed, none of them negative.

Light over hours is a sum of what comes from the sky, the sun and lamps, each times a brightness. Non-negative
factorisation (Lee and Seung 2001) finds such parts; by least squares, row by row (hierarchical alternating least
squares, Cichocki and Phan 2009). None is negative, so that textures of unsigned texels hold them.
"""

import numpy as np

_ROUNDS = 100
_LAST_ROUNDS = 60  # of the components alone, from a good start
_TINY = 1e-12


def factorise(light: np.ndarray, count: int) -> np.ndarray:
    """Finds the states' factors.

    Args:
        light: float64 [M, N, 3], states of sampled points, not negative, on one scale.
        count: K, at least 1; M or more: every state is a component.

    Returns:
        float64 [M, K, 3], not negative: mixed by them, some components [K, N, 3] come close to the light.
    """
    states = len(light)
    if count >= states:
        return np.repeat(np.eye(states)[:, :, None], 3, 2)
    together = light.reshape(states, -1)
    weight, part = _start(together, count)
    weight, part = _alternate(together, weight, part)
    factor = np.empty((states, count, 3))
    for channel in range(3):
        own = part.reshape(count, -1, 3)[:, :, channel]
        factor[:, :, channel], _ = _alternate(light[:, :, channel], weight.copy(), own.copy())
    return factor


def components(light: np.ndarray, factor: np.ndarray, rounds: int = _LAST_ROUNDS) -> np.ndarray:
    """The components of least squared error for given factors.

    Args:
        light: float [M, N, 3], on the scale of `factorise`.
        factor: float64 [M, K, 3].
        rounds: Of coordinate descent.

    Returns:
        float32 [K, N, 3], not negative.
    """
    if factor.shape[0] == factor.shape[1] and (factor == np.eye(len(factor))[:, :, None]).all():
        return np.asarray(light, np.float32)
    result = np.empty((factor.shape[1], *light.shape[1:]), np.float32)
    for channel in range(3):
        weight = factor[:, :, channel]
        gram, right = weight.T @ weight, weight.T @ light[:, :, channel].astype(np.float64)
        start = np.linalg.lstsq(gram, right, rcond=None)[0].clip(min=0.0)
        result[:, :, channel] = _descend(start, gram, right, rounds)
    return result


def _start(light: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """States as far from each other as can be, one after another (successive projections, Araujo et al. 2001)."""
    rest, chosen = light.copy(), []
    for _ in range(count):
        energy = (rest * rest).sum(1)
        energy[chosen] = -1.0
        best = int(energy.argmax())
        chosen.append(best)
        direction = rest[best] / max(np.linalg.norm(rest[best]), _TINY)
        rest = rest - np.outer(rest @ direction, direction)
    part = light[chosen] + _TINY
    gram, right = part @ part.T, part @ light.T
    weight = np.linalg.lstsq(gram, right, rcond=None)[0].clip(min=0.0).T
    return weight + 1e-6, part


def _alternate(light: np.ndarray, weight: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    for _ in range(_ROUNDS):
        part = _descend(part, weight.T @ weight, weight.T @ light, 1)
        weight = _descend(weight.T, part @ part.T, part @ light.T, 1).T
    return weight, part


def _descend(value: np.ndarray, gram: np.ndarray, right: np.ndarray, rounds: int) -> np.ndarray:
    """Coordinate descent on || A x - b ||² with x not negative; gram = A^T A, right = A^T b."""
    for _ in range(rounds):
        for k in range(len(value)):
            step = (right[k] - gram[k] @ value) / max(gram[k, k], _TINY)
            value[k] = np.maximum(value[k] + step, 0.0)
    return value
