"""Six-way lightmaps of any program: textures of flip books, and EXR files with a layer or a part per light.

Such files do not state what their numbers mean. Each reader takes it from its options, from wlm's own entry in the file
or beside it, or from the content, and notes in one line what it assumed.
"""

import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from pydantic import BaseModel, Field

from wlm.errors import WlmError
from wlm.formats.exr import read_every_channel, read_exr
from wlm.formats.exr_header import check_header
from wlm.formats.folder import read_index
from wlm.formats.levels import read_levels
from wlm.formats.limits import SURE_BYTES
from wlm.smoke.camera import ALPHA, DIRECTIONS, EMISSION, LAYOUTS, Camera
from wlm.smoke.flipbook.naming import TRANSPARENCY, Layout, layout_name, parse_layout, second_names, six_way_channels
from wlm.smoke.lightmaps import SixWay, axis_faults, axis_shifts, light_centres

NOTE = "wlm"
"""Name of the entry of a PNG or an EXR file, and content of the identification field of a TGA file, with JSON."""

SUFFIXES = (".exr", ".png", ".tga")

_LEAST_SHIFT, _CLEARLY = 1e-3, 1.1  # of the centres of light; share by which another layout must fit better
_BARE, _LIT = 0.001, 0.05  # largest opacity without smoke; largest mean light there if alpha is premultiplied
_THIN, _THICK, _FEWEST = (0.02, 0.1), 0.5, 16  # opacities whose light tells straight from premultiplied, and pixels
_STRAIGHT, _PREMULTIPLIED = 4.0, 2.5  # light over opacity of thin smoke, as a multiple of that of thick smoke
_SAMPLES = 1 << 20
_MOST_CELLS, _SMALLEST = 64, 8  # cells along a side, and pixels of a cell, of a guess
_DARK = 0.02  # of the mean light: at the borders of cells, and in a cell without smoke


class _Stated(BaseModel, strict=True, allow_inf_nan=False):
    """The description of a texture that `write_book` stores in its document."""

    layout: Literal[tuple(LAYOUTS)]  # type: ignore[valid-type]
    rows: int = Field(ge=1, le=4096)
    columns: int = Field(ge=1, le=4096)
    frames: int = Field(ge=0, le=4096)
    padding: int = Field(ge=0, le=4096)
    gain: float = Field(gt=0.0)


def read_flipbook(
    paths: Sequence[str | os.PathLike[str]],
    layout: str | None = None,
    *,
    rows: int | None = None,
    columns: int | None = None,
    straight: bool | None = None,
    gain: float | None = None,
    notes: list[str] | None = None,
    device: str = "cpu",
) -> list[SixWay]:
    """Reads the frames of a flip book of any program; the unknown camera is taken to be in front of the smoke.

    An argument that is None is read from the entry that `write_book` or `wlm.export` wrote, then from the files' names,
    then from their content.

    Args:
        paths: The files, .exr, .png or .tga (linear): the two of the layout, and optionally a third with the opacity in
            its alpha or first channel; or one EXR file with a layer or a part per light.
        layout: A layout for `parse_layout`; else the one that the light fits best, or "unity".
        rows, columns: Number of rows and of columns of cells; all cells are read.
        straight: Whether the files have straight (unpremultiplied) alpha; the result is premultiplied.
        gain: Factor by which the light in the files was multiplied; else 1.
        notes: Receives a line with what is assumed, and a line for each contradiction.
        device: Device of the frames.

    Returns:
        The frames, float32; transparency and emission are None if no channel stores them.
    """
    where, lines, said = ", ".join(map(str, paths)), [] if notes is None else notes, []
    if not (len(paths) in (2, 3) or (len(paths) == 1 and Path(paths[0]).suffix.lower() == ".exr")):
        raise WlmError(f"{where}: expected two textures, or three with one of opacity, got {len(paths)} file(s)")
    stated: dict[str, Any] = {}
    if len(paths) == 1:
        planes = read_layers(paths[0], lines)
        if layout is not None:
            raise WlmError(f"{where}: expected no layout for an EXR file whose channels have names, got {layout}")
        said.append("one EXR file of all directions")
        rows, columns = rows or 1, columns or 1
        pages = [np.stack([*planes.values()], -1)]
        names: list[Sequence[str]] = [[*planes]]
    else:
        read = [_read(Path(path), grey=number == 2) for number, path in enumerate(paths)]
        pages, stated = [page for page, _ in read], _stated(read[0][1], Path(paths[0]))
        if any(page.shape[:2] != pages[0].shape[:2] for page in pages):
            raise WlmError(f"{where}: expected textures of one size, found {[page.shape[:2] for page in pages]}")
        if len(pages) == 3:
            pages[2] = pages[2][..., -1:] if pages[2].shape[2] in (2, 4) else pages[2][..., :1]
    rows, columns, padding = _cells(where, Path(paths[0]), pages, (rows, columns), stated, said)
    frames = [torch.from_numpy(_cut(page, rows, columns, padding)).to(device) for page in pages]  # [N, C, H, W]
    count = min(int(stated.get("frames", rows * columns)), rows * columns)
    frames = [each[: max(count, 1)] for each in frames]
    if len(paths) > 1:
        names = [*_layout(where, Path(paths[0]), frames[:2], layout, stated, said, lines), (ALPHA,)]
    found = {
        name: each[:, i]
        for each, page in zip(frames, names, strict=False)
        for i, name in enumerate(page[: each.shape[1]])
    }
    missing = [name for name in DIRECTIONS if name not in found]
    if missing:
        text = layout_name((tuple(names[0]), tuple(names[1])))
        raise WlmError(f"{where}: layout {text}: expected channels for {', '.join(missing)}, found none")
    maps, alpha, glow = torch.stack([found[name] for name in DIRECTIONS], 1), found.get(ALPHA), found.get(EMISSION)
    if len(paths) == 1:
        lines += [f"{where}: {fault}" for fault in axis_faults(maps)]
    if straight and alpha is None:
        raise WlmError(f"{where}: expected an alpha channel or a texture of opacity for straight alpha, found none")
    if alpha is not None:
        source = "as given"
        if straight is None and (stated or len(paths) == 1):
            straight, source = False, "as wlm wrote it" if stated else "as EXR defines it"
        straight = _straight(where, maps, alpha, straight, source, said, lines)
    gain = gain or stated.get("gain")
    said.append(f"light divided by the gain {gain:.4g}" if gain else "light as stored (else --from-gain)")
    factor = (alpha[:, None] if alpha is not None and straight else 1.0) / torch.tensor(gain or 1.0)
    maps = maps * factor
    if glow is not None:
        glow = glow * (factor[:, 0] if factor.ndim else factor)
    said.append("seen from the front")
    lines.insert(0, f"{where}: {'; '.join(said)}")
    camera = front_camera(*maps.shape[2:])
    absent = [None] * len(maps)
    parts = (maps, absent if alpha is None else 1.0 - alpha, absent if glow is None else glow)
    return [SixWay(*part, camera) for part in zip(*parts, strict=True)]


def front_camera(height: int, width: int) -> Camera:
    """Returns the camera that is taken for files without one: in front of the smoke, an image of height 1."""
    return Camera.look_at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), extent=1.0, height=height, width=width)


def read_layers(path: str | os.PathLike[str], notes: list[str]) -> dict[str, np.ndarray]:
    """Reads the six-way lightmaps of an EXR file whose channels, layers or parts are named after directions. Returns
    float32 [H, W] per direction, and `ALPHA` and `EMISSION` if there are channels for them."""
    pixels, names = read_every_channel(path, notes)
    roles = six_way_channels(names)
    if not roles:
        found = ", ".join(names[:12])
        raise WlmError(f"{path}: expected channels, layers or parts for {', '.join(DIRECTIONS)}, found {found}")
    planes = {}
    for role, candidates in roles.items():
        if len(candidates) > 1:
            listed = " and ".join(each[0] for each in candidates[:2])
            raise WlmError(f"{path}: expected one layer for {role}, found {listed}")
        colours = pixels[..., [names.index(name) for name in candidates[0]]]
        if not np.isfinite(colours).all():
            raise WlmError(f"{path}: channel {candidates[0][0]}: expected finite numbers, found NaN or infinity")
        planes[role] = colours.mean(-1)
        if (np.ptp(colours, -1) > 0.02 * colours.max()).any():
            notes.append(f"{path}: {role}: its colours differ; their mean is taken as the light")
    if TRANSPARENCY in planes:
        planes[ALPHA] = 1.0 - planes.pop(TRANSPARENCY)
    return planes


def guess_book(first: Path, second: Path) -> str | None:
    """Returns the layout of two textures if their light is that of six directions; None otherwise."""
    pages = [_read(path)[0] for path in (first, second)]
    if pages[0].shape[:2] != pages[1].shape[:2]:
        return None
    rows, columns = guess_cells(pages) or (1, 1)
    return _best([torch.from_numpy(_cut(page, rows, columns, 0)) for page in pages], ())[0]


def guess_cells(pages: Sequence[np.ndarray]) -> tuple[int, int] | None:
    """Guesses the rows and columns of cells from dark lines between pictures of smoke; None if there are none."""
    light = sum(page.sum(-1) for page in pages)
    # Lines of constant light, as the alpha of an opaque texture, do not count.
    light = light - light.min()
    found = []
    for axis in (1, 0):
        profile = light.mean(axis)
        best = 0
        for count in range(1, min(_MOST_CELLS, len(profile) // _SMALLEST) + 1):
            if len(profile) % count:
                continue
            strips = profile.reshape(count, -1)
            borders = np.minimum(strips[1:, 0], strips[:-1, -1])
            limit = _DARK * profile.mean()
            if profile.mean() > 0 and (borders <= limit).all() and (strips.mean(1) > limit).all():
                best = count
        found.append(best)
    return (found[0], found[1]) if all(found) else None


def _cells(
    where: str,
    path: Path,
    pages: Sequence[np.ndarray],
    given: tuple[int | None, int | None],
    stated: Mapping[str, Any],
    said: list[str],
) -> tuple[int, int, int]:
    """Returns the rows and columns of cells and the padding of each, and says where they are from."""
    height, width = pages[0].shape[:2]
    named = re.search(r"(?<!\d)(\d{1,2})x(\d{1,2})(?!\d)", path.stem)
    source, rows, columns = "as given", *given
    if rows is None or columns is None:
        if {"rows", "columns"} <= stated.keys():
            source, rows, columns = "as wlm wrote it", stated["rows"], stated["columns"]
        elif named and height % int(named[2] or 1) == 0 == width % int(named[1] or 1):
            source, rows, columns = "by its name", int(named[2]), int(named[1])
        elif guess := guess_cells(pages):
            source, (rows, columns) = "by its dark borders (else --cells)", guess
    if not rows or not columns:
        raise WlmError(f"{where}: expected --cells ROWSxCOLUMNS: neither the names nor dark borders show the cells")
    padding = int(stated.get("padding", 0)) if (rows, columns) == (stated.get("rows"), stated.get("columns")) else 0
    cell = height // rows, width // columns
    if (height, width) != (rows * cell[0], columns * cell[1]) or min(cell) <= 2 * padding:
        raise WlmError(
            f"{where}: expected textures that divide into {rows} rows and {columns} columns of cells, found a height "
            f"of {height} and a width of {width} pixels"
        )
    said.append(f"{rows} x {columns} cells, {source}")
    return rows, columns, padding


def _cut(page: np.ndarray, rows: int, columns: int, padding: int) -> np.ndarray:
    """Cuts a texture [H, W, C] into its cells without their padding, float32 [rows * columns, C, h, w]."""
    height, width = page.shape[0] // rows, page.shape[1] // columns
    cells = page.reshape(rows, height, columns, width, -1).transpose(0, 2, 4, 1, 3)
    cells = cells[..., padding : height - padding, padding : width - padding]
    return np.ascontiguousarray(cells.reshape(rows * columns, *cells.shape[2:]), np.float32)


def _layout(
    where: str,
    path: Path,
    frames: Sequence[torch.Tensor],
    given: str | None,
    stated: Mapping[str, Any],
    said: list[str],
    notes: list[str],
) -> Layout:
    """Chooses the layout, and notes a better one if the light contradicts it."""
    named = next((layout for _, layout in second_names(path.stem) if layout), None)
    chosen, source = given or stated.get("layout") or named, "as given" if given else "by its name"
    layout = parse_layout(chosen or "unity")
    best, total, own = _best(frames, (layout,))
    if chosen is None and best is not None:
        layout, source, own = parse_layout(best), "by its light (else --from)", total
    elif chosen is None:
        source = "by default (else --from)"
    elif best is not None and best != layout_name(layout) and total > _CLEARLY * max(own, 0.0) + _LEAST_SHIFT:
        notes.append(
            f"warning: {where}: the light contradicts the layout {layout_name(layout)}; it fits --from {best} better"
        )
    said.insert(0, f"layout {layout_name(layout)}, {source}")
    return layout


def _best(frames: Sequence[torch.Tensor], others: Sequence[Layout]) -> tuple[str | None, float, float]:
    """Finds the layout whose directions fit the light of two textures [N, C, H, W]. Besides the known layouts, these
    with the textures exchanged, and the variants of `others` with two opposite directions exchanged, are tried. Returns
    its text for `parse_layout`, None if no layout fits; how well it fits; and how well the first of `others` does."""
    counts = [each.shape[1] for each in frames]
    centres = light_centres(torch.cat(list(frames), 1))
    tried = [*LAYOUTS.values(), *(layout[::-1] for layout in LAYOUTS.values())]
    for layout in others:
        for one, other in zip(DIRECTIONS[::2], DIRECTIONS[1::2], strict=True):
            swap = {one: other, other: one}
            tried.append(tuple(tuple(swap.get(name, name) for name in page) for page in layout))  # type: ignore[arg-type]
    best, most, own = None, 0.0, 0.0
    for layout in (*others, *tried):
        places = {
            name: i + (counts[0] if page else 0)
            for page, listed in enumerate(layout)
            for i, name in enumerate(listed[: counts[page]])
        }
        if not set(DIRECTIONS) <= places.keys():
            continue
        shifts = axis_shifts(centres[[places[name] for name in DIRECTIONS]])
        own = float(shifts.sum()) if others and layout is others[0] else own
        if float(shifts.min()) > _LEAST_SHIFT and float(shifts.sum()) > most:
            best, most = layout_name(layout), float(shifts.sum())
    return best, most, own


def _straight(
    where: str,
    maps: torch.Tensor,
    alpha: torch.Tensor,
    given: bool | None,
    source: str,
    said: list[str],
    notes: list[str],
) -> bool:
    """Returns whether alpha is straight: as `given`, else by its light, else false; adds lines on this and doubts."""
    seen = _is_straight(maps, alpha)
    kinds = {True: "straight", False: "premultiplied"}
    if given is None:
        source = "by its light" if seen is not None else "assumed"
        said.append(f"alpha {kinds[bool(seen)]}, {source} (else --{kinds[not seen]})")
        return bool(seen)
    said.append(f"alpha {kinds[given]}, {source}")
    if seen is not None and seen != given:
        notes.append(f"warning: {where}: the light suggests {kinds[seen]} alpha (--{kinds[seen]})")
    return given


def _is_straight(maps: torch.Tensor, alpha: torch.Tensor) -> bool | None:
    """Tells straight from premultiplied alpha by lightmaps [N, 6, H, W] and opacity [N, H, W]; None: it can't be told.
    Premultiplied light fades with the opacity, straight light does not."""
    bright, alpha = maps.amax(1).flatten(), alpha.flatten()
    bare = bright[alpha <= _BARE]
    if len(bare) and float(bare.mean()) > _LIT:
        return True
    ratio = bright / alpha.clamp(min=_BARE)
    thin, thick = ratio[(alpha > _THIN[0]) & (alpha < _THIN[1])], ratio[alpha > _THICK]
    if min(len(thin), len(thick)) < _FEWEST:
        return None
    thick = thick[:: max(len(thick) // _SAMPLES, 1)]
    share = float(thin.median()) / max(float(thick.quantile(0.95)), 1e-9)
    return True if share > _STRAIGHT else False if share < _PREMULTIPLIED else None


def _stated(entry: bytes | str, path: Path) -> dict[str, Any]:
    """Parses the description that wlm wrote into a texture (`entry`) or beside it; an empty dict for other files."""
    try:
        found = json.loads(entry or b"{}")
        index = path.with_name("bundle.json")
        if not found and index.is_file():
            document = read_index(index)
            found = document if path.stem in document.get("channels", ()) and document.get("system") == "smoke" else {}
        return _Stated.model_validate(found).model_dump()
    except (ValueError, TypeError, AttributeError, WlmError, RecursionError):
        return {}


def _read(path: Path, *, grey: bool = False) -> tuple[np.ndarray, bytes | str]:
    """Reads a texture, float32 [H, W, C], and the entry that `write_book` wrote into it; empty for other files."""
    suffix = suffix_of(path)
    if suffix == ".exr":
        page = read_exr(path)[0]
        if not np.isfinite(page).all():
            raise WlmError(f"{path}: expected finite light, found NaN or infinity")
        return page, check_header(path)[0].attributes.get(NOTE, ("", b""))[1]
    entries: dict[Any, Any] = {}
    page, names = read_levels(path, suffix[1:].upper(), [], entries, SURE_BYTES)
    if len(names) < 3 and not grey:
        raise WlmError(f"{path}: expected a texture of RGB or RGBA, found one of {', '.join(names)}")
    return page, entries.get(NOTE) or entries.get("id_section") or b""


def suffix_of(path: str | os.PathLike[str]) -> str:
    """Returns the suffix of a texture in lower case."""
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise WlmError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}, found {suffix or 'none'}")
    return suffix
