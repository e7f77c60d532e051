"""Names of channels, layers and files by which programs store six-way lightmaps of smoke."""

import re
from collections.abc import Sequence

from wlm.errors import WlmError
from wlm.smoke.camera import ALPHA, DIRECTIONS, EMISSION, LAYOUTS

Layout = tuple[tuple[str, ...], tuple[str, ...]]
"""Content of the channels R, G, B and A of two textures: directions, `ALPHA`, `EMISSION`, or "-" for another."""

PAIRS = (
    ("rlt", "bbf", "o3de"),
    ("tlr", "bbf", "embergen"),
    ("rtb", "lbf", "unity"),
    ("rtbk", "lbtf", "unity"),
    ("tlrb", "fb", "o3de-tlrb"),
    *((first, second, "unity") for first, second in (("positive", "negative"), ("pos", "neg"), ("p", "n"))),
    *((first, second, "") for first, second in (("a", "b"), ("1", "2"))),
)
"""Parts of the names of the first and the second texture, and the layout that they stand for, "" for any."""

TRANSPARENCY = "transparency"
_WORDS = {
    **{name: name for name in (*DIRECTIONS, TRANSPARENCY, ALPHA, EMISSION)},
    **{"rgt": "right", "lft": "left", "up": "top", "bot": "bottom", "down": "bottom", "behind": "back"},
    **{"opacity": ALPHA, "emissive": EMISSION, "fire": EMISSION},
}
_LETTERS = "RGBA"


def parse_layout(text: str) -> Layout:
    """Returns a layout by its name or by its channels, such as "right,left,top,alpha:bottom,back,front,emission"."""
    if text in LAYOUTS:
        return LAYOUTS[text]
    pages = tuple(tuple(page.split(",")) for page in text.split(":"))
    listed = [name for page in pages for name in page if name != "-"]
    known = {*DIRECTIONS, ALPHA, EMISSION}
    if len(pages) != 2 or max(map(len, pages)) > 4 or not set(DIRECTIONS) <= set(listed) <= known:
        names = ", ".join(LAYOUTS)
        raise WlmError(
            f"--from: expected {names}, or channels such as right,top,back,alpha:left,bottom,front, got {text}"
        )
    if len(set(listed)) != len(listed):
        raise WlmError(f"--from: expected each channel once, got {text}")
    return pages


def layout_name(layout: Layout) -> str:
    """Returns the text that `parse_layout` reads: the name of a layout, or its channels."""
    named = next((name for name, pages in LAYOUTS.items() if pages == layout), None)
    return named or ":".join(",".join(page) for page in layout)


def second_names(first: str, back: bool = False) -> list[tuple[str, str]]:
    """Returns the names that a flip book's second texture may have if the first is named `first`, each with its layout,
    "" for any; with `back` the names of the first texture, given that of the second."""
    found = []
    for one, other, layout in PAIRS:
        if back:
            one, other = other, one
        # A part begins after a separator or, in upper case, after a lower-case letter: smoke_RLT, lightmapA.
        for match in re.finditer(rf"(?:^|(?<=[_. -])|(?<=[a-z])(?=[A-Z]))(?i:{one})(?=[_. -]|$)", first):
            name = first[: match.start()] + _like(match[0], other) + first[match.end() :]
            found += (
                [(name, layout)]
                if not layout
                else [(name, layout), (re.sub(r"(?<=[_.-])1(?=[_.-])", "2", name), layout)]
            )
    return list(dict.fromkeys(found))


def _like(text: str, other: str) -> str:
    return other.upper() if text.isupper() else other


def six_way_channels(names: Sequence[str]) -> dict[str, list[list[str]]]:
    """Finds six-way lightmaps among the channels of an EXR file: for each direction, `ALPHA`, `EMISSION` and
    `TRANSPARENCY` the channels of each candidate; empty if a direction has none.

    A direction is a channel such as "left", a layer or a part such as "C_left" of R, G and B, or a channel of one of
    two layers that are named like textures, such as "lightmapA.R".
    """
    found: dict[str, dict[str, list[str]]] = {}
    layers: dict[str, dict[str, str]] = {}
    for name in names:
        layer, _, letter = name.rpartition(".")
        colour = letter.upper() in _LETTERS and len(letter) == 1
        if colour:
            layers.setdefault(layer, {})[letter.upper()] = name
        source = layer if colour else name
        words = re.findall(r"[A-Z]?[a-z]+|[A-Z]+", source)
        roles = {_WORDS[word.lower()] for word in words if word.lower() in _WORDS}
        if len(roles) == 1 and not (colour and letter in "Aa" and len(layers[layer]) > 1):
            found.setdefault(roles.pop(), {}).setdefault(source, []).append(name)
    if not set(DIRECTIONS) <= set(found):
        found = {}
        for first, own in layers.items():
            for second, layout in second_names(first):
                pages = LAYOUTS[layout or "unity"]
                if {*_LETTERS[:3]} <= set(own) and {*_LETTERS[:3]} <= set(layers.get(second, ())):
                    for page, layer in zip(pages, (first, second), strict=True):
                        for role, letter in zip(page, _LETTERS, strict=True):
                            if letter in layers[layer]:
                                found.setdefault(role, {})[layer] = [layers[layer][letter]]
    if not set(DIRECTIONS) <= set(found):
        return {}
    if ALPHA not in found and TRANSPARENCY not in found:
        sources = ["", *(each for each in layers if each.lower() in ("rgba", "beauty", "c")), *found["front"]]
        alpha = next((layers[each]["A"] for each in sources if "A" in layers.get(each, ())), None)
        if alpha is not None:
            found[ALPHA] = {"": [alpha]}
    return {role: list(candidates.values()) for role, candidates in found.items()}
