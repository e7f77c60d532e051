"""`Sheet`: up to three channels of one layer of one atlas. Lightmap sets, models and reports are collections of sheets.

An ordinary lightmap over time is one sheet: the channels R, G and B of the layer "light" of the atlas "0". A scene with
several atlases has a sheet for each; a layer with more than three channels, such as SH coefficients, is split into
sheets of three. Light that is added at run time, such as that of a lamp, is a group of sheets of its own
(`wlm.lightmap.groups`).

Radiance is stored in gamma space. Directions, ratios of SH coefficients and masks are not light and have no gamma:
their sheets hold values mapped linearly to levels in [0, 1], so that kernels need no case for negative values and
interpolating levels interpolates values.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from wlm.errors import WlmError
from wlm.formats.limits import PICTURE_TEXELS

VALUE_RANGES = {"radiance": (0.0, 1.0), "unit": (0.0, 1.0), "signed": (-1.0, 1.0)}
"""The values that levels 0 and 1 stand for, by encoding. Radiance is its own level and has no upper limit."""

MOST_CHANNELS = 12
"""Largest number of channels of an atlas, over all layers."""

MOST_SHEETS = 1024
"""Largest number of sheets of a set."""

MOST_NAME = 128
"""Largest number of characters in the name of a layer, an atlas or a channel."""

WIDTH = 3
"""Number of channels that the lightmap of a sheet holds."""

BASE = "base"
"""Name of the group of the sheets of a set that names no groups."""


@dataclass(frozen=True)
class Sheet:
    """Identifies the up to three channels that are stored together as one RGB lightmap.

    A sheet of fewer than three channels repeats its last one. Three equal channels compress about as well as one, and
    scores over the three are nearly those of the real channels.

    Attributes:
        atlas, layer: Names of the atlas and of the layer.
        channels: One to three names of channels.
        encoding: "radiance", "unit" for values in [0, 1], or "signed" for values in [-1, 1].
        group: Name of the light group; not in `repr`, of which hashes of sets without groups are made.
    """

    atlas: str = "0"
    layer: str = "light"
    channels: tuple[str, ...] = ("R", "G", "B")
    encoding: str = "radiance"
    group: str = field(default=BASE, repr=False)

    @property
    def label(self) -> str:
        """Name of the sheet in messages, such as `Lightmap-0/dir RGB`, or `lamp: 0/light RGB` of a named group."""
        joint = "" if all(len(name) == 1 for name in self.channels) else ","
        group = "" if self.group == BASE else f"{self.group}: "
        return f"{group}{self.atlas}/{self.layer} {joint.join(self.channels)}"

    @property
    def plain(self) -> Sheet:
        """The same sheet without a named group."""
        return replace(self, group=BASE)

    @property
    def linear(self) -> bool:
        """Whether the sheet holds levels in [0, 1] (directions, ratios, masks) instead of radiance."""
        return self.encoding != "radiance"

    @property
    def values(self) -> tuple[float, float] | None:
        """The values that levels 0 and 1 stand for, such as (-1, 1); None for radiance."""
        return VALUE_RANGES[self.encoding] if self.linear else None

    @property
    def span(self) -> float:
        """Size of the value range: the value of level 1 minus that of level 0."""
        least, greatest = VALUE_RANGES[self.encoding]
        return greatest - least

    def to_levels(self, values: np.ndarray) -> np.ndarray:
        """Converts values [..., C] of the sheet's channels to levels, float32 [..., 3]."""
        chosen = np.minimum(np.arange(WIDTH), len(self.channels) - 1)
        levels = values[..., chosen].astype(np.float32)
        if self.encoding == "signed":
            levels = (levels + np.float32(1.0)) * np.float32(0.5)
        return levels

    def to_values(self, levels: np.ndarray) -> np.ndarray:
        """Converts levels [..., 3] back to values, float32 [..., C]."""
        values = levels[..., : len(self.channels)]
        return values * np.float32(2.0) - np.float32(1.0) if self.encoding == "signed" else values


LIGHT = Sheet()
"""The sheet of an ordinary lightmap."""


def is_name(value: object) -> bool:
    """Returns whether a value can name a layer, an atlas or a channel."""
    return isinstance(value, str) and bool(value.strip()) and len(value) <= MOST_NAME and value.isprintable()


def is_group(value: object) -> bool:
    """Returns whether a value can name a group: as `is_name`, without "=", which ends the name on a command line."""
    return is_name(value) and "=" not in str(value)


def sheets_of(atlas: str, layer: str, channels: tuple[str, ...], encoding: str) -> list[Sheet]:
    """Splits a layer of an atlas into sheets of up to three channels, in the order of the channels."""
    return [Sheet(atlas, layer, channels[first : first + WIDTH], encoding) for first in range(0, len(channels), WIDTH)]


def first_light(sheets: Iterable[Sheet]) -> Sheet:
    """Returns the first sheet of radiance, or the first sheet if no sheet is radiance."""
    sheets = list(sheets)
    return next((sheet for sheet in sheets if not sheet.linear), sheets[0])


def layer_sheets(where: str, sheets: Iterable[Sheet], layer: str | None, atlas: str | None) -> list[Sheet]:
    """Returns the sheets of one layer of one atlas, in all groups that have it; `where` names the collection in
    messages.

    Without a layer it is the first layer of radiance, or the first if none is radiance; without an atlas the first that
    has the layer.
    """
    sheets = list(sheets)
    named = [sheet for sheet in sheets if atlas in (None, sheet.atlas) and layer in (None, sheet.layer)]
    if not named:
        names = ", ".join(dict.fromkeys(f"{sheet.atlas}/{sheet.layer}" for sheet in sheets))
        asked = f"{'any atlas' if atlas is None else atlas}/{'any layer' if layer is None else layer}"
        raise WlmError(f"{where}: atlas/layer: expected one of {names}, got {asked}")
    first = first_light(named)
    return [sheet for sheet in named if (sheet.atlas, sheet.layer) == (first.atlas, first.layer)]


def check_sheets(where: str, sizes: Mapping[Sheet, tuple[int, int]]) -> None:
    """Checks the number and the sizes of the sheets that a set or a file claims to have, before memory is allocated.
    `where` names the set or the file in messages; `sizes` has the height and width of each sheet."""
    if not 1 <= len(sizes) <= MOST_SHEETS:
        raise WlmError(f"{where}: expected 1 to {MOST_SHEETS} sheets of three channels, found {len(sizes)}")
    channels: dict[tuple[str, str], list[tuple[str, str]]] = {}
    found: dict[tuple[str, str], tuple[int, int]] = {}
    layers: dict[tuple[str, str], dict[str, set[Sheet]]] = {}
    for sheet, size in sizes.items():
        if (known := found.setdefault((sheet.atlas, sheet.layer), size)) != size:
            first, second = (f"{width}x{height}" for height, width in (known, size))
            raise WlmError(f"{where}: {sheet.label} has {second} texels, but others of its layer have {first}")
        channels.setdefault((sheet.group, sheet.atlas), []).extend((sheet.layer, name) for name in sheet.channels)
        groups = layers.setdefault((sheet.atlas, sheet.layer), {})
        groups.setdefault(sheet.group, set()).add(sheet.plain)
    for (atlas, layer), groups in layers.items():
        first, *others = groups.values()
        if (others and any(sheet.linear for sheet in first)) or any(other != first for other in others):
            raise WlmError(
                f"{where}: {atlas}/{layer}: expected light with the same channels in the groups {', '.join(groups)}, "
                "since groups are added; found other values or channels"
            )
    for (_, atlas), names in channels.items():
        if len(set(names)) < len(names):
            raise WlmError(f"{where}: atlas {atlas}: expected every channel once, found one twice")
        if len(names) > MOST_CHANNELS:
            raise WlmError(f"{where}: atlas {atlas}: expected at most {MOST_CHANNELS} channels, found {len(names)}")
    if (texels := sum(height * width for height, width in sizes.values())) > PICTURE_TEXELS:
        raise WlmError(f"{where}: expected at most {PICTURE_TEXELS} texels in all sheets together, found {texels}")
