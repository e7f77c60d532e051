"""Reads and writes principal components in files."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from wlm.formats.parts import Part
from wlm.probe.model import Profile
from wlm.probe.pca.model import Components

_MOST_LOG = 88.0  # the exponential still fits float32


def settings(content: Components) -> dict[str, Any]:
    """Returns the setting for the file's header: the number of components."""
    return {"count": content.count}


def table(live: int, outputs: int, count: int) -> dict[str, Part]:
    """Returns the types and shapes, by name, of the arrays that store `live` probes in `count` components.

    Raises:
        ValueError: There are more components than numbers of a probe.
    """
    if count > outputs:
        raise ValueError(f"setting count: expected at most {outputs} components, found {count}")
    return {
        "code": Part(np.uint8, (1 + count, live)),
        "bounds": Part(np.float16, (2, 1 + count)),
        "basis": Part(np.float16, (0 if count == outputs else count, outputs)),
    }


def parts(content: Components) -> dict[str, np.ndarray]:
    """Returns the arrays by name; codes are stored column by column."""
    return {"code": content.code.T, "bounds": content.bounds, "basis": content.basis}


def content(profile: Profile, outputs: int, stored: Mapping[str, np.ndarray], dropped: int) -> Components:
    """Builds the principal components from a file's arrays; `dropped` is not used.

    Raises:
        ValueError: The numbers exceed what a decoder can compute in float32.
    """
    bounds = stored["bounds"].astype(np.float64)
    most = np.maximum(np.abs(bounds[0]), np.abs(bounds[0] + 255.0 * bounds[1]))
    largest = float(np.abs(stored["basis"].astype(np.float64)).max(initial=0.0)) if stored["basis"].size else 1.0
    if (bounds[1] < 0).any() or most[0] > _MOST_LOG:
        raise ValueError(f"part bounds: expected steps of at least 0, and log magnitudes within {_MOST_LOG:g}")
    if not np.exp(most[0]) * most[1:].sum() * largest <= np.finfo(np.float32).max:
        raise ValueError("parts bounds and basis: expected light within the range of float32")
    return Components(outputs, np.ascontiguousarray(stored["code"].T), stored["bounds"], stored["basis"])
