"""OpenEXR pictures of named channels, such as six-way lightmaps, with a note in the header."""

import json
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats.exr import HALF_MAX
from wlm.formats.exr_file import read_part, write_part

_NOTE = "wlm"  # the header's attribute


def write_planes(
    path: str | os.PathLike[str],
    planes: Mapping[str, np.ndarray],
    note: Mapping[str, Any] | None = None,
    *,
    whole: tuple[str, ...] = (),
) -> None:
    """Writes planes as an EXR file of scan lines under lossless ZIP, whole or not at all.

    Args:
        path: The file to write; its folder must exist.
        planes: [H, W] each, linear, not empty; the keys name the channels.
        note: JSON that goes into the header.
        whole: Planes that stay float32; the others become half floats, and what is beyond their range +-65504.

    Raises:
        ValueError: Not planes of one shape.
        WlmError: The file can't be written; what was there before stays.
    """
    shapes = {np.shape(plane) for plane in planes.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2 or 0 in next(iter(shapes)):
        raise ValueError(f"expected planes [H, W] of one shape, got {sorted(shapes)}")
    attributes = {} if note is None else {_NOTE: json.dumps(note, allow_nan=False)}
    channels = {}
    for name, plane in planes.items():
        plane = np.asarray(plane)
        if name not in whole:
            plane = np.clip(plane, -HALF_MAX, HALF_MAX)
        channels[name] = np.ascontiguousarray(plane, np.float32 if name in whole else np.float16)
    write_part(path, channels, read_planes, attributes)


def read_planes(path: str | os.PathLike[str]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Reads all channels of a single-part EXR file.

    Args:
        path: The EXR file.

    Returns:
        The planes by name, float32 [H, W], as they are in the file, NaN too; and the header's note, empty if there is
        none.

    Raises:
        WlmError: The file is missing, not an EXR, damaged, of several parts or deep, or a channel isn't half or float.
    """
    part = read_part(path)
    planes = {}
    for name, channel in part.channels.items():
        pixels = channel.pixels
        if pixels is None or pixels.dtype not in (np.float16, np.float32):
            content = "no pixels" if pixels is None else pixels.dtype
            raise WlmError(f"{path}: channel {name}: expected half or float, found {content}")
        if planes and pixels.shape != next(iter(planes.values())).shape:
            raise WlmError(f"{path}: channel {name}: expected as many pixels as the others, found {pixels.shape}")
        planes[name] = pixels.astype(np.float32)
    try:
        note = json.loads(part.header.get(_NOTE, "{}"))
    except (ValueError, TypeError, RecursionError):
        note = None
    if not isinstance(note, dict):
        raise WlmError(f"{path}: header attribute {_NOTE}: expected a JSON object")
    return planes, note
