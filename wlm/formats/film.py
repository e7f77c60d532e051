"""Writing of H.264 films (`.mp4`), frame by frame, by the ffmpeg of an optional package."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path
from wlm.formats.hdr_blocks import need

EXTRA = "film"
"""The optional extra with the package that writes films."""

_QUALITY = 8  # imageio-ffmpeg's quality, 0 to 10


@contextmanager
def film(path: str | os.PathLike[str], height: int, width: int, rate: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Writes an `.mp4` film atomically, at the end of the block.

    Yields a function that adds a frame, uint8 [height, width, 3] in sRGB. Sizes must be even, since chroma has half the
    resolution; `rate` is the number of frames per second.

    Raises:
        WlmError: The package is missing, a size is odd, or the file cannot be written.
    """
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
