"""The encoder astcenc and its decoder, in threads: half-float RGB images and blocks of 16 bytes, row by row."""

import functools
import math
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import numpy as np

from wlm.formats.hdr_blocks import need
from wlm.workers import cores, each

MEDIUM = 60.0  # astcenc's preset "medium"
_TEXELS_A_THREAD = 4096  # the least work of a thread, about 20 ms


class Astc:
    """An ASTC codec: the package astc_encoder with one configuration."""

    def __init__(self, codec: ModuleType, config: Any) -> None:
        self._codec, self._config, self._rows = codec, config, config.block_y
        self._idle: list[Any] = []  # idle contexts; a context serves one thread at a time

    def encode(self, texels: np.ndarray) -> bytes:
        """Encodes half [H, W, 3], finite and at least 0, to blocks; astcenc pads to whole blocks.

        Each thread encodes some rows of blocks; the result does not depend on the number of threads.
        """
        codec, (height, width) = self._codec, texels.shape[:2]
        least = self._rows * math.ceil(_TEXELS_A_THREAD / (self._rows * width))
        step = max(least, self._rows * math.ceil(height / (self._rows * cores())))

        def strip(first: int) -> bytes:
            part = texels[first : first + step]
            source = codec.ASTCImage(codec.ASTCType.F16, width, len(part), 1, _with_alpha(part).tobytes())
            with self._context() as context:
                return context.compress(source, codec.ASTCSwizzle.from_str("RGB1"))

        return b"".join(each(strip, range(0, height, step)))

    def decode(self, blocks: bytes, height: int, width: int) -> np.ndarray:
        """Decodes blocks to half [H, W, 3]; invalid blocks become NaN."""
        codec = self._codec
        target = codec.ASTCImage(codec.ASTCType.F16, width, height, 1)
        with self._context() as context:
            context.decompress(blocks, target, codec.ASTCSwizzle.from_str("RGBA"))
        return np.frombuffer(target.data, np.float16).reshape(height, width, 4)[..., :3]

    @contextmanager
    def _context(self) -> Iterator[Any]:
        try:
            context = self._idle.pop()
        except IndexError:
            context = self._codec.ASTCContext(self._config, 1)
        yield context
        self._idle.append(context)


def astc(block: tuple[int, int], quality: float, extra: str) -> Astc:
    """Returns the HDR codec for blocks of one of `hdr_blocks.ASTC_BLOCKS` texels; equal settings share it.

    `quality` is the effort of the encoder, 0 (fastest) to 100 (exhaustive), and `extra` names the extra of wlm that
    installs it.
    """
    return _astc(need("astc_encoder", extra), block, quality)


@functools.cache  # building the tables of a context takes 15 ms
def _astc(codec: ModuleType, block: tuple[int, int], quality: float) -> Astc:
    return Astc(codec, codec.ASTCConfig(codec.ASTCProfile.HDR_RGB_LDR_A, *block, 1, quality))


def _with_alpha(texels: np.ndarray) -> np.ndarray:
    return np.concatenate([texels, np.ones((*texels.shape[:2], 1), np.float16)], axis=2, dtype=np.float16)
