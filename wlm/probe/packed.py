"""Gaussians and a network as whole numbers: what a packed file holds, and the arrays of a model that follow from it.

A rotation is three numbers, the modified Rodrigues parameters p of one of the 24 rotations that give the same ellipsoid
(its axes, and with them its scales, in another order), the one that turns least: |p| < 0.28. Of p

    q = (1 - |p|^2, 2 p) / (1 + |p|^2)          w, x, y, z

(Shuster, A Survey of Attitude Representations, 1993).
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

# Numbers of a Gaussian: its place and its scales, three of its rotation, its latent.
PLACE, SIZE, TURN = slice(0, 3), slice(3, 6), slice(6, 9)
LATENT = slice(9, None)

MOST = 65535
"""The largest code that a model has for a number of a Gaussian."""

# What is beyond this is refused of a file, whatever it is.
_FARTHEST = 3e38
_SHORTEST = 1e-12  # of a quaternion that has a direction
_SAME = 1e-12  # between angles that rounding alone tells apart


@dataclass(frozen=True, eq=False)
class Packed:
    """A model's whole numbers; each times its step is what it stands for.

    Attributes:
        gaussians: int64 [K, 9 + L]: centre 3, log of the scale 3, rotation 3, latent L.
        step: float64 [9 + L].
        net: Of each of the three layers int64 [I + 1, O], as `wlm.probe.model.layer_shapes` has them.
        net_step: float64 [L + 6], of each row of the first layer, of the second layer and of the third.
    """

    gaussians: np.ndarray
    step: np.ndarray
    net: tuple[np.ndarray, np.ndarray, np.ndarray]
    net_step: np.ndarray

    def rows(self) -> np.ndarray:
        """What the Gaussians' numbers stand for, float64 [K, 9 + L]."""
        return self.gaussians * self.step

    def layers(self) -> list[np.ndarray]:
        """What the network's numbers stand for, half floats as a model has them."""
        first, second, third = self.net
        steps = self.net_step[:-2, None], self.net_step[-2], self.net_step[-1]
        return [_half(layer * step) for layer, step in zip((first, second, third), steps, strict=True)]

    def levels(self) -> np.ndarray:
        """The largest code of each number of a Gaussian of the model, int64 [10 + L]."""
        spread = np.ptp(self.gaussians, axis=0)
        return np.concatenate([spread[: TURN.start], np.full(4, MOST), spread[LATENT]])

    def arrays(self) -> dict[str, np.ndarray]:
        """`centre`, `code`, `bounds` and `net` of the model.

        Raises:
            ValueError: A number is beyond what a model holds.
        """
        low, high = self.gaussians.min(0), self.gaussians.max(0)
        turn = self.rows()[:, TURN]
        if (high - low).max() > MOST or not (np.square(turn).sum(1) <= 1.0).all():
            raise ValueError("part body: expected Gaussians of fewer levels, turned by no more than half a turn")
        codes = self.gaussians - low
        square = np.square(turn).sum(1, keepdims=True)
        quaternion = np.concatenate([1.0 - square, 2.0 * turn], 1) / (1.0 + square)
        turned = np.rint((quaternion + 1.0) * (0.5 * MOST))
        codes = np.concatenate([codes[:, : TURN.start], turned, codes[:, LATENT]], 1).astype(np.uint16)
        bounds = np.stack([low, high]) * self.step
        bounds = np.concatenate([bounds[:, : TURN.start], [[-1.0] * 4, [1.0] * 4], bounds[:, LATENT]], 1)
        net = np.concatenate([layer.ravel() for layer in self.layers()])
        return {
            "centre": codes[:, PLACE],
            "code": codes[:, PLACE.stop :],
            "bounds": np.clip(bounds, -_FARTHEST, _FARTHEST).astype(np.float32),
            "net": net,
        }


def least_turned(rows: np.ndarray) -> np.ndarray:
    """Gaussians with the rotation that turns least.

    Args:
        rows: [K, 10 + L], as of `wlm.probe.model.ProbeModel.rows`.

    Returns:
        float64 [K, 9 + L], numbers as of `Packed`.
    """
    rows = rows.astype(np.float64)
    quaternion = rows[:, 6:10]
    none = np.linalg.norm(quaternion, axis=1, keepdims=True) < _SHORTEST
    turn = Rotation.from_quat(np.where(none, [1.0, 0.0, 0.0, 0.0], quaternion)[:, [1, 2, 3, 0]])
    least = np.full(len(rows), np.inf)
    scale, parameters = np.empty((len(rows), 3)), np.empty((len(rows), 3))
    for axes in Rotation.create_group("O"):
        turned = turn * axes
        angle = turned.magnitude()
        better = angle < least - _SAME
        least[better] = angle[better]
        scale[better] = (rows[:, SIZE] @ np.abs(np.rint(axes.as_matrix())))[better]
        parameters[better] = turned.as_mrp()[better]
    return np.concatenate([rows[:, PLACE], scale, parameters, rows[:, 10:]], 1)


def _half(numbers: np.ndarray) -> np.ndarray:
    most = float(np.finfo(np.float16).max)
    return np.clip(numbers, -most, most).astype(np.float16)
