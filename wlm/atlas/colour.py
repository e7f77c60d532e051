"""Formats of the stored colour texture: half floats, RGB9E5, and the block formats of GPUs, BC6H and ASTC HDR 4x4.

RGB9E5 takes 32 bits a texel, and all GPUs filter it; half floats take 64, since desktop GPUs support them with four
channels but not with three. Both block formats take 16 bytes for 4x4 texels, 8 bits per texel.
(lightmap-uv-clustering-cascade, section 4.4, counts 6 bits per texel for ASTC 4x4; the format takes 8, as we count.)
Decoding of both needs the optional packages of the extra `atlas`.

Half floats represent the decoded texels of every format exactly.
"""

import math

import numpy as np
import torch
from torch.nn.functional import pad

from wlm.atlas.model import BLOCK_SIDE
from wlm.errors import WlmError
from wlm.formats import hdr_blocks
from wlm.formats.exr import HALF_MAX
from wlm.formats.shared_exponent import LARGEST
from wlm.ops.hdr_blocks import encoded_blocks

BLOCK_CODECS = ("bc6h", "astc")
_Array = np.ndarray | torch.Tensor
_EXTRA = "atlas"
_MANTISSA = 512  # mantissa steps of RGB9E5, and its least exponent, where the largest channel is below 2 ** -15
_LEAST_EXPONENT = -15
_SCALE_BIAS = 127 - 24  # from a stored exponent to the exponent bits of a mantissa's float32 scale


def block_grid(height: int, width: int) -> tuple[int, int]:
    """Computes the rows and columns of blocks that cover a texture."""
    return math.ceil(height / BLOCK_SIDE), math.ceil(width / BLOCK_SIDE)


def quantise(texels: _Array, colour: str, weight: _Array | None = None, device: str = "cpu") -> dict[str, np.ndarray]:
    """Encodes the colour texture T_p as `quantised` does, and returns numpy arrays."""
    return {name: part.cpu().numpy() for name, part in quantised(texels, colour, weight, device).items()}


def quantised(texels: _Array, colour: str, weight: _Array | None, device: str) -> dict[str, torch.Tensor]:
    """Encodes a linear texture such as T_p, [H, W, 3] on any device. Returns, on `device`, the arrays of `AtlasModel`:
    `texels` as decoded, half [H, W, 3], and, for a block format, `blocks`, uint8 [B, 16], row by row.

    Block formats clamp values, also infinite ones, to [0, 65504] and weight the squared errors of texels with `weight`
    [H, W]. If H or W is no multiple of 4, the last row or column is repeated.
    """
    if colour == "rgb9e5":
        return {"texels": _rounded(_on(texels, device)).half()}
    if colour not in BLOCK_CODECS:
        texels = texels.cpu().numpy() if isinstance(texels, torch.Tensor) else texels
        return {"texels": torch.from_numpy(texels.clip(0.0, HALF_MAX).astype(np.float16)).to(device)}
    light = _on(texels, device)
    if count := int(light.isnan().any(2).sum()):
        raise ValueError(f"texels: expected no NaN, found {count} texels with NaN")
    height, width = light.shape[:2]
    below, right = -height % BLOCK_SIDE, -width % BLOCK_SIDE
    light = light.clamp(0.0, HALF_MAX).float()
    light = torch.cat([light, light[-1:].expand(below, -1, -1)]) if below else light
    light = torch.cat([light, light[:, -1:].expand(-1, right, -1)], 1) if right else light
    weight = torch.ones((height, width), device=device) if weight is None else _on(weight, device)
    padded = pad(weight.float(), (0, right, 0, below))[None, ..., None]
    blocks, decoded = encoded_blocks(colour, _by_block(light[None]), _by_block(padded)[..., 0])
    whole = _of_blocks(decoded, 1, *light.shape[:2])[0, :height, :width]
    return {"texels": whole.half(), "blocks": blocks}


def stored(samples: torch.Tensor, weight: torch.Tensor | None, colour: str) -> torch.Tensor:
    """Returns the samples of T tiles after encoding and decoding, float32 [T, ny, nx, 3], at least 0; for block formats
    ny and nx are multiples of 4, and squared errors are weighted by `weight` [T, ny, nx], which other formats ignore.
    For half floats, whose rounding is too small to matter, samples stay as they are."""
    if colour == "half":
        return samples
    if colour == "rgb9e5":
        return _rounded(samples)
    count, ny, nx, _ = samples.shape
    _, decoded = encoded_blocks(colour, _by_block(samples), _by_block(weight[..., None])[..., 0])
    return _of_blocks(decoded, count, ny, nx)


def _rounded(samples: torch.Tensor) -> torch.Tensor:
    """Rounds samples in a tensor to RGB9E5, as `wlm.formats.shared_exponent` does for arrays."""
    samples = samples.clamp(0.0, LARGEST)
    largest = samples.amax(-1, keepdim=True)
    # The exponent of a number from 1/2 to 1 times a power of two.
    exponent = torch.frexp(largest)[1].clamp(min=_LEAST_EXPONENT) - _LEAST_EXPONENT
    # The bits of a power of two, which a GPU's function would round.
    scale = (exponent + _SCALE_BIAS << 23).view(torch.float32)
    scale = torch.where((largest / scale).round() >= _MANTISSA, 2.0 * scale, scale)
    return (samples / scale).round() * scale


def _by_block(texels: torch.Tensor) -> torch.Tensor:
    """Cuts tiles [T, ny, nx, C] into blocks of 4x4 texels [N, 16, C], tile by tile and row by row."""
    count, ny, nx, channels = texels.shape
    cells = texels.reshape(count, ny // BLOCK_SIDE, BLOCK_SIDE, nx // BLOCK_SIDE, BLOCK_SIDE, channels)
    return cells.transpose(2, 3).reshape(-1, BLOCK_SIDE * BLOCK_SIDE, channels)


def _of_blocks(texels: torch.Tensor, count: int, ny: int, nx: int) -> torch.Tensor:
    cells = texels.view(count, ny // BLOCK_SIDE, nx // BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE, 3)
    return cells.transpose(2, 3).reshape(count, ny, nx, 3)


def decode(blocks: np.ndarray, height: int, width: int, codec: str) -> np.ndarray:
    """Decodes a texture of blocks, uint8 [B, 16], to float32 [height, width, 3], finite, in [0, 65504]."""
    rows, columns = block_grid(height, width)
    if blocks.dtype != np.uint8 or blocks.shape != (rows * columns, 16) or not blocks.size:
        raise ValueError(f"blocks: expected shape uint8 [{rows * columns}, 16], got {blocks.dtype} {blocks.shape}")
    size = (rows * BLOCK_SIDE, columns * BLOCK_SIDE)
    if codec == "bc6h":
        texels = hdr_blocks.decode_bc6h(blocks.tobytes(), *size, _EXTRA)
    else:
        texels = hdr_blocks.decode_astc(blocks.tobytes(), (BLOCK_SIDE, BLOCK_SIDE), *size, _EXTRA)
    texels = texels[:height, :width].astype(np.float32)
    broken = ~np.isfinite(texels).all(axis=2)
    if broken.any():
        row, column = np.argwhere(broken)[0] // BLOCK_SIDE
        raise WlmError(f"{codec}: the block in row {row}, column {column} is invalid: its texels are NaN or infinite")
    return texels


def _on(values: _Array, device: str) -> torch.Tensor:
    return torch.as_tensor(values if isinstance(values, torch.Tensor) else np.array(values), device=device)
