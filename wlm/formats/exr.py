"""Reading and writing OpenEXR pictures of RGB or RGBA."""

import os

import numpy as np

from wlm.errors import WlmError
from wlm.formats.exr_file import read_part, write_part

HALF_MAX = 65504.0
"""The largest finite half float."""

_COLOUR = ("R", "G", "B")
_ALPHA = "A"


def read_exr(path: str | os.PathLike[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads the colour channels of a single-part EXR file, over its data window.

    Half and float files are read, scan lines or tiles. Channels other than R, G, B and A are left out. Values
    come as they are in the file, NaN and Inf too: the caller checks what it can't use.

    Args:
        path: The EXR file.

    Returns:
        The pixels, float32 [H, W, 3 or 4], and the channels' names, ("R", "G", "B") or ("R", "G", "B", "A").

    Raises:
        WlmError: The file is missing, not an EXR, cut short or damaged, has several parts or deep data, or
            lacks one of R, G and B.
    """
    channels = read_part(path).channels
    if any(name not in channels for name in _COLOUR):
        raise WlmError(f"{path}: expected channels R,G,B or R,G,B,A, found {','.join(channels) or 'none'}")
    names = (*_COLOUR, _ALPHA) if _ALPHA in channels else _COLOUR
    planes = [channels[name].pixels for name in names]
    for name, plane in zip(names, planes, strict=True):
        if plane is None or plane.dtype not in (np.float16, np.float32):
            content = "no pixels" if plane is None else plane.dtype
            raise WlmError(f"{path}: channel {name}: expected half or float, found {content}")
        if plane.shape != planes[0].shape:
            raise WlmError(f"{path}: channel {name}: expected {planes[0].shape} pixels, found {plane.shape}")
    return np.stack(planes, axis=-1).astype(np.float32, copy=False), names


def write_exr(path: str | os.PathLike[str], pixels: np.ndarray, half: bool = True) -> None:
    """Writes RGB or RGBA pixels as an EXR file of scan lines under lossless ZIP, whole or not at all.

    Args:
        path: The file to write; its folder must exist.
        pixels: Linear values, [H, W, 3 or 4], neither side empty.
        half: Whether to round to half floats. Values beyond their range, Inf too, become +-65504; NaN stays.

    Raises:
        ValueError: The shape isn't that of a picture.
        WlmError: The file can't be written; what was there before stays.
    """
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or 0 in pixels.shape:
        raise ValueError(f"expected pixels [H, W, 3 or 4], got {pixels.shape}")
    if half:
        pixels = np.clip(pixels, -HALF_MAX, HALF_MAX).astype(np.float16)
    else:
        pixels = pixels.astype(np.float32, copy=False)
    planes = zip((*_COLOUR, _ALPHA), np.moveaxis(pixels, -1, 0), strict=False)
    # The library wants every plane contiguous.
    write_part(path, {name: np.ascontiguousarray(plane) for name, plane in planes}, read_exr)
