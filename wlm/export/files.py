"""Writes the files of a bundle's textures and buffers, and their entries for the index of a folder."""

from pathlib import Path
from typing import Any

import numpy as np

from wlm.bundle import Texture
from wlm.errors import WlmError
from wlm.formats.bc7 import decode_image
from wlm.formats.dds import DXGI_FORMATS, write_dds
from wlm.formats.exr import write_exr
from wlm.formats.float_texels import MOST_SIDE
from wlm.formats.ktx2 import write_ktx2
from wlm.formats.shared_exponent import unpack_rgb9e5

# Type and number of channels of the formats that are stored texel by texel.
_PLAIN = {
    "R32G32B32A32_FLOAT": ("<f4", 4),
    "R16G16B16A16_FLOAT": ("<f2", 4),
    "R16G16B16A16_UINT": ("<u2", 4),
    "R16G16_UNORM": ("<u2", 2),
    "R16G16_UINT": ("<u2", 2),
    "R8G8B8A8_UNORM": ("u1", 4),
    "R8G8_UNORM": ("u1", 2),
    "R8_UNORM": ("u1", 1),
}
_UNORM_16 = 65535


def write_texture(folder: Path, name: str, texture: Texture, ending: str | None = None) -> dict[str, Any]:
    """Writes a texture as DDS, or as KTX2 if DDS lacks its format, and returns its entry for the folder's index.
    `ending` replaces the usual ending of the file's name, ".dds" or ".ktx2"."""
    if max(texture.width, texture.height) > MOST_SIDE:
        size = f"{texture.width}x{texture.height}"
        raise WlmError(f"{name}: cannot export: expected at most {MOST_SIDE} texels along a side, found {size}")
    dds = texture.fmt in DXGI_FORMATS
    made = folder / f"{name}{'.dds' if dds else '.ktx2'}"
    content, size = texture.data.tobytes(), (texture.width, texture.height)
    if dds:
        write_dds(made, content, *size, fmt=texture.fmt, mips=texture.mips, layers=texture.layers)
    else:
        write_ktx2(made, content, *size, texture.fmt, mips=texture.mips)
    file = made if ending is None else made.rename(folder / (name + ending))
    return {
        "file": file.name,
        "format": texture.fmt,
        "width": texture.width,
        "height": texture.height,
        "layers": texture.layers,
        "mips": texture.mips,
    }


def write_buffer(folder: Path, name: str, values: np.ndarray, ending: str = ".bin") -> dict[str, Any]:
    """Writes an array of numbers as little-endian bytes, and returns its entry for the folder's index."""
    values = values.astype(values.dtype.newbyteorder("<"), copy=False)
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise WlmError(f"{name}: cannot export: a number is NaN or infinite")
    (folder / (name + ending)).write_bytes(values.tobytes())
    return {"file": name + ending, "dtype": values.dtype.name, "shape": list(values.shape)}


def write_reference(folder: Path, name: str, values: np.ndarray) -> dict[str, Any]:
    """Writes a picture as EXR, any other array as bytes; returns its entry for the folder's index."""
    if values.ndim != 3 or values.shape[2] != 3:
        return write_buffer(folder, name, values)
    write_exr(folder / f"{name}.exr", values, half=False)
    return {"file": f"{name}.exr", "dtype": values.dtype.name, "shape": list(values.shape)}


def decode_texture(texture: Texture) -> np.ndarray:
    """Decodes the largest level of a texture for engines that import pictures.

    Returns:
        [H, W, C], or [L, H, W, C] for an array of L layers: uint8 for 8-bit formats and BC7, integers for UINT formats,
        else float32. For BC6H and ASTC it is the texture's own `image`.
    """
    if texture.image is not None:
        return texture.image
    size = (*([texture.layers] if texture.layers else []), texture.height, texture.width)
    raw = np.frombuffer(texture.data.tobytes(), np.uint8)
    if texture.fmt == "BC7_UNORM":
        columns = -(-texture.width // 4)
        pixels = decode_image(raw.reshape(-1, columns, 16))
        return pixels.reshape(*size[:-2], -1, 4 * columns, 4)[..., : texture.height, : texture.width, :]
    if texture.fmt == "R9G9B9E5_SHAREDEXP":
        return unpack_rgb9e5(raw.view("<u4").reshape(size))
    kind, channels = _PLAIN[texture.fmt]
    texels = raw.view(kind).reshape(*size, channels)
    if texture.fmt == "R16G16_UNORM":
        return texels.astype(np.float32) / np.float32(_UNORM_16)
    return texels.astype(np.float32) if kind in ("<f2", "<f4") else texels
