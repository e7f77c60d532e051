"""Reads and writes Gaussians in files: quantised integers, and the upper 16 bits of each float32 quantisation step."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from wlm.formats.parts import Part
from wlm.probe.gaussian.model import LARGEST, LATENT, SCALE, Gaussians, WholeNumbers, layer_shapes
from wlm.probe.model import Profile

_MOST, _MOST_LOG = 1e38, 40.0


def settings(content: Gaussians) -> dict[str, Any]:
    """Returns settings for the file's header: the number of stored Gaussians, and of those that the fit dropped."""
    return {"count": content.count, "dropped": content.dropped}


def table(profile: Profile, outputs: int, count: int) -> dict[str, Part]:
    """Returns the types and shapes, by name, of the arrays that store `count` Gaussians."""
    channels = 9 + profile.latent
    weights = sum(rows * columns for rows, columns in layer_shapes(profile.latent, profile.hidden, outputs))
    return {
        "gain": Part(np.float64, (1,), least=0.0, most=float(np.finfo(np.float32).max)),
        "lowest": Part(np.int32, (channels,)),
        "gaussians": Part(np.uint16, (channels, count)),
        "steps": Part(np.uint16, (channels + profile.latent + 6,)),
        "network": Part(np.int32, (weights,), least=-LARGEST, most=LARGEST),
    }


def parts(content: Gaussians) -> dict[str, np.ndarray]:
    """Returns the arrays by name; Gaussians are stored channel by channel, minus the lowest number of each channel."""
    whole = content.whole
    if whole is None:
        raise ValueError("expected Gaussians quantised to integers, as `compress` returns them")
    lowest = whole.gaussians.min(0)
    steps = np.concatenate([whole.step, whole.net_step]).astype(np.float32)
    return {
        "gain": np.array([content.gain]),
        "lowest": lowest.astype(np.int32),
        "gaussians": (whole.gaussians - lowest).T.astype(np.uint16),
        "steps": (steps.view(np.uint32) >> 16).astype(np.uint16),
        "network": np.concatenate([layer.ravel() for layer in whole.net]).astype(np.int32),
    }


def content(profile: Profile, outputs: int, stored: Mapping[str, np.ndarray], dropped: int) -> Gaussians:
    """Builds the Gaussians and their network from a file's arrays; `dropped`: number of Gaussians that the fit dropped.

    Raises:
        ValueError: The numbers contradict each other, or exceed what a decoder can compute in float32.
    """
    latent, hidden = profile.latent, profile.hidden
    shapes = layer_shapes(latent, hidden, outputs)
    layers = np.split(stored["network"].astype(np.int64), np.cumsum([rows * columns for rows, columns in shapes])[:-1])
    steps = (stored["steps"].astype(np.uint32) << 16).view(np.float32).astype(np.float64)
    if not (np.isfinite(steps).all() and (steps > 0).all()):
        raise ValueError("part steps: expected finite quantisation steps above 0")
    whole = WholeNumbers(
        gaussians=stored["gaussians"].T.astype(np.int64) + stored["lowest"],
        step=steps[: 9 + latent],
        net=tuple(layer.reshape(shape) for layer, shape in zip(layers, shapes, strict=True)),
        net_step=steps[9 + latent :],
    )
    return _checked(
        Gaussians(
            latent=latent,
            hidden=hidden,
            outputs=outputs,
            support=profile.support,
            gain=float(stored["gain"][0]),
            dropped=dropped,
            whole=whole,
            **whole.codes(),
        )
    )


def _checked(content: Gaussians) -> Gaussians:
    """Returns the content after checking that no number in its decoding exceeds float32."""
    bounds = content.bounds
    # The difference of any two bounds must be finite, and so must the squares of scales and of their inverses.
    if not np.abs(bounds).max() <= _MOST:
        raise ValueError(f"part gaussians: expected numbers of at most {_MOST:g} in magnitude")
    if np.abs(bounds[:, SCALE]).max() > _MOST_LOG:
        raise ValueError(f"part gaussians: expected logarithms of scales of at most {_MOST_LOG:g} in magnitude")
    if not content.gain > 0:
        raise ValueError("part gain: expected a positive number")
    first, _, third = (np.abs(layer.astype(np.float64)) for layer in content.layers())
    sums = content.count * np.abs(bounds[:, LATENT].astype(np.float64)).max(0)
    first *= np.concatenate([np.maximum(sums, 1.0), np.ones(4)])[:, None]
    most = max(first.sum(0).max(), content.gain * third.sum(0).max())
    if not most <= np.finfo(np.float32).max:
        raise ValueError("parts network, gaussians and gain: expected light within the range of float32")
    return content
