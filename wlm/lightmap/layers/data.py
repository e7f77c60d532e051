"""What comes in: layered sets, read from files or arrays and checked.

The table of `wlm.lightmap.data` holds for every sheet, and this one:

====================================  ================================================================
input                                 behaviour
====================================  ================================================================
NaN, Inf of a linear layer            as NaN of light
values beyond a linear layer's range  clamped to it; inside the mask a warning
a PNG of radiance                     error: no light is known by 8 bits
a PNG of a linear layer               its levels run from the least value to the greatest
a layer or atlas that a state lacks   error that names the state, and one that has it
pictures of one atlas of two sizes    error that names both files
channels that a file lacks            error that names the file and its channels
more than 12 channels of an atlas     error
====================================  ================================================================
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wlm.errors import WlmError
from wlm.formats.channels import read_channels
from wlm.formats.limits import FRAMES, PICTURE_GROWTH, check_growth
from wlm.formats.mask import read_mask
from wlm.formats.scratch import room
from wlm.lightmap.data import LightmapSet, check_times, checked_set
from wlm.lightmap.layers.listing import MOST_NAME, Atlas, Layer, LayeredListing, Source, is_name, list_layers
from wlm.lightmap.layers.sheet import ENCODINGS, Sheet, check_sheets, sheets_of

_LIGHT = ("R", "G", "B")
_ALPHA = "A"


@dataclass(frozen=True, eq=False)
class LayeredSet:
    """Layers of atlases at the same times.

    Attributes:
        name: The set's name.
        sheets: What is there, atlas by atlas and layer by layer; the frames of a linear sheet are levels in [0, 1], see
            `wlm.lightmap.layers.sheet`.
    """

    name: str
    sheets: dict[Sheet, LightmapSet]

    @property
    def times(self) -> np.ndarray:
        """float64 [T], increasing."""
        return next(iter(self.sheets.values())).times

    @property
    def period(self) -> float | None:
        """Length of the day in the unit of the times, or None."""
        return next(iter(self.sheets.values())).period

    @property
    def source(self) -> str:
        """16 hexadecimal digits of BLAKE2b over the sheets and their names."""
        digest = hashlib.blake2b(digest_size=8)
        for sheet, lightmaps in self.sheets.items():
            digest.update(repr((sheet, lightmaps.source)).encode())
        return digest.hexdigest()

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was repaired, one line each."""
        return tuple(dict.fromkeys(text for lightmaps in self.sheets.values() for text in lightmaps.warnings))


@dataclass(frozen=True, eq=False)
class LayerArrays:
    """A layer of an atlas, in memory.

    Attributes:
        frames: `[T, H, W, C]` of numbers.
        name, atlas: Of the layer and the atlas.
        encoding: A name of `wlm.lightmap.layers.sheet.ENCODINGS`.
        channels: C names; None: R, G, B, A, or numbers where there are more than four.
    """

    frames: np.ndarray
    name: str = "light"
    atlas: str = "0"
    encoding: str = "radiance"
    channels: tuple[str, ...] | None = None


def load(
    path: str | os.PathLike[str],
    *,
    times: Sequence[float] | None = None,
    mask: str | os.PathLike[str] | None = None,
    period: float | None = None,
    trust: bool = False,
    layers: Sequence[str] | None = None,
) -> LayeredSet:
    """Reads a layered set: a `set.json` with `layers` (docs/formats.md), or folders as Unity writes them.

    A folder with `NAME_comp_light.exr` is one state of light; a folder of such folders has a state for each, in natural
    order of their names. NAME is the atlas; beside the light, `_comp_dir` and `_comp_shadowmask` are linear layers.

    Args:
        path: The `set.json` or the folder.
        times, mask, period, trust: As for `wlm.lightmap.data.load`; a mask holds for all atlases.
        layers: Names of the layers to read; None: all.

    Returns:
        The set, repaired as the module's table says.

    Raises:
        WlmError: One line that names the file and the field, for each error of the module's table.
    """
    listing = list_layers(Path(path), times, layers, trust)
    stamps = np.asarray(listing.times, np.float64)
    period = listing.period if period is None else period
    check_times(str(path), listing.labels, stamps, period)
    order = np.argsort(stamps, kind="stable")
    reader = _Reader(listing, order, trust)
    sheets: dict[Sheet, LightmapSet] = {}
    for atlas in listing.atlases:
        valid = mask_from = None
        chosen = str(mask) if mask is not None else atlas.mask
        # Light first: its alpha is the atlas' mask.
        for layer in sorted(listing.layers, key=lambda layer: layer.encoding != "radiance"):
            by_alpha = chosen in ("alpha", None) and valid is None and layer.encoding == "radiance"
            stack = reader.read(atlas, layer, by_alpha)
            if valid is None:
                valid = _valid(listing, atlas, layer, stack, chosen)
                mask_from = "the alpha of the light; --mask all takes all" if stack.alpha is not None else chosen
            labels = [_name_of(state[atlas.name, layer.name].path) for state in listing.states]
            for sheet, frames in stack.frames.items():
                told = str(path), str(mask_from), listing.warn_order
                sheets[sheet] = _checked(sheet, listing.name, labels, stamps, order, frames, valid, period, *told)
    order_of = {layer.name: i for i, layer in enumerate(listing.layers)}
    atlas_of = {atlas.name: i for i, atlas in enumerate(listing.atlases)}
    placed = sorted(sheets, key=lambda sheet: (atlas_of[sheet.atlas], order_of[sheet.layer]))
    meshes = {atlas.name: atlas.mesh for atlas in listing.atlases}
    return LayeredSet(listing.name, {sheet: _with_mesh(sheet, sheets[sheet], meshes) for sheet in placed})


def from_layers(
    layers: Sequence[LayerArrays],
    times: Sequence[float] | np.ndarray,
    masks: Mapping[str, np.ndarray] | None = None,
    period: float | None = None,
    name: str = "array",
) -> LayeredSet:
    """Makes a checked layered set from arrays, under the same rules as `load`.

    Args:
        layers: In the order in which they are stored; all layers of an atlas have its height and width.
        times: `[T]`, in any order.
        masks: By atlas `[H, W]`, true where a texel is valid, or `[T, H, W]`; an atlas without one has no gaps.
        period: Length of the day in the unit of the times; None for a set that is not periodic.
        name: The set's name, used in messages too.

    Raises:
        WlmError: A shape is wrong, or an error of the module's table.
    """
    stamps = np.asarray(times, np.float64)
    sizes: dict[Sheet, tuple[int, int]] = {}
    sources: dict[Sheet, tuple[np.ndarray, list[int]]] = {}
    for layer in layers:
        frames = np.asarray(layer.frames)
        if frames.ndim != 4 or 0 in frames.shape or len(frames) != stamps.size or stamps.ndim != 1:
            where = f"{name}: {layer.atlas}/{layer.name}"
            raise WlmError(f"{where}: expected frames [{stamps.size}, H, W, C], none of them 0, got {frames.shape}")
        count = frames.shape[3]
        channels = tuple(layer.channels or ("RGBA"[:count] if count <= 4 else map(str, range(count))))
        if not all(is_name(value) for value in (layer.atlas, layer.name, *channels)):
            raise WlmError(
                f"{name}: atlases, layers, channels: expected names of 1 to {MOST_NAME} printable characters"
            )
        if layer.encoding not in ENCODINGS or len(channels) != count:
            raise WlmError(
                f"{name}: {layer.atlas}/{layer.name}: expected an encoding of {', '.join(ENCODINGS)} and {count} "
                f"channels, got {layer.encoding!r} and {len(channels)}"
            )
        for sheet in sheets_of(layer.atlas, layer.name, channels, layer.encoding):
            if sheet in sizes:
                raise WlmError(f"{name}: {layer.atlas}/{layer.name}: expected each channel of a layer once")
            sizes[sheet] = frames.shape[1:3]
            sources[sheet] = frames, [channels.index(channel) for channel in sheet.channels]
    check_sheets(name, sizes)
    if unknown := (masks or {}).keys() - {sheet.atlas for sheet in sizes}:
        raise WlmError(f"{name}: masks: expected those of atlases that layers are of, found {sorted(unknown)[0]!r}")
    labels = [f"frame {i} (time {time:g})" for i, time in enumerate(stamps)]
    check_times(name, labels, stamps, period)
    order = np.argsort(stamps, kind="stable")
    sheets, made = {}, 0
    for sheet, (frames, chosen) in sources.items():
        valid = np.asarray((masks or {}).get(sheet.atlas, np.ones(sizes[sheet], bool))).astype(bool)
        if valid.shape not in (frames.shape[1:3], frames.shape[:3]):
            raise WlmError(f"{name}: expected a mask of {frames.shape[1:3]}, got {valid.shape}")
        copied = room((*frames.shape[:3], 3), np.float32, name, made)
        made += copied.nbytes
        with np.errstate(over="ignore"):
            for frame, index in zip(copied, order, strict=True):
                frame[...] = sheet.levels(frames[index][..., chosen])
        valid = valid[order] if valid.ndim == 3 else valid
        sheets[sheet] = _checked(sheet, name, labels, stamps, order, copied, valid, period, name, "the mask", True)
    return LayeredSet(name, sheets)


@dataclass(frozen=True, eq=False)
class _Stack:
    """A layer of an atlas as read.

    Attributes:
        frames: Of each of its sheets, levels float32 [T, H, W, 3], in the order of the times.
        alpha: float32 [T, H, W], if it was asked for and is there.
    """

    frames: dict[Sheet, np.ndarray]
    alpha: np.ndarray | None


class _Reader:
    """Reads the layers of a listing, one after another."""

    def __init__(self, listing: LayeredListing, order: np.ndarray, trust: bool) -> None:
        self._listing, self._order, self._trust = listing, order, trust
        self._sizes: dict[Sheet, tuple[int, int]] = {}
        self._made = 0  # bytes of the sheets that room was made for
        self._held = {source.path for state in listing.states for source in state.values()}

    def read(self, atlas: Atlas, layer: Layer, need_alpha: bool) -> _Stack:
        """Reads a layer of an atlas at all times."""
        sources = [state[atlas.name, layer.name] for state in self._listing.states]
        stack = None
        for i, source in zip(np.argsort(self._order), sources, strict=True):
            pixels, names = _read(source, layer)
            if stack is None:
                stack, first = self._stack(atlas, layer, pixels, names, need_alpha, source), source
                at = [names.index(channel) for sheet in stack.frames for channel in sheet.channels]
                known = names
            if pixels.shape[:2] != next(iter(stack.frames.values())).shape[1:3] or names != known:
                raise WlmError(
                    f"{source.path}: is {_described(pixels.shape, names)}, but {first.path} is "
                    f"{_described(next(iter(stack.frames.values())).shape[1:3], known)}; expected the same"
                )
            start = 0
            for sheet, frames in stack.frames.items():
                chosen = at[start : start + len(sheet.channels)]
                frames[i] = sheet.levels(pixels[..., chosen])
                start += len(sheet.channels)
            if stack.alpha is not None:
                stack.alpha[i] = pixels[..., names.index(_ALPHA)]
        return stack

    def _stack(
        self,
        atlas: Atlas,
        layer: Layer,
        pixels: np.ndarray,
        names: tuple[str, ...],
        need_alpha: bool,
        source: Source,
    ) -> _Stack:
        """Makes room for a layer, given its first picture."""
        channels = layer.channels or (_LIGHT if layer.encoding == "radiance" else names)
        if missing := [channel for channel in channels if channel not in names]:
            found = ", ".join(names)
            raise WlmError(f"{source.path}: layer {layer.name}: expected a channel {missing[0]}, found {found}")
        size = pixels.shape[:2]
        if atlas.size not in (None, size):
            raise WlmError(f"{source.path}: is {_size(size)}, but {self._listing.where} states {_size(atlas.size)}")
        sheets = sheets_of(atlas.name, layer.name, channels, layer.encoding)
        self._sizes |= dict.fromkeys(sheets, size)
        check_sheets(str(self._listing.where), self._sizes)
        count = len(self._listing.states)
        if not self._trust:
            held = sum(os.path.getsize(file) for file in self._held if os.path.exists(file))
            total = sum(math.prod(at) for at in self._sizes.values()) * 3 * 4 * count
            check_growth(f"{self._listing.where}: lightmaps", held, total, PICTURE_GROWTH, FRAMES)
        where = f"{self._listing.where}: {count} pictures of {_size(size)}"
        frames = {}
        for sheet in sheets:
            frames[sheet] = room((count, *size, 3), np.float32, where, self._made)
            self._made += frames[sheet].nbytes
        alpha = room((count, *size), np.float32, where) if need_alpha and _ALPHA in names else None
        return _Stack(frames, alpha)


def _read(source: Source, layer: Layer) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads a picture: values [H, W, C] and the channels' names."""
    pixels, names, levels = read_channels(source.path)
    if levels:
        if layer.encoding == "radiance":
            raise WlmError(f"{source.path}: layer {layer.name}: expected light, found a PNG, whose bits say none")
        least, greatest = ENCODINGS[layer.encoding]
        pixels = np.float32(least) + pixels * np.float32(greatest - least)
    if source.slices > 1:
        height, rest = divmod(len(pixels), source.slices)
        if rest or not height:
            raise WlmError(f"{source.path}: expected {source.slices} slices of one height, found {len(pixels)} rows")
        pixels = pixels[source.slice * height : (source.slice + 1) * height]
    return pixels, names


def _valid(listing: LayeredListing, atlas: Atlas, layer: Layer, stack: _Stack, mask: str | None) -> np.ndarray:
    """The valid texels of an atlas, bool [H, W] or [T, H, W] in the order of the times."""
    frames = next(iter(stack.frames.values()))
    size, first = frames.shape[1:3], listing.states[0][atlas.name, layer.name].path
    if stack.alpha is not None:
        return np.isfinite(stack.alpha) & (stack.alpha > 0)
    if mask == "alpha":
        raise WlmError(f"{first}: expected light with a channel A, which the mask is to come from, found none")
    if mask in ("all", None):
        return np.ones(size, bool)
    return read_mask(Path(mask), first, size, ', "alpha" or "all"')


def _checked(
    sheet: Sheet,
    name: str,
    labels: Sequence[str],
    times: np.ndarray,
    order: np.ndarray,
    frames: np.ndarray,
    mask: np.ndarray,
    period: float | None,
    where: str,
    mask_from: str,
    warn_order: bool,
) -> LightmapSet:
    """Clamps levels and applies the table of `wlm.lightmap.data`."""
    warnings = list(_clamped(sheet, labels, order, frames, mask)) if sheet.linear else []
    return checked_set(
        f"{name} {sheet.label}",
        labels,
        times,
        order,
        frames,
        mask,
        period,
        where=where,
        mask_from=mask_from,
        warn_order=warn_order,
        warnings=warnings,
    )


def _clamped(
    sheet: Sheet, labels: Sequence[str], order: np.ndarray, frames: np.ndarray, mask: np.ndarray
) -> Iterator[str]:
    """Clamps levels to [0, 1], in place; infinite ones become NaN, which are repaired as NaN. Yields warnings."""
    least, greatest = ENCODINGS[sheet.encoding]
    for i, frame in enumerate(frames):
        inside = mask[i] if mask.ndim == 3 else mask
        frame[np.isinf(frame)] = np.nan
        with np.errstate(invalid="ignore"):
            beyond = np.count_nonzero(((frame < 0.0) | (frame > 1.0)).any(axis=2) & inside)
        if beyond:
            texels = f"{beyond} {'texel' if beyond == 1 else 'texels'}"
            yield f"{labels[order[i]]}: {sheet.label}: {texels} beyond {least:g} to {greatest:g}: clamped to it"
        np.clip(frame, 0.0, 1.0, out=frame)


def _with_mesh(sheet: Sheet, lightmaps: LightmapSet, meshes: Mapping[str, Path | None]) -> LightmapSet:
    return LightmapSet(**vars(lightmaps) | {"mesh": None if sheet.linear else meshes[sheet.atlas]})


def _name_of(path: Path) -> str:
    """A file with its folder, which tells a state."""
    return f"{path.parent.name}/{path.name}"


def _size(shape: Sequence[int]) -> str:
    return f"{shape[1]}x{shape[0]}"


def _described(shape: Sequence[int], names: Sequence[str]) -> str:
    return f"{_size(shape)} of {', '.join(names)}"
