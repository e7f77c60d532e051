"""A video codec over the hours: AV1 in 10 bits with full chroma, the smallest on disk, without random access.

The frames are the levels of `benchmarks.rivals.lightmap_levels` as one AVIF sequence of libaom. A texel cannot be read
without decoding its whole frame and the frames that it depends on, and a GPU stores the decoded frame. Gaps are filled
smoothly: detail there would cost as much as on a chart. The coded planes are luma, a green and an orange difference,
computed here: libavif's conversion, in floats, loses 0.1 to 0.4 dB.

Compared with HEVC by x265 ("slower", 4:4:4, PSNR tuning) AV1 takes a fifth less for the same PSNR on `city`.
"""

import numpy as np

from benchmarks.rivals.lightmap_levels import TileRanges, prepare, seen_texels, to_codes
from benchmarks.rivals.rival import EXTRA, Rival, disk_size, measure
from wlm.errors import WlmError
from wlm.formats.hdr_blocks import need
from wlm.workers import cores

BITS = 10  # bits of a sample
WHITE = (1 << BITS) - 1  # level of the greatest colour
_MIDDLE = 1 << BITS - 1  # stands for a difference of 0
_SPEED = 3  # speed of libaom, 0 (slowest, best) to 10
_IDENTITY = 0  # matrix coefficients, ITU-T H.273: green, blue and red are Y, U and V
_FROM_PLANES, _TO_PLANES = [2, 0, 1], [1, 2, 0]


def encode_av1(frames: np.ndarray, mask: np.ndarray, quality: int = 80) -> Rival:
    """Encodes all lightmaps of a set as one AV1 sequence.

    Args:
        frames: Lightmaps at T times, [T, H, W, 3], linear RGB.
        mask: [H, W], true where a texel is valid.
        quality: Quality setting of the encoder, 0 to 100; higher is better and larger.

    Returns:
        The rival; `decoded` is float32 [T, H, W, 3].

    Raises:
        WlmError: As for the block codecs, or a setting is out of range.
    """
    if not 0 <= quality <= 100:
        raise WlmError(f"av1: expected a quality from 0 to 100, got {quality}")
    # Each texel that must be right costs bits here: a ring of one is enough for a bilinear read.
    codes, seen = to_codes(prepare(frames, mask)), seen_texels(mask, ring=1)
    tiles = TileRanges.over_times(codes, seen, by_channel=False)  # grey stays grey
    levels = fill_smoothly(tiles.levels(codes), seen)

    def decode(stream: bytes) -> np.ndarray:
        return tiles.radiance(decode_levels(stream, levels.shape) / np.float32(WHITE))

    return measure(
        f"av1-{quality}",
        lambda: encode_levels(levels, quality),
        decode,
        bytes=lambda data: _stream_bytes(data) + len(tiles.tobytes()),
        disk_bytes=lambda data: _stream_bytes(data) + disk_size(tiles.tobytes()),
    )


def encode_levels(levels: np.ndarray, quality: int) -> bytes:
    """Encodes colour levels, float32 [T, H, W, 3] in [0, 1], as one AVIF sequence.

    The stream is the same on any machine with the same version of the encoder.

    Raises:
        WlmError: The encoder is missing.
    """
    planes = np.empty(levels.shape, np.uint16)
    for picture, out in zip(levels, planes, strict=True):
        red, green, blue = np.moveaxis(picture * np.float32(WHITE), 2, 0)
        luma = 0.25 * (red + blue) + 0.5 * green
        for i, plane in enumerate((luma, green - luma + _MIDDLE, 0.5 * (red - blue) + _MIDDLE)):
            out[..., i] = np.clip(plane + np.float32(0.5), 0, WHITE)
    rgb = np.ascontiguousarray(planes[..., _FROM_PLANES])
    return need("imagecodecs", EXTRA).avif_encode(
        rgb if len(rgb) > 1 else rgb[0],  # one frame is a still picture
        level=quality,
        speed=_SPEED,
        bitspersample=BITS,
        pixelformat="yuv444",
        matrix=_IDENTITY,
        codec="aom",
        numthreads=max(2, cores()),  # the stream is the same for any number except 1
    )


def decode_levels(data: bytes, shape: tuple[int, ...]) -> np.ndarray:
    """Decodes the result of `encode_levels` to integers from 0 to `WHITE`, uint16 of the shape [T, H, W, 3].

    Raises:
        WlmError: The decoder is missing.
    """
    rgb = need("imagecodecs", EXTRA).avif_decode(data)
    levels = np.ascontiguousarray(rgb.reshape(shape)[..., _TO_PLANES])
    for picture in levels:
        luma, green, orange = np.moveaxis(picture.astype(np.int32), 2, 0)
        green, orange = green - _MIDDLE, orange - _MIDDLE
        rest = luma - green
        np.clip(np.stack([rest + orange, luma + green, rest - orange], 2), 0, WHITE, out=picture, casting="unsafe")
    return levels


def fill_smoothly(images: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Fills texels outside the mask with means of increasingly large neighbourhoods, which compress to few bits.

    Args:
        images: float32 [..., H, W, C].
        mask: bool [H, W]; texels outside it aren't read.

    Returns:
        A new array; 0 where the mask is empty.
    """
    weight = mask.astype(np.float32)[..., None]
    return _pull_push(np.where(mask[..., None], images, np.float32(0.0)), weight)


def _stream_bytes(data: bytes) -> int:
    """Returns the size in bytes of the AV1 stream alone, without the boxes of the AVIF file."""
    at = 0
    while data[at + 4 : at + 8] != b"mdat":
        at += int.from_bytes(data[at : at + 4], "big")
    return int.from_bytes(data[at : at + 4], "big") - 8


def _pull_push(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Fills gaps, where weights [h, w, 1] are below 1, in values [..., h, w, C] that are premultiplied by them."""
    height, width = weight.shape[:2]
    if height == width == 1:
        return values / np.where(weight > 0.0, weight, np.float32(1.0))
    pad = ((0, height % 2), (0, width % 2), (0, 0))
    halves = [
        sum(np.pad(array, ((0, 0),) * (array.ndim - 3) + pad)[..., y::2, x::2, :] for y in (0, 1) for x in (0, 1))
        for array in (values, weight)
    ]
    # A coarse texel with any weight gets full weight: it is the mean of the valid texels that it covers.
    whole = 1.0 / np.maximum(halves[1], np.float32(1.0))
    coarse = _pull_push(halves[0] * whole, halves[1] * whole)
    fine = coarse.repeat(2, axis=-3).repeat(2, axis=-2)[..., :height, :width, :]
    return values + (1.0 - weight) * fine
