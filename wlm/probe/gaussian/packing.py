"""Quantises a fit for its file: integers with steps as coarse as an error budget allows.

Numbers that are rounded later compensate for the rounding of earlier ones. The latents are fitted again to the rounded
Gaussians, so that their weighted sums at the probes hardly change; each layer of the network is fitted to the original
inputs of the next layer, the last layer to the probes, or to its original results after a fit to pictures. Within a
matrix, rows are rounded one by one, and later rows compensate for the rounding error of each row (Frantar et al., OPTQ:
Accurate Quantization for Generative Pre-trained Transformers, 2023). Steps are chosen so that one more bit reduces the
error about equally in each group of numbers.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from wlm.probe.gaussian.decode import GaussianDecoder
from wlm.probe.gaussian.model import (
    CUT,
    LARGEST,
    STORED_CENTRE,
    STORED_LATENT,
    STORED_ROTATION,
    STORED_SCALE,
    Gaussians,
    WholeNumbers,
    least_turned,
)
from wlm.probe.model import CODES, ProbeModel
from wlm.probe.morton import morton_keys
from wlm.probe.relative import magnitudes, with_magnitude

DROP = 0.05
"""Growth in dB of the error that the fit minimised by quantising."""

_MANY = 20_000  # most probes that numbers are fitted to; fitting to few probes would favour them over the rest
_TOGETHER = 1024  # most Gaussians whose latents are fitted together: the matrix has as many rows and columns
_PIECE = 1 << 22  # probes times Gaussians per piece
_FAINT = 1e-10  # share of the squared range below which an error counts as float32 rounding
# Factors of the groups' natural steps with which one bit less costs about the same error in each group; the best
# factors of the sets `livingroom` and `city` are within a third of these.
_SHARES = np.array([0.033, 0.0141, 0.0105, 0.0226, 0.0151, 0.06, 0.168, 0.037])
_NEAR = 0.85  # the search ends at this share of the allowed growth of the error
_TRIES = 8
_FINEST = 1 / 64  # of the natural steps, where no tried step is fine enough
_AGAIN, _LESS = 3, 0.7  # attempts, and the factor of the allowed growth if probes that were left out lost more
_ROWS = 64  # rows of a matrix that are rounded before the rows behind them change
_OF_LATENTS, _OF_LAYERS = 1e-4, 1e-5  # ridge of the least squares, as a share of the mean square


def pack_model(
    model: ProbeModel, position: np.ndarray, values: np.ndarray, device: str, pictured: bool = False
) -> ProbeModel:
    """Quantises a fitted model to integers.

    Args:
        model: The fit, whose Gaussians have no whole numbers yet.
        position: float64 [N, 3], positions of the live probes.
        values: float32 [N, T D], the numbers of these probes at T hours, without the model's `scales`.
        device: Device on which results are compared with the fit.
        pictured: Whether the fit minimised the error of pictures too, which to fit layers to the probes would raise.

    Returns:
        The coarsest model found that loses at most `DROP` dB; if none does, a model with fine steps.
    """
    content = model.content
    assert isinstance(content, Gaussians)
    many, hours = slice(None, None, -(-len(position) // _MANY)), content.hours
    if content.relative:
        unit = np.repeat(magnitudes(values, hours), content.outputs, axis=1)
        wanted, faint = with_magnitude(values, hours), _FAINT
    else:
        unit, wanted = np.full((1, 1), content.gain), values.astype(np.float64) / content.gain
        faint = _FAINT * max(float(np.ptp(wanted)), float(np.abs(wanted).max())) ** 2

    def error(tried: ProbeModel) -> float:
        plain = replace(tried, scales=np.ones(hours))
        decoded = GaussianDecoder(plain, device).decode_hours(position).astype(np.float64)
        return float(np.square((decoded - values) / unit).mean())

    search = _Search(content, model.normalise(position[many]), wanted[many], faint, device, pictured)
    growth = 10.0 ** (DROP / 10.0) - 1.0
    most = (1.0 + growth) * (error(model) + faint)
    for _ in range(_AGAIN):
        whole = search.within(growth)
        if whole is None:
            break
        found = replace(model, content=replace(content, whole=whole, **whole.codes()))
        if error(found) <= most:
            return found
        growth *= _LESS
    whole = search.finest()
    return replace(model, content=replace(content, whole=whole, **whole.codes()))


class _Steps(NamedTuple):
    """The quantisation steps of each group of numbers.

    Attributes:
        centre, scale, rotation: Steps of a Gaussian's centre, logarithm of the scale and rotation.
        latent: Step of the latents, times the norm of their weights in the first layer.
        first: Step of the first layer's weights of latents, times the norm of the latents.
        position: Step of the first layer's weights of positions, and of its biases.
        second, third: Steps of the second and the third layer.
    """

    centre: float
    scale: float
    rotation: float
    latent: float
    first: float
    position: float
    second: float
    third: float


class _Search:
    """Finds the integers of a model for given steps, and the error that they cause."""

    def __init__(
        self, content: Gaussians, x: np.ndarray, wanted: np.ndarray, faint: float, device: str, pictured: bool
    ) -> None:
        self._sphere = content.support == "sphere"
        self._x = torch.from_numpy(x.astype(np.float64)).to(device)
        self._wanted = self._put(wanted)
        rows = least_turned(content.rows())
        centre = rows[:, STORED_CENTRE]
        order = np.argsort(morton_keys(np.rint((centre - centre.min(0)) * CODES / 4).astype(np.int64)))
        self._rows = rows = rows[order]
        self._layers = [layer.astype(np.float64) for layer in content.layers()]
        self._latent = self._latents(rows[:, : STORED_LATENT.start], rows[:, STORED_LATENT])
        self._inside = []  # inputs of the second and of the third layer, before the sigmoid
        inputs = self._inputs(self._latent)
        for layer in self._layers[:2]:
            self._inside.append(inputs @ self._put(layer))
            inputs = _with_one(self._inside[-1].sigmoid())
        self._faint = faint
        result = inputs @ self._put(self._layers[2])
        self._base, self._aim = self._error(result), result if pictured else self._wanted
        # Change of the first layer's sums by one unit of each latent, and by one unit of its weight.
        first = self._layers[0][: self._latent.shape[1]]
        self._of_latent = 1.0 / _positive(np.linalg.norm(first, axis=1))
        self._of_first = 1.0 / _positive(self._latent.square().mean(0).sqrt().cpu().numpy())

    def within(self, growth: float) -> WholeNumbers | None:
        """Returns the coarsest integers found with which the error grows by at most the fraction `growth`, or None."""
        best, natural, most = None, self._natural(), (1.0 + growth) * self._base
        least, times, tried = 0.0, 1.0, []
        for _ in range(_TRIES):
            whole, error = self._rounded(_Steps(*(natural * times)))
            tried.append((times**2, error))
            if error <= most and times > least:
                best, least = whole, times
                if error >= most - (1.0 - _NEAR) * growth * self._base:
                    break
            # The error is about that without rounding plus a multiple of the squared step.
            (square, last), (other, before) = tried[-1], tried[-2] if len(tried) > 1 else (0.0, self._base)
            slope = (last - before) / (square - other) if square != other else 0.0
            wanted = square + (most - 0.5 * (1.0 - _NEAR) * growth * self._base - last) / slope if slope > 0.0 else 0.0
            times *= math.sqrt(min(max(wanted / square, 1 / 8), 8.0)) if slope > 0.0 else 2.0
        return best

    def finest(self) -> WholeNumbers:
        """Returns integers with steps so fine that rounding has hardly any effect."""
        return self._rounded(_Steps(*(self._natural() * _FINEST)))[0]

    def _natural(self) -> np.ndarray:
        """Returns a rounding step for each of eight groups of numbers, float64 [8], that give about equal errors."""
        rows, (first, second, third) = self._rows, self._layers
        latents = first[: len(self._of_latent)]
        slender = np.expm1(np.ptp(rows[:, STORED_SCALE], axis=1))
        units = [1.0 / _rms(np.exp(-rows[:, STORED_SCALE].min(1))), 1.0, min(1.0 / _rms(slender), 1.0)]
        units.append(_rms(rows[:, STORED_LATENT] / self._of_latent))
        units += map(_rms, (latents / self._of_first[:, None], first[len(latents) :], second, third))
        return np.array(units) * _SHARES

    def _rounded(self, steps: _Steps) -> tuple[WholeNumbers, float]:
        """Returns the integers for given steps, and the mean squared error of the network's outputs."""
        rows, latents, start = self._rows, self._latent.shape[1], STORED_LATENT.start
        step = np.concatenate([np.repeat(steps[:3], 3), steps.latent * self._of_latent])
        least = np.ptp(rows, axis=0) * (1.01 / CODES)
        least[STORED_ROTATION] = 1.0 / CODES
        step = np.array([stored_step(each) for each in np.maximum(step, least)])
        whole = np.rint(rows[:, :start] / step[:start])
        turn = whole[:, STORED_ROTATION] * step[STORED_ROTATION]
        # A file holds at most half a turn, which only steps that are far too coarse exceed.
        whole[np.square(turn).sum(1) > 1.0, STORED_ROTATION] = 0.0
        moved, latent, weight, feed = whole * step[:start], rows[:, STORED_LATENT], None, None
        if len(rows) <= _TOGETHER:
            weight = torch.cat(list(self._weights(moved)))
            square = weight.T @ weight
            latent, feed = _fitted(square, weight.T @ self._latent, self._put(latent), _OF_LATENTS)
        latent = _fed(latent, np.tile(step[STORED_LATENT], (len(rows), 1)), feed, CODES // 2)
        net_step = [steps.first * each for each in self._of_first]
        net_step += [steps.position] * 4 + [steps.second, steps.third]
        net_step = np.array([stored_step(each) for each in net_step])
        inputs = self._inputs(self._latents(moved, latent * step[STORED_LATENT], weight))
        net = []
        wanted = [*self._inside, self._aim]
        for number, layer in enumerate(self._layers):
            own = net_step[: latents + 4] if number == 0 else np.full(len(layer), net_step[latents + 3 + number])
            square = inputs.T @ inputs
            fitted, own_feed = _fitted(square, inputs.T @ wanted[number], self._put(layer), _OF_LAYERS)
            net.append(_fed(fitted, np.repeat(own[:, None], layer.shape[1], 1), own_feed, LARGEST))
            result = inputs @ self._put(net[-1] * own[:, None])
            inputs = _with_one(result.sigmoid())
        numbers = np.concatenate([whole, latent], 1).astype(np.int64)
        centre = numbers[:, STORED_CENTRE] - numbers[:, STORED_CENTRE].min(0)
        numbers = numbers[np.argsort(morton_keys(centre), kind="stable")]
        packed = WholeNumbers(numbers, step, tuple(layer.astype(np.int64) for layer in net), net_step)
        return packed, self._error(result)

    def _error(self, result: torch.Tensor) -> float:
        return float((result - self._wanted).square().mean()) + self._faint

    def _weights(self, rows: np.ndarray) -> Iterator[torch.Tensor]:
        """Yields the weights of Gaussians [K, 9] at the probes, float64 [n, K], for n probes at a time."""
        scale = np.exp(rows[:, STORED_SCALE])
        whiten = (
            Rotation.from_mrp(rows[:, STORED_ROTATION]).as_matrix().transpose(0, 2, 1) / scale[:, :, None]
        )  # S^-1 R^T
        middle = self._put(np.einsum("kij,kj->ki", whiten, rows[:, STORED_CENTRE]))
        flat, centre = self._put(whiten.reshape(-1, 3).T), self._put(rows[:, STORED_CENTRE])
        reach = self._put(np.square(CUT * scale.max(1)))
        for x in self._x.split(max(1, _PIECE // len(rows))):
            square = ((x @ flat).reshape(-1, len(rows), 3) - middle).square_().sum(2)
            reached = (x[:, None] - centre).square_().sum(2) < reach if self._sphere else square < CUT**2
            yield square.mul_(-0.5).exp_().mul_(reached)

    def _latents(self, rows: np.ndarray, latent: np.ndarray, weight: torch.Tensor | None = None) -> torch.Tensor:
        """Returns the weighted sum of latents at each probe, float64 [N, L] on the device; `weight`, if known, is that
        of the Gaussians `rows` [K, 9] at the probes, [N, K]."""
        latents = self._put(latent)
        pieces = self._weights(rows) if weight is None else [weight]
        return torch.cat([weight @ latents for weight in pieces])

    def _put(self, numbers: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(numbers)).to(self._x.device)

    def _inputs(self, latent: torch.Tensor) -> torch.Tensor:
        return _with_one(torch.cat([latent, self._x], 1))


def stored_step(step: float) -> float:
    """Rounds a positive step to the upper 16 bits of a float32, as a file stores it."""
    bits = max(int(np.array(step, np.float32).view(np.uint32)) + 0x8000 >> 16, 1)
    return float(np.array(bits << 16, np.uint32).view(np.float32))


def _fitted(
    square: torch.Tensor, right: torch.Tensor, before: torch.Tensor, share: float
) -> tuple[np.ndarray, np.ndarray]:
    """Solves normal equations with ridge regularisation, `share` of the mean of the diagonal, towards the solution
    `before`. Returns the solution and the upper Cholesky factor of the inverse of the regularised matrix, [I, I]."""
    ridge = max(share * float(square.trace()) / len(square), np.finfo(np.float32).tiny)
    one = torch.eye(len(square), dtype=square.dtype, device=square.device)
    # A = R R^T with upper R, so that A^-1 = U^T U with U = R^-1.
    root = torch.linalg.cholesky((square + ridge * one).flip(0, 1)).flip(0, 1)
    upper = torch.linalg.solve_triangular(root, one, upper=True)
    return (upper.T @ (upper @ (right + ridge * before))).cpu().numpy(), upper.cpu().numpy()


def _fed(numbers: np.ndarray, step: np.ndarray, feed: np.ndarray | None, most: int) -> np.ndarray:
    """Divides numbers [I, O] by steps and rounds them to -most to most, row by row; later rows make up for errors."""
    if feed is None:
        return np.clip(np.rint(numbers / step), -most, most)
    numbers, whole = numbers.copy(), np.empty_like(numbers)
    for start in range(0, len(numbers), _ROWS):
        # Rows behind these make up for all of them at once.
        part = slice(start, start + _ROWS)
        own, over = numbers[part], np.empty_like(numbers[part])
        for row, (left, size, factor) in enumerate(zip(own, step[part], feed[part, part], strict=True)):
            whole[start + row] = np.rint(left / size).clip(-most, most)
            over[row] = (left - whole[start + row] * size) / factor[row]
            own[row + 1 :] -= factor[row + 1 :, None] * over[row]
        numbers[start + _ROWS :] -= feed[part, start + _ROWS :].T @ over
    return whole


def _with_one(inputs: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.pad(inputs, (0, 1), value=1.0)


def _positive(numbers: np.ndarray) -> np.ndarray:
    """Replaces numbers below a thousandth of the largest number by the largest number."""
    most = float(numbers.max()) or 1.0
    return np.where(numbers > 1e-3 * most, numbers, most)


def _rms(numbers: np.ndarray) -> float:
    return float(np.sqrt(np.square(numbers).mean())) or 1.0
