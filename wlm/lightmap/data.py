"""Reads sets of lightmaps over time from files or arrays, checks them and repairs them.

These are the rules for input; each repair adds a line with the number of texels to `LightmapSet.warnings`:

- Inside the mask a NaN or infinite texel takes the value of the nearest finite texel at that time, negative channels
  are clamped to 0, and values above 65,504, the maximum of half floats, to 65,504. Outside the mask the same repairs
  are made without a warning.
- A time without a finite texel inside the mask, an empty mask, two equal times, a NaN or infinite time, a time outside
  [0, period) and more than 100,000 times are errors. Times out of order are sorted.
- If the mask comes from alpha, texels with NaN or infinite alpha are outside. A texel that is valid in only some frames
  is fitted at the other times to the nearest frame in which it is valid, and is only scored in frames where it is
  valid.
- Frames whose chart borders differ may belong to different atlases, which gives a warning (`wlm.lightmap.layout`).
- Unless it is trusted, a set may only name files in its own folder, and a small file may not claim frames beyond 1 GiB.
  Frames of more than 1 GiB are kept in an unnamed file in the folder for temporary files (TMPDIR).
- The frames of a layer, the light's mask and `set.json` must agree in size; another layer of the atlas may have another
  size, and its mask is that of the light, resampled. A file that does not hold light is an error that says what it
  holds.
- A picture of a layer may be missing at some times, which are fitted to the nearest time that has it and not scored.
- Layers that are not light (directions, masks) have a fixed range; values outside it are clamped. A PNG of such a layer
  maps black to the range's lower end and white to its upper end. All pictures of a layer must have the same channels,
  at most 12 in an atlas.

The layout of a set and its evaluation follow neural-dynamic-gi, section 10.1.
"""

import hashlib
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from wlm.errors import WlmError, counted
from wlm.formats.limits import TIMES
from wlm.formats.mask import read_mask
from wlm.formats.scratch import room
from wlm.lightmap.assumptions import set_lines, size_line
from wlm.lightmap.groups import Sheets, groups_of
from wlm.lightmap.layout import odd_layout
from wlm.lightmap.listing import Listing, list_set
from wlm.lightmap.profile import TimeAxis
from wlm.lightmap.reading import ALL, FROM_ALPHA, Bounds, Reader, Stack, size_text
from wlm.lightmap.sheet import BASE, LIGHT, MOST_NAME, VALUE_RANGES, Sheet, check_sheets, is_group, is_name, sheets_of
from wlm.texels import repair

_PIECE = 1 << 18  # frames times texels that are filled at once
_TIME_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class SheetFrames:
    """Checked and repaired lightmaps of one sheet (up to three channels of a layer of an atlas) at several times.

    Attributes:
        name: Name of the set; for any sheet but the ordinary lightmap, followed by the sheet's name.
        times: `[T]` float64, strictly increasing, in hours or any other unit.
        frames: `[T, H, W, 3]` float32, linear RGB irradiance, finite, in [0, 65504]; if the sheet is not light,
            normalised values in [0, 1]. Row 0 is v = 0. Arrays of more than 1 GiB are mapped from a file, see
            `wlm.formats.scratch`.
        mask: `[H, W]` bool, true where a texel belongs to a chart; at least one is.
        period: Length of the day in the unit of `times`, all of which are then in [0, period); None if the set is not
            periodic: times before the first or after the last are then clamped.
        source: Hash of the checked pixels, the times and the mask: 16 hexadecimal digits of BLAKE2b.
        warnings: Descriptions of the repairs, one line each.
        mesh: Path of the mesh that the lightmaps belong to, as the set names it; the file may be missing. None if the
            set names no mesh.
        covered: `[T, H, W]` bool, which valid texels of `mask` are valid in each frame; None if all are valid in every
            frame. A texel that is not valid in a frame holds its light from the nearest time at which it is valid.
    """

    name: str
    times: np.ndarray
    frames: np.ndarray
    mask: np.ndarray
    period: float | None
    source: str
    warnings: tuple[str, ...]
    mesh: Path | None = None
    covered: np.ndarray | None = None

    def valid(self, index: int) -> np.ndarray:
        """Returns which texels are valid in the frame with this index, bool [H, W]."""
        return self.mask if self.covered is None else self.covered[index]

    def at(self, time: float) -> np.ndarray:
        """Returns the light at a time, between two stored ones interpolated (neural-dynamic-gi, eq. 2), [H, W, 3]."""
        before, after, share = TimeAxis(self.times, self.period, "frames").neighbours(time)
        if share == 0.0:
            return self.frames[before]
        return (1.0 - share) * self.frames[before] + share * self.frames[after]

    def select(self, indices: Sequence[int] | np.ndarray) -> "SheetFrames":
        """Returns the lightmaps with these indices, which are copied, as if the set had no others."""
        chosen = np.unique(np.asarray(indices, np.int64))
        frames, times = room((len(chosen), *self.frames.shape[1:]), np.float32, self.name), self.times[chosen]
        for frame, index in zip(frames, chosen, strict=True):
            frame[...] = self.frames[index]
        mask, covered = self.mask, None
        if self.covered is not None:
            covered = self.covered[chosen]
            mask = covered.any(0)
            if not mask.any():
                raise WlmError(f"{self.name}: expected a valid texel at the times that are kept, found none")
            covered = None if (covered == mask).all() else covered
        if covered is not None:
            _fill_in_time(frames, covered, times, self.period)
        source = _hash(frames, times, mask if covered is None else covered)
        return replace(self, times=times, frames=frames, mask=mask, covered=covered, source=source)


@dataclass(frozen=True, eq=False)
class LightmapSet(Sheets[SheetFrames]):
    """Lightmaps over time: one or more sheets, each up to three channels of a layer of an atlas.

    The sheets of a light group (`wlm.lightmap.groups`) have the same times.

    Attributes:
        name: Name of the set.
        sheets: The sheets, group by group, atlas by atlas and layer by layer; an ordinary set has one.
    """

    name: str
    sheets: dict[Sheet, SheetFrames]

    def find(self, sheet: Sheet) -> SheetFrames:
        """Returns the lightmaps of `sheet`. If the set has only one sheet, it returns the lightmaps of that sheet
        instead.

        Raises:
            WlmError: The set has several sheets, and `sheet` is not one of them.
        """
        if sheet not in self.sheets and len(self.sheets) > 1:
            found = ", ".join(one.label for one in self.sheets)
            raise WlmError(f"{self.name}: expected a set with the sheet {sheet.label}, found {found}")
        return self.sheets.get(sheet, self.light)

    @property
    def source(self) -> str:
        """Hash of all sheets and their names: 16 hexadecimal digits of BLAKE2b."""
        digest = hashlib.blake2b(digest_size=8)
        for sheet, own in self.sheets.items():
            group = "" if sheet.group == BASE else sheet.group
            digest.update((repr((sheet, own.source)) + group).encode())
        return digest.hexdigest()

    def without(self, times: Sequence[float]) -> "LightmapSet":
        """Returns the set without some times, so that a fit can be scored at times that it has not seen.

        Raises:
            WlmError: No sheet has one of the times, or a sheet would have no time left.
        """
        sheets = {}
        for sheet, own in self.sheets.items():
            kept = np.setdiff1d(np.arange(len(own.times)), at_times(own.times, np.asarray(times, np.float64)))
            if not len(kept):
                raise WlmError(f"{own.name}: expected at least one time to be kept, got all of them to leave out")
            sheets[sheet] = own if len(kept) == len(own.times) else own.select(kept)
        for time in times:
            if (at_times(self.times, np.array([time])) < 0).all():
                raise WlmError(f"{self.name}: expected times of the set to leave out, got {time:g}")
        return LightmapSet(self.name, sheets)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Descriptions of the repairs of all sheets, one line each."""
        return tuple(dict.fromkeys(text for own in self.sheets.values() for text in own.warnings))


@dataclass(frozen=True, eq=False)
class Layer:
    """One layer of an atlas at all times, given as arrays.

    Attributes:
        frames: The pixels at each time, numeric `[T, H, W, C]`.
        name, atlas: Names of the layer and of the atlas.
        encoding: "radiance", "unit" for values in [0, 1], or "signed" for values in [-1, 1].
        channels: Names of the C channels; None: R, G, B, A, or numbers if there are more than four.
    """

    frames: np.ndarray
    name: str = LIGHT.layer
    atlas: str = LIGHT.atlas
    encoding: str = LIGHT.encoding
    channels: tuple[str, ...] | None = None


def load(
    path: str | os.PathLike[str],
    *,
    times: Sequence[float] | None = None,
    mask: str | os.PathLike[str] | None = None,
    period: float | None = None,
    trust: bool = False,
    layers: Sequence[str] | None = None,
    encoding: str | None = None,
    groups: Mapping[str, str | os.PathLike[str]] | None = None,
) -> LightmapSet:
    """Reads a lightmap set: a `set.json`, a folder that holds one, a plain folder of lightmaps, or folders from Unity.

    A lightmap is a file of linear light that `wlm.formats.light` reads; a set may mix them.

    The keys of a `set.json` are described in docs/formats.md. File names in it are relative to its folder.

    The files of a plain folder that end in `.exr`, `.hdr`, `.pfm`, `.tif`, `.ktx2` or `.dds` are read in natural order
    of their names ("2" before "10"). Without `times`, the hours are read from the names if every name ends in one
    (`wlm.formats.hours`); if all are within a day, the period is 24. A `mask.png` among them is the mask unless `mask`
    says otherwise.

    A folder with `NAME_comp_light.exr`, as Unity writes it, is one state of light; a folder of such folders has a state
    for each, in natural order of their names. NAME is the atlas; `_comp_dir` and `_comp_shadowmask` are linear layers.

    Args:
        path: The `set.json` or the folder.
        times: A time for each state, in the order of `set.json` or of the file names; replaces the times of `set.json`.
        mask: A PNG (a texel is valid if any colour channel is above 0), "alpha" (valid if the alpha channel of a frame
            is above 0; frames may differ) or "all"; None uses the mask of the set. It applies to all atlases.
        period: Length of the day in the unit of the times; None uses the set's `period_hours`, or that of names.
        trust: Whether a `set.json` may name files outside its folder, and small files may hold large frames
            (`wlm.formats.limits`).
        layers: Names of the layers to read; None reads all.
        encoding: How the files store their light, an encoding of `wlm.formats.channels`, if they don't define it
            themselves; a folder may then hold PNG, JPEG, WebP and TGA files. None uses `stored` of the set, if any.
        groups: Further light groups by name, each a set or one lightmap, which is then the same at all times. The set
            at `path` is the group "base" unless it names groups. See `wlm.lightmap.groups`.

    Returns:
        The set, repaired by the module's rules.

    Raises:
        WlmError: The set breaks one of the module's rules; the line names the file and the field.
    """
    further = {name: Path(own) for name, own in (groups or {}).items()}
    listings = list_set(Path(path), times, layers, trust, encoding, further)
    # Before any file is read, since a wrong list makes that useless.
    for listing in listings.values():
        day = listing.period if period is None else period
        check_times(str(listing.where), listing.labels, np.asarray(listing.times, np.float64), day)
    bounds = Bounds(f"{path}: lightmaps", list(listings.values()), trust)
    sets = {group: _read_set(listing, mask, period, bounds) for group, listing in listings.items()}
    return from_groups(sets, next(iter(sets.values())).name) if [*sets] != [BASE] else sets[BASE]


def _read_set(
    listing: Listing, mask: str | os.PathLike[str] | None, given: float | None, bounds: Bounds
) -> LightmapSet:
    """Reads the pictures of a set without groups; for the options see `load`."""
    stamps, period = np.asarray(listing.times, np.float64), listing.period if given is None else given
    lines = [f"{listing.where}: {line}" for line in set_lines(listing, given)]
    reader = Reader(listing, np.argsort(stamps, kind="stable"), bounds)
    sheets: dict[Sheet, SheetFrames] = {}
    for atlas in listing.atlases:
        valid = mask_from = None
        chosen = str(mask) if mask is not None else atlas.mask
        for layer in listing.light_first:
            leads = valid is None
            wanted = chosen if leads and layer.encoding == LIGHT.encoding and chosen in (FROM_ALPHA, None) else ALL
            stack = reader.read(atlas, layer, wanted, leads)
            if stack is None:
                continue
            sources = [state.get((atlas.name, layer.name)) for state in listing.states]
            size = next(iter(stack.frames.values())).shape[1:3]
            if valid is None:
                first = next(source.path for source in sources if source)
                valid = _valid(first, size, stack, chosen)
                mask_from = "the alpha of the light; --mask all takes all" if stack.alpha is not None else str(chosen)
            elif size != valid.shape[-2:]:
                line = size_line(atlas.name, layer.name, size_text(size), size_text(valid.shape[-2:]))
                stack.warnings.append(f"{listing.where}: {line}")
            own = _resized(valid, *size)
            if not stack.present.all():
                own = own & stack.present[:, None, None]
            labels = [source.label if source else text for source, text in zip(sources, listing.labels, strict=True)]
            states = _States(labels, stamps, period, str(listing.where), mask_from, not listing.origin, stack.present)
            for sheet, frames in stack.frames.items():
                mesh = None if sheet.linear else atlas.mesh
                sheets[sheet] = states.checked(listing.name, sheet, frames, own, [*lines, *stack.warnings], mesh)
    atlas_of = {atlas.name: i for i, atlas in enumerate(listing.atlases)}
    layer_of = {layer.name: i for i, layer in enumerate(listing.layers)}
    ordered = sorted(sheets, key=lambda sheet: (atlas_of[sheet.atlas], layer_of[sheet.layer]))
    return LightmapSet(listing.name, {sheet: sheets[sheet] for sheet in ordered})


def from_arrays(
    frames: np.ndarray,
    times: Sequence[float] | np.ndarray,
    mask: np.ndarray | None = None,
    period: float | None = None,
    name: str = "array",
) -> LightmapSet:
    """Makes a checked set of one lightmap for each time from arrays, under the same rules as `load`.

    Args:
        frames: `[T, H, W, 3]` of numbers, linear RGB irradiance; copied.
        times: `[T]`, in any order.
        mask: `[H, W]`, true where a texel is valid, or `[T, H, W]` if this differs by frame; None: all are valid.
        period: Length of the day in the unit of the times; None for a set that is not periodic.
        name: Name of the set, also in messages.

    Returns:
        The set, repaired by the module's rules; a frame is called "frame 3 (time 5)" in its warnings.

    Raises:
        WlmError: A shape is wrong, or the set breaks one of the module's rules.
    """
    frames = np.asarray(frames)
    if frames.ndim != 4 or frames.shape[3] != 3:
        raise WlmError(f"{name}: expected frames [T, H, W, 3], got {frames.shape}")
    return from_layers([Layer(frames)], times, None if mask is None else {LIGHT.atlas: mask}, period, name)


def from_layers(
    layers: Sequence[Layer],
    times: Sequence[float] | np.ndarray,
    masks: Mapping[str, np.ndarray] | None = None,
    period: float | None = None,
    name: str = "array",
) -> LightmapSet:
    """Makes a checked set of several layers from arrays, under the same rules as `load`.

    Args:
        layers: The layers in the order in which they are stored.
        times: `[T]`, in any order.
        masks: Masks by the name of their atlas, as for `from_arrays`. In an atlas without a mask all texels are valid.
        period, name: As for `from_arrays`.

    Raises:
        WlmError: A shape is wrong, or the set breaks one of the module's rules.
    """
    stamps = np.asarray(times, np.float64)
    sizes: dict[Sheet, tuple[int, int]] = {}
    sources: dict[Sheet, tuple[np.ndarray, list[int]]] = {}
    for layer in layers:
        frames, where = np.asarray(layer.frames), f"{name}: {layer.atlas}/{layer.name}"
        if frames.ndim != 4 or 0 in frames.shape or stamps.shape != frames.shape[:1]:
            expected = f"[{stamps.size}, H, W, C], none of them 0, and a time for each"
            raise WlmError(f"{where}: expected frames {expected}, got {frames.shape} and times {stamps.shape}")
        count = frames.shape[3]
        channels = tuple(layer.channels or ("RGBA"[:count] if count <= 4 else map(str, range(count))))
        if not all(is_name(value) for value in (layer.atlas, layer.name, *channels)):
            raise WlmError(
                f"{name}: expected names of atlases, layers and channels of 1 to {MOST_NAME} printable characters"
            )
        if layer.encoding not in VALUE_RANGES or len(channels) != count:
            raise WlmError(
                f"{where}: expected {count} names of channels and one of the encodings {', '.join(VALUE_RANGES)}, got "
                f"{len(channels)} names and {layer.encoding!r}"
            )
        for sheet in sheets_of(layer.atlas, layer.name, channels, layer.encoding):
            if sheet in sizes:
                raise WlmError(f"{where}: expected every channel once, found one twice")
            sizes[sheet] = frames.shape[1:3]
            sources[sheet] = frames, [channels.index(channel) for channel in sheet.channels]
    check_sheets(name, sizes)
    if unknown := (masks or {}).keys() - {sheet.atlas for sheet in sizes}:
        raise WlmError(f"{name}: masks: expected names of atlases that have layers, got {sorted(unknown)[0]!r}")
    labels = [f"frame {i} (time {time:g})" for i, time in enumerate(stamps)]
    check_times(name, labels, stamps, period)
    states = _States(labels, stamps, period, name, "the mask", True, np.ones(stamps.shape, bool))
    sheets, made = {}, 0
    for sheet, (frames, chosen) in sources.items():
        valid = np.asarray((masks or {}).get(sheet.atlas, np.ones(sizes[sheet], bool))).astype(bool)
        if valid.shape[-2:] in [size for other, size in sizes.items() if other.atlas == sheet.atlas]:
            valid = _resized(valid, *sizes[sheet])
        if valid.shape not in (frames.shape[1:3], frames.shape[:3]):
            raise WlmError(f"{name}: expected a mask of the shape {frames.shape[1:3]}, got {valid.shape}")
        copied = room((*frames.shape[:3], 3), np.float32, name, made)
        made += copied.nbytes
        with np.errstate(over="ignore"):  # float64 beyond float32 becomes Inf and is repaired as Inf
            for frame, index in zip(copied, states.order, strict=True):
                frame[...] = sheet.to_levels(frames[index][..., chosen])
        valid = valid[states.order] if valid.ndim == 3 else valid.copy()
        sheets[sheet] = states.checked(name, sheet, copied, valid)
    return LightmapSet(name, sheets)


def from_groups(sets: Mapping[str, LightmapSet], name: str = "groups") -> LightmapSet:
    """Makes one set of several over the same UVs, whose light is added at run time.

    The rules are those of `wlm.lightmap.groups`.

    Args:
        sets: The sets by the name of their group, without groups of their own. The frames are not copied.
        name: Name of the set, also in messages.

    Returns:
        The set, with the sheets of one group after another.

    Raises:
        WlmError: There is no set, a name is wrong, or the sets break one of the rules.
    """
    if not sets:
        raise WlmError(f"{name}: expected at least one group, found none")
    for group, own in sets.items():
        if not is_group(group):
            raise WlmError(f"{name}: expected names of groups of printable characters without '=', got {group!r}")
        if groups_of(own.sheets) != (BASE,):
            raise WlmError(f"{name}: group {group}: expected a set without groups, found one with its own")
    first = next(iter(sets.values()))
    periods = {own.period: group for group, own in sets.items() if len(own.times) > 1} or {first.period: ""}
    if len(periods) > 1:
        found = " and ".join(f"{period or 'none'} in {group}" for period, group in periods.items())
        raise WlmError(f"{name}: expected one period in all groups with several times, found {found}")
    period = next(iter(periods))
    named = {replace(sheet, group=group): own for group, one in sets.items() for sheet, own in one.sheets.items()}
    check_sheets(name, {sheet: own.mask.shape for sheet, own in named.items()})
    masks: dict[tuple[str, tuple[int, ...]], tuple[str, np.ndarray]] = {}
    for sheet, own in named.items():
        key = sheet.atlas, own.mask.shape
        if key not in masks or (masks[key][1].all() and not own.mask.all()):
            masks[key] = sheet.group, own.mask
    sheets = {}
    for sheet, own in named.items():
        source, mask = masks[sheet.atlas, own.mask.shape]
        if lacking := np.count_nonzero(mask & ~own.mask):
            raise WlmError(
                f"{name}: {sheet.label}: its mask lacks {lacking} texels of that of group {source}, whose light is "
                "therefore unknown: give one mask for all groups"
            )
        warnings = own.warnings
        if not own.frames.any():
            warnings += (f"{name}: {sheet.label}: no light: all its texels are 0",)
        sheets[sheet] = replace(
            own,
            name=name if sheet == LIGHT else f"{name} {sheet.label}",
            # The one time of a group that does not change may lie outside the period of the others.
            times=own.times if period is None else own.times % period,
            mask=mask,
            period=period,
            warnings=warnings,
            covered=None if own.covered is None else own.covered & mask,
        )
    return replace(first, name=name, sheets=sheets)


def at_times(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Returns for each time of `wanted` its index in `times`, -1 if it is not there, int [K]. Times that differ by a
    millionth count as equal: a file stores them as float32 if that keeps them distinct."""
    close = np.isclose(np.asarray(wanted)[:, None], times[None], rtol=_TIME_TOLERANCE, atol=_TIME_TOLERANCE)
    return np.where(close.any(1), close.argmax(1), -1)


def parse_times(text: str) -> list[float]:
    """Reads a list of times: numbers and `start:stop:step` ranges, separated by commas.

    A range leaves `stop` out, as in Python: "0:24:1" is 0, 1, ... 23, one day without its first hour twice. `text` is a
    list such as "0,1,2.5", "0:24:1" or "0:18:1,18.45,18.55,19:24:1". Returns the times in the order written, at least
    one."""
    times: list[float] = []
    for part in text.split(","):
        try:
            numbers = [float(piece) for piece in part.split(":")]
        except ValueError:
            numbers = []
        if len(numbers) not in (1, 3) or not all(map(math.isfinite, numbers)):
            raise WlmError(f"times: expected a number or start:stop:step, got {part.strip()!r} in {text!r}")
        if len(numbers) == 1:
            times.append(numbers[0])
            continue
        start, stop, step = numbers
        # The small slack keeps 0.1:0.4:0.1 at three times, although (0.4 - 0.1) / 0.1 is a little above 3.
        steps = (stop - start) / step - 1e-9 if step else 0.0
        if not 0.0 < steps < math.inf:
            raise WlmError(f"times: the range {part.strip()!r} is empty: its step leads away from its stop, or is 0")
        if len(times) + steps > TIMES:
            raise WlmError(f"times: expected at most {TIMES:,} times, exceeded at the range {part.strip()!r}")
        times.extend(start + i * step for i in range(math.ceil(steps)))
    return times


def check_times(where: str, labels: Sequence[str], times: np.ndarray, period: float | None) -> None:
    """Checks the times [T] by the module's rules; `labels` names the lightmap of each time in messages."""
    if period is not None and not (math.isfinite(period) and period > 0):
        raise WlmError(f"{where}: expected a finite period above 0, got {period:g}")
    for label, time in zip(labels, times, strict=True):
        if not math.isfinite(time):
            raise WlmError(f"{where}: the time of {label} is {time:g}; expected a finite number")
        if period is not None and not 0 <= time < period:
            raise WlmError(f"{where}: the time of {label} is {time:g}; expected 0 to less than the period {period:g}")
    order = np.argsort(times, kind="stable")
    for i, j in pairwise(order):
        if times[i] == times[j]:
            raise WlmError(f"{where}: {labels[i]} and {labels[j]} have the same time, {times[i]:g}")


def _valid(first: Path, size: tuple[int, int], stack: Stack, mask: str | None) -> np.ndarray:
    """Returns the valid texels of an atlas, bool [H, W] or [T, H, W] in the order of the times."""
    if stack.alpha is not None:
        return stack.alpha
    if mask == FROM_ALPHA:
        raise WlmError(f"{first}: expected a channel A for the mask, found none")
    if mask in (ALL, None):
        return np.ones(size, bool)
    return read_mask(Path(mask), first, size, ', "alpha" or "all"')


def _resized(mask: np.ndarray, *size: int) -> np.ndarray:
    """Resamples a mask [..., H, W] to another height and width: a texel is valid if it overlaps a valid one."""
    for axis, count in zip((-2, -1), size, strict=True):
        old = mask.shape[axis]
        if old != count:
            at = np.arange(count)
            sums = np.insert(np.cumsum(mask, axis), 0, 0, axis)
            mask = sums.take(-(-(at + 1) * old // count), axis) > sums.take(at * old // count, axis)
    return mask


@dataclass(frozen=True, eq=False)
class _States:
    """Times and labels of a set's lightmaps, in the order given; `where` and `mask_from` are words for messages.
    `present`, bool [T], states at which of the sorted times there is a picture."""

    labels: Sequence[str]
    times: np.ndarray
    period: float | None
    where: str
    mask_from: str
    warn_order: bool
    present: np.ndarray

    @property
    def order(self) -> np.ndarray:
        """Indices that sort the times, int [T]."""
        return np.argsort(self.times, kind="stable")

    def checked(
        self,
        name: str,
        sheet: Sheet,
        frames: np.ndarray,
        mask: np.ndarray,
        warnings: Sequence[str] = (),
        mesh: Path | None = None,
    ) -> SheetFrames:
        """Checks and repairs a sheet's frames in place (NaN, negative and missing texels); returns them as a sheet."""
        where, period = self.where, self.period
        if not mask.any():
            raise WlmError(f"{where}: the mask is empty: no texel is valid ({self.mask_from})")
        warnings, order = list(warnings), self.order
        if (np.diff(order) < 0).any() and self.warn_order:
            warnings.append(f"{where}: the times were not in order: the frames were sorted by time")
        times, labels = self.times[order], [self.labels[i] for i in order]
        if sheet.linear:
            warnings += _clamp(sheet, labels, frames, mask)
        covered = mask if mask.ndim == 3 and any((valid != mask[0]).any() for valid in mask) else None
        mask = mask.any(0) if mask.ndim == 3 else mask
        for i, (label, frame) in enumerate(zip(labels, frames, strict=True)):
            inside = mask if covered is None else covered[i]
            if self.present[i]:
                warnings += [f"{label}: {text}" for text in repair(frame, inside, f"{where}: {label}")]
        odd = odd_layout(len(frames), lambda i: frames[i].any(-1) if covered is None else covered[i])
        if odd is not None:
            warnings.append(
                f"{where}: {labels[odd[0]]} and {labels[odd[1]]} don't look like one atlas at two times: their charts "
                "end in other texels"
            )
        if covered is not None:
            covered = covered & mask
            _fill_in_time(frames, covered, times, period)
            if missing := np.count_nonzero(mask & ~covered[self.present].all(0)):
                warnings.append(
                    f"{where}: {missing} texels are valid in only some lightmaps: at other times they are fitted to "
                    "the light of the nearest time at which they are valid, and are not scored"
                )
        return SheetFrames(
            name=name if sheet == LIGHT else f"{name} {sheet.label}",
            times=times,
            frames=frames,
            mask=mask,
            period=None if period is None else float(period),
            source=_hash(frames, times, mask if covered is None else covered),
            warnings=tuple(warnings),
            mesh=mesh,
            covered=covered,
        )


def _clamp(sheet: Sheet, labels: Sequence[str], frames: np.ndarray, mask: np.ndarray) -> Iterator[str]:
    """Clamps normalised values to [0, 1] in place and yields warnings. Infinite values become NaN, repaired later."""
    least, greatest = VALUE_RANGES[sheet.encoding]
    for i, frame in enumerate(frames):
        inside = mask[i] if mask.ndim == 3 else mask
        frame[np.isinf(frame)] = np.nan
        with np.errstate(invalid="ignore"):
            beyond = np.count_nonzero(((frame < 0.0) | (frame > 1.0)).any(axis=2) & inside)
        if beyond:
            texels = counted(beyond, "texel")
            yield f"{labels[i]}: {sheet.label}: {texels} beyond {least:g} to {greatest:g}: clamped to it"
        np.clip(frame, 0.0, 1.0, out=frame)


def _fill_in_time(frames: np.ndarray, covered: np.ndarray, times: np.ndarray, period: float | None) -> None:
    """Fills texels that a frame lacks, in place, from the frame nearest in time in which they are valid."""
    count, around = len(times), np.inf if period is None else period
    number, stamps = np.arange(count)[:, None], times[:, None]
    for row in range(covered.shape[1]):
        some = np.flatnonzero(covered[:, row].any(0) & ~covered[:, row].all(0))
        for columns in np.array_split(some, -(-len(some) * count // _PIECE) or 1):
            here = covered[:, row, columns]
            before = np.maximum.accumulate(np.where(here, number, -1))
            after = np.minimum.accumulate(np.where(here, number, count)[::-1])[::-1]
            # Before the first valid frame comes the last one of the day before, after the last one the first.
            earlier, later = np.where(before < 0, before[-1], before), np.where(after == count, after[0], after)
            since = stamps - times[earlier] + np.where(before < 0, around, 0.0)
            until = times[later] - stamps + np.where(after == count, around, 0.0)
            nearer = (since < until) | ((since == until) & (earlier < later))
            frames[:, row, columns] = frames[np.where(nearer, earlier, later), row, columns]


def _hash(frames: np.ndarray, times: np.ndarray, mask: np.ndarray) -> str:
    digest = hashlib.blake2b(digest_size=8)
    digest.update(np.asarray(frames.shape, "<i8").tobytes())
    digest.update(np.asarray(times, "<f8").tobytes())
    digest.update(np.packbits(mask).tobytes())
    for frame in frames:
        digest.update(np.ascontiguousarray(frame, "<f4"))
    return digest.hexdigest()
