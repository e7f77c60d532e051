"""RGB9E5: three mantissas of nine bits and one exponent in 32 bits, an HDR format that every GPU can filter.

DXGI_FORMAT_R9G9B9E5_SHAREDEXP, VK_FORMAT_E5B9G9R9_UFLOAT_PACK32, GL_RGB9_E5. On the GPU: `wlm_kernels.shared_exponent`.
"""

import numpy as np

LARGEST = 65408.0
"""The largest number of the format."""

# 2^(e - 15 - 9): nine bits of mantissa without an implied leading bit.
_SCALE = np.ldexp(np.float32(1), np.arange(32) - 24)


def pack_rgb9e5(light: np.ndarray) -> np.ndarray:
    """Packs linear RGB [..., 3], finite, clamped to [0, `LARGEST`], into RGB9E5 words, uint32 [...]; the error is at
    most 1/512 of the largest channel of a texel."""
    light = np.clip(np.asarray(light, np.float64), 0.0, LARGEST)
    largest = light.max(-1)
    # The mantissa largest / 2 ** (exponent - 24) must be below 512.
    exponent = np.clip(np.floor(np.log2(np.maximum(largest, 2.0**-20))) + 16, 0, 31).astype(np.int64)
    exponent += np.round(largest / 2.0 ** (exponent - 24)) >= 512
    codes = np.round(light / 2.0 ** (exponent - 24)[..., None]).astype(np.uint32)
    return codes[..., 0] | codes[..., 1] << 9 | codes[..., 2] << 18 | exponent.astype(np.uint32) << 27


def unpack_rgb9e5(words: np.ndarray) -> np.ndarray:
    """Unpacks texels, uint32 [...], exactly to float32 [..., 3]."""
    mantissas = words[..., None] >> np.array([0, 9, 18], np.uint32) & np.uint32(0x1FF)
    return mantissas.astype(np.float32) * _SCALE[words >> np.uint32(27)][..., None]
