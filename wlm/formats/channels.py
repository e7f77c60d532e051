"""Reads pictures with any channels (light, directions, masks, data), and PNGs that encode light in one of five ways.

Here p is a stored colour value in [0, 1], a the stored alpha, and L the sRGB curve to linear light (IEC 61966-2-1):

========  ======================  =========================================================
encoding  light                   where it is used
========  ======================  =========================================================
linear    p                       data textures
srgb      L(p)                    pictures, lightmaps of low range
rgbm      34.4932 a^2.2 L(p)      Unity, linear colour space (`DecodeLightmapRGBM`); factor 5^2.2
dldr      4.5948 L(p)             Unity (`DecodeLightmapDoubleLDR`); factor 2^2.2
rgbe      255 p 2^(255 a - 136)   Radiance's numbers as RGBA; 0 where a is 0
========  ======================  =========================================================
"""

import io
import os

import numpy as np
from PIL.PngImagePlugin import PngImageFile

from wlm.errors import WlmError
from wlm.formats.exr import MAGIC as EXR_MAGIC
from wlm.formats.exr import float_planes, read_part
from wlm.formats.light import read_light
from wlm.formats.limits import IMAGE_BYTES, PICTURE_BYTES, PICTURE_GROWTH, check_growth, check_sides
from wlm.formats.mask import DAMAGED_PICTURE
from wlm.formats.reading import damaged, open_file, read_file

_PNG_MAGIC = b"\x89PNG"
_FIRST = ("R", "G", "B", "A")  # in this order; other channels follow, sorted by name
_RGBM, _DLDR = 5.0**2.2, 2.0**2.2
_ALPHA = ("rgbm", "rgbe")

ENCODINGS = ("linear", "srgb", "rgbm", "dldr", "rgbe")
"""Names of the encodings in the module's table."""


def read_channels(path: str | os.PathLike[str]) -> tuple[np.ndarray, tuple[str, ...], bool]:
    """Reads all channels of an EXR file, a PNG (8 bits, or grey of 16 bits) or another picture of light.

    Returns:
        The pixels, float32 [H, W, C], the top row first; the channel names, R, G, B and A first; and whether the values
        are integers of a PNG, scaled to [0, 1].

    Raises:
        WlmError: The file is missing, of another kind, cut short or damaged.
    """
    with open_file(path, "the picture") as file:
        magic = file.read(len(_PNG_MAGIC))
    if magic == _PNG_MAGIC:
        return *_read_png(path), True
    return *(_read_exr(path) if magic == EXR_MAGIC else read_light(path)), False


def _read_exr(path: str | os.PathLike[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    channels = read_part(path).channels
    names = tuple(sorted(channels, key=lambda name: (_FIRST.index(name) if name in _FIRST else len(_FIRST), name)))
    if not names:
        raise WlmError(f"{path}: expected channels, found none")
    return np.stack(float_planes(path, channels, names), axis=-1), names


def _read_png(path: str | os.PathLike[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    data = read_file(path, IMAGE_BYTES, "the PNG")
    # `Image.open` would try the readers of other formats, too.
    with damaged(f"{path}: cannot read the PNG", *DAMAGED_PICTURE), PngImageFile(io.BytesIO(data)) as image:
        check_sides(str(path), image.width, image.height)
        size = image.width * image.height * len(image.getbands())
        check_growth(str(path), len(data), size, PICTURE_GROWTH, PICTURE_BYTES)
        if image.mode not in ("L", "LA", "RGB", "RGBA", "I;16"):
            raise WlmError(f"{path}: expected a PNG of grey or RGB, with alpha or without, found {image.mode}")
        pixels, names = np.asarray(image), image.getbands()
    levels = pixels.astype(np.float32) / np.iinfo(pixels.dtype).max
    return levels.reshape(*pixels.shape[:2], -1), ("L",) if len(names) == 1 else tuple(names)


def read_encoded(path: str | os.PathLike[str], encoding: str) -> np.ndarray:
    """Reads the light of a PNG with one of `ENCODINGS`: linear, float32 [H, W, 3], the top row first.

    Raises:
        WlmError: The encoding is unknown; the file is missing, damaged or not a PNG; or it lacks colour, or the alpha
            that the encoding needs.
    """
    if encoding not in ENCODINGS:
        raise WlmError(f"encoding: expected one of {', '.join(ENCODINGS)}, got {encoding!r}")
    pixels, names, levels = read_channels(path)
    if not levels:
        raise WlmError(f"{path}: encoding: expected a PNG; other formats define their encoding themselves")
    if names not in (("R", "G", "B"), ("R", "G", "B", "A")) or (encoding in _ALPHA and len(names) == 3):
        alpha = " with alpha" if encoding in _ALPHA else ""
        raise WlmError(f"{path}: encoding {encoding}: expected a PNG of RGB{alpha}, found {''.join(names)}")
    colour, alpha = pixels[..., :3], pixels[..., 3:]
    if encoding == "rgbe":
        exponent = np.rint(alpha * 255.0)
        return np.where(exponent > 0, np.rint(colour * 255.0) * np.exp2(exponent - 136.0), 0.0).astype(np.float32)
    if encoding != "linear":
        colour = np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)
    factor = {"rgbm": _RGBM * alpha**2.2, "dldr": _DLDR}.get(encoding, 1.0)
    return (colour * factor).astype(np.float32)
