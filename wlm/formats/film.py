"""Writing of films, frame by frame: H.264 (`.mp4`) by the ffmpeg of an optional package, and animated WebP."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from PIL import Image

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path
from wlm.formats.hdr_blocks import need

EXTRA = "film"
"""The optional extra with the package that writes films."""

_QUALITY = 8  # imageio-ffmpeg's quality, 0 to 10
_WEBP_QUALITY = 80  # Pillow's quality, 0 to 100


@contextmanager
def film(path: str | os.PathLike[str], height: int, width: int, rate: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Writes an `.mp4` film or an animated `.webp` atomically, at the end of the block.

    Yields a function that adds a frame, uint8 [height, width, 3] in sRGB. Sizes of an `.mp4` must be even, since chroma
    has half the resolution; frames of a `.webp` stay in memory until the end. `rate` is the number of frames a second.
    """
    if os.fspath(path).lower().endswith(".webp"):
        pictures: list[Image.Image] = []
        yield lambda pixels: pictures.append(Image.fromarray(pixels))
        ends = np.round(1000.0 / rate * np.arange(len(pictures) + 1)).astype(int)  # milliseconds
        options = {"append_images": pictures[1:], "duration": np.diff(ends).tolist(), "quality": _WEBP_QUALITY}
        with atomic_path(path) as part:
            pictures[0].save(part, "WEBP", save_all=True, loop=0, **options)
        return
    if height % 2 or width % 2:
        raise WlmError(f"{path}: expected frames of even width and height, found {width} x {height} pixels")
    ffmpeg = need("imageio_ffmpeg", EXTRA)
    options = {"fps": rate, "codec": "libx264", "quality": _QUALITY, "macro_block_size": 2}
    # The name of the temporary file has no suffix that states the format.
    options["output_params"] = ["-f", "mp4", "-movflags", "+faststart"]
    with atomic_path(path) as part:
        frames = ffmpeg.write_frames(str(part), (width, height), **options)
        try:
            frames.send(None)
            yield lambda pixels: frames.send(np.ascontiguousarray(pixels))
        finally:
            frames.close()
