"""A flip book: textures of six-way lightmaps, and the facts that an engine needs to read them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wlm.smoke.camera import LAYOUTS
from wlm.smoke.data import Frames
from wlm.smoke.flipbook.depth import encoded_depth, frames_depth
from wlm.smoke.flipbook.motion import ZERO, encoded, frames_motion, mip_levels, scale_of
from wlm.smoke.flipbook.shots import Shot
from wlm.smoke.flipbook.textures import brightest_gain, cells, lay_out, pack
from wlm.smoke.shading import Ramp
from wlm.system import OnProgress

RATE = 25.0
"""Frames per second if the smoke has no rate."""


@dataclass(frozen=True, eq=False)
class Book:
    """A flip book.

    Attributes:
        first, second: float32 [rows * (H + 2 padding), columns * (W + 2 padding), 3 or 4], see
            `wlm.smoke.flipbook.textures`.
        motion: float32 [..., 3] of the same size, see `wlm.smoke.flipbook.motion`; or None.
        depth: float32 [..., 3] of the same size, see `wlm.smoke.flipbook.depth`; or None.
        layout: One of `wlm.smoke.camera.LAYOUTS`.
        rows, columns, count: Numbers of rows and columns of cells, and of frames.
        size: Height and width of a frame in pixels, without padding.
        padding: Pixels around a frame.
        gain: Factor of the light in the textures.
        hot: Whether there is a channel of emission.
        scale: Range of the motion in shares of a frame; None: no motion.
        reach: Range of the depth in heights of a frame; None: no depth.
        rate: Frames per second.
        extent: Height of the view in the world's unit.
        ramp: Colour of the emission; None: grey.
    """

    first: np.ndarray
    second: np.ndarray
    motion: np.ndarray | None
    depth: np.ndarray | None
    layout: str
    rows: int
    columns: int
    count: int
    size: tuple[int, int]
    padding: int
    gain: float
    hot: bool
    scale: float | None
    reach: float | None
    rate: float
    extent: float
    ramp: Ramp | None

    @property
    def pages(self) -> dict[str, np.ndarray]:
        """Textures by name."""
        pages = {"first": self.first, "second": self.second, "motion": self.motion, "depth": self.depth}
        return {name: page for name, page in pages.items() if page is not None}

    @property
    def channels(self) -> dict[str, tuple[str, ...]]:
        """Content of each texture's channels."""
        first, second = LAYOUTS[self.layout]
        named = {"first": first, "second": second, "motion": ("right", "up"), "depth": ("depth",)}
        return {name: named[name][: page.shape[2]] for name, page in self.pages.items()}

    @property
    def levels(self) -> int:
        """Smallest mip level at which frames do not show their neighbours."""
        return mip_levels(*self.size, self.padding)


def pack_book(
    shots: Sequence[Shot],
    layout: str = "unity",
    *,
    columns: int | None = None,
    gain: float | None = None,
    padding: int = 0,
    air: Frames | None = None,
    volumes: Frames | None = None,
    rate: float | None = None,
    progress: OnProgress | None = None,
) -> Book:
    """Packs frames into textures.

    Args:
        shots: The frames, at least one, of one size.
        layout: One of `wlm.smoke.camera.LAYOUTS`.
        columns: Largest number of columns; None: nearest to a square.
        gain: Factor of the light; None: the largest without clipping in 8 bits.
        padding: Pixels around each frame that repeat its border.
        air: Frames from `wlm.smoke.flipbook.motion.open_motion`, for a texture of motion; None: no motion.
        volumes: The smoke of the frames, for a texture of depth; None: no depth.
        rate: Frames per second; None: that of the scene, or `RATE`.
        progress: Called after each frame of motion and depth.

    Raises:
        ValueError: The frames have several sizes, or as for `pack`.
        WlmError: As for `frames_motion` and `frames_depth`.
    """
    frames = [shot.six for shot in shots]
    if any(frame.lightmaps.shape != frames[0].lightmaps.shape for frame in frames):
        raise ValueError("expected lightmaps of one size")
    rows, columns = cells(len(frames), columns)
    gain = brightest_gain(frames) if gain is None else gain
    first, second = pack(frames, layout, rows=rows, columns=columns, gain=gain, padding=padding)
    numbers, scale, reach, motion, depth = [shot.number for shot in shots], None, None, None, None
    if air is not None:
        moved = frames_motion(air, numbers, frames, progress)
        scale = scale_of(moved)
        motion = lay_out(encoded(moved, scale), rows, columns, padding, ZERO)
    if volumes is not None:
        away = frames_depth(volumes, numbers, frames, progress)
        reach = scale_of(away)
        depth = lay_out(encoded_depth(away, reach), rows, columns, padding, ZERO)
    looks = shots[0].looks
    camera = frames[0].camera
    return Book(
        first=first,
        second=second,
        motion=motion,
        depth=depth,
        layout=layout,
        rows=rows,
        columns=columns,
        count=len(frames),
        size=(frames[0].lightmaps.shape[1], frames[0].lightmaps.shape[2]),
        padding=padding,
        gain=gain,
        hot=any(frame.emission is not None for frame in frames),
        scale=scale,
        reach=reach,
        rate=_rate(shots) if rate is None else rate,
        extent=1.0 if camera is None else camera.extent,
        ramp=None if looks is None else looks.ramp,
    )


def _rate(shots: Sequence[Shot]) -> float:
    """Returns frames per second, from the times of a scene's first and last frame."""
    first, last = shots[0].looks, shots[-1].looks
    if first is None or last is None or not last.time > first.time:
        return RATE
    return (len(shots) - 1) / (last.time - first.time)
