"""Scores the sum of light groups, all at full weight, by the paper's protocol (neural-dynamic-gi, section 10.2).

The sum is compared with the sum of the originals, whose error is that of the groups alone, and with a bake of all
lights together, whose error also has the noise of both bakes, and any light that is in one of them only.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from wlm.errors import WlmError
from wlm.lightmap.data import LightmapSet, SheetFrames
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.groups import times_of
from wlm.lightmap.model import LightmapModel, SheetModel
from wlm.lightmap.profile import TimeAxis
from wlm.lightmap.sheet import BASE, Sheet
from wlm.lightmap.tiles import TILE, TileKind
from wlm.metrics import Summary, evaluate_frame, summarise

ORIGINALS, BAKE = "originals of the groups", "bake of all lights"
"""What a sum is compared with."""


@dataclass(frozen=True)
class SumScore(Summary):
    """Error of the sum of all groups of a sheet over tiles and times; the scores are those of `Summary`.

    Attributes:
        sheet: Label of the sheet, without a group.
        reference: `ORIGINALS` or `BAKE`.
        times: float64 [T], the times that are scored.
    """

    sheet: str
    reference: str
    times: np.ndarray


def score_sums(
    model: LightmapModel,
    lightmaps: LightmapSet,
    all_lights: LightmapSet | None,
    device: str,
    metrics: Sequence[str],
) -> list[SumScore]:
    """Scores the sum of the groups of each sheet of light.

    Args:
        model: The model.
        lightmaps: Its input, with the same sheets.
        all_lights: A bake of all lights together, without groups, at any times; None: there is none.
        device: Device that decodes.
        metrics: Any of `wlm.metrics.METRICS`.

    Returns:
        Of each sheet in several groups the score against the originals, and of each sheet that is in `all_lights` the
        score against it.

    Raises:
        WlmError: `all_lights` has another size, groups, or no sheet of the model.
    """
    scores: list[SumScore] = []
    wanted = {} if all_lights is None else dict(all_lights.sheets)
    for plain in dict.fromkeys(replace(sheet, group=BASE) for sheet in model.sheets if not sheet.linear):
        groups = {sheet: own for sheet, own in model.sheets.items() if replace(sheet, group=BASE) == plain}
        decoders = [SheetDecoder(own, device) for own in groups.values()]
        references: dict[str, list[SheetFrames]] = {}
        if len(groups) > 1:
            references[ORIGINALS] = [lightmaps.sheets[sheet] for sheet in groups]
        if (bake := wanted.pop(plain, None)) is not None:
            first = next(iter(groups.values()))
            if bake.mask.shape != (first.height, first.width):
                height, width = bake.mask.shape
                raise WlmError(f"{bake.name}: expected lightmaps of {first.width}x{first.height}, got {width}x{height}")
            references[BAKE] = [bake]
        for reference, originals in references.items():
            times = times_of(dict(zip(groups, originals, strict=False)))
            frames = []
            for time in times.tolist():
                decoded = sum(decoder.frame(time) for decoder in decoders)
                expected = sum(_at(own, time) for own in originals)
                mask = _scored(groups) & originals[0].mask
                frames.append(evaluate_frame(expected, decoded, mask, TILE, metrics, name=f"{model.name} at {time:g}"))
            summary = summarise(frames, times)
            scores.append(SumScore(**vars(summary), sheet=plain.label, reference=reference, times=times))
    if wanted:
        sheet = next(iter(wanted))
        raise WlmError(f"{all_lights.name}: expected light of the sheets of {model.name}, found {sheet.label}")
    return scores


def _scored(groups: Mapping[Sheet, SheetModel]) -> np.ndarray:
    """Returns the valid texels in tiles that some group stores, bool [H, W]."""
    own = next(iter(groups.values()))
    stored = np.any([each.kind != TileKind.EMPTY for each in groups.values()], axis=0)
    return own.mask & own.grid.texels_of(stored.reshape(own.grid.rows, own.grid.cols))


def _at(lightmaps: SheetFrames, time: float) -> np.ndarray:
    """Returns the original light at a time, between two stored times interpolated (eq. 2), [H, W, 3]."""
    before, after, share = TimeAxis(lightmaps.times, lightmaps.period, "frames").neighbours(time)
    if share == 0.0:
        return lightmaps.frames[before]
    return (1.0 - share) * lightmaps.frames[before] + share * lightmaps.frames[after]
