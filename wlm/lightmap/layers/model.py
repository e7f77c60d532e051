"""A compressed layered set: a lightmap model for each sheet."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from wlm.errors import WlmError
from wlm.lightmap.layers.sheet import Sheet
from wlm.lightmap.model import LightmapModel, Profile
from wlm.system import Model

_LINEAR = {"gamma": 1.0, "peak": 1.0}


@dataclass
class LayeredModel(Model):
    """What a layered file holds.

    Attributes:
        name, source: Of the input, see `wlm.lightmap.layers.data.LayeredSet`.
        sheets: The models, of the same times; those of one atlas share size and mask.
    """

    SYSTEM: ClassVar[str] = "lightmap-layers"

    name: str
    source: str
    sheets: dict[Sheet, LightmapModel]

    @property
    def times(self) -> np.ndarray:
        """float64 [T], increasing."""
        return self._first.times

    @property
    def period(self) -> float | None:
        """Length of the day in the unit of the times, or None."""
        return self._first.period

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the fits fell back on, one line each; not in the file."""
        return tuple(dict.fromkeys(text for model in self.sheets.values() for text in model.warnings))

    @property
    def atlases(self) -> dict[str, tuple[int, int]]:
        """Height and width of each atlas by name."""
        return {sheet.atlas: (model.height, model.width) for sheet, model in self.sheets.items()}

    def layer(self, name: str | None = None, atlas: str | None = None) -> list[Sheet]:
        """The sheets of a layer of an atlas.

        Args:
            name, atlas: None: the first of radiance, if there is one; the first.

        Raises:
            WlmError: There is none.
        """
        of_atlas = [sheet for sheet in self.sheets if atlas in (None, sheet.atlas)]
        light = [sheet for sheet in of_atlas if not sheet.linear]
        named = [sheet for sheet in of_atlas if sheet.layer == name] if name is not None else light or of_atlas
        if not named:
            names = ", ".join(dict.fromkeys(f"{sheet.atlas}/{sheet.layer}" for sheet in self.sheets))
            asked = f"{'any atlas' if atlas is None else atlas}/{'any layer' if name is None else name}"
            raise WlmError(f"{self.name}: expected one of {names}, got {asked}")
        first = named[0]
        return [sheet for sheet in named if (sheet.atlas, sheet.layer) == (first.atlas, first.layer)]

    def shown(self) -> tuple[Sheet, LightmapModel]:
        """What a picture shows that has room for three channels: the first sheet of light, or the first."""
        sheet = self.layer()[0]
        return sheet, self.sheets[sheet]

    @property
    def _first(self) -> LightmapModel:
        return next(iter(self.sheets.values()))


def sheet_profile(profile: Profile, sheet: Sheet) -> Profile:
    """The settings of a sheet: a linear one has no gamma, and an error counts the same in each tile at each time."""
    return profile.override(_LINEAR) if sheet.linear else profile
