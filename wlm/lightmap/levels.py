"""Tiles stored as levels: those of 10 bits that a GPU reads, coded without loss, where little may be lost.

As in video a texel is a level between a least and a greatest colour of its tile at its time, in gamma space; but each
channel has its own two:

    colour = least + level / 1023 (greatest - least),     radiance = colour ** gamma

A flat ground of one hue has a narrow range in each channel, and all of its half floats among 1,024 levels. Levels are a
step apart, all three channels' the same share of the tile's whole range: the error of a tile is then the same in all
channels, and 6 dB less for a bit more of each texel and channel. No channel has more than 1,024.

From some bits a texel on this takes fewer bytes than AV1 for the same PSNR, and each tile is read alone.
"""

import math

import numpy as np

from wlm.lightmap.frames import round_half
from wlm.lightmap.streams import LEVELS, code_levels
from wlm.lightmap.tiles import TILE
from wlm.lightmap.video_packing import WHITE
from wlm.metrics import evaluate_frame

_LEAST_STEPS = 16.0
_NARROWER = 1.06  # steps that are tried next where some are too wide


def quantise(colour: np.ndarray, valid: np.ndarray, steps: float) -> tuple[np.ndarray, np.ndarray]:
    """Rounds a tile's colours to levels.

    Args:
        colour: float32 [T, 128, 128, 3], in gamma space.
        valid: bool [128, 128], one at least.
        steps: In the range of all channels at each time.

    Returns:
        Levels uint16 [T, 128, 128, 3], of which the valid texels' matter, and ranges half [T, 2, 3], least and
        greatest.
    """
    texels = colour[:, valid]
    ranges = np.stack([round_half(texels.min(1), -np.inf), round_half(texels.max(1), np.inf)], 1)
    least, greatest = ranges.astype(np.float64).swapaxes(0, 1)
    span = greatest - least
    whole = (texels.max((1, 2)) - texels.min((1, 2))).astype(np.float64)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        wanted = np.where(span > 0, np.ceil(span / whole * steps), 1.0)
    last = np.clip(wanted, 1.0, WHITE)[:, None, None]
    share = (colour - least[:, None, None]) / np.where(span > 0, span, 1.0)[:, None, None]
    place = np.rint(np.clip(share, 0.0, 1.0) * last)
    return np.rint(place * (WHITE / last)).astype(np.uint16), ranges


def encode_tile(colour: np.ndarray, valid: np.ndarray, steps: float) -> tuple[bytes, np.ndarray]:
    """Encodes a tile: its stream and its ranges, see `quantise`."""
    levels, ranges = quantise(colour, valid, steps)
    return code_levels(levels, valid), ranges


def steps_for(colour: np.ndarray, valid: np.ndarray, gamma: float, psnr: float) -> float:
    """The least steps that reach a PSNR, within some percent; all where none does.

    Args:
        colour, valid: As for `quantise`.
        gamma: Of the colours' space.
        psnr: By the tiled protocol, dB.
    """
    if math.isnan(psnr):  # what has no score needs none
        return _LEAST_STEPS
    steps = 256.0
    # Nearly 6 dB for twice the steps.
    steps = max(steps * 2.0 ** ((psnr - tile_psnr(colour, valid, gamma, steps)) / 6.02), _LEAST_STEPS)
    while tile_psnr(colour, valid, gamma, steps) < psnr:
        if steps > LEVELS * 64:
            return math.inf
        steps *= _NARROWER
    return steps


def tile_psnr(colour: np.ndarray, valid: np.ndarray, gamma: float, steps: float) -> float:
    """Mean PSNR of a tile's times as levels, dB; NaN where none has a score."""
    levels, ranges = quantise(colour, valid, steps)
    return mean_psnr(colour, decoded(levels, ranges), valid, gamma)


def decoded(levels: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    """Colours that levels stand for, float32 [T, 128, 128, 3]."""
    least, greatest = ranges.astype(np.float32).swapaxes(0, 1)[:, :, None, None]
    return least + levels * ((greatest - least) / np.float32(WHITE))


def mean_psnr(colour: np.ndarray, other: np.ndarray, valid: np.ndarray, gamma: float) -> float:
    """Mean PSNR of a tile's times by the tiled protocol, dB; NaN where none has a score.

    Args:
        colour, other: The original and what is compared with it, float32 [T, 128, 128, 3], in gamma space.
        valid: bool [128, 128].
        gamma: Of their space.
    """
    pairs = zip(colour, other, strict=True)
    scores = [evaluate_frame(a**gamma, b**gamma, valid, TILE, ("psnr",)).psnr[0, 0] for a, b in pairs]
    return float(np.nanmean(scores)) if np.isfinite(scores).any() else math.nan
