"""Reading pictures of integers, PNG, JPEG, WebP, TGA and TIFF, as levels in [0, 1].

The files do not say what light the levels stand for. Profiles of colour and gamma in them are ignored, as glTF demands.
"""

import io
import os
from typing import Any

import numpy as np
from PIL.Image import Image
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.TgaImagePlugin import TgaImageFile
from PIL.WebPImagePlugin import WebPImageFile

from wlm.errors import WlmError
from wlm.formats import tiff
from wlm.formats.float_texels import EXTRA
from wlm.formats.hdr_blocks import need
from wlm.formats.limits import IMAGE_BYTES, PICTURE_BYTES, PICTURE_GROWTH, check_growth, check_sides
from wlm.formats.mask import DAMAGED_PICTURE
from wlm.formats.reading import damaged, read_file

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tga")
"""Suffixes of pictures that are always of integers."""

KINDS = "PNG, JPEG, WebP, TGA or TIFF"
"""Names of the formats, for messages."""

HEAD = 26
"""Bytes at the beginning of a file that `level_kind` needs."""

_READERS = {"PNG": PngImageFile, "JPEG": JpegImageFile, "WebP": WebPImageFile, "TGA": TgaImageFile}
_DIRECT = ("L", "LA", "RGB", "RGBA", "I;16")
_PNG_DEPTH, _WIDE = 24, 16  # offset of the bits of a sample, and the number that Pillow reduces to 8 bits in colour
_ORIENTATION = 0x0112  # tag of EXIF


def level_kind(path: str | os.PathLike[str], head: bytes) -> str | None:
    """Returns "PNG", "JPEG", "WebP", "TGA" or "TIFF" for a file that begins with `head`, None for others. A TGA has no
    mark at its beginning: it is known by its suffix. A BigTIFF is not known."""
    if head.startswith(b"\x89PNG"):
        return "PNG"
    if head.startswith(b"\xff\xd8\xff"):
        return "JPEG"
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return "WebP"
    if head[:4] in tiff.MAGIC:
        return "TIFF"
    return "TGA" if os.fspath(path).lower().endswith(".tga") else None


def read_levels(
    path: str | os.PathLike[str],
    kind: str,
    notes: list[str],
    entries: dict[Any, Any] | None = None,
    sure: int = PICTURE_BYTES,
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads a picture of integers of a kind of `level_kind`.

    `notes` gets a line if the file states an orientation, which is ignored; `entries` receives what Pillow finds
    besides the pixels, such as the texts of a PNG by name; `sure` are decoded bytes that are allowed for any size of
    file. Returns the levels, float32 [H, W, C] in [0, 1], the top row first, and the names of the channels: L, or R, G
    and B, then A if there is alpha.
    """
    if kind == "TIFF":
        pixels, names = tiff.read_tiff(path, notes)
    else:
        data = read_file(path, IMAGE_BYTES, f"the {kind}")
        # `Image.open` would try the readers of other formats, too.
        with damaged(f"{path}: cannot read the {kind}", *DAMAGED_PICTURE), _READERS[kind](io.BytesIO(data)) as image:
            check_sides(str(path), image.width, image.height)
            size = image.width * image.height * len(image.getbands())
            check_growth(str(path), len(data), size, PICTURE_GROWTH, sure)
            pixels, names = _pixels(path, kind, data, image)
            if entries is not None:
                entries |= image.info
            if kind == "JPEG" and (turned := image.getexif().get(_ORIENTATION, 1)) != 1:
                notes.append(f"its EXIF orientation, {turned}, is ignored: rows are read as they are stored")
    if pixels.dtype.kind == "f":
        raise WlmError(f"{path}: encoding: expected a picture of integers, found floats, which need no encoding")
    levels = pixels.astype(np.float32) / np.iinfo(pixels.dtype).max
    return levels.reshape(*pixels.shape[:2], -1), names


def _pixels(path: str | os.PathLike[str], kind: str, data: bytes, image: Image) -> tuple[np.ndarray, tuple[str, ...]]:
    if getattr(image, "n_frames", 1) > 1:
        raise WlmError(f"{path}: expected one picture, found an animation of {image.n_frames}")
    if kind == "PNG" and data[_PNG_DEPTH] == _WIDE and image.mode != "I;16":
        pixels = need("imagecodecs", EXTRA).png_decode(data)
        return pixels, {2: ("L", "A"), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}[pixels.shape[-1]]
    if image.mode == "1":
        image = image.convert("L")
    elif image.mode in ("P", "PA"):
        image = image.convert("RGBA" if image.mode == "PA" or "transparency" in image.info else "RGB")
    if image.mode not in _DIRECT:
        raise WlmError(
            f"{path}: expected a {kind} of grey, RGB or a palette, with alpha or without, found mode {image.mode}"
        )
    return np.asarray(image), ("L",) if image.mode == "I;16" else tuple(image.getbands())
