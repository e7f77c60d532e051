"""Reads pictures with any channels (light, directions, masks, data), and pictures of integers that encode light.

Here p is a stored colour value in [0, 1], a the stored alpha, and L the sRGB curve to linear light (IEC 61966-2-1):

==========  ========================  ==========================================================="""

import os
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats.exr import read_every_channel, read_exr
from wlm.formats.exr_header import MAGIC as EXR_MAGIC
from wlm.formats.levels import HEAD, KINDS, level_kind, read_levels
from wlm.formats.light import read_light
from wlm.formats.reading import open_file

_RGBM, _DLDR, _BABYLON = 5.0**2.2, 2.0**2.2, 2.2
_ALPHA = ("rgbm", "rgbd", "rgbe")
_RANGED = ("rgbm", "rgbd")  # encodings with a range and a gamma
_LAYER = "layer:"
_NEAR_ONE = 0.75  # RGBM with a fine alpha has its brightest channel above this in half of the texels

ENCODINGS = ("linear", "srgb", "rgbm", "rgbd", "dldr", "rgbe")
"""Names of the encodings in the module's table."""

EXPECTED = "linear, srgb, rgbm, rgbm:RANGE:GAMMA, rgbd, rgbd:RANGE:GAMMA, dldr, rgbe, or layer:NAME for an EXR"
"""The forms of an encoding, for messages."""


def read_channels(
    path: str | os.PathLike[str], notes: list[str] | None = None, light: bool = False
) -> tuple[np.ndarray, tuple[str, ...], bool]:
    """Reads all channels of an EXR file, a picture of integers, or another picture of light.

    Each assumption and conversion adds a line to `notes`; with `light` the colours are light, which is converted to the
    primaries of Rec. 709. Returns the pixels, float32 [H, W, C], the top row first; the channel names, R, G, B and A
    first; and whether the values are integers, scaled to [0, 1].
    """
    notes = [] if notes is None else notes
    with open_file(path, "the picture") as file:
        head = file.read(HEAD)
    kind = level_kind(path, head)
    if kind is not None and kind != "TIFF":
        return *read_levels(path, kind, notes), True
    return *(read_every_channel(path, notes, light) if head.startswith(EXR_MAGIC) else read_light(path, notes)), False


def read_encoded(path: str | os.PathLike[str], encoding: str, notes: list[str] | None = None) -> np.ndarray:
    """Reads the light of a picture by an encoding of the module's table, such as "srgb" or "rgbm:16:1": linear, float32
    [H, W, 3], the top row first. Each assumption, and each doubt about the encoding, adds a line to `notes`."""
    notes = [] if notes is None else notes
    name, largest, gamma = parse_encoding(encoding)
    if name == _LAYER:
        return read_exr(path, notes, encoding.removeprefix(_LAYER))[0][..., :3]
    with open_file(path, "the lightmap") as file:
        kind = level_kind(path, file.read(HEAD))
    if kind is None:
        raise WlmError(
            f"{path}: encoding: expected a {KINDS} of integers, found a format that states its encoding itself"
        )
    entries: dict[Any, Any] = {}
    pixels, names = read_levels(path, kind, notes, entries)
    stated = "srgb" if "srgb" in entries else {1.0: "linear", 0.45455: "srgb"}.get(entries.get("gamma", 0.0))
    if stated and name in ("linear", "srgb") and stated != name:
        notes.append(f"the PNG says that its levels are {stated}: is its encoding {stated}, not {name}?")
    profile = entries.get("icc_profile") or b"sRGB"
    if not any(word in profile for word in (b"sRGB", "sRGB".encode("utf-16-be"))):
        notes.append("its ICC profile is not applied: the primaries are taken as Rec. 709")
    if name in _ALPHA and "A" not in names:
        raise WlmError(f"{path}: encoding {name}: expected a picture with alpha, found the channels {''.join(names)}")
    colour, alpha = (pixels[..., :-1], pixels[..., -1:]) if "A" in names else (pixels, None)
    if colour.shape[2] == 1:
        notes.append("its grey is taken as grey light")
        colour = np.repeat(colour, 3, axis=2)
    _note_doubts(name, largest, colour, alpha, notes)
    if name == "rgbe":
        exponent = np.rint(alpha * 255.0)
        return np.where(exponent > 0, np.rint(colour * 255.0) * np.exp2(exponent - 136.0), 0.0).astype(np.float32)
    if name == "rgbm" and largest:
        return ((largest * alpha * colour) ** gamma).astype(np.float32)
    if name == "rgbd":
        # Without a range as Babylon.js writes it, whose range is 255.
        light = colour ** (gamma if largest else _BABYLON) * ((largest or 255.0) / 255.0)
        return np.divide(light, alpha, out=np.zeros_like(light), where=alpha > 0).astype(np.float32)
    if name != "linear":
        colour = np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)
    factor = _RGBM * alpha**2.2 if name == "rgbm" else _DLDR if name == "dldr" else 1.0
    return (colour * factor).astype(np.float32)


def parse_encoding(encoding: str) -> tuple[str, float, float]:
    """Returns the name of an encoding, its range, which is 0 if none is stated, and its gamma. The name of "layer:NAME"
    is "layer:"."""
    if encoding.startswith(_LAYER) and len(encoding) > len(_LAYER):
        return _LAYER, 0.0, 1.0
    name, *numbers = encoding.split(":")
    try:
        values = [float(number) for number in numbers]
    except ValueError:
        values = [0.0]
    if name not in ENCODINGS or len(values) > 2 * (name in _RANGED) or not all(0 < value < 1e6 for value in values):
        raise WlmError(f"encoding: expected {EXPECTED}, got {encoding!r}")
    return name, *(*values, 0.0)[:1], *(*values[1:], 1.0)[:1]


def _note_doubts(name: str, largest: float, colour: np.ndarray, alpha: np.ndarray | None, notes: list[str]) -> None:
    if name in _RANGED and not largest:
        whose = "Unity in linear colour space, 34.49 a^2.2" if name == "rgbm" else "Babylon.js, p^2.2 / a"
        notes.append(f"{name} is taken to be that of {whose}: state another as {name}:RANGE:GAMMA")
    if alpha is None:
        return
    if name in _ALPHA and alpha.min() == alpha.max():
        notes.append(f"alpha is {alpha.max():.3g} everywhere, which {name} hardly writes: is it srgb or linear?")
    if name not in _ALPHA and np.mean((alpha > 0) & (alpha < 1)) > 0.5 and np.median(colour.max(-1)) > _NEAR_ONE:
        notes.append(f"alpha varies and colours are near 1, as in RGBM: is its encoding rgbm, not {name}?")
