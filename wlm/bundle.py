"""`Bundle`: the textures, buffers and shader that a model puts on a GPU.

Every system has a function `bundle(model, ...)` that makes one. Everything that leaves a model consumes it: the raw
folder and the engine kits of `wlm.export`, the web page, the viewer and `wlm inspect`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class Texture:
    """A texture in the layout that graphics interfaces upload.

    Attributes:
        data: Texels or blocks, row by row from the top left; of an array layer after layer; mip levels follow their
            layer's largest level, each half the size of the one before.
        fmt: Pixel format, a key of `wlm.formats.dds.DXGI_FORMATS` or of `wlm.formats.ktx2.VK_FORMATS`.
        width, height: Size in texels.
        layers: Number of layers of a texture array; 0 for a plain texture.
        mips: Number of mip levels below the largest.
        image: Optional float32 [H, W, 3], the decoded content, for formats that picture viewers can not show.
    """

    data: np.ndarray
    fmt: str
    width: int
    height: int
    layers: int = 0
    mips: int = 0
    image: np.ndarray | None = None

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
        textures: Textures by name.
        buffers: Arrays of numbers by name, in the layout that the shader reads.
        shader: GLSL source that reads the textures and buffers.
        document: Description of all of it as JSON values. Its entry "about" explains the others in sentences.
        reference: Arrays that a reader of the bundle should reproduce, by name: for a lightmap `frame`, float32
            [H, W, 3] linear RGB at the first stored time.
        files: Further files by name, such as the mesh of an atlas.
        parts: Bundles of the members of a collection that are read by themselves, by name: sheets of a lightmap.
            Empty for a single item.
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

    @property
    def nbytes(self) -> int:
        """Bytes that the textures and buffers take in GPU memory, those of the parts included."""
        own = sum(item.nbytes for item in (*self.textures.values(), *self.buffers.values()))
        return own + sum(part.nbytes for part in self.parts.values())
