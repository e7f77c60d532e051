"""Describes lightmap sets: missing files, sizes, UV layouts, and values."""

from collections.abc import Sequence
from pathlib import Path

from wlm.errors import WlmError
from wlm.formats.light import noted
from wlm.inspection.finding import Finding, compress_command
from wlm.inspection.pictures import Picture, picture_of, read_lit, said, size_of
from wlm.lightmap.assumptions import set_lines, size_line
from wlm.lightmap.layout import PICTURES, odd_layout, spread
from wlm.lightmap.listing import Listing, count_of, list_set
from wlm.lightmap.sheet import LIGHT

UNREADABLE_SET = "a lightmap set that cannot be read"


def inspect_set(path: Path) -> Finding:
    """Describes the lightmap set that a `set.json` lists, and names its missing files."""
    try:
        listing = list_set(path)
        if any(key != (LIGHT.atlas, LIGHT.layer) for key in listing.states[0]):
            sheets = f"{count_of(listing.atlases, 'atlas')} with {', '.join(layer.name for layer in listing.layers)}"
            problems = sorted(
                {f"{s.path.name} is missing" for one in listing.states for s in one.values() if not s.path.is_file()}
            )
            what = f"a set of lightmaps with layers at {count_of(listing.states, 'time')}: {sheets}"
            problems = [*problems[:4], *assumed(listing)]
            return Finding(path.parent, what, compress_command(path.parent), tuple(problems))
        return _checked(path.parent, listing)
    except WlmError as error:
        return Finding(path.parent, UNREADABLE_SET, problems=(said(error, path),))


def named(path: Path, files: Sequence[Path]) -> set[Path]:
    """Returns the files that a `set.json` names."""
    try:
        listing = list_set(path)
    except WlmError:
        return set()
    return {*listing.files, *(Path(str(atlas.mask)) for atlas in listing.atlases)} & set(files)


def _checked(folder: Path, listing: Listing) -> Finding:
    missing = [file.name for file in listing.files if not file.is_file()]
    problems = [f"{missing[0]} is missing" + f", and {len(missing) - 1} more" * (len(missing) > 1)] if missing else []
    files = list(dict.fromkeys(file for file in listing.files if file.is_file()))
    heads = [picture_of(file) for file in files]
    size = size_of(files[0]) if files else ""
    what = f"a set of lightmaps at {count_of(listing.files, 'time')}, {size or 'an unknown size'}"
    problems += assumed(listing)
    if (stored := listing.layers[0].stored) is not None:
        return Finding(folder, f"{what}, stored as {stored}", compress_command(folder), tuple(problems))
    problems += together(files, heads)[0]
    return Finding(folder, what, compress_command(folder), tuple(problems))


def assumed(listing: Listing) -> list[str]:
    """Returns the lines about times, states and sizes of a set that `wlm compress` prints, too."""
    lines = list(set_lines(listing))
    for atlas in listing.atlases:
        lead = ""
        for layer in listing.light_first:
            source = next(
                (state[atlas.name, layer.name] for state in listing.states if (atlas.name, layer.name) in state), None
            )
            size = "" if source is None else size_of(source.path, source.slices)
            if lead and size and size != lead:
                lines.append(size_line(atlas.name, layer.name, size, lead))
            lead = lead or size
    return lines


def together(files: Sequence[Path], heads: Sequence[Picture | None]) -> tuple[list[str], bool]:
    """Checks whether pictures are one lightmap at several times, from all headers and the texels of at most eight.

    Returns:
        The problems, one line each, and whether the pictures may be one lightmap.
    """
    problems = []
    for file, head in zip(files, heads, strict=True):
        if head is None or not head.is_light:
            return [f"{file.name} has no radiance"], True
    sized = [(file, head) for file, head in zip(files, heads, strict=True) if head is not None and head.width]
    for file, head in sized[1:]:
        if head.size != sized[0][1].size:
            return [f"{file.name} is {head.size}, {sized[0][0].name} is {sized[0][1].size}"], False
    chosen = [files[i] for i in spread(len(files), PICTURES)]
    lit, notes = [], []
    for file in chosen:
        try:
            one, found = read_lit(file)
        except WlmError as error:
            return [*problems, f"{file.name}: {said(error, file)}"], True
        lit.append(one)
        notes.append(found)
    problems += noted([file.name for file in chosen], notes)
    if len({one.shape for one in lit}) > 1:
        return [*problems, "their sizes differ"], False
    odd = odd_layout(len(lit), lit.__getitem__)
    if odd is None:
        return problems, True
    first, second = (chosen[i].name for i in odd)
    return [*problems, f"{first} and {second} have different charts"], False
