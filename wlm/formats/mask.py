"""Masks of lightmaps: PNGs that mark the texels of charts."""

import io
import os
import struct
import zlib
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngImageFile

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path
from wlm.formats.limits import IMAGE_BYTES
from wlm.formats.reading import damaged, read_file

DAMAGED_PICTURE = (
    *(OSError, SyntaxError, ValueError, TypeError, LookupError, ArithmeticError, RuntimeError, AttributeError),
    *(EOFError, MemoryError, struct.error, zlib.error, Image.DecompressionBombError),
)
"""Exceptions that Pillow and imagecodecs raise for a damaged picture or other content."""


def read_mask(path: Path, beside: str | os.PathLike[str], size: tuple[int, int], others: str = "") -> np.ndarray:
    """Reads a PNG, of a height and width `size`, as a mask, bool [H, W]: true where any colour channel is above 0.

    In messages `beside` is the path of its lightmap, and `others` follows "expected a PNG", for example "or alpha in
    the lightmap".
    """
    data = read_file(path, IMAGE_BYTES, f"the mask (expected a PNG of {size[1]}x{size[0]}{others})")
    # `Image.open` would try the readers of other formats and refuse masks of 16384 x 16384. From a file on disk, Pillow
    # would allocate the claimed size of a chunk.
    with (
        damaged(f"{path}: cannot read the mask: expected a PNG", *DAMAGED_PICTURE),
        PngImageFile(io.BytesIO(data)) as image,
    ):
        # The size in the header is checked before anything is decoded.
        if (image.height, image.width) != size:
            raise WlmError(f"{path}: the mask is {image.width}x{image.height}, but {beside} is {size[1]}x{size[0]}")
        # The index of a palette has no meaning here, and alpha is not coverage.
        colour = np.asarray(image.convert("RGB") if image.mode in ("P", "PA", "RGBA", "LA") else image)
    return colour > 0 if colour.ndim == 2 else (colour > 0).any(axis=2)


def write_mask(path: str | os.PathLike[str], mask: np.ndarray) -> None:
    """Writes a mask, bool [H, W], as a PNG of one bit per texel, atomically."""
    with atomic_path(path) as temporary:
        Image.fromarray(np.asarray(mask, bool)).save(temporary, format="PNG")
