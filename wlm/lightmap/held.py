"""What each tile of a model got, what that takes in its file, and why."""

from dataclasses import dataclass

import numpy as np

from wlm.lightmap.codec import encode
from wlm.lightmap.level_packing import STEPS
from wlm.lightmap.model import LightmapModel
from wlm.lightmap.tiles import TileKind, valid_texels
from wlm.lightmap.video_packing import pages


@dataclass(frozen=True)
class HeldTile:
    """A tile of a model.

    Attributes:
        number, row, column: Where it is in the grid.
        kind: Of `TileKind`, in small letters.
        valid: Texels inside charts.
        bytes: Its own in the file: streams, frames or colours, without the ranges and scales of all tiles; of video its
            share of the page that it is in.
        why: What this kind is chosen for.
    """

    number: int
    row: int
    column: int
    kind: str
    valid: int
    bytes: int
    why: str


def held_tiles(model: LightmapModel) -> list[HeldTile]:
    """Lists the tiles of a model's grid, row by row."""
    stored = encode(model)[1]
    sizes = np.zeros(len(model.kind), int)
    if "stream_sizes" in stored:
        sizes[model.mapped] = stored["stream_sizes"].sum(1)
    if "frame_sizes" in stored:
        sizes[model.kind == TileKind.FRAMES] = stored["frame_sizes"]
    for page, size in zip(pages(model.kind, model.tile_columns, len(model.times)), model.video_sizes, strict=True):
        sizes[page.numbers] = np.diff(np.linspace(0, int(size), len(page.numbers) + 1).astype(int))
    sizes[model.kind == TileKind.LEVELS] = model.level_sizes
    constant = model.kind == TileKind.CONSTANT
    sizes[constant] = model.constant.nbytes // max(int(constant.sum()), 1)
    result = []
    for number, (kind, size) in enumerate(zip(model.kind, sizes.tolist(), strict=True)):
        valid = int(valid_texels(model.mask, number).sum())
        place = divmod(number, model.tile_columns)
        result.append(
            HeldTile(number, *place, TileKind(kind).name.lower(), valid, size, _why(model, TileKind(kind), valid))
        )
    return result


def _why(model: LightmapModel, kind: TileKind, valid: int) -> str:
    profile, times = model.profile, len(model.times)
    if kind == TileKind.EMPTY:
        return "it was left out of the fit" if valid else "no texel is inside a chart"
    if kind == TileKind.CONSTANT:
        return "one colour at each time is all there is"
    if kind == TileKind.STATIC:
        pattern = f"one pattern, brighter or darker, has {profile.static_budget_db:g} dB at all times"
        return pattern if times > 1 else "there is one time"
    if kind == TileKind.DYNAMIC:
        less = ", and BC7 of each time would take more bytes" if profile.frames == "auto" else ""
        return f"its light changes over time{less}"
    if kind == TileKind.FRAMES and profile.frames == "auto":
        return f"{times} times as BC7 take no more bytes than maps and a network"
    if kind == TileKind.LEVELS and profile.video_quality in STEPS:
        return f"the setting video_quality is {profile.video_quality}"
    if kind == TileKind.LEVELS:
        return f"no worse than AV1 of quality {profile.video_quality}, in fewer bytes"
    return f"the setting frames is {profile.frames}"
