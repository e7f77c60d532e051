"""Block codecs that engines ship lightmaps in: BC6H, BC7 with a gamma, ASTC HDR; and plain 8 bits.

Each encoder takes one lightmap [H, W, 3] in linear RGB and its mask [H, W], true where a texel is valid, and returns a
`Rival` whose `decoded` is the lightmap, float32 [H, W, 3]. Negative radiance becomes 0, and values above 65,504,
half float's largest, become that; with an empty mask a black lightmap is encoded. Gaps between charts are dilated from
the nearest valid texel first, as every engine does: zeros there cost 10 dB at charts' edges. Times are those of one
thread, for the codec alone: dilation does not count. A size has padding to whole blocks in it.

All raise a `WlmError` where shapes do not fit, a valid texel is NaN or infinite, a setting is out of range, or a
package is missing.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from wlm.baselines.rival import Rival, measure
from wlm.errors import WlmError
from wlm.formats import hdr_blocks
from wlm.formats.hdr_blocks import ASTC_MEDIUM, need
from wlm.lightmap.data import LightmapSet
from wlm.lightmap.evaluation import SCORES, scored_mask
from wlm.lightmap.model import TILE, LightmapModel
from wlm.lightmap.seen import SeenScore, Tally
from wlm.lightmap.views import VIEWS, views_of
from wlm.metrics import evaluate_frame, summarise
from wlm.system import Meter, OnProgress
from wlm.texels import fill_gaps

HALF_MAX = 65504.0
# The usual display gamma: 8 bits of it are spaced about as the eye and as a lightmap's errors are.
GAMMA = 2.2
_BC_BLOCK = 4  # texels along a block's side
# An 8-bit lightmap is stored relative to its brightest texel, which must be kept with it as one float32.
_SCALE_BYTES = 4
_EXTRA = "baselines"  # with the codecs' packages
_SUMMED = ("bytes", "encode_seconds", "decode_seconds")  # of a set: over its times


def encode_bc6h(frame: np.ndarray, mask: np.ndarray, profile: str = "slow") -> Rival:
    """BC6H, unsigned, 8 bits a texel, with Intel's ISPC texture compressor.

    Args:
        frame, mask: The lightmap.
        profile: `veryfast`, `fast`, `basic`, `slow` or `veryslow`.
    """
    for package in ("ispc_texcomp", "imagecodecs"):  # the time to import them isn't the codec's
        need(package, _EXTRA)
    _check_profile("bc6h", profile, hdr_blocks.BC6H_PROFILES)
    image = _prepare(frame, mask)
    padded = _pad(image).astype(np.float16)
    rival = measure(
        "bc6h",
        lambda: hdr_blocks.encode_bc6h(padded, profile, _EXTRA),
        lambda data: hdr_blocks.decode_bc6h(data, *padded.shape[:2], _EXTRA),
    )
    return _cropped(rival, image)


def encode_bc7(frame: np.ndarray, mask: np.ndarray, profile: str = "basic") -> Rival:
    """BC7 with gamma 2.2, relative to the brightest valid texel; 8 bits a texel and one float32.

    Args:
        frame, mask: The lightmap.
        profile: `ultrafast`, `veryfast`, `fast`, `basic` or `slow`.
    """
    texcomp, codecs = need("ispc_texcomp", _EXTRA), need("imagecodecs", _EXTRA)
    _check_profile("bc7", profile, ("ultrafast", "veryfast", "fast", "basic", "slow"))
    image = _prepare(frame, mask)
    levels, scale = _to_levels(image)
    padded = _pad(levels)
    height, width = padded.shape[:2]
    opaque = np.concatenate([padded, np.full((height, width, 1), 255, np.uint8)], axis=2)
    surface = texcomp.RGBASurface(opaque.tobytes(), width, height)
    settings = texcomp.BC7EncSettings.from_profile(profile)
    rival = measure(
        "bc7",
        lambda: texcomp.compress_blocks_bc7(surface, settings),
        lambda data: codecs.bcn_decode(data, 7, shape=(height, width, 4)),
        bytes=lambda data: len(data) + _SCALE_BYTES,
    )
    return _cropped(replace(rival, decoded=_from_levels(rival.decoded[..., :3], scale)), image)


def encode_astc(frame: np.ndarray, mask: np.ndarray, block: int = 12, quality: float = ASTC_MEDIUM) -> Rival:
    """ASTC HDR in square blocks of 16 bytes, with astcenc: 0.89 bits a texel at 12x12, 1.28 at 10x10.

    The HDR profile has no early stop on decibels (astcenc ignores `tune_db_limit` there); in an LDR profile that stop
    must be raised, or the baseline is worse than the format.

    Args:
        frame, mask: The lightmap.
        block: Side of a block in texels: 4, 5, 6, 8, 10 or 12.
        quality: astcenc's effort, 0 (fastest) to 100 (exhaustive); 60 is its "medium".
    """
    if block not in (4, 5, 6, 8, 10, 12):
        raise WlmError(f"astc: expected a block side of 4, 5, 6, 8, 10 or 12, got {block}")
    if not 0.0 <= quality <= 100.0:
        raise WlmError(f"astc: expected a quality from 0 to 100, got {quality}")
    image = _prepare(frame, mask)
    texels, codec = image.astype(np.float16), hdr_blocks.astc((block, block), quality, _EXTRA)
    rival = measure(f"astc{block}", lambda: codec.encode(texels), lambda data: codec.decode(data, *texels.shape[:2]))
    return _cropped(rival, image)


def encode_8bit(frame: np.ndarray, mask: np.ndarray) -> Rival:
    """Three bytes a texel with gamma 2.2, relative to the brightest valid texel: about BC7's upper bound."""
    image = _prepare(frame, mask)
    rival = measure(
        "8bit",
        lambda: _to_levels(image),
        lambda payload: _from_levels(*payload),
        bytes=lambda payload: payload[0].nbytes + _SCALE_BYTES,
    )
    return _cropped(rival, image)


RIVALS: dict[str, Callable[[np.ndarray, np.ndarray], Rival]] = {
    "bc6h": encode_bc6h,
    "bc7": encode_bc7,
    "astc10": functools.partial(encode_astc, block=10),
    "astc12": functools.partial(encode_astc, block=12),
    "8bit": encode_8bit,
}
"""By name, each as the published comparisons set it: a lightmap and its mask to a `Rival`."""


@dataclass(frozen=True)
class Score(SeenScore):
    """How wrong a block codec is on a set, over the texels that ours is scored over.

    Between stored times its light is the mix of the two lightmaps. The scores of `SeenScore` are attributes too.

    Attributes:
        psnr, ssim, flip: As in the report of `wlm.lightmap.evaluate`.
        bpp: Bits for each texel and time. These codecs have a fixed rate, so this holds for any part of the map.
        bytes: Of all times of the whole map, also where only some tiles are scored.
    """

    psnr: float
    ssim: float
    flip: float
    bpp: float
    bytes: int


def evaluate_rivals(
    model: LightmapModel,
    lightmaps: LightmapSet,
    names: Sequence[str] = ("bc6h", "bc7", "astc12", "astc10", "8bit"),
    *,
    metrics: Sequence[str] = SCORES,
    views: int = VIEWS,
    progress: OnProgress | None = None,
) -> list[tuple[Rival, Score]]:
    """Puts every time through block codecs, one time after the other, and scores the texels that `evaluate` scores.

    Args:
        model: The model to compare with: it says which tiles are scored.
        lightmaps: The input.
        names: Keys of `RIVALS`.
        metrics, views: As for `wlm.lightmap.evaluate`.
        progress: Called about twice a second.

    Returns:
        For each name the rival, with bytes and seconds of all times and without what was decoded, and its score.

    Raises:
        WlmError: As `wlm.lightmap.evaluate`, an unknown name, or the extra `baselines` is missing.
    """
    for name in names:
        if name not in RIVALS:
            raise WlmError(f"baselines: unknown codec {name!r}, expected one of {', '.join(RIVALS)}")
    mask, count = scored_mask(model, lightmaps), len(lightmaps.frames)
    plain, seen = [metric for metric in metrics if metric != "seen"], "seen" in metrics
    meter = Meter(progress, "baselines", len(names) * count)
    results = []
    for k, name in enumerate(names):
        rivals, frames = [], []
        tally = Tally(lightmaps, mask, views=views_of(lightmaps, views if seen else 0)[0], name=name)
        for i, frame in enumerate(lightmaps.frames):
            # The whole map's mask: an engine would encode all of it, whatever we score.
            rival = RIVALS[name](frame, lightmaps.mask)
            valid = mask & lightmaps.valid(i)
            frames.append(evaluate_frame(frame, rival.decoded, valid, TILE, plain, name=name))
            if seen:
                tally.add(i, rival.decoded, frames[i])
            rivals.append(replace(rival, decoded=None))  # a set of them is too much memory
            if meter.due(k * count + i + 1):
                meter.report(k * count + i + 1)
        summed = {key: sum(getattr(rival, key) for rival in rivals) for key in _SUMMED}
        rival, summary = replace(rivals[0], **summed), summarise(frames)
        bpp = rival.bytes * 8 / (lightmaps.mask.size * count)
        scores = {"psnr": summary.psnr, "ssim": summary.ssim, "flip": summary.flip, **vars(tally.score())}
        results.append((rival, Score(**scores, bpp=bpp, bytes=rival.bytes)))
    return results


def _check_profile(codec: str, profile: str, names: Sequence[str]) -> None:
    if profile not in names:
        raise WlmError(f"{codec}: unknown profile {profile!r}, expected one of {', '.join(names)}")


def _prepare(frame: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Checks a lightmap, dilates its charts and brings it into half float's range, as float32."""
    frame = np.asarray(frame)
    if frame.ndim != 3 or frame.shape[2] != 3 or 0 in frame.shape:
        raise WlmError(f"baselines: expected a lightmap [H, W, 3], got {frame.shape}")
    filled = fill_gaps(frame, mask)
    if not np.isfinite(filled).all():
        raise WlmError("baselines: the lightmap is NaN or infinite at valid texels")
    return np.clip(filled, 0.0, HALF_MAX).astype(np.float32)


def _pad(image: np.ndarray) -> np.ndarray:
    """Repeats the last row and column up to whole BC blocks."""
    height, width = image.shape[:2]
    return np.pad(image, ((0, -height % _BC_BLOCK), (0, -width % _BC_BLOCK), (0, 0)), mode="edge")


def _to_levels(image: np.ndarray) -> tuple[np.ndarray, float]:
    # A filled image holds no value that is not a valid texel's, so its maximum is theirs.
    scale = float(image.max()) or 1.0
    return (np.power(image / np.float32(scale), 1.0 / GAMMA) * 255.0 + 0.5).astype(np.uint8), scale


def _from_levels(levels: np.ndarray, scale: float) -> np.ndarray:
    table = ((np.arange(256) / 255.0) ** GAMMA * scale).astype(np.float32)
    return table[levels]


def _cropped(rival: Rival, image: np.ndarray) -> Rival:
    """Without the padding of blocks."""
    height, width = image.shape[:2]
    decoded = np.ascontiguousarray(rival.decoded[:height, :width], dtype=np.float32)
    return replace(rival, decoded=decoded, size=(height, width))
