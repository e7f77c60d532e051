"""Scores the sum of light groups, all at full weight, by the paper's protocol (neural-dynamic-gi, section 10.2).

The sum is compared with the sum of the originals, whose error is that of the groups alone, and with a bake of all
lights together, whose error also has the noise of both bakes, and any light that is in one of them only.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from wlm.errors import WlmError
from wlm.lightmap.data import LightmapSet, SheetFrames
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.groups import in_groups, times_of
from wlm.lightmap.model import LightmapModel
from wlm.lightmap.sheet import Sheet
from wlm.lightmap.tiles import TILE
from wlm.metrics import Summary, evaluate_frame, summarise

ORIGINALS, BAKE = "originals of the groups", "bake of all lights"
"""References with which a sum is compared."""


@dataclass(frozen=True)
class SumScore(Summary):
    """Error of the sum of all groups of a sheet over tiles and times; the scores are those of `Summary`.

    `sheet` is the sheet's label, without a group; `reference` is `ORIGINALS` or `BAKE`. `between_inputs` is the PSNR of
    the sum of the originals against the reference, in dB: the noise of the bakes, which no compression can undo; NaN if
    the reference is that sum itself.
    """

    sheet: str
    reference: str
    times: np.ndarray
    between_inputs: float


def score_sums(
    model: LightmapModel, lightmaps: LightmapSet, all_lights: LightmapSet | None, device: str, metrics: Sequence[str]
) -> list[SumScore]:
    """Scores the sum of the groups of each sheet of light by some of `wlm.metrics.METRICS`.

    `lightmaps` is the model's input, with the same sheets; `all_lights` is a bake of all lights together, without
    groups, at any times; None: there is none.

    Returns of each sheet in several groups the score against the originals, and of each sheet that is in `all_lights`
    the score against it.
    """
    scores: list[SumScore] = []
    wanted = {} if all_lights is None else dict(all_lights.sheets)
    for plain in dict.fromkeys(sheet.plain for sheet in model.sheets if not sheet.linear):
        groups = model.maps(plain)
        first, decoders = next(iter(groups.values())), [SheetDecoder(own, device) for own in groups.values()]
        together = sum_of(lightmaps, plain)
        references = {} if len(groups) == 1 else {ORIGINALS: together}
        if (bake := wanted.pop(plain, None)) is not None:
            if bake.mask.shape != (first.height, first.width):
                height, width = bake.mask.shape
                raise WlmError(f"{bake.name}: expected lightmaps of {first.width}x{first.height}, got {width}x{height}")
            references[BAKE] = bake
        mask = first.mask & np.any([own.stored_texels for own in groups.values()], axis=0)
        for reference, original in references.items():
            frames, inputs = [], []
            for i, time in enumerate(original.times.tolist()):
                decoded, name = sum(decoder.frame(time) for decoder in decoders), f"{model.name} at {time:g}"
                inside = mask & original.valid(i)
                frames.append(evaluate_frame(original.frames[i], decoded, inside, TILE, metrics, name=name))
                if reference == BAKE:
                    light = together.at(time)
                    inputs.append(evaluate_frame(original.frames[i], light, inside, TILE, ("psnr",), name=name))
            summary, labels = summarise(frames, original.times), {"sheet": plain.label, "reference": reference}
            between = summarise(inputs).psnr if inputs else float("nan")
            scores.append(SumScore(**vars(summary), **labels, times=original.times, between_inputs=between))
    if wanted:
        sheet = next(iter(wanted))
        raise WlmError(f"{all_lights.name}: expected light of the sheets of {model.name}, found {sheet.label}")
    return scores


def sum_of(lightmaps: LightmapSet, sheet: Sheet) -> SheetFrames:
    """Returns the sum of the light groups of an input as one sheet, at the times of all of them; `sheet` is that of any
    of its groups."""
    groups = in_groups(lightmaps.sheets, sheet)
    first, times = next(iter(groups.values())), times_of(groups)
    if len(groups) == 1:
        return first
    frames = np.zeros((len(times), *first.frames.shape[1:]), np.float32)
    for own in groups.values():
        for frame, time in zip(frames, times.tolist(), strict=True):
            frame += own.at(time)
    return replace(first, name=f"{lightmaps.name} {sheet.plain.label}", times=times, frames=frames, covered=None)
