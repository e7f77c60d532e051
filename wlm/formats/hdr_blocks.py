"""Decoding of BC6H and ASTC by optional packages, on the CPU: from blocks of 16 bytes, row by row, to half-float RGB.

The packages are imported when they are used.
"""

import importlib
from types import ModuleType

import numpy as np

from wlm.errors import WlmError

ASTC_BLOCKS = (
    (4, 4), (5, 4), (5, 5), (6, 5), (6, 6), (8, 5), (8, 6), (8, 8), (10, 5), (10, 6), (10, 8), (10, 10), (12, 10),
    (12, 12),
)  # fmt: skip
"""Width and height of every 2D block size of the format, in texels."""


def need(package: str, extra: str) -> ModuleType:
    """Imports an optional package."""
    try:
        return importlib.import_module(package)
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and error.name == package:
            raise WlmError(f"{extra}: {package} is missing; needs the extra: pip install 'wlm[{extra}]'") from error
        raise WlmError(
            f"{extra}: {package} is installed but cannot be imported: {type(error).__name__}: {error}; install it "
            f"again: pip install --force-reinstall 'wlm[{extra}]'"
        ) from error


def decode_bc6h(blocks: bytes, height: int, width: int, extra: str, signed: bool = False) -> np.ndarray:
    """Decodes BC6H to half [H, W, 3], H and W multiples of 4; blocks of reserved modes become black."""
    return need("imagecodecs", extra).bcn_decode(blocks, -6 if signed else 6, shape=(height, width, 3))


def decode_astc(blocks: bytes, block: tuple[int, int], height: int, width: int, extra: str) -> np.ndarray:
    """Decodes ASTC HDR with blocks of one of `ASTC_BLOCKS` texels to half [H, W, 3]; invalid blocks become NaN."""
    codec = need("astc_encoder", extra)
    config = codec.ASTCConfig(codec.ASTCProfile.HDR_RGB_LDR_A, *block, 1, 0.0)  # 0: the least effort of its encoder
    target = codec.ASTCImage(codec.ASTCType.F16, width, height, 1)
    codec.ASTCContext(config, 1).decompress(blocks, target, codec.ASTCSwizzle.from_str("RGBA"))
    return np.frombuffer(target.data, np.float16).reshape(height, width, 4)[..., :3]
