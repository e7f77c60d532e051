"""Pictures of any channels: light, and what lies beside it as data, directions and masks."""

import io
import os

import numpy as np
from PIL.PngImagePlugin import PngImageFile

from wlm.errors import WlmError
from wlm.formats.exr_file import MAGIC as EXR_MAGIC
from wlm.formats.exr_file import read_part
from wlm.formats.light import read_light
from wlm.formats.limits import IMAGE_BYTES, PICTURE_BYTES, PICTURE_GROWTH, check_growth, check_sides
from wlm.formats.mask import DAMAGED_PICTURE
from wlm.formats.reading import open_file, read_file

_PNG_MAGIC = b"\x89PNG"
_FIRST = ("R", "G", "B", "A")  # in this order, before others in that of their names


def read_channels(path: str | os.PathLike[str]) -> tuple[np.ndarray, tuple[str, ...], bool]:
    """Reads all channels of a picture: of an EXR file any, of a PNG 8 bits or grey of 16, of others those of light.

    Args:
        path: The file.

    Returns:
        The pixels, float32 [H, W, C], the top row first; the channels' names, R, G, B and A first; and whether the
        values are levels, those of a PNG over the greatest that it can have.

    Raises:
        WlmError: The file is missing, of another kind, cut short or damaged, as the reader of its kind says.
    """
    with open_file(path, "the picture") as file:
        magic = file.read(len(_PNG_MAGIC))
    if magic == _PNG_MAGIC:
        return *_read_png(path), True
    return *(_read_exr(path) if magic == EXR_MAGIC else read_light(path)), False


def _read_exr(path: str | os.PathLike[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    channels = read_part(path).channels
    names = tuple(sorted(channels, key=lambda name: (_FIRST.index(name) if name in _FIRST else len(_FIRST), name)))
    planes = [channels[name].pixels for name in names]
    for name, plane in zip(names, planes, strict=True):
        if plane is None or plane.dtype not in (np.float16, np.float32):
            content = "no pixels" if plane is None else plane.dtype
            raise WlmError(f"{path}: channel {name}: expected half or float, found {content}")
        if plane.shape != planes[0].shape:
            raise WlmError(f"{path}: channel {name}: expected {planes[0].shape} pixels, found {plane.shape}")
    if not planes:
        raise WlmError(f"{path}: expected channels, found none")
    return np.stack(planes, axis=-1).astype(np.float32, copy=False), names


def _read_png(path: str | os.PathLike[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    data = read_file(path, IMAGE_BYTES, "the PNG")
    try:
        # Not `Image.open`: it would try other formats' readers too.
        with PngImageFile(io.BytesIO(data)) as image:
            check_sides(str(path), image.width, image.height)
            size = image.width * image.height * len(image.getbands())
            check_growth(str(path), len(data), size, PICTURE_GROWTH, PICTURE_BYTES)
            if image.mode not in ("L", "LA", "RGB", "RGBA", "I;16"):
                raise WlmError(f"{path}: expected a PNG of grey or RGB, with alpha or without, found {image.mode}")
            pixels, names = np.asarray(image), image.getbands()
    except DAMAGED_PICTURE as error:
        raise WlmError(f"{path}: cannot read the PNG: {str(error) or type(error).__name__}") from error
    levels = pixels.astype(np.float32) / np.iinfo(pixels.dtype).max
    return levels.reshape(*pixels.shape[:2], -1), ("L",) if len(names) == 1 else tuple(names)
