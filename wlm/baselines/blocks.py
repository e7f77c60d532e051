"""Block codecs that engines ship lightmaps in: BC6H, BC7 with a gamma, ASTC HDR; and plain 8 bits.

Each encoder takes one lightmap and returns what it weighs, how long it took and what comes back out of it.
Gaps between charts are filled from the nearest valid texel first, as every engine does: zeros there cost 10
dB at chart edges. Times are wall-clock on the CPU with one thread, for the codec alone: the filling does not
count.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from wlm.errors import WlmError
from wlm.formats import hdr_blocks
from wlm.formats.hdr_blocks import ASTC_MEDIUM, need
from wlm.texels import fill_gaps

__all__ = [
    "BASELINES",
    "BlockResult",
    "encode_8bit",
    "encode_astc",
    "encode_bc6h",
    "encode_bc7",
    "run_baselines",
]

_T = TypeVar("_T")

HALF_MAX = 65504.0
# The usual display gamma: 8 bits of it are spaced about as the eye and as a lightmap's errors are.
GAMMA = 2.2
# BC blocks are 4x4 texels.
_BC_BLOCK = 4
# An 8-bit lightmap is stored relative to its brightest texel, which must be kept with it as one float32.
_SCALE_BYTES = 4
# The extra with the codecs' packages.
_EXTRA = "baselines"


@dataclass(frozen=True)
class BlockResult:
    """One lightmap through one codec.

    Attributes:
        name: The codec, as in `BASELINES`.
        bpp: Bits for each texel of the lightmap, `bytes * 8 / (H * W)`, padding to whole blocks included.
        bytes: Size of everything that a decoder needs.
        encode_seconds: Wall-clock time of the encoder.
        decode_seconds: Wall-clock time of the decoder on the CPU. A GPU decodes these formats in its texture
            unit, so this is no measure of what they cost there.
        decoded: `[H, W, 3]` float32, linear.
    """

    name: str
    bpp: float
    bytes: int
    encode_seconds: float
    decode_seconds: float
    decoded: np.ndarray


def encode_bc6h(frame: np.ndarray, mask: np.ndarray, profile: str = "slow") -> BlockResult:
    """BC6H, unsigned, 8 bits a texel, with Intel's ISPC texture compressor.

    Args:
        frame: `[H, W, 3]`, linear RGB. Negatives become 0 and values above 65,504, half float's largest,
            become that.
        mask: `[H, W]`, true where a texel is valid. With an empty mask a black lightmap is encoded.
        profile: `veryfast`, `fast`, `basic`, `slow` or `veryslow`.

    Returns:
        Sizes, times and the decoded lightmap.

    Raises:
        WlmError: Shapes do not fit, a valid texel is NaN or infinite, the profile is unknown, or a package is
            missing.
    """
    for package in ("ispc_texcomp", "imagecodecs"):  # the time to import them isn't the codec's
        need(package, _EXTRA)
    _check_profile("bc6h", profile, hdr_blocks.BC6H_PROFILES)
    image = _prepare(frame, mask)
    padded = _pad(image).astype(np.float16)
    data, encode_seconds = _timed(lambda: hdr_blocks.encode_bc6h(padded, profile, _EXTRA))
    decoded, decode_seconds = _timed(lambda: hdr_blocks.decode_bc6h(data, *padded.shape[:2], _EXTRA))
    return _result("bc6h", image, len(data), encode_seconds, decode_seconds, decoded)


def encode_bc7(frame: np.ndarray, mask: np.ndarray, profile: str = "basic") -> BlockResult:
    """BC7 with gamma 2.2, relative to the brightest valid texel; 8 bits a texel and one float32.

    Args:
        frame: `[H, W, 3]`, linear RGB. Negatives become 0 and values above 65,504 become that.
        mask: `[H, W]`, true where a texel is valid. With an empty mask a black lightmap is encoded.
        profile: `ultrafast`, `veryfast`, `fast`, `basic` or `slow`.

    Returns:
        Sizes, times and the decoded lightmap.

    Raises:
        WlmError: Shapes do not fit, a valid texel is NaN or infinite, the profile is unknown, or a package is
            missing.
    """
    texcomp, codecs = need("ispc_texcomp", _EXTRA), need("imagecodecs", _EXTRA)
    _check_profile("bc7", profile, ("ultrafast", "veryfast", "fast", "basic", "slow"))
    image = _prepare(frame, mask)
    levels, scale = _to_levels(image)
    padded = _pad(levels)
    height, width = padded.shape[:2]
    surface = texcomp.RGBASurface(_with_alpha(padded, np.uint8(255)).tobytes(), width, height)
    settings = texcomp.BC7EncSettings.from_profile(profile)
    data, encode_seconds = _timed(lambda: texcomp.compress_blocks_bc7(surface, settings))
    texels, decode_seconds = _timed(lambda: codecs.bcn_decode(data, 7, shape=(height, width, 4)))
    decoded = _from_levels(texels[..., :3], scale)
    return _result("bc7", image, len(data) + _SCALE_BYTES, encode_seconds, decode_seconds, decoded)


def encode_astc(frame: np.ndarray, mask: np.ndarray, block: int = 12, quality: float = ASTC_MEDIUM) -> BlockResult:
    """ASTC HDR in square blocks of 16 bytes, with astcenc: 0.89 bits a texel at 12x12, 1.28 at 10x10.

    The HDR profile has no early stop on decibels (astcenc ignores `tune_db_limit` there); in an LDR profile
    that stop must be raised, or the baseline is worse than the format.

    Args:
        frame: `[H, W, 3]`, linear RGB. Negatives become 0 and values above 65,504 become that.
        mask: `[H, W]`, true where a texel is valid. With an empty mask a black lightmap is encoded.
        block: Side of a block in texels: 4, 5, 6, 8, 10 or 12.
        quality: astcenc's effort, 0 (fastest) to 100 (exhaustive); 60 is its "medium".

    Returns:
        Sizes, times and the decoded lightmap.

    Raises:
        WlmError: Shapes do not fit, a valid texel is NaN or infinite, an argument is out of range, or the
            package is missing.
    """
    if block not in (4, 5, 6, 8, 10, 12):
        raise WlmError(f"astc: expected a block side of 4, 5, 6, 8, 10 or 12, got {block}")
    if not 0.0 <= quality <= 100.0:
        raise WlmError(f"astc: expected a quality from 0 to 100, got {quality}")
    image = _prepare(frame, mask)
    texels, codec = image.astype(np.float16), hdr_blocks.astc((block, block), quality, _EXTRA)
    data, encode_seconds = _timed(lambda: codec.encode(texels))
    decoded, decode_seconds = _timed(lambda: codec.decode(data, *texels.shape[:2]))
    return _result(f"astc{block}", image, len(data), encode_seconds, decode_seconds, decoded)


def encode_8bit(frame: np.ndarray, mask: np.ndarray) -> BlockResult:
    """Three bytes a texel with gamma 2.2, relative to the brightest valid texel: about BC7's upper bound.

    Args:
        frame: `[H, W, 3]`, linear RGB. Negatives become 0 and values above 65,504 become that.
        mask: `[H, W]`, true where a texel is valid. With an empty mask a black lightmap is encoded.

    Returns:
        Sizes, times and the decoded lightmap.

    Raises:
        WlmError: Shapes do not fit, or a valid texel is NaN or infinite.
    """
    image = _prepare(frame, mask)
    (levels, scale), encode_seconds = _timed(lambda: _to_levels(image))
    decoded, decode_seconds = _timed(lambda: _from_levels(levels, scale))
    return _result("8bit", image, levels.nbytes + _SCALE_BYTES, encode_seconds, decode_seconds, decoded)


# By name, each as the published comparisons set it.
BASELINES: dict[str, Callable[[np.ndarray, np.ndarray], BlockResult]] = {
    "bc6h": encode_bc6h,
    "bc7": encode_bc7,
    "astc10": functools.partial(encode_astc, block=10),
    "astc12": functools.partial(encode_astc, block=12),
    "8bit": encode_8bit,
}


def run_baselines(
    frames: Iterable[np.ndarray], mask: np.ndarray, names: Sequence[str] = tuple(BASELINES)
) -> list[list[BlockResult]]:
    """Every named codec on every lightmap of a set, which share one mask.

    The decoded lightmaps are kept: 12 MiB for each codec and lightmap of 1024². Pass one lightmap at a time
    where that is too much.

    Args:
        frames: Lightmaps `[H, W, 3]`, linear RGB.
        mask: `[H, W]`, true where a texel is valid.
        names: Keys of `BASELINES`.

    Returns:
        One list a lightmap, with one result a name, in the given orders.

    Raises:
        WlmError: A name is unknown, or as the encoder.
    """
    for name in names:
        if name not in BASELINES:
            raise WlmError(f"baselines: unknown codec {name!r}, expected one of {', '.join(BASELINES)}")
    return [[BASELINES[name](frame, mask) for name in names] for frame in frames]


def _check_profile(codec: str, profile: str, known: Sequence[str]) -> None:
    if profile not in known:
        raise WlmError(f"{codec}: unknown profile {profile!r}, expected one of {', '.join(known)}")


def _prepare(frame: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Check a lightmap, fill its gaps and bring it into half float's range, as float32."""
    frame = np.asarray(frame)
    if frame.ndim != 3 or frame.shape[2] != 3 or 0 in frame.shape:
        raise WlmError(f"baselines: expected a lightmap [H, W, 3], got {frame.shape}")
    filled = fill_gaps(frame, mask)
    if not np.isfinite(filled).all():
        raise WlmError("baselines: the lightmap is NaN or infinite at valid texels")
    return np.clip(filled, 0.0, HALF_MAX).astype(np.float32)


def _pad(image: np.ndarray) -> np.ndarray:
    """Repeat the last row and column up to whole BC blocks."""
    height, width = image.shape[:2]
    return np.pad(image, ((0, -height % _BC_BLOCK), (0, -width % _BC_BLOCK), (0, 0)), mode="edge")


def _with_alpha(image: np.ndarray, alpha: np.generic) -> np.ndarray:
    return np.ascontiguousarray(np.concatenate([image, np.full((*image.shape[:2], 1), alpha)], axis=2))


def _to_levels(image: np.ndarray) -> tuple[np.ndarray, float]:
    # A filled image holds no value that is not a valid texel's, so its maximum is theirs.
    scale = float(image.max()) or 1.0
    return (np.power(image / np.float32(scale), 1.0 / GAMMA) * 255.0 + 0.5).astype(np.uint8), scale


def _from_levels(levels: np.ndarray, scale: float) -> np.ndarray:
    table = ((np.arange(256) / 255.0) ** GAMMA * scale).astype(np.float32)
    return table[levels]


def _timed(call: Callable[[], _T]) -> tuple[_T, float]:
    start = time.perf_counter()
    value = call()
    return value, time.perf_counter() - start


def _result(
    name: str, image: np.ndarray, size: int, encode_seconds: float, decode_seconds: float, decoded: np.ndarray
) -> BlockResult:
    height, width = image.shape[:2]
    return BlockResult(
        name=name,
        bpp=size * 8 / (height * width),
        bytes=size,
        encode_seconds=encode_seconds,
        decode_seconds=decode_seconds,
        decoded=np.ascontiguousarray(decoded[:height, :width], dtype=np.float32),
    )
