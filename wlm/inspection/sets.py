"""Describes lightmap sets: missing files, sizes, UV layouts, and values."""

from collections.abc import Sequence
from pathlib import Path

from wlm.errors import WlmError, counted
from wlm.formats.light import noted
from wlm.inspection.finding import Finding, compress_command
from wlm.inspection.pictures import Picture, picture_of, read_lit, said, size_of
from wlm.lightmap.assumptions import set_lines, size_line
from wlm.lightmap.layout import PICTURES, odd_layout, spread
from wlm.lightmap.listing import Listing, list_set
from wlm.lightmap.sheet import BASE, LIGHT

UNREADABLE_SET = "a lightmap set that cannot be read"


def inspect_set(path: Path) -> Finding:
    """Describes the lightmap set that a `set.json` lists, and names its missing files."""
    folder = path.parent
    try:
        listings = list_set(path)
        files = list(dict.fromkeys(file for listing in listings.values() for file in listing.files))
        atlases = [atlas for listing in listings.values() for atlas in listing.atlases]
        masks = [mask for atlas in atlases if (mask := Path(str(atlas.mask))).suffix]  # the others are words
        if missing := [file.name for file in (*files, *masks) if not file.is_file()]:
            lost = f"{missing[0]} is missing" + f", and {len(missing) - 1} more" * (len(missing) > 1)
            return Finding(folder, f"a set of {counted(len(files), 'lightmap')}", problems=(lost,))
        if [*listings] != [BASE]:
            names = ", ".join(f"{name} at {counted(len(own.states), 'time')}" for name, own in listings.items())
            what = f"a set of lightmaps in {counted(len(listings), 'light group')}: {names}; {size_of(files[0])}"
            problems = [f"{name}: {line}" for name, own in listings.items() for line in assumed(own)]
            return Finding(folder, what, compress_command(folder), tuple(problems))
        listing = listings[BASE]
        what, problems = f"a set of lightmaps at {counted(len(listing.states), 'time')}", list[str]()
        if any(key != (LIGHT.atlas, LIGHT.layer) for key in listing.states[0]):
            names = ", ".join(layer.name for layer in listing.layers)
            what = f"{what}: {counted(len(listing.atlases), 'atlas', 'atlases')} with {names}"
        else:
            stored = listing.layers[0].stored
            what = f"{what}, {size_of(files[0])}" + (f", stored as {stored}" if stored else "")
            problems = [] if stored else together(files, [picture_of(file) for file in files])[0]
        return Finding(folder, what, compress_command(folder), (*problems, *assumed(listing)))
    except WlmError as error:
        return Finding(folder, UNREADABLE_SET, problems=(said(error, path),))


def named(path: Path, files: Sequence[Path]) -> set[Path]:
    """Returns which of `files` a `set.json` names as pictures or masks; none if it cannot be read."""
    try:
        listings = list_set(path).values()
    except WlmError:
        return set()
    masks = (Path(str(atlas.mask)) for listing in listings for atlas in listing.atlases)
    return {*masks, *(file for listing in listings for file in listing.files)} & set(files)


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


def together(files: Sequence[Path], heads: Sequence[Picture | None]) -> tuple[list[str], str]:
    """Checks whether pictures are one lightmap at several times, from all headers and the texels of at most eight.
    Returns the problems, one line each, and the common size, such as "512x256"; "" if the pictures are not one
    lightmap."""
    for file, head in zip(files, heads, strict=True):
        if head is None or not head.is_light:
            raise WlmError(f"{file.name}: expected a picture of light, found a file of another kind")
    sized = [(file, head) for file, head in zip(files, heads, strict=True) if head is not None and head.width]
    for file, head in sized[1:]:
        if head.size != sized[0][1].size:
            return [f"{file.name} is {head.size}, {sized[0][0].name} is {sized[0][1].size}"], ""
    chosen = [files[i] for i in spread(len(files), PICTURES)]
    lit, notes = [], []
    for file in chosen:
        try:
            one, found = read_lit(file)
        except WlmError as error:
            raise WlmError(f"{file.name}: {said(error, file)}") from error
        lit.append(one)
        notes.append(found)
    problems = noted([file.name for file in chosen], notes)
    if len({one.shape for one in lit}) > 1:
        return [*problems, "their sizes differ"], ""
    odd = odd_layout(len(lit), lit.__getitem__)
    if odd is None:
        return problems, "{1}x{0}".format(*lit[0].shape)
    first, second = (chosen[i].name for i in odd)
    return [*problems, f"{first} and {second} have different charts"], ""
