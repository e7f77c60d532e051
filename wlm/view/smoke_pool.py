"""Pictures of what a network learns from: guiding maps, lightmaps and motion, a column a sample."""

from __future__ import annotations

import os

import numpy as np
import torch

from wlm.smoke.planes import GUIDES, PLANES, Pool
from wlm.view.smoke import MOST_COLUMNS, contact_sheet

__all__ = ["pool_sheet"]


def pool_sheet(path: str | os.PathLike[str], pool: Pool, *, columns: int = MOST_COLUMNS) -> tuple[int, ...]:
    """Writes a contact sheet of the later frames; the planes are shown as they are encoded, 1 is white.

    Motion is red where it goes to the right and green where it goes up, dark in these the other way; half of both is no
    motion, and the strongest in the pool is the fullest.

    Args:
        path: The PNG to write; its folder must exist.
        pool: At least one sample.
        columns: Samples shown at most, evenly spread.

    Returns:
        The numbers of those.

    Raises:
        ValueError: The pool is empty.
        WlmError: The file can't be written.
    """
    if not len(pool):
        raise ValueError("pool: expected at least one sample, got none")
    chosen = np.unique(np.linspace(0, len(pool) - 1, min(columns, len(pool))).round()).astype(int)
    planes = next(names for names in GUIDES.values() if len(names) == pool.guides.shape[2])
    rows = {f"guide: {name}": [_grey(pool.guides[i, 1, k]) for i in chosen] for k, name in enumerate(planes)}
    rows |= {name: [_grey(pool.targets[i, 1, k]) for i in chosen] for k, name in enumerate(PLANES)}
    strongest = max(float(pool.motion.abs().max()), 1e-6)
    rows["motion"] = [_arrows(pool.motion[i], strongest) for i in chosen]
    titles = [f"{int(i)} of {int(pool.sequence[i])}" for i in chosen]
    contact_sheet(path, rows, titles, columns=len(chosen))
    return tuple(map(int, chosen))


def _grey(plane: torch.Tensor) -> np.ndarray:
    shown = (plane.float().clamp(0.0, 1.0) * 255.0 + 0.5).to(torch.uint8).cpu().numpy()
    return np.repeat(shown[..., None], 3, axis=2)


def _arrows(motion: torch.Tensor, strongest: float) -> np.ndarray:
    right, down = (motion.float() / strongest).cpu().numpy()
    colour = 0.5 + 0.5 * np.stack([right, -down, np.zeros_like(right)], -1)
    return (np.clip(colour, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
