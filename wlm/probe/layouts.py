"""Order of the numbers of spherical harmonics in RGB, and whether numbers are plausible as light.

Engines store the numbers of a probe coefficient by coefficient (r0 g0 b0 r1 ...) or channel by channel (r0 r1 ... g0
...). Light is not negative, which bounds each band: by the addition theorem, the root of the sum of squares of the
coefficients of band l is at most sqrt(2l + 1) times the first coefficient. Numbers in another order or convention
exceed the bound, or have channels that do not resemble each other.
"""

import numpy as np

from wlm.probe.conventions import CANONICAL, CONVENTIONS, to_canonical
from wlm.probe.sphere import coefficient_bands

COEFFICIENT, CHANNEL = ORDERS = ("coefficient", "channel")

ORDER_TEXTS = {
    COEFFICIENT: "coefficient by coefficient (r0 g0 b0 r1 ...)",
    CHANNEL: "channel by channel (r0 r1 ... g0 ...)",
}
"""Descriptions of the orders."""

_SLACK = 1.1  # bakers filter and clamp, which exceeds the bound slightly
_FEW = 0.01  # share of probes beyond the bound that needs no warning
_APART = 0.1  # difference of shares that decides between orders, and largest share of an order that fits
_TINTED = 0.1  # share of the squares in the differences of channels: natural light has some hundredths
_SAMPLE = 256  # probes that are checked


def coefficients_first(values: np.ndarray, order: str) -> np.ndarray:
    """Arranges numbers of spherical harmonics in RGB, [N, 3 C] in any shape, as [N, C, 3]."""
    if order == CHANNEL:
        return values.reshape(len(values), 3, -1).transpose(0, 2, 1)
    return values.reshape(len(values), -1, 3)


def choose_order(values: np.ndarray, convention: str, order: str | None) -> tuple[str, tuple[str, ...]]:
    """Chooses the order of the numbers of spherical harmonics in RGB, and checks whether they can be light.

    Args:
        values: [N, C, 3], [N, 3, C] or [N, 3 C] of numbers.
        convention: One of `wlm.probe.conventions.CONVENTIONS`.
        order: One of `ORDERS`; None takes the order that the shape shows, and for [N, 3 C] the one that fits light,
            coefficient by coefficient if both do.

    Returns:
        The order, and a warning for each doubt, which names the alternative.

    Raises:
        WlmError: The convention does not fit the numbers.
    """
    sample = values[:: max(1, len(values) // _SAMPLE)].astype(np.float64)
    sample = sample[np.isfinite(sample).all(axis=tuple(range(1, sample.ndim)))].reshape(-1, values[0].size)
    sample = sample[(sample != 0.0).any(axis=1)]
    known = order or (CHANNEL if values.ndim == 3 and values.shape[2] != 3 else COEFFICIENT)
    if not len(sample):
        return known, ()
    other = ORDERS[known == COEFFICIENT]
    fit = _doubt(sample, known, convention)
    # Most numbers fit in the known order, which spares the comparison.
    if (fit[0] > _APART or fit[1] > _TINTED) and _better(_doubt(sample, other, convention), fit):
        if order is None and values.ndim == 2:
            return other, (f"read {ORDER_TEXTS[other]}, which fits light better; --order {known} overrides",)
        text = f"{ORDER_TEXTS[known]} does not fit light: is it {ORDER_TEXTS[other]}? Then add --order {other}"
        return known, (text,)
    share = fit[0]
    if share <= _FEW:
        return known, ()
    text = f"{share:.0%} of the probes have a first coefficient, the mean, that is too small for the others to be light"
    last = values[0].size > 27  # bands that unreal and unity lack
    others = [each for each in CONVENTIONS if not (last and each in ("unreal", "unity"))]
    fitting = [each for each in others if _doubt(sample, known, each)[0] < share / 4.0]
    hint = f"--convention {' or '.join(fitting)} fits" if fitting else "is it another order, basis or convention?"
    return known, (f"{text}: {hint}",)


def _doubt(sample: np.ndarray, order: str, convention: str) -> tuple[float, float]:
    """Reads probes [N, 3 C] in an order; returns the share of them that cannot be light, and the share of the sum of
    squares that is in differences between channels."""
    sample = sample / np.abs(sample).max(axis=1, keepdims=True)
    light = to_canonical(coefficients_first(sample, order), convention)
    band, first = coefficient_bands(light.shape[1]), light[:, :1]
    squares = light * light
    sizes = np.add.reduceat(squares, np.flatnonzero(np.diff(band, prepend=-1)), axis=1)[:, 1:]
    most = _SLACK * np.sqrt(2.0 * np.arange(1, band[-1] + 1) + 1.0)[:, None] * first + 1e-6
    wrong = (first < 0.0).any(axis=(1, 2)) | (sizes > most * most).any(axis=(1, 2))
    tint = 1.0 - np.square(light.sum(axis=2)).sum() / (3.0 * squares.sum())
    return float(wrong.mean()), float(tint)


def _better(one: tuple[float, float], other: tuple[float, float]) -> bool:
    if one[0] > _APART or one[0] > other[0] + _FEW:
        return False
    return other[0] > one[0] + _APART or other[1] > max(_TINTED, 3.0 * one[1])


def described(convention: str, origin: str, order: str, certain: bool) -> str:
    """Describes how SH were read, in one clause; `origin` is where the convention comes from, "" if it is assumed."""
    name = "three.js (wlm's own)" if convention == CANONICAL else convention
    found = origin or "assumed: --convention states another"
    numbers = ORDER_TEXTS[order] + ("" if certain else ", assumed: --order states another")
    return f"SH of radiance in the file's unit; convention {name}, {found}; {numbers}"
