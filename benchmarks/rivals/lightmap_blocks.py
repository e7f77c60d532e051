"""Block codecs that engines ship lightmaps in: BC6H, BC7 and ASTC, each at its best; and plain 8 bits.

Each encoder takes one lightmap [H, W, 3] in linear RGB and its mask [H, W], true where a texel is valid, and returns a
`Rival` whose `decoded` is the lightmap, float32 [H, W, 3]. Negative radiance becomes 0, and values above 65,504,
half float's largest, become that; with an empty mask a black lightmap is encoded. Gaps between charts are dilated from
the nearest valid texel first, as every engine does: zeros there cost 10 dB at charts' edges. Blocks that no read
reaches are black. 8 bits and the LDR formats hold levels between the least and the greatest of each tile, with a gamma
(`benchmarks.rivals.lightmap_levels`). Times are those of one thread, for the codec alone: what comes before does not
count. A size has padding to whole blocks in it.

All raise a `WlmError` where shapes do not fit, a valid texel is NaN or infinite, a setting is out of range, or a
package is missing.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchmarks.rivals.lightmap_levels import TileRanges, clear_unseen, prepare, seen_texels, to_codes
from benchmarks.rivals.rival import EXTRA, Rival, disk_size, measure
from wlm.errors import WlmError
from wlm.formats import bc7_modes, hdr_blocks
from wlm.formats.block_reuse import reuse_blocks
from wlm.formats.hdr_blocks import ASTC_THOROUGH, need
from wlm.lightmap.tiles import TILE
from wlm.metrics import evaluate_frame, summarise

_BC_BLOCK = 4  # texels along a block's side
_RING_WEIGHT = 0.25
_ASTC_BLOCKS = (4, 5, 6, 8, 10, 12)
_ASTC_PROFILES = ("best", "ldr", "hdr")


def encode_bc6h(frame: np.ndarray, mask: np.ndarray, profile: str = "slow", loss: float = 0.0) -> Rival:
    """Encodes as BC6H, unsigned, 8 bits a texel, with Intel's ISPC texture compressor.

    Args:
        frame, mask: The lightmap.
        profile: `veryfast`, `fast`, `basic`, `slow` or `veryslow`.
        loss: Of rate-distortion optimisation (`block_reuse`): what the root mean square error of a block's seen texels
            may grow by, in squares, in levels of 255; 0 for none.
    """
    for package in ("ispc_texcomp", "imagecodecs"):  # the time to import them isn't the codec's
        need(package, EXTRA)
    _check_profile("bc6h", profile, hdr_blocks.BC6H_PROFILES)
    _check_loss("bc6h", loss)
    image = prepare(frame, mask)
    seen = seen_texels(mask)
    padded = _pad(clear_unseen(image, seen, _BC_BLOCK)).astype(np.float16)

    def decode(data: bytes) -> np.ndarray:
        return hdr_blocks.decode_bc6h(data, *padded.shape[:2], EXTRA)

    def encode() -> bytes:
        data = hdr_blocks.encode_bc6h(padded, profile, EXTRA)
        if loss == 0.0:
            return data
        # Errors of codes, as shares of their tile's range.
        codes = _pad(to_codes(image))
        span = _pad(TileRanges.of(to_codes(image), seen).span(*seen.shape))
        weight = _weight(mask)
        return reuse_blocks(data, to_codes(decode(data)), codes, weight / np.square(span), weight * (loss / 255.0) ** 2)

    return _cropped(measure(_with_loss("bc6h", loss), encode, decode, disk_bytes=disk_size), image)


def encode_bc7(frame: np.ndarray, mask: np.ndarray, profile: str = "slow", loss: float = 0.0) -> Rival:
    """Encodes as BC7 with gamma 2.2 and the range of each tile; 8 bits a texel and 12 bytes a tile.

    Args:
        frame, mask: The lightmap.
        profile: `ultrafast`, `veryfast`, `fast`, `basic` or `slow`.
        loss: Of rate-distortion optimisation (`block_reuse`): what the root mean square error of a block's seen texels
            may grow by, in squares, in levels of 255; 0 for none.
    """
    for package in ("ispc_texcomp", "imagecodecs"):  # the time to import them isn't the codec's
        need(package, EXTRA)
    _check_profile("bc7", profile, bc7_modes.ENCODERS)
    _check_loss("bc7", loss)
    image = prepare(frame, mask)
    levels, ranges = _levels(image, mask, _BC_BLOCK)
    padded = _pad(_to_bytes(levels))

    def decode(data: bytes) -> np.ndarray:
        return need("imagecodecs", EXTRA).bcn_decode(data, 7, shape=(*padded.shape[:2], 4))[..., :3]

    def encode() -> bytes:
        data = bc7_modes.encode_image(padded, EXTRA, profile).tobytes()
        if loss == 0.0:
            return data
        weight = _weight(mask)
        return reuse_blocks(data, decode(data) / np.float32(255.0), _pad(levels), weight, weight * (loss / 255.0) ** 2)

    rival = measure(
        _with_loss("bc7", loss),
        encode,
        decode,
        bytes=lambda data: len(data) + len(ranges.tobytes()),
        disk_bytes=lambda data: disk_size(data + ranges.tobytes()),
    )
    rival = _cropped(rival, image)
    return replace(rival, decoded=ranges.radiance(rival.decoded / np.float32(255.0)))


def encode_astc(
    frame: np.ndarray, mask: np.ndarray, block: int = 12, quality: float = ASTC_THOROUGH, profile: str = "best"
) -> Rival:
    """Encodes as ASTC in square blocks of 16 bytes, with astcenc: from 8 bits a texel at 4x4 to 0.89 at 12x12.

    LDR holds levels with gamma 2.2 and the range of each tile, as BC7 does, but reads them at 16 bits; HDR holds the
    radiance. A tile's range may change within a block where the block's side divides no tile, which costs less than
    one range for the whole map does.

    Args:
        frame, mask: The lightmap.
        block: Side of a block in texels: 4, 5, 6, 8, 10 or 12.
        quality: astcenc's effort, 0 (fastest) to 100 (exhaustive); 60 is its "medium", 98 its "thorough".
        profile: `ldr`, `hdr`, or `best`, the one with the higher PSNR; the rival's `option` says which it was.
    """
    if block not in _ASTC_BLOCKS:
        raise WlmError(f"astc: expected a block side of 4, 5, 6, 8, 10 or 12, got {block}")
    if not 0.0 <= quality <= 100.0:
        raise WlmError(f"astc: expected a quality from 0 to 100, got {quality}")
    _check_profile("astc", profile, _ASTC_PROFILES)
    image = prepare(frame, mask)
    if profile != "best":
        return _astc(image, mask, block, quality, profile)
    ldr, hdr = (_astc(image, mask, block, quality, name) for name in ("ldr", "hdr"))
    scores = [
        summarise([evaluate_frame(image, rival.decoded, mask, TILE, ("psnr",), name=rival.name)]).psnr
        for rival in (ldr, hdr)
    ]
    return hdr if scores[1] > scores[0] else ldr  # without any score, as of one texel, LDR


def encode_8bit(frame: np.ndarray, mask: np.ndarray) -> Rival:
    """Encodes as three bytes a texel with gamma 2.2 and the range of each tile: about BC7's upper bound."""
    image = prepare(frame, mask)
    levels, ranges = _levels(image, mask, 1)
    rival = measure(
        "8bit",
        lambda: _to_bytes(levels).tobytes(),
        lambda data: ranges.radiance(np.frombuffer(data, np.uint8).reshape(image.shape) / np.float32(255.0)),
        bytes=lambda data: len(data) + len(ranges.tobytes()),
        disk_bytes=lambda data: disk_size(data + ranges.tobytes()),
    )
    return _cropped(rival, image)


def _astc(image: np.ndarray, mask: np.ndarray, block: int, quality: float, profile: str) -> Rival:
    ldr = profile == "ldr"
    codec = hdr_blocks.astc((block, block), quality, EXTRA, ldr=ldr)
    if ldr:
        texels, ranges = _levels(image, mask, block)
        scale = ranges.tobytes()
    else:
        texels, scale = clear_unseen(image, seen_texels(mask), block), b""
    texels = texels.astype(np.float16)
    rival = measure(
        f"astc{block}",
        lambda: codec.encode(texels),
        lambda data: codec.decode(data, *texels.shape[:2]),
        bytes=lambda data: len(data) + len(scale),
        disk_bytes=lambda data: disk_size(data + scale),
        option=lambda data: profile.upper(),
    )
    rival = _cropped(rival, image)
    return replace(rival, decoded=ranges.radiance(rival.decoded)) if ldr else rival


def _check_profile(codec: str, profile: str, names: Sequence[str]) -> None:
    if profile not in names:
        raise WlmError(f"{codec}: unknown profile {profile!r}, expected one of {', '.join(names)}")


def _check_loss(codec: str, loss: float) -> None:
    if not 0.0 <= loss <= 255.0:
        raise WlmError(f"{codec}: expected a loss from 0 to 255, got {loss:g}")


def _with_loss(name: str, loss: float) -> str:
    return f"{name}-rdo-{loss:g}" if loss else name


def _weight(mask: np.ndarray) -> np.ndarray:
    """Returns the weight of squared errors, float32 [H, W, 3] padded to blocks: some bilinear reads reach the ring."""
    valid = np.asarray(mask).astype(bool)
    weight = np.where(valid, 1.0, np.where(seen_texels(valid, ring=1), _RING_WEIGHT, 0.0)).astype(np.float32)
    height, width = valid.shape
    padded = np.pad(weight, ((0, -height % _BC_BLOCK), (0, -width % _BC_BLOCK)))
    return np.repeat(padded[..., None], 3, axis=2)


def _levels(image: np.ndarray, mask: np.ndarray, block: int) -> tuple[np.ndarray, TileRanges]:
    """Returns levels [H, W, 3] of a lightmap for blocks of this side, and the ranges that they are relative to."""
    codes, seen = to_codes(image), seen_texels(mask)
    ranges = TileRanges.of(codes, seen)
    return clear_unseen(ranges.levels(codes), seen, block), ranges


def _to_bytes(levels: np.ndarray) -> np.ndarray:
    return (levels * 255.0 + 0.5).astype(np.uint8)


def _pad(image: np.ndarray) -> np.ndarray:
    """Repeats the last row and column up to whole BC blocks."""
    height, width = image.shape[:2]
    return np.pad(image, ((0, -height % _BC_BLOCK), (0, -width % _BC_BLOCK), (0, 0)), mode="edge")


def _cropped(rival: Rival, image: np.ndarray) -> Rival:
    """Removes the padding of blocks."""
    height, width = image.shape[:2]
    decoded = np.ascontiguousarray(rival.decoded[:height, :width], dtype=np.float32)
    return replace(rival, decoded=decoded, size=(height, width))
