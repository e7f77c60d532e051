"""Flip books: textures with one cell per frame of six-way lightmaps, row by row from the top left.

EXR stores half floats. PNG and TGA store 8 bits per channel, linear in 0 to 1: import them without sRGB decoding. Light
is premultiplied by the opacity: a picture is this light plus the background times 1 - alpha.
`wlm.smoke.camera.LAYOUTS` lists the content of the channels.
"""

import io
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
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
from wlm.smoke.camera import ALPHA, DIRECTIONS, EMISSION, LAYOUTS, Camera
from wlm.smoke.data import Frames, read_shaded, spread
from wlm.smoke.flipbook.motion import ZERO, encoded, frames_motion, mip_levels, scale_of
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.scene import Looks
from wlm.smoke.shading import Ramp
from wlm.system import Meter, OnProgress

RATE = 25.0
"""Frames per second if the smoke has no rate."""

_SUFFIXES = (".exr", ".png", ".tga")
_MODES, _GREY = ("RGB", "RGBA"), ("L", "LA")
_BARE, _LIT = 0.999, 0.05  # least transparency without smoke; largest mean light there


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame of six-way lightmaps, and the scene's settings for its picture.

    Attributes:
        number: Number of the frame.
        six: Lightmaps with their camera; if there are obstacles, also with their depth.
        looks: Lights, colours and obstacles of the scene; None: unknown.
    """

    number: int
    six: SixWay
    looks: Looks | None = None


def read_shots(
    files: Mapping[int, Path], device: str = "cpu", count: int | None = None, progress: OnProgress | None = None
) -> Iterator[Shot]:
    """Yields the frames of lightmaps that `bake` or `predict` wrote, one after the other.

    Args:
        files: EXR files by frame number.
        device: Device of the lightmaps.
        count: Largest number of frames, which are evenly spread over all; None: all frames.
        progress: Called after each frame.

    Raises:
        WlmError: A file is damaged or of another kind.
    """
    numbers = spread(tuple(files), count)
    meter = Meter(progress, "read", len(numbers))
    for done, number in enumerate(numbers, 1):
        yield Shot(number, *read_shaded(files[number], device))
        meter.report(done)


@dataclass(frozen=True, eq=False)
class Book:
    """A flip book: two textures of six-way lightmaps and optionally one of motion vectors, with a cell per frame.

    Attributes:
        first, second: The lightmaps, float32 [rows * (H + 2 padding), columns * (W + 2 padding), 3 or 4].
        motion: Motion vectors, float32 [..., 3] of the same size, see `wlm.smoke.flipbook.motion`; None: no motion.
        layout: Name of the order of the channels, one of `wlm.smoke.camera.LAYOUTS`.
        rows, columns, count: Number of rows of cells, of columns of cells, and of frames.
        size: Height and width of a frame in pixels, without padding.
        padding: Width in pixels of the border around each frame.
        gain: Factor by which light is multiplied in the textures.
        hot: Whether a texture has a channel for emission.
        scale: Largest motion that the texture can store, as a share of a frame's size; None: no motion.
        rate: Frames per second.
        extent: Height in world units of the region that a frame shows.
        ramp: Colour of the emission; None: grey.
    """

    first: np.ndarray
    second: np.ndarray
    motion: np.ndarray | None
    layout: str
    rows: int
    columns: int
    count: int
    size: tuple[int, int]
    padding: int
    gain: float
    hot: bool
    scale: float | None
    rate: float
    extent: float
    ramp: Ramp | None

    @property
    def pages(self) -> dict[str, np.ndarray]:
        """Textures by name."""
        pages = {"first": self.first, "second": self.second, "motion": self.motion}
        return {name: page for name, page in pages.items() if page is not None}

    @property
    def channels(self) -> dict[str, tuple[str, ...]]:
        """Content of the channels of each texture, such as "right" or "alpha"."""
        first, second = LAYOUTS[self.layout]
        named = {"first": first, "second": second, "motion": ("right", "up")}
        return {name: named[name][: page.shape[2]] for name, page in self.pages.items()}

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
    air: Frames | None = None,
    rate: float | None = None,
    progress: OnProgress | None = None,
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
        air: Frames with velocities, from `wlm.smoke.flipbook.motion.open_motion`, for motion vectors; None: no motion.
        rate: Frames per second; None: that of the scene, or `RATE`.
        progress: Called after the motion of each frame has been computed.

    Raises:
        ValueError: The frames have several sizes, the layout is unknown, or a number is out of its range.
        WlmError: As for `frames_motion`.
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
    scale, motion = None, None
    if air is not None:
        moved = frames_motion(air, [shot.number for shot in shots], frames, progress)
        scale = scale_of(moved)
        motion = lay_out(encoded(moved, scale), rows, columns, padding, ZERO)
    looks, camera = shots[0].looks, frames[0].camera
    return Book(
        first=pages[0],
        second=pages[1],
        motion=motion,
        layout=layout,
        rows=rows,
        columns=columns,
        count=len(frames),
        size=size,
        padding=padding,
        gain=gain,
        hot=any(frame.emission is not None for frame in frames),
        scale=scale,
        rate=_rate(shots) if rate is None else rate,
        extent=1.0 if camera is None else camera.extent,
        ramp=None if looks is None else looks.ramp,
    )


def _rate(shots: Sequence[Shot]) -> float:
    """Returns the frames per second, from the times of the first and the last frame, or `RATE` without a scene."""
    first, last = shots[0].looks, shots[-1].looks
    if first is None or last is None or not last.time > first.time:
        return RATE
    return (len(shots) - 1) / (last.time - first.time)


def _brightest_gain(frames: Sequence[SixWay]) -> float:
    planes = [plane for six in frames for plane in (six.lightmaps, six.emission) if plane is not None]
    brightest = max(float(plane.max()) for plane in planes)
    return 1.0 / brightest if brightest > 0 else 1.0


def _channels(frames: Sequence[SixWay], layout: str) -> tuple[tuple[str, ...], ...]:
    """Returns the names of the two textures' channels, without a last channel that no frame has."""
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


def lay_out(frames: np.ndarray, rows: int, columns: int, padding: int, empty: float = 0.0) -> np.ndarray:
    """Lays pictures [N, H, W, C] out in cells with borders of `padding` pixels; cells without picture are `empty`."""
    _count, height, width, channels = frames.shape
    page = np.full((rows, height + 2 * padding, columns, width + 2 * padding, channels), empty, np.float32)
    around = [(0, 0), (padding, padding), (padding, padding), (0, 0)]
    for i, cell in enumerate(np.pad(frames, around, mode="edge")):
        page[i // columns, :, i % columns] = cell
    return page.reshape(rows * page.shape[1], columns * page.shape[3], channels)


def write_book(book: Book, output: str | os.PathLike[str]) -> tuple[dict[Path, tuple[str, ...]], int]:
    """Writes the textures of a flip book to files NAME_1, NAME_2 and, with motion, NAME_motion, each atomically.

    Args:
        book: The flip book.
        output: Path in an existing folder: NAME with the suffix .exr, .png or .tga of all files.

    Returns:
        The names of the channels of each file, and the number of values that were clipped to the range of the files.

    Raises:
        WlmError: The suffix is wrong, a number is not finite, or a file cannot be written.
    """
    output = Path(output)
    endings = {"first": "1", "second": "2", "motion": "motion"}
    paths = {name: output.with_name(f"{output.stem}_{endings[name]}{output.suffix}") for name in book.pages}
    clipped = sum(_write_page(path, book.pages[name]) for name, path in paths.items())
    return {path: book.channels[name] for name, path in paths.items()}, clipped


def _write_page(path: Path, page: np.ndarray) -> int:
    """Writes a texture [H, W, 3 or 4] and returns the number of clipped values."""
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
    layout: str,
    *,
    rows: int,
    columns: int,
    straight: bool = False,
    device: str = "cpu",
) -> list[SixWay]:
    """Reads the frames of a flip book of any program; the unknown camera is taken to be in front of the smoke.

    Args:
        paths: The files, .exr, .png or .tga (8 bits per channel, linear): the two of the layout, and optionally a third
            with the opacity in its alpha or first channel.
        layout: Name of the order of the channels, one of `LAYOUTS`.
        rows, columns: Number of rows and of columns of cells; all cells are read.
        straight: Whether the files have straight (unpremultiplied) alpha; the result is premultiplied.
        device: Device of the frames.

    Returns:
        The frames, float32; transparency and emission are None if no channel stores them.

    Raises:
        WlmError: There are not two or three files; one is missing, damaged, of another kind or size, has numbers that
            are not finite, or lacks a channel of the layout; or alpha is straight and there is no opacity.
    """
    where = ", ".join(map(str, paths))
    if len(paths) not in (2, 3):
        raise WlmError(f"{where}: expected two textures, or three with one of opacity, got {len(paths)}")
    pages = [_read(path, grey=number == 2) for number, path in enumerate(paths)]
    if any(page.shape[:2] != pages[0].shape[:2] for page in pages):
        raise WlmError(f"{where}: expected textures of one size, found {[page.shape[:2] for page in pages]}")
    height, width = pages[0].shape[0] // rows, pages[0].shape[1] // columns
    if pages[0].shape[:2] != (rows * height, columns * width) or not (height and width):
        size = "{1}x{0} pixels".format(*pages[0].shape)
        raise WlmError(f"{where}: expected sides that divide into {rows} rows and {columns} columns, found {size}")
    planes: dict[str, torch.Tensor] = {}
    named = [*LAYOUTS[layout], (ALPHA,)]
    if len(pages) == 3:
        pages[2] = pages[2][..., -1:] if pages[2].shape[2] in (2, 4) else pages[2][..., :1]
    for page, names in zip(pages, named, strict=False):
        cells = page.reshape(rows, height, columns, width, -1).transpose(4, 0, 2, 1, 3)
        cells = torch.from_numpy(cells.reshape(-1, rows * columns, height, width).astype(np.float32)).to(device)
        planes |= dict(zip(names, cells, strict=False))
    missing = [name for name in DIRECTIONS if name not in planes]
    if missing:
        raise WlmError(f"{where}: layout {layout}: expected channels for {', '.join(missing)}, found none")
    camera = Camera.look_at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), extent=1.0, height=height, width=width)
    maps = torch.stack([planes[name] for name in DIRECTIONS], 1)
    alpha, glow = planes.get(ALPHA), planes.get(EMISSION)
    if straight:
        if alpha is None:
            raise WlmError(f"{where}: expected an alpha channel or a third texture for straight alpha, found none")
        maps, glow = maps * alpha[:, None], None if glow is None else glow * alpha
    absent = [None] * len(maps)
    parts = (maps, absent if alpha is None else 1.0 - alpha, absent if glow is None else glow)
    return [SixWay(*part, camera) for part in zip(*parts, strict=True)]


def is_straight(frames: Sequence[SixWay]) -> bool:
    """Returns whether pixels without smoke have light, a sign of straight alpha; False if there is no opacity."""
    bare = [frame.lightmaps.amax(0)[frame.transparency > _BARE] for frame in frames if frame.transparency is not None]
    light = torch.cat(bare) if bare else torch.zeros(0)
    return len(light) > 0 and float(light.mean()) > _LIT


def _read(path: str | os.PathLike[str], *, grey: bool) -> np.ndarray:
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
                raise WlmError(f"{path}: expected {' or '.join(modes)} with 8 bits per channel, found {image.mode}")
            floats = 4 * image.width * image.height * len(image.getbands())
            check_growth(str(path), len(data), floats, PICTURE_GROWTH)
            pixels = np.asarray(image).astype(np.float32) / np.float32(255.0)
            return pixels.reshape(*pixels.shape[:2], -1)
    except DAMAGED_PICTURE as error:
        raise WlmError(f"{path}: cannot read the picture: {str(error) or type(error).__name__}") from error


def _suffix(path: str | os.PathLike[str]) -> str:
    suffix = Path(path).suffix.lower()
    if suffix not in _SUFFIXES:
        raise WlmError(f"{path}: expected a name that ends in {', '.join(_SUFFIXES)}, found {suffix or 'none'}")
    return suffix
