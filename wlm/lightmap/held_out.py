"""Scores a model at times of its input that it does not store: those that were left out of the fit.

Such a score tells how well the stored times and the interpolation between them stand for the hours that a scene shows.
`LightmapSet.without` leaves times out; `wlm.lightmap.evaluation.evaluate` takes the whole set.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wlm.errors import WlmError
from wlm.lightmap.data import LightmapSet, SheetFrames, at_times
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.model import LightmapModel, SheetModel
from wlm.lightmap.tiles import TILE
from wlm.metrics import Summary, evaluate_frame, summarise


@dataclass(frozen=True)
class HeldOut:
    """Error of a sheet at the times that its model does not store.

    Attributes:
        times: float64 [K], these times.
        decoded: Scores of the decoded light.
        mixed: For comparison, scores of the input's own lightmaps at the two neighbouring stored times, interpolated
            linearly (neural-dynamic-gi, eq. 2): the error of leaving the times out, without that of compression.
    """

    times: np.ndarray
    decoded: Summary
    mixed: Summary


def stored_part(model: LightmapModel, lightmaps: LightmapSet) -> LightmapSet:
    """Returns a set with the same sheets as a model, without the times that the model does not store."""
    sheets = {}
    for sheet, own in model.sheets.items():
        frames = lightmaps.sheets[sheet]
        found = at_times(frames.times, own.times)
        if (found < 0).any():
            time = own.times[np.argmin(found)]
            raise WlmError(f"{frames.name}: expected a lightmap at {time:g}, as in the file {own.name}, found none")
        sheets[sheet] = frames if len(found) == len(frames.times) else frames.select(found)
    return LightmapSet(lightmaps.name, sheets)


def score_held_out(
    model: SheetModel, stored: SheetFrames, whole: SheetFrames, device: str, metrics: Sequence[str]
) -> HeldOut | None:
    """Scores a sheet at the times that its model does not store; None if there are none. `stored` is its input at the
    stored times, from `stored_part`, and `whole` the whole input; `metrics` are any of `wlm.metrics.METRICS`."""
    held = np.setdiff1d(np.arange(len(whole.times)), at_times(whole.times, stored.times))
    if not len(held):
        return None
    decoder, mask = SheetDecoder(model, device), stored.mask & model.stored_texels
    frames: tuple[list, list] = ([], [])
    for i in held.tolist():
        time = float(whole.times[i])
        for scores, light in zip(frames, (decoder.frame(time), stored.at(time)), strict=True):
            options = {"name": f"{model.name} at {time:g}", "peak": model.profile.peak}
            scores.append(evaluate_frame(whole.frames[i], light, mask & whole.valid(i), TILE, metrics, **options))
    times = whole.times[held]
    return HeldOut(times, *(summarise(scores, times) for scores in frames))
