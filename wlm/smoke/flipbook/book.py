"""Flip books: textures with one cell per frame of six-way lightmaps, row by row from the top left.

EXR stores half floats. PNG and TGA store 8 bits per channel, linear in 0 to 1: import them without sRGB decoding. Light
is premultiplied by the opacity: a picture is this light plus the background times 1 - alpha.
`wlm.smoke.camera.LAYOUTS` lists the content of the channels.
"""

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path
from wlm.formats.exr import write_exr
from wlm.smoke.camera import ALPHA, EMISSION, LAYOUTS
from wlm.smoke.data import read_shaded, spread
from wlm.smoke.flipbook.reading import NOTE, suffix_of
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.scene import Looks
from wlm.smoke.shading import Ramp
from wlm.system import Meter, OnProgress

RATE = 25.0
"""Frames per second if the smoke has no rate."""


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame of six-way lightmaps with their camera, and if there are obstacles also with their depth; and the scene's
    settings for its picture, None if unknown."""

    number: int
    six: SixWay
    looks: Looks | None = None


def read_shots(
    files: Mapping[int, Path],
    device: str = "cpu",
    count: int | None = None,
    progress: OnProgress | None = None,
    notes: list[str] | None = None,
) -> Iterator[Shot]:
    """Yields the frames of the EXR files, by number, that `bake` or `predict` wrote, at most `count`, evenly spread
    over all; `read_shaded` explains `notes`."""
    numbers = spread(tuple(files), count)
    meter = Meter(progress, "read", len(numbers))
    for done, number in enumerate(numbers, 1):
        yield Shot(number, *read_shaded(files[number], device, notes))
        meter.report(done)


@dataclass(frozen=True, eq=False)
class Book:
    """A flip book: two textures of six-way lightmaps, with a cell per frame.

    Attributes:
        first, second: The lightmaps, float32 [rows * (H + 2 padding), columns * (W + 2 padding), 3 or 4].
        layout: Name of the order of the channels, one of `wlm.smoke.camera.LAYOUTS`.
        rows, columns, count: Number of rows of cells, of columns of cells, and of frames.
        size: Height and width of a frame in pixels, without padding.
        padding: Width in pixels of the border around each frame.
        gain: Factor by which light is multiplied in the textures.
        hot: Whether a texture has a channel for emission.
        rate: Frames per second.
        extent: Height in world units of the region that a frame shows.
        ramp: Colour of the emission; None: grey.
    """

    first: np.ndarray
    second: np.ndarray
    layout: str
    rows: int
    columns: int
    count: int
    size: tuple[int, int]
    padding: int
    gain: float
    hot: bool
    rate: float
    extent: float
    ramp: Ramp | None

    @property
    def pages(self) -> dict[str, np.ndarray]:
        """Textures by name."""
        return {"first": self.first, "second": self.second}

    @property
    def channels(self) -> dict[str, tuple[str, ...]]:
        """Content of the channels of each texture, such as "right" or "alpha"."""
        pages = zip(self.pages.items(), LAYOUTS[self.layout], strict=True)
        return {name: contents[: page.shape[2]] for (name, page), contents in pages}

    @property
    def levels(self) -> int:
        """Index of the coarsest mip level at which no frame shows parts of neighbouring frames."""
        return mip_levels(*self.size, self.padding)


def pack_book(
    shots: Sequence[Shot],
    layout: str = "unity",
    *,
    columns: int | None = None,
    gain: float | None = None,
    padding: int = 0,
    rate: float | None = None,
) -> Book:
    """Packs frames into the textures of a flip book.

    A texture whose last channel is missing in all frames has three channels, as the second one without emission. Cells
    without a frame are black, with alpha 0.

    Args:
        shots: The frames, at least one, of one size.
        layout: Name of the order of the channels, one of `wlm.smoke.camera.LAYOUTS`.
        columns: Largest number of columns; None: such that the texture is nearest to a square.
        gain: Factor of the light; None: the largest with which no light is above 1.
        padding: Pixels around each frame that repeat its border, so that filters and mips do not mix frames.
        rate: Frames per second; None: that of the scene, or `RATE`.
    """
    frames = [shot.six for shot in shots]
    if any(frame.lightmaps.shape != frames[0].lightmaps.shape for frame in frames):
        raise ValueError("shots: expected lightmaps of one size, got several sizes")
    if layout not in LAYOUTS:
        raise ValueError(f"layout: expected one of {', '.join(LAYOUTS)}, got {layout!r}")
    if padding < 0:
        raise ValueError(f"padding: expected at least 0 pixels, got {padding}")
    gain = _brightest_gain(frames) if gain is None else gain
    if not 0 < gain < np.inf:
        raise ValueError(f"gain: expected a number above 0, got {gain}")
    columns = min(columns or math.ceil(len(frames) ** 0.5), len(frames))
    rows = -(-len(frames) // columns)
    size = (frames[0].lightmaps.shape[1], frames[0].lightmaps.shape[2])
    pages = []
    for names in _channels(frames, layout):
        planes = [[np.broadcast_to(_plane(frame, name, gain), size) for name in names] for frame in frames]
        pages.append(lay_out(np.moveaxis(np.array(planes, np.float32), 1, -1), rows, columns, padding))
    looks, camera = shots[0].looks, frames[0].camera
    return Book(
        first=pages[0],
        second=pages[1],
        layout=layout,
        rows=rows,
        columns=columns,
        count=len(frames),
        size=size,
        padding=padding,
        gain=gain,
        hot=any(frame.emission is not None for frame in frames),
        rate=_rate(shots) if rate is None else rate,
        extent=1.0 if camera is None else camera.extent,
        ramp=None if looks is None else looks.ramp,
    )


def _rate(shots: Sequence[Shot]) -> float:
    first, last = shots[0].looks, shots[-1].looks
    if first is None or last is None or not last.time > first.time:
        return RATE
    return (len(shots) - 1) / (last.time - first.time)


def _brightest_gain(frames: Sequence[SixWay]) -> float:
    planes = [plane for six in frames for plane in (six.lightmaps, six.emission) if plane is not None]
    brightest = max(float(plane.max()) for plane in planes)
    return 1.0 / brightest if brightest > 0 else 1.0


def _channels(frames: Sequence[SixWay], layout: str) -> tuple[tuple[str, ...], ...]:
    planes = {ALPHA: "transparency", EMISSION: "emission"}
    absent = [name for name, plane in planes.items() if all(getattr(frame, plane) is None for frame in frames)]
    return tuple(names[:-1] if names[-1] in absent else names for names in LAYOUTS[layout])


def _plane(frame: SixWay, name: str, gain: float) -> np.ndarray | float:
    if name == ALPHA:
        # A frame without transparency among others that have it counts as transparent.
        return 0.0 if frame.transparency is None else 1.0 - frame.transparency.cpu().numpy()
    if name == EMISSION:
        return 0.0 if frame.emission is None else gain * frame.emission.cpu().numpy()
    return gain * frame[name].cpu().numpy()


def lay_out(frames: np.ndarray, rows: int, columns: int, padding: int) -> np.ndarray:
    """Lays pictures [N, H, W, C] out in cells with borders of `padding` pixels; cells without picture are 0."""
    _count, height, width, channels = frames.shape
    page = np.zeros((rows, height + 2 * padding, columns, width + 2 * padding, channels), np.float32)
    around = [(0, 0), (padding, padding), (padding, padding), (0, 0)]
    for i, cell in enumerate(np.pad(frames, around, mode="edge")):
        page[i // columns, :, i % columns] = cell
    return page.reshape(rows * page.shape[1], columns * page.shape[3], channels)


def mip_padding(height: int, width: int, levels: int) -> int:
    """Returns the least padding in pixels with which `levels` mip levels do not mix neighbouring frames.

    A texel of the coarsest level must not span two cells, and the half texel that a filter reads beyond a frame's edge
    must be within its padding.
    """
    part = 2**levels
    for padding in range(part // 2, part // 2 + part):
        if (height + 2 * padding) % part == 0 == (width + 2 * padding) % part:
            return padding
    raise WlmError(
        f"mips: {levels} levels need cells with sides of a multiple of {part} pixels, which no padding gives for frames"
        f" of {width} x {height} pixels: use fewer levels"
    )


def mip_levels(height: int, width: int, padding: int) -> int:
    """Returns the index of the coarsest mip level that does not mix neighbouring padded frames; 0: no mips."""
    level = 0
    while 2**level <= padding and not any((n + 2 * padding) % 2 ** (level + 1) for n in (height, width)):
        level += 1
    return level


def write_book(book: Book, output: str | os.PathLike[str]) -> tuple[dict[Path, tuple[str, ...]], int]:
    """Writes the textures of a flip book to files NAME_1 and NAME_2, atomically: all of them or none.

    `output` is NAME with the suffix .exr, .png or .tga of all files, in an existing folder. Returns the names of the
    channels of each file, and the number of values that were clipped to the range of the files.
    """
    output = Path(output)
    paths = {name: output.with_name(f"{output.stem}_{i}{output.suffix}") for i, name in enumerate(book.pages, 1)}
    facts = {"layout": book.layout, "rows": book.rows, "columns": book.columns, "frames": book.count}
    text = json.dumps(facts | {"padding": book.padding, "gain": book.gain}, separators=(",", ":"))
    with ExitStack() as files:
        made = {path: files.enter_context(atomic_path(path)) for path in paths.values()}
        clipped = sum(_write_page(path, made[path], book.pages[name], text) for name, path in paths.items())
    return {path: book.channels[name] for name, path in paths.items()}, clipped


def _write_page(path: Path, temporary: Path, page: np.ndarray, text: str) -> int:
    """Writes a texture [H, W, 3 or 4] with its description `text` as an image of the kind of `path` into a temporary
    file; returns how many values are clipped."""
    if not np.isfinite(page).all():
        raise WlmError(f"{path}: cannot write: expected finite light, found NaN or infinity")
    if suffix_of(path) == ".exr":
        try:
            write_exr(temporary, page, note=json.loads(text))
        except WlmError as error:
            raise WlmError(str(error).replace(str(temporary), str(path))) from error
        return int((page > 65504.0).sum())
    image = Image.fromarray(np.round(np.clip(page, 0.0, 1.0) * 255.0).astype(np.uint8))
    entry: dict[str, Any] = {"id_section": text.encode()}
    if suffix_of(path) == ".png":
        entry = {"pnginfo": PngInfo()}
        entry["pnginfo"].add_text(NOTE, text)
    image.save(temporary, format=suffix_of(path)[1:].upper(), **entry)
    return int((page > 1.0).sum())
