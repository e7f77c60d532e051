"""Contact sheets of training samples: guiding maps, lightmaps and motion, one column per sample."""

import os

import numpy as np
import torch

from wlm.smoke.network.planes import GUIDES, PLANES
from wlm.smoke.network.pool import Pool
from wlm.view.smoke import MOST_COLUMNS, contact_sheet


def pool_sheet(path: str | os.PathLike[str], pool: Pool, *, columns: int = MOST_COLUMNS) -> tuple[int, ...]:
    """Writes a contact sheet of the later frames, with planes as they are encoded, 1 in white.

    Motion to the right is red and motion upwards green, the opposite ways dark; both at half is no motion. The fastest
    motion in the pool has the full colour.

    Args:
        path: The PNG to write; its folder must exist.
        pool: At least one sample.
        columns: Most samples shown, evenly spread.

    Returns:
        Their numbers.

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
    fastest = max(float(pool.motion.abs().max()), 1e-6)
    rows["motion"] = [_colour(pool.motion[i], fastest) for i in chosen]
    titles = [f"{int(i)} of {int(pool.sequence[i])}" for i in chosen]
    contact_sheet(path, rows, titles, columns=len(chosen))
    return tuple(map(int, chosen))


def _grey(plane: torch.Tensor) -> np.ndarray:
    levels = (plane.float().clamp(0.0, 1.0) * 255.0 + 0.5).to(torch.uint8).cpu().numpy()
    return np.repeat(levels[..., None], 3, axis=2)


def _colour(motion: torch.Tensor, fastest: float) -> np.ndarray:
    right, down = (motion.float() / fastest).cpu().numpy()
    colour = 0.5 + 0.5 * np.stack([right, -down, np.zeros_like(right)], -1)
    return (np.clip(colour, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
