"""Packing a fitted model: in as coarse whole numbers as cost next to nothing.

What a number's rounding does is made up for by those that come after it. The latents are fitted anew to the rounded
Gaussians, so that their sums stay; each layer of the network to what went into the next one, the last to the probes.
Within a matrix rows are rounded one by one, and what each leaves over is taken from those to come (Frantar et al.,
OPTQ: Accurate Quantization for Generative Pre-trained Transformers, 2023). Steps are such that a bit is worth about
as much in each group of numbers, and as long as the error lets them be.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy import linalg
from scipy.spatial.transform import Rotation

from wlm.probe.decode import Decoder
from wlm.probe.entropy import LARGEST
from wlm.probe.gaussian_codec import most_gaussians
from wlm.probe.index import morton_keys
from wlm.probe.model import ProbeModel
from wlm.probe.packed import LATENT, MOST, PLACE, SIZE, TURN, Packed, least_turned
from wlm.probe.transform import SOURCE, stored_step

DROP = 0.05
"""dB that packing may cost at the probes."""

_MANY = 20_000  # probes that numbers are fitted to: fewer would be fitted better, and the others worse
_TOGETHER = 1024  # Gaussians up to which latents are fitted together: their matrix has as many rows and columns
_PIECE = 1 << 22  # probes times Gaussians at once
_FAINT = 1e-10  # of the squared range: an error that is floats'
# Of the natural steps of each group, where a bit is worth as much in all: within a third for `livingroom` and `city`.
_SHARES = np.array([0.033, 0.0141, 0.0105, 0.0226, 0.0151, 0.06, 0.168, 0.037])
_NEAR = 0.85  # of the allowed growth that is near enough
_TRIES = 8
_AGAIN, _LESS = 3, 0.7  # times, and with what share of the room, where the other probes have lost more
_OF_LATENTS, _OF_LAYERS = 1e-4, 1e-5  # how much stays as it was, of the mean square of what is weighted


def pack_model(model: ProbeModel, position: np.ndarray, values: np.ndarray, device: str) -> ProbeModel:
    """A fitted model in fewer bytes, if there is a way that costs at most `DROP`; else the model itself.

    Args:
        model: As fitted.
        position: float64 [N, 3], of the live probes.
        values: float32 [N, D].
        device: Where the result is compared with the model.
    """
    many = slice(None, None, -(-len(position) // _MANY))
    faint = _FAINT * max(float(np.ptp(values)), float(np.abs(values).max())) ** 2
    search = _Search(model, position[many], values[many], faint, device)
    growth = 10.0 ** (DROP / 10.0) - 1.0
    most = (1.0 + growth) * (_error(model, position, values, device) + faint)
    for _ in range(_AGAIN):
        packed = search.within(growth)
        if packed is None:
            break
        found = replace(model, source=model.source[:SOURCE], packed=packed, **packed.arrays())
        if _error(found, position, values, device) <= most:
            size = found.file_bytes()
            return found if size < model.file_bytes() and found.count <= most_gaussians(size // 2) else model
        growth *= _LESS
    return model


def _error(model: ProbeModel, position: np.ndarray, values: np.ndarray, device: str) -> float:
    return float(np.square(Decoder(model, device).decode(position).astype(np.float64) - values).mean())


class _Steps(NamedTuple):
    """Of each group of numbers.

    Attributes:
        place, scale, turn: Of a Gaussian.
        latent: The same, over what the first layer makes of each.
        first: Of the first layer's weights of latents, over these.
        near: Of its weights of a place, and its biases.
        second, third: Of these layers.
    """

    place: float
    scale: float
    turn: float
    latent: float
    first: float
    near: float
    second: float
    third: float


class _Sums(NamedTuple):
    """What some Gaussians without their latents are to the probes.

    Attributes:
        rows: float64 [K, 9], the Gaussians.
        weight: float64 [N, K] on the device, None where there are too many of them.
        square: weight^T weight, None as this.
        feed: Its `_feed`, None as this.
    """

    rows: np.ndarray
    weight: torch.Tensor | None
    square: np.ndarray | None
    feed: np.ndarray | None


class _Search:
    """Whole numbers of a model at some steps, and the error that they leave."""

    def __init__(self, model: ProbeModel, position: np.ndarray, values: np.ndarray, faint: float, device: str) -> None:
        self._gain, self._cut, self._sphere = model.gain, model.profile.cut, model.profile.support == "sphere"
        self._x = torch.from_numpy(model.normalise(position).astype(np.float64)).to(device)
        self._wanted = self._put(values.astype(np.float64) / self._gain)
        rows = least_turned(model.rows())
        order = np.argsort(morton_keys(np.rint((rows[:, PLACE] - rows[:, PLACE].min(0)) * MOST / 4).astype(np.int64)))
        self._rows = rows = rows[order]
        self._layers = [layer.astype(np.float64) for layer in model.layers()]
        self._latent = self._latents(self._sums(rows[:, : LATENT.start]), rows[:, LATENT])
        self._inside = []  # what goes into the second layer and the third one, before it is bent
        inputs = self._inputs(self._latent)
        for layer in self._layers[:2]:
            self._inside.append(inputs @ self._put(layer))
            inputs = _with_one(self._inside[-1].sigmoid())
        self._faint = faint / self._gain**2
        self._base = self._error(inputs @ self._put(self._layers[2]))
        # What one unit of each latent, and of its weight, changes.
        first = self._layers[0][: self._latent.shape[1]]
        self._of_latent = 1.0 / _positive(np.linalg.norm(first, axis=1))
        self._of_first = 1.0 / _positive(self._latent.square().mean(0).sqrt().cpu().numpy())

    def within(self, growth: float) -> Packed | None:
        """The coarsest numbers found with which the error grows by at most this share; None: there are none."""
        best, natural, most = None, self._natural(), (1.0 + growth) * self._base
        least, times, tried = 0.0, 1.0, []
        for _ in range(_TRIES):
            packed, error = self._rounded(_Steps(*(natural * times)))
            tried.append((times**2, error))
            if error <= most and times > least:
                best, least = packed, times
                if error >= most - (1.0 - _NEAR) * growth * self._base:
                    break
            # The error is about that of numbers without steps, and a share of the square of the steps.
            (square, last), (other, before) = tried[-1], tried[-2] if len(tried) > 1 else (0.0, self._base)
            slope = (last - before) / (square - other) if square != other else 0.0
            wanted = square + (most - 0.5 * (1.0 - _NEAR) * growth * self._base - last) / slope if slope > 0.0 else 0.0
            times *= math.sqrt(min(max(wanted / square, 1 / 8), 8.0)) if slope > 0.0 else 2.0
        return best

    def _natural(self) -> np.ndarray:
        """Steps that do about as much harm in each group at `_SHARES` of them, float64 [8]."""
        rows, (first, second, third) = self._rows, self._layers
        latents = first[: len(self._of_latent)]
        slender = np.expm1(np.ptp(rows[:, SIZE], axis=1))
        units = [1.0 / _spread(np.exp(-rows[:, SIZE].min(1))), 1.0, min(1.0 / _spread(slender), 1.0)]
        units.append(_spread(rows[:, LATENT] / self._of_latent))
        units += map(_spread, (latents / self._of_first[:, None], first[len(latents) :], second, third))
        return np.array(units) * _SHARES

    def _rounded(self, steps: _Steps) -> tuple[Packed, float]:
        """Whole numbers, and the mean squared error over gain squared."""
        rows, latents = self._rows, self._latent.shape[1]
        step = np.concatenate([np.repeat(steps[:3], 3), steps.latent * self._of_latent])
        least = np.ptp(rows, axis=0) * (1.01 / MOST)
        least[TURN] = 1.0 / MOST
        step = np.array([stored_step(each) for each in np.maximum(step, least)])
        whole = np.rint(rows[:, : LATENT.start] / step[: LATENT.start])
        turn = whole[:, TURN] * step[TURN]
        # Steps that large are none that come into question, but a file has half a turn at most.
        whole[np.square(turn).sum(1) > 1.0, TURN] = 0.0
        sums = self._sums(whole * step[: LATENT.start])
        latent = rows[:, LATENT]
        if sums.square is not None:
            latent = _fitted(sums.square, (sums.weight.T @ self._latent).cpu().numpy(), latent, _OF_LATENTS)
        latent = _fed(latent, np.tile(step[LATENT], (len(rows), 1)), sums.feed, MOST // 2)
        net_step = [steps.first * each for each in self._of_first] + [steps.near] * 4 + [steps.second, steps.third]
        net_step = np.array([stored_step(each) for each in net_step])
        inputs = self._inputs(self._latents(sums, latent * step[LATENT]))
        net = []
        wanted = [*self._inside, self._wanted]
        for number, layer in enumerate(self._layers):
            own = net_step[: latents + 4] if number == 0 else np.full(len(layer), net_step[latents + 3 + number])
            square = (inputs.T @ inputs).cpu().numpy()
            fitted = _fitted(square, (inputs.T @ wanted[number]).cpu().numpy(), layer, _OF_LAYERS)
            net.append(_fed(fitted, np.repeat(own[:, None], layer.shape[1], 1), _feed(square, _OF_LAYERS), LARGEST))
            result = inputs @ self._put(net[-1] * own[:, None])
            inputs = _with_one(result.sigmoid())
        numbers = np.concatenate([whole, latent], 1).astype(np.int64)
        place = numbers[:, PLACE] - numbers[:, PLACE].min(0)
        numbers = numbers[np.argsort(morton_keys(place), kind="stable")]
        packed = Packed(numbers, step, tuple(layer.astype(np.int64) for layer in net), net_step)
        return packed, self._error(result)

    def _error(self, result: torch.Tensor) -> float:
        return float((result - self._wanted).square().mean()) + self._faint

    def _sums(self, rows: np.ndarray) -> _Sums:
        if len(rows) > _TOGETHER:
            return _Sums(rows, None, None, None)
        weight = torch.cat(list(self._weights(rows)))
        square = (weight.T @ weight).cpu().numpy()
        return _Sums(rows, weight, square, _feed(square, _OF_LATENTS))

    def _weights(self, rows: np.ndarray) -> Iterator[torch.Tensor]:
        """Weights of Gaussians [K, 9] at the probes, float64 [n, K] of some after the others."""
        scale = np.exp(rows[:, SIZE])
        bent = Rotation.from_mrp(rows[:, TURN]).as_matrix().transpose(0, 2, 1) / scale[:, :, None]  # S^-1 R^T
        middle = self._put(np.einsum("kij,kj->ki", bent, rows[:, PLACE]))
        flat, place = self._put(bent.reshape(-1, 3).T), self._put(rows[:, PLACE])
        reach = self._put(np.square(self._cut * scale.max(1)))
        for x in self._x.split(max(1, _PIECE // len(rows))):
            square = ((x @ flat).reshape(-1, len(rows), 3) - middle).square_().sum(2)
            reached = (x[:, None] - place).square_().sum(2) < reach if self._sphere else square < self._cut**2
            yield square.mul_(-0.5).exp_().mul_(reached)

    def _latents(self, sums: _Sums, latent: np.ndarray) -> torch.Tensor:
        """The sum of latents at the probes, float64 [N, L] on the device."""
        latents = self._put(latent)
        pieces = self._weights(sums.rows) if sums.weight is None else [sums.weight]
        return torch.cat([weight @ latents for weight in pieces])

    def _put(self, numbers: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(numbers)).to(self._x.device)

    def _inputs(self, latent: torch.Tensor) -> torch.Tensor:
        return _with_one(torch.cat([latent, self._x], 1))


def _fitted(square: np.ndarray, right: np.ndarray, before: np.ndarray, share: float) -> np.ndarray:
    """The least squares of normal equations, as near to what was there before as a share of their mean asks for."""
    ridge = _ridge(square, share)
    return linalg.solve(square + ridge * np.eye(len(square)), right + ridge * before, assume_a="pos")


def _feed(square: np.ndarray, share: float) -> np.ndarray:
    """The upper triangle of Cholesky's of the inverse of a matrix, made positive."""
    inverse = linalg.inv(square + _ridge(square, share) * np.eye(len(square)))
    return linalg.cholesky(0.5 * (inverse + inverse.T))


def _fed(numbers: np.ndarray, step: np.ndarray, feed: np.ndarray | None, most: int) -> np.ndarray:
    """Numbers [I, O] rounded row by row, each making up for those before it; whole ones up to `most`, as float64."""
    numbers, whole = numbers.copy(), np.empty_like(numbers)
    for row in range(len(numbers)):
        whole[row] = np.clip(np.rint(numbers[row] / step[row]), -most, most)
        if feed is not None:
            over = (numbers[row] - whole[row] * step[row]) / feed[row, row]
            numbers[row + 1 :] -= np.outer(feed[row, row + 1 :], over)
    return whole


def _ridge(square: np.ndarray, share: float) -> float:
    return max(share * float(np.trace(square)) / len(square), np.finfo(np.float32).tiny)


def _with_one(inputs: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.pad(inputs, (0, 1), value=1.0)


def _positive(numbers: np.ndarray) -> np.ndarray:
    """Numbers, with the largest for those that are next to nothing."""
    most = float(numbers.max()) or 1.0
    return np.where(numbers > 1e-3 * most, numbers, most)


def _spread(numbers: np.ndarray) -> float:
    return float(np.sqrt(np.square(numbers).mean())) or 1.0
