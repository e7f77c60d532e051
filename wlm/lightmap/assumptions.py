"""Lines about what is assumed of a set of lightmaps, the same from `wlm compress` and `wlm inspect`."""

import hashlib
import os
import re
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

from wlm.formats.reading import open_file
from wlm.lightmap.listing import Listing, Source
from wlm.lightmap.sheet import LIGHT

# Endings that Bakery and others give to what lies beside the light.
_OTHER_MAP = re.compile(r"_(dir|l1[xyz]?|rnm[0-2]|ao|normal|mask|shadowmask)$", re.IGNORECASE)
_NAMED = 8  # names that a line lists


def set_lines(listing: Listing, period: float | None = None) -> Iterator[str]:
    """Yields one line for each assumption about the times and the states of a set, without the name of the set.
    `listing` is the set. `period` is the length of the day that the caller gives; None uses the set's."""
    times, period = listing.times, listing.period if period is None else period
    if len(times) > 1 and listing.origin:
        pairs = [f"{label} = {time:.6g}" for label, time in zip(listing.labels, times, strict=True)]
        yield f"{listing.origin}: {_some(pairs)}" + (f"; period {period:g}" if period else "")
    if listing.doubt:
        yield listing.doubt
    light = [state.get((LIGHT.atlas, LIGHT.layer)) for state in listing.states]
    if others := [
        source.label for source in light if source and len(times) > 1 and _OTHER_MAP.search(source.path.stem)
    ]:
        yield f"{_some(others)}: by their names no light of a time: list them as layers in a set.json"
    if len(times) > 1 and not period:
        yield (
            f"no period is stated: before {min(times):.6g} and after {max(times):.6g} the first and the last lightmap "
            "stay; for hours of a day give --period 24"
        )
    digests: dict[Path, bytes] = {}
    for atlas, layer in product(listing.atlases, listing.layers):
        name = f"{atlas.name}/{layer.name}"
        sources = [state.get((atlas.name, layer.name)) for state in listing.states]
        absent = [label for label, source in zip(listing.labels, sources, strict=True) if source is None]
        if len(absent) == len(sources):
            yield f"{name} is in no state: left out"
        elif absent:
            yield f"{name} is not in {_some(absent)}: the nearest time's is used there, and not scored"
        for group in _equal(sources, digests) if layer.encoding == LIGHT.encoding else ():
            labels = _some([listing.labels[i] for i in group])
            yield f"{name} of {labels}: equal files: was one bake saved under several times?"


def size_line(atlas: str, layer: str, size: str, lead: str) -> str:
    """Returns a line: a layer's size, such as "64x32", differs from `lead`, the size of the atlas's first layer."""
    return f"{atlas}/{layer} is {size}, but the first layer of {atlas} is {lead}: each keeps its size"


def _equal(sources: Sequence[Source | None], digests: dict[Path, bytes]) -> list[list[int]]:
    """Returns groups of indices of pictures that are byte for byte equal; keeps the hash of each file that is read."""
    sizes: dict[tuple[int, ...], list[tuple[int, Path]]] = {}
    for i, source in enumerate(sources):
        if source is not None and os.path.isfile(source.path):  # False for a name that is too long
            key = source.path.stat().st_size, source.slice, source.slices
            sizes.setdefault(key, []).append((i, source.path))
    groups: dict[tuple[object, ...], list[int]] = {}
    for key, found in sizes.items():
        for i, path in found if len(found) > 1 else ():
            if path not in digests:
                with open_file(path, "the lightmap") as file:
                    digests[path] = hashlib.file_digest(file, "blake2b").digest()
            groups.setdefault((key, digests[path]), []).append(i)
    return [group for group in groups.values() if len(group) > 1]


def _some(names: Sequence[str]) -> str:
    rest = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {rest} more" if rest > 0 else "")
