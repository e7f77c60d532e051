"""Masks of lightmaps: PNGs that say which texels belong to a chart."""

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
from wlm.formats.reading import read_file

DAMAGED_PICTURE = (
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    LookupError,
    ArithmeticError,
    AttributeError,
    EOFError,
    MemoryError,
    NotImplementedError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
)
"""What Pillow raises on a picture that is none, or damaged."""


def read_mask(path: Path, beside: str | os.PathLike[str], size: tuple[int, int], others: str = "") -> np.ndarray:
    """Reads a PNG as [H, W] bool: valid where any colour channel is above 0.

    Args:
        path: The PNG.
        beside: The lightmap whose size it must have; for the message.
        size: Its rows and columns.
        others: What else than a PNG is expected, for the message of one that isn't there.

    Raises:
        WlmError: It is missing, damaged or of another size.
    """
    data = read_file(path, IMAGE_BYTES, f"the mask (expected a PNG of {size[1]}x{size[0]}{others})")
    try:
        # Not `Image.open`: it would try other formats' readers too, and refuses masks of 16384 x 16384. Of a file on
        # disk it would make room for as many bytes as a chunk claims to have.
        with PngImageFile(io.BytesIO(data)) as image:
            # The header's size first: a wrong one need not be decoded.
            if (image.height, image.width) != size:
                raise WlmError(f"{path}: the mask is {image.width}x{image.height}, but {beside} is {size[1]}x{size[0]}")
            # A palette's index says nothing; an alpha channel is not coverage here.
            colour = np.asarray(image.convert("RGB") if image.mode in ("P", "PA", "RGBA", "LA") else image)
    except DAMAGED_PICTURE as error:
        problem = str(error) or type(error).__name__
        raise WlmError(f"{path}: cannot read the mask: expected a PNG: {problem}") from error
    return colour > 0 if colour.ndim == 2 else (colour > 0).any(axis=2)


def write_mask(path: str | os.PathLike[str], mask: np.ndarray) -> None:
    """Writes a mask, bool [H, W], as a PNG of one bit a texel, whole or not at all.

    Raises:
        WlmError: The file can't be written.
    """
    with atomic_path(path) as temporary:
        Image.fromarray(np.asarray(mask, bool)).save(temporary, format="PNG")
