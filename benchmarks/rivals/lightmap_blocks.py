"""Block codecs that engines use for lightmaps: BC6H, BC7 and ASTC, each at its best quality.

Each encoder takes one lightmap [H, W, 3] in linear RGB and its mask [H, W], true where a texel is valid, and returns a
`Rival` whose `decoded` is the lightmap, float32 [H, W, 3]. Negative radiance becomes 0, and values above 65,504,
the largest half float, are clamped; with an empty mask a black lightmap is encoded. Gaps between charts are dilated
from the nearest valid texel first, as every engine does: zeros there cost 10 dB at the edges of charts. Blocks that no
read reaches are black. BC7 and ASTC's LDR profile store levels between minimum and maximum of a tile, with a gamma
(`benchmarks.rivals.lightmap_levels`). Times are those of the codec alone on one thread, without the preparation. Sizes
include the padding to whole blocks.

All functions raise a `WlmError` if shapes do not fit, a valid texel is NaN or infinite, a setting is out of range, or a
package is missing.
"""

import functools
from collections.abc import Callable
from dataclasses import replace
from types import ModuleType

import numpy as np

from benchmarks.rivals import astcenc
from benchmarks.rivals.lightmap_levels import TileRanges, clear_unseen, prepare, seen_texels, to_codes
from benchmarks.rivals.rival import EXTRA, Rival, disk_size, measure, need_bc
from wlm.errors import WlmError
from wlm.formats import bc7, hdr_blocks
from wlm.formats.hdr_blocks import need
from wlm.lightmap.tiles import TILE
from wlm.metrics import evaluate_frame, summarise

_BC_BLOCK = 4  # texels along a block's side
_BC_PROFILE = "slow"
_ASTC_BLOCKS = (4, 5, 6, 8, 10, 12)
_ASTC_PROFILES = ("best", "ldr", "hdr")
_ASTC_THOROUGH = 98.0  # astcenc's preset "thorough"
# Above the PSNR of any block. In the LDR profile the presets stop the search of a block at 29 to 32 dB.
_NO_LIMIT_DB = 999.0


def encode_bc6h(frame: np.ndarray, mask: np.ndarray) -> Rival:
    """Encodes a lightmap as unsigned BC6H, 8 bits a texel, with Intel's ISPC texture compressor."""
    need_bc()
    image = prepare(frame, mask)
    padded = _pad(clear_unseen(image, seen_texels(mask), _BC_BLOCK)).astype(np.float16)

    def decode(data: bytes) -> np.ndarray:
        return hdr_blocks.decode_bc6h(data, *padded.shape[:2], EXTRA)

    return _cropped(_measured("bc6h", lambda: ispc_bc6h(padded), decode), image)


def ispc_bc6h(texels: np.ndarray) -> bytes:
    """Encodes texels, half [H, W, 3], as unsigned BC6H with Intel's ISPC texture compressor. Returns the blocks.

    Texels must be finite and not negative; H and W must be multiples of 4.
    """
    texcomp, (height, width) = need("ispc_texcomp", EXTRA), texels.shape[:2]
    rgba = np.pad(texels, ((0, 0), (0, 0), (0, 1)), constant_values=1)
    surface = texcomp.RGBASurface(rgba.tobytes(), width, height, rgba.strides[0])
    return texcomp.compress_blocks_bc6h(surface, texcomp.BC6HEncSettings.from_profile(_BC_PROFILE))


def encode_bc7(frame: np.ndarray, mask: np.ndarray) -> Rival:
    """Encodes a lightmap as BC7 with gamma 2.2, scaled by each tile's range; 8 bits a texel and 12 bytes a tile."""
    need_bc()
    image = prepare(frame, mask)
    levels, ranges = _levels(image, mask, _BC_BLOCK)
    padded = _pad((levels * 255.0 + 0.5).astype(np.uint8))

    def decode(data: bytes) -> np.ndarray:
        return need("imagecodecs", EXTRA).bcn_decode(data, 7, shape=(*padded.shape[:2], 4))[..., :3]

    def encode() -> bytes:
        return bc7.encode_image(padded, EXTRA, _BC_PROFILE).tobytes()

    rival = _cropped(_measured("bc7", encode, decode, ranges.tobytes()), image)
    return replace(rival, decoded=ranges.radiance(rival.decoded / np.float32(255.0)))


def encode_astc(frame: np.ndarray, mask: np.ndarray, block: int = 12, profile: str = "best") -> Rival:
    """Encodes a lightmap as ASTC in blocks of 16 bytes, with astcenc: 8 bits a texel at 4x4 to 0.89 at 12x12.

    LDR stores levels with gamma 2.2, scaled by the range of each tile, as for BC7, but decodes them to 16 bits; HDR
    stores radiance. A block that spans two tiles holds levels of two ranges, which loses less quality than one range
    for the whole map would.

    Args:
        frame, mask: The lightmap [H, W, 3] and its mask [H, W].
        block: Side of a block in texels: 4, 5, 6, 8, 10 or 12.
        profile: `ldr`, `hdr`, or `best`, the one with the higher PSNR; the `option` of the rival states the choice.
    """
    if block not in _ASTC_BLOCKS:
        raise WlmError(f"astc: expected a block side of 4, 5, 6, 8, 10 or 12, got {block}")
    if profile not in _ASTC_PROFILES:
        raise WlmError(f"astc: unknown profile {profile!r}, expected one of {', '.join(_ASTC_PROFILES)}")
    image = prepare(frame, mask)
    if profile != "best":
        return _astc(image, mask, block, profile)
    ldr, hdr = (_astc(image, mask, block, name) for name in ("ldr", "hdr"))
    scores = [
        summarise([evaluate_frame(image, rival.decoded, mask, TILE, ("psnr",), name=rival.name)]).psnr
        for rival in (ldr, hdr)
    ]
    return hdr if scores[1] > scores[0] else ldr  # without any score, as of one texel, LDR


def _astc(image: np.ndarray, mask: np.ndarray, block: int, profile: str) -> Rival:
    ldr = profile == "ldr"
    codec = _astc_codec(need("astc_encoder", EXTRA), block, ldr)
    if ldr:
        texels, ranges = _levels(image, mask, block)
        scale = ranges.tobytes()
    else:
        texels, scale = clear_unseen(image, seen_texels(mask), block), b""
    texels = texels.astype(np.float16)
    rival = _measured(
        f"astc{block}", lambda: codec.encode(texels), lambda data: codec.decode(data, *texels.shape[:2]), scale
    )
    rival = replace(_cropped(rival, image), option=profile.upper())
    return replace(rival, decoded=ranges.radiance(rival.decoded)) if ldr else rival


@functools.cache
def _astc_codec(codec: ModuleType, block: int, ldr: bool) -> astcenc.Astc:
    profile = codec.ASTCProfile.LDR if ldr else codec.ASTCProfile.HDR_RGB_LDR_A
    config = codec.ASTCConfig(profile, block, block, 1, _ASTC_THOROUGH)
    if ldr:
        config.tune_db_limit = _NO_LIMIT_DB  # the HDR profile has no such limit
    return astcenc.Astc(codec, config)


def _measured(
    name: str, encode: Callable[[], bytes], decode: Callable[[bytes], np.ndarray], ranges: bytes = b""
) -> Rival:
    """Encodes, decodes and times a codec. `ranges` are further bytes that its decoder needs: the ranges of tiles."""
    return measure(
        name,
        encode,
        decode,
        bytes=lambda data: len(data) + len(ranges),
        disk_bytes=lambda data: disk_size(data + ranges),
    )


def _levels(image: np.ndarray, mask: np.ndarray, block: int) -> tuple[np.ndarray, TileRanges]:
    """Gamma-encodes a lightmap; returns it as levels [H, W, 3], 0 to 1 within each tile's range, and the ranges."""
    codes, seen = to_codes(image), seen_texels(mask)
    ranges = TileRanges.of(codes, seen)
    return clear_unseen(ranges.levels(codes), seen, block), ranges


def _pad(image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    return np.pad(image, ((0, -height % _BC_BLOCK), (0, -width % _BC_BLOCK), (0, 0)), mode="edge")


def _cropped(rival: Rival, image: np.ndarray) -> Rival:
    """Returns the rival with its decoded lightmap cropped to the size of `image`, without the padding of blocks."""
    height, width = image.shape[:2]
    decoded = np.ascontiguousarray(rival.decoded[:height, :width], dtype=np.float32)
    return replace(rival, decoded=decoded, size=(height, width))
