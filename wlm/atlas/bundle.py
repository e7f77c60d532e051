"""The GPU form of an atlas model: the lookup texture, the colour textures, the shader and the mesh."""

import math
from typing import Any

import numpy as np

from wlm.atlas.decode import Decoder
from wlm.atlas.model import BLOCKS, TEXELS, AtlasModel
from wlm.atlas.shader import EXACT, glsl
from wlm.atlas.stored import with_uvs
from wlm.bundle import Bundle, Texture
from wlm.errors import WlmError
from wlm.formats.float_texels import MOST_SIDE
from wlm.formats.shared_exponent import pack_rgb9e5

MESH_FILE = "mesh.glb"

_FORMATS = {
    "half": "R16G16B16A16_FLOAT",
    "rgb9e5": "R9G9B9E5_SHAREDEXP",
    "bc6h": "BC6H_UF16",
    "astc": "ASTC_4x4_SFLOAT_BLOCK",
}
_ONE_ABOUT = (
    "Light of a mesh from its compressed lightmap: call wlm_atlas of the shader with UV set uv_set of mesh.glb. "
    "method is tiles (lut holds a rectangle of colour for each tile), cascade (lut holds coordinates of colour) or "
    "plain (colour alone). cr is 1 less the bits of the textures over the lightmap's at 48 per texel."
)
_SHARED_ABOUT = (
    "Light of a scene from its compressed lightmaps: call wlm_object of the shader with the UVs of set uv_set, the "
    "scale_offset and sheet of the object, and the number of a state, which may lie between two states. objects are "
    "the nodes of mesh.glb that read a sheet; extras.wlm of a node says the same. layer_heights are rows of a layer of "
    "the texture arrays. cr is 1 less the bits of textures and tables over the lightmaps' at 48 per texel."
)


def bundle(model: AtlasModel, *, device: str = "cpu") -> Bundle:
    """Makes the textures, shader and mesh of a model.

    Args:
        model: The model.
        device: "cpu" or "cuda:N", where the lightmap for comparison is decoded.

    Returns:
        A bundle with the texture `colour`; the textures `lut` and `blocks` where the model has them; for a model of
        several lightmaps the textures `sheets` and `factors`; the file `mesh.glb`; and, to test a renderer against, the
        first lightmap as decoded, `lightmap`, float32 [H, W, 3].
    """
    shared = model.method == "shared"
    textures = {"colour": _colour(model, layered=shared)}
    if model.lut.size:
        textures["lut"] = _lookup(model)
    if model.colour == "mixed":
        layers = len(model.blocks) if shared else 0
        textures["blocks"] = _texture(model.blocks, BLOCKS, model.block_texels, layers)
    if shared:
        sheets, factors = sheet_texels(model), np.pad(model.factor.astype("<f4"), ((0, 0), (0, 0), (0, 1)))
        textures["sheets"] = Texture.from_texels(sheets, "R16G16B16A16_UINT")
        textures["factors"] = Texture.from_texels(factors, "R32G32B32A32_FLOAT")
    for name, texture in textures.items():
        side = max(texture.width, texture.height)
        if side > MOST_SIDE:
            raise WlmError(f"{model.name}: texture {name}: expected at most {MOST_SIDE} texels a side, found {side}")
    glb, uv_set = with_uvs(model.scene, model.uv) if len(model.uv) else (model.stored.glb, model.stored.uv_set)
    return Bundle(
        system=model.SYSTEM,
        name=model.name,
        shader=glsl(model),
        document=_document(model, textures, uv_set),
        textures=textures,
        reference={"lightmap": Decoder(model, device).lightmap()},
        files={MESH_FILE: glb},
        exact="" if shared else EXACT,
        model=model,
    )


def sheet_texels(model: AtlasModel) -> np.ndarray:
    """Makes the texture `sheets`, uint16 [rows, 2, 4]: one row per lightmap layout (sheet) or mip level. The first
    texel of a row has width and height in texels, then x and y of the first entry in the lookup texture; the second has
    the tiles in x and y, the row of the next smaller mip level (0 if none), and 0."""
    table = model.table()
    texels = np.zeros((len(table), 2, 4), "<u2")
    texels[:, 0] = table[:, [1, 0, 3, 2]]
    texels[:, 1, :3] = table[:, [5, 4, 6]]
    return texels


def _colour(model: AtlasModel, layered: bool) -> Texture:
    """Makes the colour texture T_p. For the colour "mixed", which has two colour textures, it is the one in RGB9E5."""
    layers = len(model.texels) if layered else 0
    format = TEXELS if model.colour == "mixed" else model.colour
    if format == "half":
        # DXGI has no format of three half floats.
        whole = np.concatenate([model.texels.astype("<f2"), np.ones((*model.texels.shape[:3], 1), "<f2")], 3)
        return _texture(whole, format, model.texels, layers)
    if format == TEXELS:
        return _texture(pack_rgb9e5(model.texels).astype("<u4"), format, model.texels, layers)
    return _texture(model.blocks, format, model.texels, layers)


def _texture(data: np.ndarray, format: str, texels: np.ndarray, layers: int) -> Texture:
    """Makes a colour texture from its stored data; block formats also get their decoded texels as an image."""
    rows, columns = texels.shape[1:3]
    image = (texels if layers else texels[0]).astype(np.float32) if format in ("bc6h", "astc") else None
    return Texture(data, _FORMATS[format], columns, rows, layers, image=image)


def _lookup(model: AtlasModel) -> Texture:
    numbers = model.lut.shape[2]
    format = "R16G16B16A16_UINT" if numbers == 4 else "R16G16_UNORM" if model.method == "cascade" else "R16G16_UINT"
    return Texture.from_texels(np.ascontiguousarray(model.lut, "<u2"), format)


def _document(model: AtlasModel, textures: dict[str, Texture], uv_set: int) -> dict[str, Any]:
    document = {
        "about": _SHARED_ABOUT if model.method == "shared" else _ONE_ABOUT,
        "source": model.source,
        "method": model.method,
        "colour": model.colour,
        "states": list(model.states),
        "sheets": [{"name": each.name, "size": [each.width, each.height]} for each in model.sheets],
        "objects": [
            {"node": each.node, "label": each.label, "sheet": each.sheet, "scale_offset": list(each.scale_offset)}
            for each in model.stored.objects
        ],
        "uv_set": uv_set,
        "tile": model.profile.tile,
        "cr": model.compression_ratio,
        "gpu_bytes": math.ceil(model.bits / 8),
    }
    layered = {name: texture.height for name, texture in textures.items() if texture.layers}
    return document | ({"layer_heights": layered} if layered else {})
