"""Lightmaps that belong together: whether they are there, of one size, of one atlas, and of light."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from wlm.errors import WlmError
from wlm.inspection.finding import Finding, quoted
from wlm.inspection.pictures import Picture, picture_of, read_lit, said
from wlm.lightmap.layout import PICTURES, odd_layout, spread
from wlm.lightmap.listing import Listing, count_of, list_set
from wlm.lightmap.sheet import LIGHT

UNREADABLE = "a lightmap set that can't be read"


def compress_command(folder: Path, options: str = "") -> str:
    """What takes lightmaps in a folder."""
    return f"wlm lightmap compress {quoted(folder)}{options} -o OUT.wlm"


def inspect_set(path: Path) -> Finding:
    """Says what a `set.json` lists, and whether it is there."""
    try:
        listing = list_set(path)
        if any(key != (LIGHT.atlas, LIGHT.layer) for key in listing.states[0]):
            sheets = f"{count_of(listing.atlases, 'atlas')} with {', '.join(layer.name for layer in listing.layers)}"
            problems = sorted(
                {f"{s.path.name} is missing" for one in listing.states for s in one.values() if not s.path.is_file()}
            )
            what = f"a layered set of lightmaps at {count_of(listing.states, 'time')}: {sheets}"
            return Finding(path.parent, what, compress_command(path.parent), tuple(problems[:4]))
        return _checked(path.parent, listing)
    except WlmError as error:
        return Finding(path.parent, UNREADABLE, problems=(said(error, path),))


def named(path: Path, files: Sequence[Path]) -> set[Path]:
    """The files beside a `set.json` that it names."""
    try:
        listing = list_set(path)
    except WlmError:
        return set()
    return {*listing.files, *(Path(str(atlas.mask)) for atlas in listing.atlases)} & set(files)


def _checked(folder: Path, listing: Listing) -> Finding:
    """A set of lightmaps over time, with what may be wrong with it."""
    missing = [file.name for file in listing.files if not file.is_file()]
    problems = [f"{missing[0]} is missing" + f", and {len(missing) - 1} more" * (len(missing) > 1)] if missing else []
    files = list(dict.fromkeys(file for file in listing.files if file.is_file()))
    heads = [picture_of(file) for file in files]
    size = next((head.size for head in heads if head is not None and head.width), "an unknown size")
    problems += together(files, heads).problems
    what = f"a set of lightmaps at {count_of(listing.files, 'time')}, {size}"
    return Finding(folder, what, compress_command(folder), tuple(problems))


class Together(NamedTuple):
    """What is said of pictures that lie together.

    Attributes:
        problems: A line each.
        alike: Whether they may be one atlas at several times.
    """

    problems: list[str]
    alike: bool


def together(files: Sequence[Path], heads: Sequence[Picture | None]) -> Together:
    """Looks at pictures for one atlas: at all heads, and at the texels of eight at most."""
    problems = []
    for file, head in zip(files, heads, strict=True):
        if head is None or head.kind == "PNG":
            return Together([f"{file.name} is no picture of light"], True)
    sized = [(file, head) for file, head in zip(files, heads, strict=True) if head is not None and head.width]
    for file, head in sized[1:]:
        if head.size != sized[0][1].size:
            return Together([f"{file.name} is {head.size}, {sized[0][0].name} is {sized[0][1].size}"], False)
    chosen = [files[i] for i in spread(len(files), PICTURES)]
    lit = []
    for file in chosen:
        try:
            one, found = read_lit(file)
        except WlmError as error:
            return Together([*problems, f"{file.name}: {said(error, file)}"], True)
        lit.append(one)
        problems += [f"{file.name}: {text}" for text in found]
    if len({one.shape for one in lit}) > 1:
        return Together([*problems, "they differ in size"], False)
    odd = odd_layout(len(lit), lit.__getitem__)
    if odd is None:
        return Together(problems, True)
    first, second = (chosen[i].name for i in odd)
    return Together([*problems, f"{first} and {second} don't look like one atlas at two times"], False)
