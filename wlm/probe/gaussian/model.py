"""The model of Gaussians and a network: the integers that a file stores, and the codes that a GPU uses.

The light at a position p follows from the sum of the Gaussians' latents at p and from p itself
(gaussian-probe-compression, eq. 2 to 7):

    x = (p - origin) / extent                        in [0, 1]^3
    F(x) = sum_j F_j exp(-d_j^2 / 2),  d_j = |S_j^-1 R_j^T (x - mu_j)|,  over the Gaussians j that reach x
    y = MLP([F(x), x])
    sh(p) = gain * y                                                       if the fit minimised the absolute error
    sh(p)_d = gain * exp(min(y_D, 0)) * y_d,  d < D                        if it minimised the relative error

In the second form the network has one more output than a probe has numbers, the logarithm of the probe's magnitude. The
paper has only the first form, whose error is as large in dark places as in bright ones. The first three numbers of
spherical harmonics, the ambient light, are clamped at 0 in both.

A file stores whole numbers, each with a step (`WholeNumbers`). A GPU holds a 16-bit code for every number of a Gaussian
and half floats for the network; both follow from the whole numbers.

A rotation is stored as three numbers, the modified Rodrigues parameters p of one of the 24 rotations that give the same
ellipsoid with its axes in another order. The rotation with the smallest angle is taken, |p| < 0.28. Its quaternion is

    q = (1 - |p|^2, 2 p) / (1 + |p|^2)          w, x, y, z

(Shuster, A Survey of Attitude Representations, 1993).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, ClassVar, Self

import numpy as np
from scipy.spatial.transform import Rotation

from wlm.errors import WlmError
from wlm.formats.parts import Part
from wlm.probe.model import CODES, Content, Profile
from wlm_kernels.probe.network import most_outputs

# Channels of a Gaussian as a GPU holds it: centre, logarithm of the scale, quaternion, latent.
CENTRE, SCALE, ROTATION, LATENT = slice(0, 3), slice(3, 6), slice(6, 10), slice(10, None)

# Channels of a Gaussian in whole numbers: the rotation takes three.
STORED_CENTRE, STORED_SCALE, STORED_ROTATION, STORED_LATENT = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, None)

CUT = 3.0
"""Radius of a Gaussian's support in standard deviations."""

LARGEST = (1 << 24) - 1
"""Largest magnitude of an integer of the quantised network."""

_FARTHEST = 3e38  # bounds beyond this are clamped, and refused when a file is read
_MOST, _MOST_LOG = 1e38, 40.0  # largest magnitudes of a file's numbers, and of logarithms of scales
_SHORTEST = 1e-12  # length of a quaternion that has a direction
_SAME = 1e-12  # difference of two angles that only rounding separates


@dataclass(frozen=True, eq=False)
class WholeNumbers:
    """Gaussians and network as integers; each integer times its step gives the number.

    Attributes:
        gaussians: int64 [K, 9 + L]: 3 numbers of the centre, 3 of the scale's logarithm, 3 of the rotation, and L of
            the latent.
        step: float64 [9 + L], the step of each column of `gaussians`.
        net: The three layers, int64 [I + 1, O] for I inputs, the biases and O outputs, see `layer_shapes`.
        net_step: float64 [L + 6], a step for each row of the first layer, one for the second layer and one for the
            third.
    """

    gaussians: np.ndarray
    step: np.ndarray
    net: tuple[np.ndarray, np.ndarray, np.ndarray]
    net_step: np.ndarray

    def layers(self) -> list[np.ndarray]:
        """Returns the three layers of the network as float16."""
        most = float(np.finfo(np.float16).max)
        steps = self.net_step[:-2, None], self.net_step[-2], self.net_step[-1]
        return [
            np.clip(layer * step, -most, most).astype(np.float16) for layer, step in zip(self.net, steps, strict=True)
        ]

    def codes(self) -> dict[str, np.ndarray]:
        """Computes from whole numbers what a GPU holds: `code`, `levels`, `bounds` and `net` of `Gaussians`. Raises a
        ValueError if the whole numbers of a channel span more than 16 bits, or a rotation exceeds half a turn."""
        low, high = self.gaussians.min(0), self.gaussians.max(0)
        turn = self.gaussians[:, STORED_ROTATION] * self.step[STORED_ROTATION]
        square = np.square(turn).sum(1, keepdims=True)
        if (high - low).max() > CODES or not (square <= 1.0).all():
            raise ValueError(
                "part gaussians: expected numbers of a channel within 16 bits, and rotations of at most half a turn"
            )
        code = self.gaussians - low
        quaternion = np.concatenate([1.0 - square, 2.0 * turn], 1) / (1.0 + square)
        turned = np.rint((quaternion + 1.0) * (0.5 * CODES))
        start = STORED_ROTATION.start
        bounds = np.stack([low, high]) * self.step
        bounds = np.concatenate([bounds[:, :start], [[-1.0] * 4, [1.0] * 4], bounds[:, STORED_LATENT]], 1)
        spread = high - low
        return {
            "code": np.concatenate([code[:, :start], turned, code[:, STORED_LATENT]], 1).astype(np.uint16),
            "levels": np.concatenate([spread[:start], np.full(4, CODES), spread[STORED_LATENT]]),
            "bounds": np.clip(bounds, -_FARTHEST, _FARTHEST).astype(np.float32),
            "net": np.concatenate([layer.ravel() for layer in self.layers()]),
        }


@dataclass(frozen=True, eq=False)
class Gaussians(Content):
    """K Gaussians with latents of length L, and a network of P weights.

    Attributes:
        latent: L, length of a latent.
        hidden: Width of both hidden layers.
        outputs: D, numbers per probe at one hour.
        support: Support of a Gaussian, "ellipsoid" or "sphere".
        relative: Whether the network has an output for the magnitude, D + 1 outputs in all.
        gain: Factor of the network's outputs.
        code: uint16 [K, 10 + L], codes of centre, logarithm of the scale, quaternion and latent.
        levels: int64 [10 + L], largest code of each channel.
        bounds: float32 [2, 10 + L], lowest and highest value of each channel.
        net: float16 [P]: for each layer a row of weights for every input, then the biases.
        dropped: Number of Gaussians that the fit dropped, since no probe needed them.
        whole: The integers from which the arrays are computed; None until a fit is quantised for its file.
        hours: T, number of hours; the network has T D outputs.
    """

    METHOD: ClassVar[str] = "gaussians"
    DECODER: ClassVar[str] = "wlm.probe.gaussian.decode:GaussianDecoder"
    BUNDLE: ClassVar[str] = "wlm.probe.gaussian.bundle:gaussian_bundle"

    latent: int
    hidden: int
    outputs: int
    support: str
    relative: bool
    gain: float
    code: np.ndarray
    levels: np.ndarray
    bounds: np.ndarray
    net: np.ndarray
    dropped: int
    whole: WholeNumbers | None = None
    hours: int = 1

    @property
    def count(self) -> int:
        """The number of Gaussians, K."""
        return len(self.code)

    @property
    def nbytes(self) -> int:
        return gaussian_bytes(self.count, self.latent, self.hidden, self.columns // self.hours, self.hours)

    @property
    def columns(self) -> int:
        """The number of outputs of the network: at each hour those of a probe, and one for the magnitude."""
        return self.hours * (self.outputs + self.relative)

    @property
    def steps(self) -> np.ndarray:
        """The difference between successive codes of each channel, float32 [10 + L]."""
        low, high = self.bounds
        return (high - low) / np.maximum(self.levels, 1).astype(np.float32)

    def rows(self) -> np.ndarray:
        """Returns the Gaussians decoded from their codes (eq. 14), float32 [K, 10 + L]. Scales are logarithms.
        Quaternions w, x, y, z have any length; a quaternion of length zero means no rotation."""
        return self.bounds[0] + self.code.astype(np.float32) * self.steps

    def layers(self) -> list[np.ndarray]:
        """Returns the three layers of `net`, float16, as `layer_shapes` describes them."""
        return split_layers(self.net, layer_shapes(self.latent, self.hidden, self.columns))

    def at(self, factors: np.ndarray, scales: np.ndarray) -> Self:
        *shared, last = (layer.astype(np.float64) for layer in self.layers())
        hours = last.reshape(len(last), self.hours, -1)
        if not self.relative:
            hours *= scales[:, None]
        mixed = [*shared, factors @ hours]
        net = np.clip(np.concatenate([layer.ravel() for layer in mixed]), -65504, 65504).astype(np.float16)
        # A half float would round the logarithm of all light by up to a hundredth.
        rounded = math.exp(mixed[-1][-1, -1] - float(net[-1])) if self.relative else 1.0
        return replace(self, net=net, gain=self.gain * rounded, whole=None, hours=1)

    def facts(self) -> dict[str, Any]:
        return {"gaussians": self.count, "dropped": self.dropped, "latent": self.latent, "hidden": self.hidden}

    def settings(self) -> dict[str, int]:
        return {"count": self.count, "dropped": self.dropped}

    @classmethod
    def table(cls, profile: Profile, outputs: int, hours: int, count: int, live: int, clusters: int) -> dict[str, Part]:
        if not count:
            raise ValueError("setting count: expected at least one Gaussian, found none")
        channels = STORED_LATENT.start + profile.latent
        shapes = layer_shapes(profile.latent, profile.hidden, profile.columns(outputs, hours))
        weights = sum(rows * columns for rows, columns in shapes)
        return {
            "gain": Part(np.float64, (1,), least=0.0, most=float(np.finfo(np.float32).max)),
            "lowest": Part(np.int32, (channels,)),
            "gaussians": Part(np.uint16, (channels, count)),
            "steps": Part(np.uint16, (channels + profile.latent + 6,)),
            "network": Part(np.int32, (weights,), least=-LARGEST, most=LARGEST),
        }

    def parts(self) -> dict[str, np.ndarray]:
        whole = self.whole
        if whole is None:
            raise ValueError("expected Gaussians quantised to integers, as `compress` returns them")
        # Channel by channel, minus the lowest number of each; of a step, the upper 16 bits of the float32.
        lowest = whole.gaussians.min(0)
        steps = np.concatenate([whole.step, whole.net_step]).astype(np.float32)
        return {
            "gain": np.array([self.gain]),
            "lowest": lowest.astype(np.int32),
            "gaussians": (whole.gaussians - lowest).T.astype(np.uint16),
            "steps": (steps.view(np.uint32) >> 16).astype(np.uint16),
            "network": np.concatenate([layer.ravel() for layer in whole.net]).astype(np.int32),
        }

    @classmethod
    def from_parts(
        cls, profile: Profile, outputs: int, hours: int, stored: Mapping[str, np.ndarray], dropped: int
    ) -> Self:
        latent, hidden = profile.latent, profile.hidden
        steps = (stored["steps"].astype(np.uint32) << 16).view(np.float32).astype(np.float64)
        if not (np.isfinite(steps).all() and (steps > 0).all()):
            raise ValueError("part steps: expected finite quantisation steps above 0")
        shapes = layer_shapes(latent, hidden, profile.columns(outputs, hours))
        first, second, third = split_layers(stored["network"].astype(np.int64), shapes)
        whole = WholeNumbers(
            gaussians=stored["gaussians"].T.astype(np.int64) + stored["lowest"],
            step=steps[: STORED_LATENT.start + latent],
            net=(first, second, third),
            net_step=steps[STORED_LATENT.start + latent :],
        )
        gain, relative = float(stored["gain"][0]), profile.error == "relative"
        sizes = latent, hidden, outputs, profile.support, relative, gain
        content = cls(*sizes, dropped=dropped, whole=whole, hours=hours, **whole.codes())
        content._check_range()
        return content

    def _check_range(self) -> None:
        """Raises a ValueError if a number in the decoding can exceed float32."""
        # The difference of any two bounds must be finite, and so must the squares of scales and of their inverses.
        if not np.abs(self.bounds).max() <= _MOST:
            raise ValueError(f"part gaussians: expected numbers of at most {_MOST:g} in magnitude")
        if np.abs(self.bounds[:, SCALE]).max() > _MOST_LOG:
            raise ValueError(f"part gaussians: expected logarithms of scales of at most {_MOST_LOG:g} in magnitude")
        if not self.gain > 0:
            raise ValueError("part gain: expected a positive number")
        first, _, third = (np.abs(layer.astype(np.float64)) for layer in self.layers())
        sums = self.count * np.abs(self.bounds[:, LATENT].astype(np.float64)).max(0)
        first *= np.concatenate([np.maximum(sums, 1.0), np.ones(4)])[:, None]
        light = third.reshape(len(third), self.hours, -1)[..., : self.outputs]
        most = max(first.sum(0).max(), third.sum(0).max(), self.gain * light.sum(0).max())
        if not most <= np.finfo(np.float32).max:
            raise ValueError("parts network, gaussians and gain: expected light within the range of float32")


def split_layers(net: Any, shapes: list[tuple[int, int]]) -> list[Any]:
    """Splits an array or a tensor of all weights, [P], into layers of these shapes."""
    ends = np.cumsum([0, *(rows * columns for rows, columns in shapes)])
    return [net[start:end].reshape(shape) for (start, end), shape in zip(pairwise(ends), shapes, strict=True)]


def gaussian_bytes(count: int, latent: int, hidden: int, outputs: int, hours: int = 1) -> int:
    """Returns the bytes of the GPU buffers of `count` Gaussians and a network with `outputs` outputs at each hour; see
    `wlm.probe.gaussian.bundle`, and for several hours `wlm.probe.bundle`."""
    channels = LATENT.start + latent
    gaussians = 4 * (10 + 2 * channels + count * ((channels + 1) // 2))
    *shared, last = (padded_size(rows - 1, columns) for rows, columns in layer_shapes(latent, hidden, outputs))
    return gaussians + 2 * (sum(shared) + last * (hours + 1 if hours > 1 else 1))


def padded_size(inputs: int, outputs: int) -> int:
    """Returns the number of weights of a layer in a GPU buffer, with biases, and fours of inputs and of outputs."""
    return (1 + -(-inputs // 4) * 4) * -(-outputs // 4) * 4


def layer_shapes(latent: int, hidden: int, outputs: int) -> list[tuple[int, int]]:
    """Returns the shapes of the layers: a row for each input and one of biases, a column for each output."""
    return [(latent + 4, hidden), (hidden + 1, hidden), (hidden + 1, outputs)]


def check_outputs(name: str, latent: int, hidden: int, outputs: int, relative: bool, device: str) -> None:
    """Checks that kernels can be compiled for `outputs` numbers per probe; on the CPU there is no limit. Raises a
    WlmError if there are too many numbers per probe for CUDA."""
    most = most_outputs(latent, hidden) - relative
    if device != "cpu" and outputs > most:
        raise WlmError(
            f"{name}: expected at most {most} numbers a probe on CUDA with latent {latent} and hidden "
            f"{hidden}, found {outputs}; the CPU has no limit"
        )


def gaussian_count(ratio: float, live: int) -> int:
    """Returns the number of Gaussians with which a fit to `live` probes begins; `ratio` is Gaussians per probe."""
    return max(1, round(ratio * live))


def least_turned(rows: np.ndarray) -> np.ndarray:
    """Returns equivalent Gaussians with the smallest rotation angle, by reordering the axes of each ellipsoid. `rows`
    is [K, 10 + L], as from `Gaussians.rows`. The result is float64 [K, 9 + L], channels as in `WholeNumbers`."""
    rows = rows.astype(np.float64)
    quaternion = rows[:, ROTATION]
    none = np.linalg.norm(quaternion, axis=1, keepdims=True) < _SHORTEST
    turn = Rotation.from_quat(np.where(none, [1.0, 0.0, 0.0, 0.0], quaternion)[:, [1, 2, 3, 0]])
    least = np.full(len(rows), np.inf)
    scale, parameters = np.empty((len(rows), 3)), np.empty((len(rows), 3))
    for axes in Rotation.create_group("O"):
        turned = turn * axes
        angle = turned.magnitude()
        better = angle < least - _SAME
        least[better] = angle[better]
        scale[better] = (rows[:, SCALE] @ np.abs(np.rint(axes.as_matrix())))[better]
        parameters[better] = turned.as_mrp()[better]
    return np.concatenate([rows[:, CENTRE], scale, parameters, rows[:, LATENT]], 1)
