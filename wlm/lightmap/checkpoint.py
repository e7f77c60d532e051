"""What a lightmap fit depends on, and so what its checkpoint must name."""

import os
from collections.abc import Sequence

from wlm.formats.checkpoint import Checkpoint
from wlm.lightmap.data import LightmapSet
from wlm.lightmap.model import Profile

__all__ = ["open_checkpoint"]


def open_checkpoint(
    output: str | os.PathLike[str],
    lightmaps: LightmapSet,
    profile: Profile,
    *,
    tiles: Sequence[int] | None = None,
    seed: int = 0,
    device: str = "cpu",
    resume: bool = False,
) -> Checkpoint:
    """Opens the checkpoint of a fit; the arguments are those of ``wlm.lightmap.fit.compress``.

    Args:
        output: The file that the fit is for; the checkpoint lies beside it.
        lightmaps: The set.
        profile: The settings.
        tiles: Numbers of the tiles, None for all.
        seed: The seed.
        device: "cpu", "cuda" or "cuda:N"; only the kind matters, a fit may go on on another GPU.
        resume: Whether to go on from the file, if there is one. Otherwise it is ignored, and replaced at the
            first save.

    Raises:
        WlmError: With ``resume``: the file is damaged, or of another fit; the line names what differs.
    """
    fit = {
        "input": lightmaps.source,
        # Not in the input's hash, and yet the time axis wraps by it.
        "period": lightmaps.period,
        "profile": profile.model_dump(mode="json"),
        "tiles": None if tiles is None else sorted(int(tile) for tile in tiles),
        "seed": int(seed),
        "device": "cpu" if device == "cpu" else "cuda",
    }
    return Checkpoint(output, "lightmap", fit, lightmaps.source, resume=resume)
