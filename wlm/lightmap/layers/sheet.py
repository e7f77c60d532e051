"""A sheet: up to three channels of one layer of one atlas, and what its numbers stand for.

Radiance is stored as ever, in gamma space. What is no light, directions or ratios of SH coefficients, has no gamma: a
sheet holds levels in [0, 1], linear in the value, so that negative values need nothing of their own in any kernel and
mixing two hours mixes the values.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wlm.errors import WlmError
from wlm.texels import MOST_TEXELS

ENCODINGS = {"radiance": (0.0, 1.0), "unit": (0.0, 1.0), "signed": (-1.0, 1.0)}
"""By name: the values of the levels 0 and 1; of radiance the level is the value, without an upper end."""

MOST_CHANNELS = 12
"""Channels of an atlas, all layers together."""

MOST_SHEETS = 1024

WIDTH = 3  # channels of a sheet


@dataclass(frozen=True)
class Sheet:
    """Which numbers a lightmap of three channels holds.

    A sheet of fewer than three channels repeats its last one: a block codec and a network hold three equal channels as
    well as one, and scores over the three are nearly those of the channels that there are.

    Attributes:
        atlas, layer: Names.
        channels: One to three names.
        encoding: A name of `ENCODINGS`.
    """

    atlas: str
    layer: str
    channels: tuple[str, ...]
    encoding: str

    @property
    def label(self) -> str:
        """What a message calls it: `Lightmap-0/dir RGB`."""
        joint = "" if all(len(name) == 1 for name in self.channels) else ","
        return f"{self.atlas}/{self.layer} {joint.join(self.channels)}"

    @property
    def linear(self) -> bool:
        """Whether it holds levels in [0, 1], not radiance."""
        return self.encoding != "radiance"

    @property
    def span(self) -> float:
        """What a step of 1 in the levels is in the values."""
        least, greatest = ENCODINGS[self.encoding]
        return greatest - least

    def levels(self, values: np.ndarray) -> np.ndarray:
        """Values [..., C] of its channels, C in 1..3, as it holds them, float32 [..., 3]."""
        chosen = np.minimum(np.arange(WIDTH), len(self.channels) - 1)
        levels = values[..., chosen].astype(np.float32)
        if self.encoding == "signed":
            levels = (levels + np.float32(1.0)) * np.float32(0.5)
        return levels

    def values(self, levels: np.ndarray) -> np.ndarray:
        """The inverse of `levels`: float32 [..., C]."""
        values = levels[..., : len(self.channels)]
        return values * np.float32(2.0) - np.float32(1.0) if self.encoding == "signed" else values


def sheets_of(atlas: str, layer: str, channels: tuple[str, ...], encoding: str) -> list[Sheet]:
    """The sheets of a layer of an atlas, three channels each, in the order of the channels."""
    return [Sheet(atlas, layer, channels[first : first + WIDTH], encoding) for first in range(0, len(channels), WIDTH)]


def check_sheets(where: str, sizes: dict[Sheet, tuple[int, int]]) -> None:
    """Checks what a set or a file says that it holds, before memory is taken for it.

    Args:
        where: The set or the file, for messages.
        sizes: Height and width of each sheet.

    Raises:
        WlmError: There is none; there are too many sheets, channels of an atlas or texels of all sheets; a channel is
            there twice; or an atlas has sheets of two sizes.
    """
    if not 1 <= len(sizes) <= MOST_SHEETS:
        raise WlmError(f"{where}: expected 1 to {MOST_SHEETS} sheets of three channels, found {len(sizes)}")
    channels: dict[str, list[tuple[str, str]]] = {}
    found: dict[str, tuple[int, int]] = {}
    for sheet, size in sizes.items():
        if found.setdefault(sheet.atlas, size) != size:
            first, second = (f"{width}x{height}" for height, width in (found[sheet.atlas], size))
            raise WlmError(f"{where}: {sheet.label} is {second}, but atlas {sheet.atlas} is {first}; expected one size")
        channels.setdefault(sheet.atlas, []).extend((sheet.layer, name) for name in sheet.channels)
    for atlas, names in channels.items():
        if len(set(names)) < len(names):
            raise WlmError(f"{where}: atlas {atlas}: expected each channel of a layer once")
        if len(names) > MOST_CHANNELS:
            raise WlmError(f"{where}: atlas {atlas}: expected at most {MOST_CHANNELS} channels, found {len(names)}")
    if (texels := sum(height * width for height, width in sizes.values())) > MOST_TEXELS:
        raise WlmError(f"{where}: expected at most {MOST_TEXELS} texels of all sheets, found {texels}")
