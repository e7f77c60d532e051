"""The artifact of an atlas model: both textures in one file, and reading it back.

Parts: ``colour`` (half [Hp, Wp, 3], or uint8 [B, 16] where it is made of blocks) and, where there are any, ``lut``
(uint16 [Hc, Wc, 2]) and ``uv`` (float32 [F, 3, 2]).
"""

import os

import numpy as np
from pydantic import ValidationError

from wlm.atlas import colour
from wlm.atlas.model import COLOUR_BITS, MOST_SIZE, AtlasModel, Profile, unpack_entries
from wlm.atlas.tiles import tile_counts
from wlm.errors import WlmError
from wlm.formats.artifact import Artifact, read_artifact, write_artifact

__all__ = ["SYSTEM", "read", "write"]

SYSTEM = "atlas"
_METHODS = ("tiles", "cascade", "plain")
_MOST_SIDE = 65536  # texels; what a file may claim before anything of that size is made


def write(path: str | os.PathLike[str], model: AtlasModel) -> int:
    """Writes a model to one file, atomically.

    Returns:
        The file's size in bytes.

    Raises:
        WlmError: The file can't be written; what was there before is untouched.
    """
    profile, defaults = model.profile.model_dump(), Profile(name="").model_dump()
    settings = {
        "name": model.name,
        "method": model.method,
        "colour": model.colour,
        "size": [model.height, model.width],
        "texels": list(model.texels.shape[:2]),
        # What is as usual is left out: the header counts.
        "profile": {key: value for key, value in profile.items() if value != defaults[key]},
        "report": model.report,
    }
    parts = {"colour": model.texels if model.colour == "half" else model.blocks}
    if model.lut.size:
        parts["lut"] = model.lut
    if len(model.uv):
        parts["uv"] = model.uv
    return write_artifact(path, SYSTEM, settings, parts, model.source)


def read(path: str | os.PathLike[str]) -> AtlasModel:
    """Reads a model back.

    Returns:
        The model that was written, to the bit.

    Raises:
        WlmError: The file is missing, damaged, of another version or system, or its parts don't fit each other; or a
            package that decodes its blocks is missing.
    """
    artifact = read_artifact(path, SYSTEM)
    try:
        return _model(artifact)
    except WlmError as error:  # of the blocks, which don't know their file
        raise WlmError(f"{path}: {error}") from error
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"])
        raise WlmError(f"{path}: the artifact's settings are damaged: profile.{field}: {first['msg']}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise WlmError(f"{path}: the artifact's parts don't fit: {error}") from error


def _model(artifact: Artifact) -> AtlasModel:
    settings, tensors = artifact.settings, artifact.tensors
    profile = Profile(**settings["profile"])
    method, stored = settings["method"], settings["colour"]
    if method not in _METHODS or stored not in COLOUR_BITS:
        raise ValueError(f"method {method!r} with colour {stored!r}")
    (height, width), shape = (_size(settings[key]) for key in ("size", "texels"))
    if stored == "half":
        texels, blocks = tensors["colour"], np.empty((0, 16), np.uint8)
        _expect("colour", texels, np.float16, (*shape, 3))
        if not (np.isfinite(texels).all() and (texels >= 0).all()):
            raise ValueError("colour: a texel is negative or not finite")
    else:
        blocks = tensors["colour"]
        rows, columns = colour.block_grid(*shape)
        _expect("colour", blocks, np.uint8, (rows * columns, 16))
        texels = colour.decode(blocks, *shape, stored).astype(np.float16)
    lut = tensors.get("lut", np.empty((0, 0, 2), np.uint16))
    if method == "plain":
        _expect("lut", lut, np.uint16, (0, 0, 2))
    elif method == "tiles":
        _expect("lut", lut, np.uint16, (*tile_counts(height, width, profile.tile), 2))
        first, size = unpack_entries(lut)
        if max(shape) > MOST_SIZE or ((first + size) > shape[::-1]).any():
            raise ValueError("lut: a tile reaches beyond the colour texture")
    elif lut.ndim != 3 or lut.dtype != np.uint16 or lut.shape[2] != 2 or 0 in lut.shape:
        raise ValueError(f"lut: expected uint16 [Hc, Wc, 2], got {lut.dtype} {lut.shape}")
    uv = tensors.get("uv", np.empty((0, 3, 2), np.float32))
    _expect("uv", uv, np.float32, (len(uv), 3, 2))
    if not ((uv >= 0) & (uv <= 1)).all():
        raise ValueError("uv: outside [0, 1]")
    return AtlasModel(
        name=str(settings["name"]),
        source=artifact.source,
        profile=profile,
        method=method,
        colour=stored,
        height=height,
        width=width,
        texels=texels,
        blocks=blocks,
        lut=lut,
        uv=uv,
        report=dict(settings["report"]),
    )


def _size(value: object) -> tuple[int, int]:
    rows, columns = value
    if not all(isinstance(n, int) and 1 <= n <= _MOST_SIDE for n in (rows, columns)):
        raise ValueError(f"a size of {rows} x {columns}")
    return rows, columns


def _expect(name: str, part: np.ndarray, dtype: type, shape: tuple[int, ...]) -> None:
    if part.dtype != dtype or part.shape != shape:
        raise ValueError(f"{name}: expected {np.dtype(dtype)} {shape}, got {part.dtype} {part.shape}")
