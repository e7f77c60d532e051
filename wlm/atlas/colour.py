"""The colour texture as stored: half floats, or blocks that GPUs decode, BC6H or ASTC HDR 4x4.

Both block formats take 16 bytes for 4x4 texels, 8 bits per texel. lightmap-uv-clustering-cascade, section 4.4, counts 6
for ASTC 4x4, which the format doesn't have; we count 8. Both need the extra `atlas`.
"""

import math

import numpy as np

from wlm.atlas.model import BLOCK_SIDE
from wlm.errors import WlmError
from wlm.formats import hdr_blocks
from wlm.formats.exr import HALF_MAX

BLOCK_CODECS = ("bc6h", "astc")
_EXTRA = "atlas"
# A third of the time of "slow" for 0.2 dB less, and every size of every tile is encoded once to measure its error.
_BC6H = "basic"


def block_grid(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of blocks that hold a texture."""
    return math.ceil(height / BLOCK_SIDE), math.ceil(width / BLOCK_SIDE)


def quantise(texels: np.ndarray, colour: str) -> dict[str, np.ndarray]:
    """Encodes T_p as it is stored.

    Args:
        texels: numbers [H, W, 3], linear.
        colour: "half", "bc6h" or "astc".

    Returns:
        `texels` and, of a block format, `blocks` of `AtlasModel`.

    Raises:
        WlmError: A package is missing; the line names the extra.
    """
    if colour == "half":
        return {"texels": texels.clip(0.0, HALF_MAX).astype(np.float16)}
    blocks, decoded = encode(texels, colour)
    return {"texels": decoded.astype(np.float16), "blocks": blocks}


def encode(texels: np.ndarray, codec: str) -> tuple[np.ndarray, np.ndarray]:
    """Encodes a texture.

    Args:
        texels: numbers [H, W, 3], linear; clamped to [0, 65504], infinities too. Where H or W is no multiple of 4 the
            last row or column is repeated.
        codec: "bc6h" or "astc".

    Returns:
        Blocks, uint8 [B, 16], row by row; and their decoded texels, float32 [H, W, 3].

    Raises:
        ValueError: No such codec, a wrong shape, or a NaN texel.
        WlmError: A package is missing; the line names the extra.
    """
    texels = np.asarray(texels)
    if codec not in BLOCK_CODECS:
        raise ValueError(f"codec: expected one of {', '.join(BLOCK_CODECS)}, got {codec!r}")
    if texels.ndim != 3 or texels.shape[2] != 3 or 0 in texels.shape:
        raise ValueError(f"texels: expected [H, W, 3], none of them 0, got {texels.shape}")
    if np.isnan(texels).any():
        raise ValueError(f"texels: {np.count_nonzero(np.isnan(texels).any(axis=2))} are NaN")
    height, width = texels.shape[:2]
    padded = np.pad(texels, ((0, -height % BLOCK_SIDE), (0, -width % BLOCK_SIDE), (0, 0)), mode="edge")
    half = np.clip(padded, 0.0, HALF_MAX).astype(np.float16)
    if codec == "bc6h":
        data = hdr_blocks.encode_bc6h(half, _BC6H, _EXTRA)
    else:
        data = _astc().encode(half)
    blocks = np.frombuffer(data, np.uint8).reshape(-1, 16).copy()
    return blocks, decode(blocks, height, width, codec)


def decode(blocks: np.ndarray, height: int, width: int, codec: str) -> np.ndarray:
    """Decodes a texture.

    Args:
        blocks: uint8 [B, 16], row by row.
        height, width: Of the texture, at least 1.
        codec: "bc6h" or "astc".

    Returns:
        float32 [height, width, 3], finite, in [0, 65504].

    Raises:
        ValueError: No such codec, or another number of blocks than the size needs.
        WlmError: A block isn't one of the format; or a package is missing, and the line names the extra.
    """
    blocks = np.asarray(blocks)
    if codec not in BLOCK_CODECS:
        raise ValueError(f"codec: expected one of {', '.join(BLOCK_CODECS)}, got {codec!r}")
    rows, columns = block_grid(height, width)
    if blocks.dtype != np.uint8 or blocks.shape != (rows * columns, 16) or not blocks.size:
        raise ValueError(f"blocks: expected uint8 [{rows * columns}, 16], got {blocks.dtype} {blocks.shape}")
    size = (rows * BLOCK_SIDE, columns * BLOCK_SIDE)
    if codec == "bc6h":
        texels = hdr_blocks.decode_bc6h(blocks.tobytes(), *size, _EXTRA)
    else:
        texels = _astc().decode(blocks.tobytes(), *size)
    texels = texels[:height, :width].astype(np.float32)
    broken = ~np.isfinite(texels).all(axis=2)
    if broken.any():
        row, column = np.argwhere(broken)[0] // BLOCK_SIDE
        raise WlmError(f"{codec}: expected blocks of the format, found none in row {row}, column {column}")
    return texels


def _astc() -> hdr_blocks.Astc:
    return hdr_blocks.astc((BLOCK_SIDE, BLOCK_SIDE), hdr_blocks.ASTC_MEDIUM, _EXTRA)
