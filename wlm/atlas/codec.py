"""The artifact of an atlas model: both textures in one file, and reading it back.

Parts: ``colour`` (half [Hp, Wp, 3], or uint8 [B, 16] where it is made of blocks) and, where there are any, ``lut``
(uint16 [Hc, Wc, 2]) and ``uv`` (float32 [F, 3, 2]).
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError

from wlm.atlas import colour
from wlm.atlas.model import COLOUR_BITS, MOST_SIZE, AtlasModel, Profile, compression_ratio, unpack_entries
from wlm.atlas.tiles import tile_counts
from wlm.errors import WlmError
from wlm.formats.artifact import Artifact, read_artifact, write_artifact

__all__ = ["SYSTEM", "Contents", "inspect", "read", "write"]

SYSTEM = "atlas"
_METHODS = ("tiles", "cascade", "plain")
_MOST_SIDE = 65536  # texels; what a file may claim before anything of that size is made
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Contents:
    """What a file holds, without what its blocks decode to.

    Attributes:
        name, source, profile, method, colour, height, width, report: As in ``AtlasModel``.
        texels: Rows and columns of T_p.
        lut: Of T_c; (0, 0) where there is none.
        triangles: With new UVs; 0 where the mesh keeps its own.
        parts: Bytes of each part.
        header_bytes, file_bytes: Of what is no part, and of all.
    """

    name: str
    source: str
    profile: Profile
    method: str
    colour: str
    height: int
    width: int
    texels: tuple[int, int]
    lut: tuple[int, int]
    triangles: int
    report: dict[str, Any]
    parts: dict[str, int]
    header_bytes: int
    file_bytes: int

    @property
    def compression_ratio(self) -> float:
        """CR of eq. 9."""
        return compression_ratio(self.texels, self.lut, (self.height, self.width), self.colour)


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
    return _checked(path, _model)


def inspect(path: str | os.PathLike[str]) -> Contents:
    """Says what a file holds. It is checked as ``read`` does, but for the blocks, which no package has to decode.

    Raises:
        WlmError: As ``read``, but for the blocks.
    """
    return _checked(path, _contents)


def _checked(path: str | os.PathLike[str], parse: Callable[[Artifact], _Result]) -> _Result:
    """Parses an artifact; what is wrong with its content is one line."""
    artifact = read_artifact(path, SYSTEM)
    try:
        return parse(artifact)
    except WlmError as error:  # of the blocks, which don't know their file
        raise WlmError(f"{path}: {error}") from error
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"])
        raise WlmError(f"{path}: the artifact's settings are damaged: profile.{field}: {first['msg']}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise WlmError(f"{path}: the artifact's parts don't fit: {error}") from error


def _model(artifact: Artifact) -> AtlasModel:
    found = _contents(artifact)
    texels, blocks = artifact.tensors["colour"], np.empty((0, 16), np.uint8)
    if found.colour != "half":
        blocks = texels
        texels = colour.decode(blocks, *found.texels, found.colour).astype(np.float16)
    lut, uv = _optional(artifact)
    return AtlasModel(
        name=found.name,
        source=found.source,
        profile=found.profile,
        method=found.method,
        colour=found.colour,
        height=found.height,
        width=found.width,
        texels=texels,
        blocks=blocks,
        lut=lut,
        uv=uv,
        report=found.report,
    )


def _contents(artifact: Artifact) -> Contents:
    """Checks the settings and the parts, but for what blocks decode to."""
    settings = artifact.settings
    profile = Profile(**settings["profile"])
    method, stored = settings["method"], settings["colour"]
    if method not in _METHODS or stored not in COLOUR_BITS:
        raise ValueError(f"method {method!r} with colour {stored!r}")
    (height, width), shape = (_size(settings[key]) for key in ("size", "texels"))
    texels, (lut, uv) = artifact.tensors["colour"], _optional(artifact)
    if stored == "half":
        _expect("colour", texels, np.float16, (*shape, 3))
        if not (np.isfinite(texels).all() and (texels >= 0).all()):
            raise ValueError("colour: a texel is negative or not finite")
    else:
        rows, columns = colour.block_grid(*shape)
        _expect("colour", texels, np.uint8, (rows * columns, 16))
    if method == "plain":
        _expect("lut", lut, np.uint16, (0, 0, 2))
    elif method == "tiles":
        _expect("lut", lut, np.uint16, (*tile_counts(height, width, profile.tile), 2))
        first, size = unpack_entries(lut)
        if max(shape) > MOST_SIZE or ((first + size) > shape[::-1]).any():
            raise ValueError("lut: a tile reaches beyond the colour texture")
    elif lut.ndim != 3 or lut.dtype != np.uint16 or lut.shape[2] != 2 or 0 in lut.shape:
        raise ValueError(f"lut: expected uint16 [Hc, Wc, 2], got {lut.dtype} {lut.shape}")
    _expect("uv", uv, np.float32, (len(uv), 3, 2))
    if not ((uv >= 0) & (uv <= 1)).all():
        raise ValueError("uv: outside [0, 1]")
    return Contents(
        name=str(settings["name"]),
        source=artifact.source,
        profile=profile,
        method=method,
        colour=stored,
        height=height,
        width=width,
        texels=shape,
        lut=lut.shape[:2],
        triangles=len(uv),
        report=dict(settings["report"]),
        parts=artifact.parts,
        header_bytes=artifact.header_bytes,
        file_bytes=artifact.file_bytes,
    )


def _optional(artifact: Artifact) -> tuple[np.ndarray, np.ndarray]:
    """T_c and the new UVs, empty where there are none."""
    tensors = artifact.tensors
    return tensors.get("lut", np.empty((0, 0, 2), np.uint16)), tensors.get("uv", np.empty((0, 3, 2), np.float32))


def _size(value: object) -> tuple[int, int]:
    rows, columns = value
    if not all(isinstance(n, int) and 1 <= n <= _MOST_SIDE for n in (rows, columns)):
        raise ValueError(f"a size of {rows} x {columns}")
    return rows, columns


def _expect(name: str, part: np.ndarray, dtype: type, shape: tuple[int, ...]) -> None:
    if part.dtype != dtype or part.shape != shape:
        raise ValueError(f"{name}: expected {np.dtype(dtype)} {shape}, got {part.dtype} {part.shape}")
