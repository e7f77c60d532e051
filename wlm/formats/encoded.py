"""Light in the bytes of a PNG, by a stated encoding.

With p the levels in [0, 1], a the alpha, and L the curve of IEC 61966-2-1 from sRGB to linear light:

========  ======================  =========================================================
encoding  light                   where it is met
========  ======================  =========================================================
linear    p                       data textures
srgb      L(p)                    pictures, lightmaps of low range
rgbm      34.4932 a^2.2 L(p)      Unity, linear colour space (`DecodeLightmapRGBM`); 5^2.2
dldr      4.5948 L(p)             Unity (`DecodeLightmapDoubleLDR`); 2^2.2
rgbe      255 p 2^(255 a - 136)   Radiance's numbers as RGBA; 0 where a is 0
========  ======================  =========================================================
"""

import os

import numpy as np

from wlm.errors import WlmError
from wlm.formats.channels import read_channels

_RGBM, _DLDR = 5.0**2.2, 2.0**2.2
_ALPHA = ("rgbm", "rgbe")

ENCODINGS = ("linear", "srgb", "rgbm", "dldr", "rgbe")
"""By name."""


def read_encoded(path: str | os.PathLike[str], encoding: str) -> np.ndarray:
    """Reads the light of a PNG.

    Args:
        path: The file.
        encoding: One of `ENCODINGS`.

    Returns:
        Linear light, float32 [H, W, 3], the top row first.

    Raises:
        WlmError: No such encoding; the file is missing, damaged or no PNG, which says itself what light it holds; or it
            has no colour, or not the alpha that the encoding needs.
    """
    if encoding not in ENCODINGS:
        raise WlmError(f"encoding: expected one of {', '.join(ENCODINGS)}, got {encoding!r}")
    pixels, names, levels = read_channels(path)
    if not levels:
        raise WlmError(f"{path}: encoding: expected a PNG; other files say themselves what light they hold")
    if names not in (("R", "G", "B"), ("R", "G", "B", "A")) or encoding in _ALPHA and len(names) == 3:
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
