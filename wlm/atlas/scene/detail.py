"""How much light varies from texel to texel: what a compression loses is in proportion to it, at equal bits.

Views and states are scored by PSNR, and a mean of PSNRs is one of logarithms: an error counts by what share it is of
all that its view, or its state, loses. So views and states weigh by the inverse of how much their light varies.
"""

from collections.abc import Sequence

import numpy as np
import torch

from wlm.atlas.scene.data import LightmappedScene

FLOOR = 1e-8
"""Of a squared peak, what is lost where no light varies."""

_PERCENTILE = 99.9  # of a state's light: its peak


def peaks_of(scene: LightmappedScene) -> np.ndarray:
    """The bright end of each state's light in charts, float64 [M], above 0."""
    light = [sheet.frames[:, sheet.mesh.mask].max(axis=2) for sheet in scene.sheets]
    peak = np.percentile(np.concatenate(light, axis=1), _PERCENTILE, axis=1)
    # A state of darkness is exact whatever its peak is.
    return np.where(peak > 0, peak, float(peak.max()) or 1.0).astype(np.float64)


def variation(scene: LightmappedScene, peak: np.ndarray, device: str) -> list[np.ndarray]:
    """Squared second differences of light, along both axes and within charts, mean of the channels.

    Args:
        scene: The scene.
        peak: float64 [M], `peaks_of`: light is divided by it.
        device: "cpu" or "cuda:N".

    Returns:
        For each sheet float32 [M, H, W].
    """
    result = []
    for sheet in scene.sheets:
        mask = torch.from_numpy(sheet.mesh.mask).to(device)
        frames = (torch.from_numpy(frame).to(device) / float(p) for frame, p in zip(sheet.frames, peak, strict=True))
        result.append(np.stack([_variation(frame, mask).cpu().numpy() for frame in frames]))
    return result


def _variation(light: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    result = torch.zeros(mask.shape, device=light.device)
    for values, inside, out in ((light, mask, result), (light.transpose(0, 1), mask.T, result.T)):
        bend = (values[:-2] - 2.0 * values[1:-1] + values[2:]).square().mean(2)
        out[1:-1] += bend * (inside[:-2] & inside[1:-1] & inside[2:])
    return result


def scales(varies: Sequence[np.ndarray], weights: Sequence[np.ndarray]) -> np.ndarray:
    """What light over its peaks is to be divided by so that it varies as much in each state.

    Args:
        varies: `variation`.
        weights: For each sheet [H, W], how much its texels count.

    Returns:
        float64 [M], of geometric mean 1.
    """
    sums = sum((each * weight).sum((1, 2), dtype=np.float64) for each, weight in zip(varies, weights, strict=True))
    total = sum(float(weight.sum()) for weight in weights)
    root = np.sqrt(sums / max(total, 1e-30) + FLOOR)
    return root / np.exp(np.log(root).mean())
