"""Light groups: several lightmap sets over the same UVs whose light is added at run time, each with a weight.

Light is linear: a lightmap of all lights is the sum of the lightmaps of each light alone. So sun and sky by the hour
and every lamp may be groups of one model, and a lamp that is dimmed, recoloured or switched is a weight, with no new
fit:

    light(texel, t) = sum over the groups of weight * light of the group(texel, t)

These are the rules:

- Each group has its own times. A group with one time, such as a lamp, has that light at all times. Groups with several
  times have the same period.
- A layer of an atlas has one size in all groups. A group may lack a layer: its light is then zero there. A layer that
  is not light (directions, masks) belongs to one group, since such values cannot be added.
- The mask of an atlas is that of the first group in which some texel of it is not valid. All groups take it; if a
  group's own mask lacks some of its texels, their light is unknown, which is an error.
- A weight is a factor for each of red, green and blue, finite and from 0 to `MOST_WEIGHT`.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Generic, Protocol, TypeVar

import numpy as np

from wlm.errors import WlmError
from wlm.formats.exr import HALF_MAX
from wlm.lightmap.sheet import Sheet, first_light

MOST_WEIGHT = HALF_MAX
"""Largest weight of a group: 65,504."""

T = TypeVar("T")

Weight = float | Sequence[float] | np.ndarray
"""A factor of a group's light, or three of red, green and blue."""


class Timed(Protocol):
    """A sheet of a set or a model: its stored times, float64 [T], and the length of the day or None."""

    @property
    def times(self) -> np.ndarray: ...
    @property
    def period(self) -> float | None: ...


def groups_of(sheets: Iterable[Sheet]) -> tuple[str, ...]:
    """Returns the names of the groups of sheets, in their order."""
    return tuple(dict.fromkeys(sheet.group for sheet in sheets))


def in_groups(sheets: Mapping[Sheet, T], sheet: Sheet) -> dict[Sheet, T]:
    """Returns the entries of one sheet, given as that of any group, in all groups that have it."""
    return {one: own for one, own in sheets.items() if one.plain == sheet.plain}


def times_of(sheets: Mapping[Sheet, Timed]) -> np.ndarray:
    """Returns the times of all groups, float64 [T], increasing. Groups with one time count only if no group has more:
    their light does not change."""
    each = {sheet.group: own.times for sheet, own in sheets.items()}
    changing = [times for times in each.values() if len(times) > 1] or list(each.values())[:1]
    return changing[0] if len(changing) == 1 else np.unique(np.concatenate(changing))


S = TypeVar("S", bound=Timed)


class Sheets(Generic[S]):
    """Base of a set and of a model of several sheets; `sheets` has them by name, group by group."""

    sheets: dict[Sheet, S]

    @property
    def light(self) -> S:
        """The first sheet of radiance, or the first sheet if no sheet is radiance."""
        return self.sheets[first_light(self.sheets)]

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the light groups, one if the set has no groups."""
        return groups_of(self.sheets)

    @property
    def times(self) -> np.ndarray:
        """float64 [T], the times of all groups, increasing; see `times_of`."""
        return times_of(self.sheets)

    @property
    def period(self) -> float | None:
        """Length of the day in the unit of the times; None if the set is not periodic."""
        return self.light.period


def changed_weights(
    where: str, weights: Mapping[str, np.ndarray], changes: Mapping[str, Weight]
) -> dict[str, np.ndarray]:
    """Returns weights by group, float32 [3], with some of them replaced; `where` names the model in messages."""
    result = dict(weights)
    for group, given in changes.items():
        if group not in result:
            raise WlmError(f"{where}: weights: expected a group among {', '.join(result)}, got {group!r}")
        try:
            weight = np.asarray(given, np.float64)
        except (TypeError, ValueError):
            weight = np.empty(0)
        # NaN is not in the range either.
        if weight.shape not in ((), (3,)) or not ((weight >= 0.0) & (weight <= MOST_WEIGHT)).all():
            raise WlmError(
                f"{where}: weight of {group}: expected one number or three, from 0 to {MOST_WEIGHT:g}, got {given!r}"
            )
        result[group] = np.broadcast_to(weight, 3).astype(np.float32)
    return result
