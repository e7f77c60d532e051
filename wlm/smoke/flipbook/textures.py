"""Textures of six-way flip books: two textures with the frames in rows of cells from the top left.

EXR stores half floats. PNG and TGA store 8 bits per channel, linear in 0 to 1: import them without sRGB decoding. Light
is premultiplied by the opacity: it is added to the background times 1 - alpha.
`wlm.smoke.camera.LAYOUTS` lists the channels.
"""

import io
import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path
from wlm.formats.exr import read_exr, write_exr
from wlm.formats.limits import IMAGE_BYTES, PICTURE_GROWTH, check_growth
from wlm.formats.mask import DAMAGED_PICTURE
from wlm.formats.reading import read_file
from wlm.smoke.camera import ALPHA, DIRECTIONS, EMISSION, LAYOUTS
from wlm.smoke.lightmaps import SixWay

_SUFFIXES = (".exr", ".png", ".tga")
_MODES, _GREY = ("RGB", "RGBA"), ("L", "LA")
_BARE, _LIT = 0.999, 0.05  # least transparency without smoke; largest mean light there


def cells(count: int, columns: int | None = None) -> tuple[int, int]:
    """Returns rows and columns of cells for frames, with at most `columns` columns; None: nearest to a square."""
    columns = min(columns or math.ceil(count**0.5), count)
    return -(-count // columns), columns


def brightest_gain(frames: Sequence[SixWay]) -> float:
    """Returns the gain that scales the brightest light of the frames to 1; 1 if all frames are black."""
    planes = [plane for six in frames for plane in (six.lightmaps, six.emission) if plane is not None]
    brightest = max(float(plane.max()) for plane in planes)
    return 1.0 / brightest if brightest > 0 else 1.0


def channels(frames: Sequence[SixWay], layout: str) -> tuple[tuple[str, ...], ...]:
    """Returns the channels of the two textures; a last channel that no frame has is omitted."""
    planes = {ALPHA: "transparency", EMISSION: "emission"}
    absent = [name for name, plane in planes.items() if all(getattr(frame, plane) is None for frame in frames)]
    return tuple(names[:-1] if names[-1] in absent else names for names in LAYOUTS[layout])


def pack(
    frames: Sequence[SixWay], layout: str = "unity", *, rows: int, columns: int, gain: float = 1.0, padding: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Lays frames out in two textures.

    Channels are those of `channels`: the second texture of cold smoke has three.

    Args:
        frames: At least one, at most rows x columns, all of one size. Cells without a frame are empty: black, alpha 0.
        layout: One of `LAYOUTS`.
        rows, columns: Numbers of rows and columns of cells.
        gain: Factor of the lightmaps and the emission, to use the range of 8 bits.
        padding: Pixels around each frame that repeat its border, so that filters and mips do not show neighbours.

    Returns:
        Two arrays float32 [rows * (H + 2 padding), columns * (W + 2 padding), 3 or 4].

    Raises:
        ValueError: The frames do not fit, the layout is unknown, or the gain is not above 0.
    """
    _check_cells(layout, rows, columns, gain, padding)
    if not 1 <= len(frames) <= rows * columns:
        raise ValueError(f"expected 1 to {rows * columns} frames, got {len(frames)}")
    height, width = frames[0].lightmaps.shape[1:]
    for i, frame in enumerate(frames):
        if tuple(frame.lightmaps.shape[1:]) != (height, width):
            raise ValueError(f"frame {i}: expected {height} x {width}, got {tuple(frame.lightmaps.shape[1:])}")
    pages = []
    for names in channels(frames, layout):
        planes = [[np.broadcast_to(_plane(frame, name, gain), (height, width)) for name in names] for frame in frames]
        pages.append(lay_out(np.moveaxis(np.array(planes, np.float32), 1, -1), rows, columns, padding))
    return pages[0], pages[1]


def lay_out(frames: np.ndarray, rows: int, columns: int, padding: int, empty: float = 0.0) -> np.ndarray:
    """Lays pictures [N, H, W, C] out in cells of one texture, each with `padding` pixels that repeat its border."""
    _count, height, width, channels = frames.shape
    page = np.full((rows, height + 2 * padding, columns, width + 2 * padding, channels), empty, np.float32)
    around = [(0, 0), (padding, padding), (padding, padding), (0, 0)]
    for i, cell in enumerate(np.pad(frames, around, mode="edge")):
        page[i // columns, :, i % columns] = cell
    return page.reshape(rows * page.shape[1], columns * page.shape[3], channels)


def unpack(
    first: np.ndarray,
    second: np.ndarray,
    layout: str = "unity",
    *,
    rows: int,
    columns: int,
    count: int | None = None,
    gain: float = 1.0,
    padding: int = 0,
) -> list[SixWay]:
    """Cuts two textures into frames; inverse of `pack`.

    Args:
        first, second: [rows * (H + 2 padding), columns * (W + 2 padding), 3 or 4].
        layout: One of `LAYOUTS`.
        rows, columns: Numbers of rows and columns of cells.
        count: Number of frames; None: all cells.
        gain: Factor of the light.
        padding: Pixels around each frame.

    Returns:
        The frames, float32 on the CPU, without a camera; None for a plane without a channel.

    Raises:
        ValueError: The shapes do not fit each other, the cells or the layout.
    """
    _check_cells(layout, rows, columns, gain, padding)
    count = rows * columns if count is None else count
    if not 1 <= count <= rows * columns:
        raise ValueError(f"count: expected 1 to {rows * columns} frames, got {count}")
    if first.shape[:2] != second.shape[:2]:
        raise ValueError(f"expected two textures of one size, got {first.shape[:2]} and {second.shape[:2]}")
    if first.shape[0] % rows or first.shape[1] % columns or 0 in first.shape:
        raise ValueError(f"expected {rows} x {columns} cells of whole pixels, got {first.shape[0]} x {first.shape[1]}")
    if min(first.shape[0] // rows, first.shape[1] // columns) <= 2 * padding:
        raise ValueError(f"padding: expected cells of more than twice {padding} pixels, got {first.shape[:2]} in all")
    planes: dict[str, np.ndarray] = {}
    for page, names in zip((first, second), LAYOUTS[layout], strict=True):
        height, width = page.shape[0] // rows, page.shape[1] // columns
        cells = page.reshape(rows, height, columns, width, -1).transpose(0, 2, 4, 1, 3)
        cells = cells.reshape(rows * columns, -1, height, width)[:count].astype(np.float32)
        cells = cells[:, :, padding : height - padding, padding : width - padding]
        planes |= {name: cells[:, c] for c, name in enumerate(names[: page.shape[2]])}
    missing = [name for name in DIRECTIONS if name not in planes]
    if missing:
        raise ValueError(f"layout {layout}: expected channels for {', '.join(missing)}")
    maps = torch.from_numpy(np.stack([planes[name] for name in DIRECTIONS], 1) / np.float32(gain))
    transparency = torch.from_numpy(1.0 - planes[ALPHA]) if ALPHA in planes else [None] * count
    glow = torch.from_numpy(planes[EMISSION] / np.float32(gain)) if EMISSION in planes else [None] * count
    return [SixWay(*parts) for parts in zip(maps, transparency, glow, strict=True)]


def write_flipbook(
    paths: tuple[str | os.PathLike[str], str | os.PathLike[str]],
    frames: Sequence[SixWay],
    layout: str = "unity",
    *,
    rows: int,
    columns: int,
    gain: float = 1.0,
    padding: int = 0,
) -> int:
    """Writes frames as two textures, atomically.

    Args:
        paths: The two files, .exr, .png or .tga; their folders must exist.
        frames, layout, rows, columns, gain, padding: As for `pack`.

    Returns:
        Number of values above the range of the file, which were clipped.

    Raises:
        ValueError: As for `pack`.
        WlmError: The suffix is wrong, a number is not finite, or a file cannot be written.
    """
    for path in paths:
        _suffix(path)
    pages = pack(frames, layout, rows=rows, columns=columns, gain=gain, padding=padding)
    return sum(write_page(path, page) for path, page in zip(paths, pages, strict=True))


def write_page(path: str | os.PathLike[str], page: np.ndarray) -> int:
    """Writes a texture [H, W, 3 or 4], atomically; returns and raises as `write_flipbook`."""
    if not np.isfinite(page).all():
        raise WlmError(f"{path}: cannot write: expected finite light, found NaN or infinity")
    if _suffix(path) == ".exr":
        write_exr(path, page)
        return int((page > 65504.0).sum())
    image = Image.fromarray(np.round(np.clip(page, 0.0, 1.0) * 255.0).astype(np.uint8))
    with atomic_path(path) as temporary:
        image.save(temporary, format=_suffix(path)[1:].upper())
    return int((page > 1.0).sum())


def read_flipbook(
    paths: Sequence[str | os.PathLike[str]],
    layout: str = "unity",
    *,
    rows: int,
    columns: int,
    count: int | None = None,
    gain: float = 1.0,
    straight: bool = False,
    padding: int = 0,
) -> list[SixWay]:
    """Reads frames from two textures, or three.

    Args:
        paths: The files, .exr, .png or .tga (8 bits per channel, linear): two of the layout, and optionally one with
            the opacity in its alpha or first channel.
        layout, rows, columns, count, gain, padding: As for `unpack`.
        straight: Whether the files have straight (unpremultiplied) alpha; the result is premultiplied.

    Returns:
        As `unpack`.

    Raises:
        WlmError: A file is missing, damaged, of another kind or size, has numbers that are not finite, or lacks a
            channel of the layout; or alpha is straight and there is no opacity.
        ValueError: There are not two or three paths.
    """
    if len(paths) not in (2, 3):
        raise ValueError(f"expected two or three textures, got {len(paths)}")
    where = ", ".join(map(str, paths))
    pages = [_read(path) for path in paths[:2]]
    try:
        options = {"rows": rows, "columns": columns, "count": count, "gain": gain, "padding": padding}
        frames = unpack(pages[0], pages[1], layout, **options)
        if len(paths) == 3:
            opacity = _read(paths[2], grey=True)
            opacity = opacity[..., -1] if opacity.shape[2] in (2, 4) else opacity[..., 0]
            if opacity.shape != pages[0].shape[:2]:
                raise ValueError(f"expected textures of one size, got {pages[0].shape[:2]} and {opacity.shape}")
            cell = opacity.reshape(rows, opacity.shape[0] // rows, columns, -1).swapaxes(1, 2)
            cell = cell.reshape(rows * columns, *cell.shape[2:])
            height, width = cell.shape[1:]
            cell = cell[:, padding : height - padding, padding : width - padding].copy()
            frames = [replace(frame, transparency=torch.from_numpy(1.0 - cell[i])) for i, frame in enumerate(frames)]
    except ValueError as error:
        raise WlmError(f"{where}: {error}") from error
    if not straight:
        return frames
    if any(frame.transparency is None for frame in frames):
        raise WlmError(f"{where}: expected opacity, in an alpha or a third texture, for light without it")
    return [_covered(frame) for frame in frames]


def is_straight(frames: Sequence[SixWay]) -> bool:
    """Whether there is light where there is no smoke, which suggests straight alpha; False without opacity."""
    bare = [frame.lightmaps.amax(0)[frame.transparency > _BARE] for frame in frames if frame.transparency is not None]
    light = torch.cat(bare) if bare else torch.zeros(0)
    return len(light) > 0 and float(light.mean()) > _LIT


def _covered(frame: SixWay) -> SixWay:
    """Returns a frame with its light multiplied by its opacity."""
    opacity = 1.0 - frame.transparency
    emission = None if frame.emission is None else frame.emission * opacity
    return replace(frame, lightmaps=frame.lightmaps * opacity, emission=emission)


def _read(path: str | os.PathLike[str], *, grey: bool = False) -> np.ndarray:
    if _suffix(path) == ".exr":
        page = read_exr(path)[0]
        if not np.isfinite(page).all():
            raise WlmError(f"{path}: expected finite light, found NaN or infinity")
        return page
    data = read_file(path, IMAGE_BYTES, "the picture")
    try:
        # From memory: for a file on disk Pillow would allocate as many bytes as a chunk claims.
        with Image.open(io.BytesIO(data), formats=[_suffix(path)[1:].upper()]) as image:
            modes = (*_MODES, *_GREY) if grey else _MODES
            if image.mode not in modes:
                raise WlmError(f"{path}: expected {' or '.join(modes)} of 8 bits, found {image.mode}")
            floats = 4 * image.width * image.height * len(image.getbands())
            check_growth(str(path), len(data), floats, PICTURE_GROWTH)
            pixels = np.asarray(image).astype(np.float32) / np.float32(255.0)
            return pixels.reshape(*pixels.shape[:2], -1)
    except DAMAGED_PICTURE as error:
        raise WlmError(f"{path}: cannot read the picture: {str(error) or type(error).__name__}") from error


def _plane(frame: SixWay, name: str, gain: float) -> np.ndarray | float:
    if name == ALPHA:
        # A frame without transparency among others that have it counts as transparent.
        return 0.0 if frame.transparency is None else 1.0 - frame.transparency.cpu().numpy()
    if name == EMISSION:
        return 0.0 if frame.emission is None else gain * frame.emission.cpu().numpy()
    return gain * frame[name].cpu().numpy()


def _suffix(path: str | os.PathLike[str]) -> str:
    suffix = Path(path).suffix.lower()
    if suffix not in _SUFFIXES:
        raise WlmError(f"{path}: expected a name that ends in {', '.join(_SUFFIXES)}, found {suffix or 'none'}")
    return suffix


def _check_cells(layout: str, rows: int, columns: int, gain: float, padding: int) -> None:
    if layout not in LAYOUTS:
        raise ValueError(f"layout: expected one of {', '.join(LAYOUTS)}, got {layout!r}")
    if rows < 1 or columns < 1:
        raise ValueError(f"expected at least one row and column, got {rows} x {columns}")
    if not 0 < gain < np.inf:
        raise ValueError(f"gain: expected a number above 0, got {gain}")
    if padding < 0:
        raise ValueError(f"padding: expected at least 0, got {padding}")
