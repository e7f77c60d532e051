"""`Bundle`: the textures, buffers and shader that a model puts on a GPU.

Every system has a function `bundle(model, ...)` that makes one, and its model has a method of that name. All exports
and viewers of models read bundles: the raw folder and the engine kits of `wlm.export`, the HTML page, the viewer and
`wlm inspect`. They rely on these names:

    system    textures                               buffers                       reference           files
    lightmap  uv, uvt, planes, frames, valid         networks, hours               frame
    atlas     colour, blocks, lut, tail, sheets,                           lightmap            mesh.glb
              factors
    probe                                            gaussians, network,           position, values
                                                     positions
    smoke     first, second, depth

`valid` is R8_UNORM and 255 inside charts. The textures of smoke are R8G8B8A8_UNORM. A texture or buffer that a model
has no use for is left out. From a bundle's `document` they read these keys, among others:

    lightmap  width, height, times, period, interpolation, time_axis, tau, slices, record, hour_fours, tile_columns,
              tile_size, hidden, gamma, tiles; images: by texture name the size [width, height] of one tile's image and
              the number of images across; values (of a part that is not light): what 0 and 1 stand for
    atlas     uv_set, states, sheets, objects (label, node, sheet, scale_offset)
    smoke     layout, channels, rows, columns, frames, frame_size, padding, levels, gain, rate, extent, clipped
              (numbers above the range of 8 bits)
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from typing import Any, Self

import numpy as np

INDEX_FILE = "bundle.json"
"""Name of the index of every folder that `wlm.export` writes."""

FORMAT = "wlm-bundle"
"""`format` of these indexes."""

RESERVED = frozenset("format version system name engine shader compute textures buffers reference files parts".split())
"""Keys of an exported index that `wlm.export` fills in; a document must not have them."""

_MARK = re.compile(r"@(\w+)@")
_SAMPLER = """\
#ifndef {macro}
#ifndef {macro}_BINDING
uniform {kind} {name};
#else
layout(binding = {macro}_BINDING) uniform {kind} {name};
#endif
#define {macro} {name}
#endif
"""


@dataclass(frozen=True, eq=False)
class Texture:
    """A texture in the layout that graphics interfaces upload.

    Attributes:
        data: Texels or blocks, row by row from the top left; of an array layer after layer; mip levels follow the
            largest level, each half the size of the one before.
        fmt: Pixel format, a key of `wlm.formats.dds.DXGI_FORMATS`; for ASTC, which DDS does not have, a key of
            `wlm.formats.ktx2.VK_FORMATS`.
        width, height: Size in texels.
        layers: Number of layers of a texture array; 0 for a plain texture.
        mips: Number of mip levels after the full-size one.
        image: float32 [H, W, 3], or [L, H, W, 3] of an array: the decoded texels of BC6H and ASTC, for engines that
            do not load these formats. None for all other formats.
    """

    data: np.ndarray
    fmt: str
    width: int
    height: int
    layers: int = 0
    mips: int = 0
    image: np.ndarray | None = None

    @classmethod
    def from_texels(cls, texels: np.ndarray, fmt: str, *, layered: bool = False) -> Self:
        """Makes a texture of an uncompressed format from texels, [H, W] or [H, W, C], little-endian numbers of the
        format's own type; with `layered` the first axis, before these, counts the layers of a texture array."""
        height, width = texels.shape[layered : layered + 2]
        return cls(np.ascontiguousarray(texels), fmt, width, height, len(texels) if layered else 0)

    @property
    def nbytes(self) -> int:
        """Bytes that the texture takes in GPU memory."""
        return self.data.nbytes


@dataclass(frozen=True, eq=False)
class Bundle:
    """A model as a GPU holds it.

    Attributes:
        system: Name of the system, "lightmap" for example.
        name: Name of the model, shown in reports and used for an engine's assets.
        shader: GLSL source that reads the textures and buffers; empty for a collection whose parts have their own.
        document: Description of the model's data as JSON values, without the keys in `RESERVED`. Its entry "about"
            explains the others in sentences. The key "values" marks a part whose texels are not light.
        textures: Textures by name.
        buffers: Little-endian arrays of numbers by name, in the layout that the shader reads.
        reference: Arrays that a reader of the bundle should reproduce, by name: for a lightmap `frame`, float32
            [H, W, 3] linear RGB at the first stored time.
        files: Further files by name, such as the mesh of an atlas.
        parts: Bundles of the members of a collection by name, such as the layers of a lightmap; empty for a bundle that
            is no collection.
        exact: Name of the macro with which the shader fetches texels and interpolates in floats instead of using the
            texture filter; empty if the shader has no such variant.
        compute: GLSL source of functions that a compute shader decodes with; empty if the system has none.
        model: The model itself, for engine kits that decode it at positions of their own, such as a grid of probes.
    """

    system: str
    name: str
    shader: str
    document: Mapping[str, Any]
    textures: Mapping[str, Texture] = field(default_factory=dict)
    buffers: Mapping[str, np.ndarray] = field(default_factory=dict)
    reference: Mapping[str, np.ndarray] = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)
    parts: Mapping[str, "Bundle"] = field(default_factory=dict)
    exact: str = ""
    compute: str = ""
    model: Any = None

    @property
    def nbytes(self) -> int:
        """Bytes that the textures and buffers take in GPU memory, including the ones in `parts`."""
        own = sum(item.nbytes for item in (*self.textures.values(), *self.buffers.values()))
        return own + sum(part.nbytes for part in self.parts.values())


def filled(package: str, name: str, /, **parts: object) -> str:
    """Reads a text from the folder `assets` of a package and replaces its marks `@NAME@` by `parts`. Raises a KeyError
    if a mark is not among `parts`."""
    text = (resources.files(package) / "assets" / name).read_text(encoding="utf-8")
    return _MARK.sub(lambda match: str(parts[match[1]]), text)


def sampler(name: str, kind: str) -> str:
    """Declares a texture, of the kind `sampler2D`, `usampler2D` or `sampler2DArray`, so that the including shader can
    replace or bind it.

    If a macro with the uniform's name in capitals is defined before, its value names the texture to read instead. If
    that macro's name followed by `_BINDING` is defined, as Vulkan needs it, it gives the texture's binding number.
    """
    return _SAMPLER.format(macro=name.upper(), name=name, kind=kind)
