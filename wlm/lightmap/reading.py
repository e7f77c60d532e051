"""Reads the pictures of a lightmap set that a `Listing` names, within bounds of memory and work."""

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wlm.errors import WlmError
from wlm.formats.channels import read_channels, read_encoded
from wlm.formats.light import noted, read_light
from wlm.formats.limits import FRAMES, PICTURE_GROWTH, Budget, check_growth
from wlm.formats.scratch import room
from wlm.lightmap.listing import AtlasInfo, LayerInfo, Listing, Source
from wlm.lightmap.sheet import LIGHT, VALUE_RANGES, Sheet, check_sheets, sheets_of
from wlm.texels import doubts

ALL, FROM_ALPHA = "all", "alpha"
"""Words for masks: all texels are valid, or those whose alpha is above 0."""

_READERS = 2  # decompression releases Python's lock; more threads than this only compete for the disk
_LIGHT_CHANNELS = ("R", "G", "B")
_ALPHA = "A"


def size_text(shape: Sequence[int]) -> str:
    """Returns the size of a picture [H, W, ...] as text, width first, such as "512x256"."""
    return f"{shape[1]}x{shape[0]}"


@dataclass(frozen=True, eq=False)
class Stack:
    """The pictures of a layer of an atlas at T times: `frames`, float32 [T, H, W, 3] by sheet, are levels; `alpha`,
    bool [T, H, W], is true where alpha is above 0, and None if the mask is not from alpha; `present`, bool [T], marks
    the times that have a picture; `warnings` are lines about the pictures."""

    frames: dict[Sheet, np.ndarray]
    alpha: np.ndarray | None
    present: np.ndarray
    warnings: list[str]


class Bounds:
    """Limits of all groups of a set together, unless it is trusted (`wlm.formats.limits`); `made` counts the bytes of
    the sheets that memory was allocated for."""

    def __init__(self, where: str, listings: Sequence[Listing], trust: bool) -> None:
        """Takes the groups' listings; `where` names the set in messages."""
        self._where, self._trust, self.made = where, trust, 0
        files = {file for listing in listings for file in listing.files}
        self._held = sum(os.path.getsize(file) for file in files if os.path.exists(file))
        # A file may serve many atlases, layers and groups, each of which reads it whole.
        self._budget = Budget(where, max(FRAMES, PICTURE_GROWTH * self._held), "decoded bytes")

    def claim(self, size: int) -> None:
        """Checks the bytes of sheets that memory will be allocated for, besides `made`."""
        if not self._trust:
            check_growth(self._where, self._held, self.made + size, PICTURE_GROWTH, FRAMES)

    def decoded(self, size: int) -> None:
        """Counts the bytes of a picture that was read."""
        if not self._trust:
            self._budget.spend(size)


class Reader:
    """Reads the pictures that a `Listing` names, one layer of one atlas at a time."""

    def __init__(self, listing: Listing, order: np.ndarray, bounds: Bounds) -> None:
        """Takes a group's listing, the indices that sort its times, int [T], and the limits of the set."""
        self._listing, self._place, self._bounds = listing, np.argsort(order), bounds
        self._sizes: dict[Sheet, tuple[int, int]] = {}

    def read(self, atlas: AtlasInfo, layer: LayerInfo, mask: str | None, leads: bool) -> Stack | None:
        """Reads a layer's pictures at all times; None without any. With `leads`, checks the atlas's stated size."""
        key = atlas.name, layer.name
        sources = {i: state[key] for i, state in enumerate(self._listing.states) if key in state}
        if not sources:
            return None
        start, first = next(iter(sources.items()))
        files: dict[str, list[int]] = {}
        for index, source in sources.items():
            files.setdefault(os.path.normpath(source.path), []).append(index)
        notes: dict[int, list[str]] = {index: [] for index in sources}
        whole, names = self._file(first.path, layer, layer.channels, notes[start])
        pixels = _part(whole, first)
        has_alpha = mask == FROM_ALPHA or (mask is None and _ALPHA in names)
        size, known = pixels.shape[:2], names
        if leads and atlas.size not in (None, size):
            raise WlmError(
                f"{first.path}: has {size_text(size)} pixels, but {self._listing.where} states {size_text(atlas.size)}"
            )
        stack = self._stack(atlas, layer, size, names, has_alpha, first.path)
        stack.present[self._place[list(sources)]] = True

        def put(index: int, pixels: np.ndarray, names: tuple[str, ...]) -> int:
            place, source = self._place[index], sources[index]
            if pixels.shape[:2] != size:
                raise WlmError(
                    f"{source.path}: has {size_text(pixels.shape)} pixels, but {first.path} has {size_text(size)}; all "
                    "times of a layer need one size"
                )
            if layer.encoding != LIGHT.encoding and names != known:
                raise WlmError(
                    f"{source.path}: has the channels {', '.join(names)}, but {first.path} has {', '.join(known)}; all "
                    "times of a layer need the same"
                )
            for sheet, frames in stack.frames.items():
                frames[place] = sheet.to_levels(pixels[..., [names.index(name) for name in sheet.channels]])
            if stack.alpha is None:
                return 0
            if _ALPHA not in names:
                found = ", ".join(names)
                raise WlmError(f"{source.path}: expected a channel A for the mask, found the channels {found}")
            alpha = pixels[..., names.index(_ALPHA)]
            stack.alpha[place] = np.isfinite(alpha) & (alpha > 0)
            return int(np.count_nonzero(~np.isfinite(alpha)))

        def put_all(path: str) -> None:
            """Reads a file once and stores its pictures for all times that use the file."""
            indices = files[path]
            at, read = indices[0], (whole, names)
            if at != start:
                read = self._file(sources[at].path, layer, layer.channels or names, notes[at])
            for index in indices:
                broken[index] = put(index, _part(read[0], sources[index]), read[1])

        broken = dict.fromkeys(sources, 0)
        pool = ThreadPoolExecutor(_READERS)
        try:
            # In order, so that the error names the first of several bad files.
            list(pool.map(put_all, files))
        finally:
            pool.shutdown(cancel_futures=True)
        stack.warnings.extend(noted([source.label for source in sources.values()], list(notes.values())))
        for index, count in broken.items():
            if count:
                label = sources[index].label
                stack.warnings.append(f"{label}: {count} texels are not valid: alpha is NaN or infinite")
        if stack.alpha is not None:
            stack.alpha[~stack.present] = stack.alpha.any(0)
        return stack

    def _stack(
        self,
        atlas: AtlasInfo,
        layer: LayerInfo,
        size: tuple[int, int],
        names: tuple[str, ...],
        alpha: bool,
        first: Path,
    ) -> Stack:
        channels = layer.channels or (_LIGHT_CHANNELS if layer.encoding == LIGHT.encoding else names)
        if missing := [channel for channel in channels if channel not in names]:
            found = ", ".join(names)
            raise WlmError(f"{first}: layer {layer.name}: expected a channel {missing[0]}, found the channels {found}")
        where = self._listing.where
        sheets = sheets_of(atlas.name, layer.name, channels, layer.encoding)
        self._sizes |= dict.fromkeys(sheets, size)
        check_sheets(str(where), self._sizes)
        count = len(self._listing.states)
        self._bounds.claim(len(sheets) * math.prod(size) * 3 * 4 * count)
        # One array from the start: a list of frames that is stacked at the end would need twice the memory.
        text, frames = f"{where}: {count} lightmaps of {size_text(size)}", {}
        for sheet in sheets:
            frames[sheet] = room((count, *size, 3), np.float32, text, self._bounds.made)
            self._bounds.made += frames[sheet].nbytes
        return Stack(frames, np.zeros((count, *size), bool) if alpha else None, np.zeros(count, bool), [])

    def _file(
        self, path: Path, layer: LayerInfo, wanted: tuple[str, ...] | None, notes: list[str]
    ) -> tuple[np.ndarray, tuple[str, ...]]:
        pixels, names = _read(path, layer, notes)
        grey = next((name for name in ("L", "Y") if name in names), None)
        if grey is not None and "R" in (wanted or ()) and "R" not in names:
            at = names.index(grey)
            rest = [i for i in range(len(names)) if i != at]
            pixels, names = pixels[..., [at, at, at, *rest]], (*_LIGHT_CHANNELS, *(names[i] for i in rest))
            notes.append("its grey is taken as red, green and blue")
        self._bounds.decoded(pixels.nbytes)
        return pixels, names


def _part(pixels: np.ndarray, source: Source) -> np.ndarray:
    if source.slices == 1:
        return pixels
    height, rest = divmod(len(pixels), source.slices)
    if rest or not height:
        raise WlmError(
            f"{source.path}: expected {source.slices} slices of equal height, found {len(pixels)} rows of pixels"
        )
    return pixels[source.slice * height : (source.slice + 1) * height]


def _read(path: Path, layer: LayerInfo, notes: list[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    light = layer.encoding == LIGHT.encoding
    if light and layer.stored is not None:
        pixels, names = read_encoded(path, layer.stored, notes), _LIGHT_CHANNELS
    elif light and layer.channels is None:
        pixels, names = read_light(path, notes)
        notes += doubts(pixels[..., :3])
    else:
        pixels, names, levels = read_channels(path, notes, light)
        if levels and light:
            raise WlmError(
                f"{path}: layer {layer.name}: expected linear light, such as an EXR, found a picture of "
                "integers: state what light they stand for with --encoding, or stored in a set.json"
            )
        if levels:
            least, greatest = VALUE_RANGES[layer.encoding]
            pixels = np.float32(least) + pixels * np.float32(greatest - least)
    return pixels, names
