"""The model of a temporal lightmap: its settings, its time axis, its scales and its arrays.

A tile of 128 x 128 texels over T times is F_uv, F_uvt, F_ut, F_vt and a small MLP (neural-dynamic-gi, eq. 5). The
network's output y is normalised colour; decoding undoes the normalisation:

    colour(u, v, t) = (shift + spread y) * scale(t),     radiance = max(colour, 0) ** gamma

`colour` is in gamma space. `scale` is the mean of each channel at each time (section 4), `shift` and `spread`
are the mean and the standard deviation, over all times, of colour / scale. The paper stops at the mean; the network of
a tile whose lighting hardly varies would then have to output 1 +- 0.001. All three are stored rounded, and the fit
divides by the rounded values, so that rounding them costs nothing.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from wlm.formats.exr import HALF_MAX
from wlm.formats.parts import Part
from wlm.lightmap.level_packing import STEPS, unpack_levels
from wlm.lightmap.tiles import TILE, UNPACKED, TileKind, valid_texels
from wlm.lightmap.video_packing import WHITE, levels_of, unpack_video
from wlm.lightmap.weights import packed_bytes
from wlm.system import Model, Settings
from wlm_kernels import mlp
from wlm_kernels.lightmap.features import STATIC_INPUTS, TEMPORAL_INPUTS

_RANGE_BYTES = 2 * 3 * 2

_MOST_ALONG_TIME = 64
_USUAL_TIMES = 26  # of the paper's sets

SCALE_SPAN = (-21.0, 16.0)  # log2 of radiance: from half float's small numbers to its largest


class Profile(Settings):
    """Settings of a fit: the sizes of the paper's table 3, and the training.

    Attributes:
        name: Shown in reports.
        hidden: Width of both hidden layers.
        uvt_resolution: Texels of F_uvt along u and along v.
        uvt_slices: Slices of F_uvt along time.
        plane_columns, plane_rows: Size of F_ut and F_vt: along u or v, and along time.
        follow_times: Whether the maps' sizes along time are those of sets of 26 times, and others have others, see
            `for_times`.
        net_bits: Bits of a network's weight in the file: 16, half floats, or 8, see `wlm.lightmap.weights`.
        map_bits: Bits of the numbers in F_ut and F_vt and of the ends of blocks: 8, all levels of BC7 mode 6; fewer,
            multiples of 2 ** (8 - bits) alone, which decode as fast and take less of the file.
        gelu: "exact", or its "tanh" form, for which GPUs have an instruction.
        gamma: The maps hold radiance ** (1 / gamma).
        time_axis: "paper": the features' time axis is the hour over the period, clamped at its ends. "frames": every
            interval between stored times gets an equal part of it, so that a lamp switched within minutes has as much
            room as an hour of afternoon; it wraps round where the set is periodic.
        interpolation: What light there is between two stored times. "radiance": the radiance of both, mixed (eq. 2), so
            that it is as exact there as at the stored times. "network": whatever the network makes of features that are
            interpolated in time, as the paper decodes.
        steps: Steps of the fit.
        samples: Random samples of each tile in one step.
        map_rate, net_rate: Adam's initial learning rate of the maps and of the network.
        final_rate: Final learning rate of both as a fraction of the initial one; the schedule is half a cosine.
        adam_epsilon: Adam's epsilon; the loss is a mean over a tile's samples and channels.
        adam_decay: Adam's decay of squared gradients, beta 2. A texel is sampled every few steps alone and its gradient
            shrinks by orders of magnitude during a fit: 0.99 follows that, and is worth 0.1 to 0.8 dB over 0.999 in
            short fits, nothing in long ones.
        metric_weight: 0: the squared error in normalised gamma space, as the paper; 1: each texel, channel and time
            weighted so that the loss is the squared error of linear radiance over the tile's range at that time, or
            over `peak`, which is what PSNR measures; between: the geometric mean.
        quantise_from: Fraction of the steps after which the maps are quantised to the exact levels of the file.
        freeze_from: Fraction of the steps after which the maps are frozen and the network alone is trained.
        peak: What an error is relative to, in all tiles at all times, of values that have a range of their own and
            aren't light; None: the range of the tile at that time, which the paper's protocol divides by.
        static_budget_db: See `wlm.lightmap.tiles.classify`.
        frames: Which tiles that are neither empty nor constant hold the lightmap of each time as BC7 rather than maps
            and a network: "auto", where that takes no more bytes, "never" or "always". "video": all are an AV1 stream,
            or levels that are coded without loss, see `video_quality`.
        frames_loss: Of these frames' rate-distortion optimisation: what the root mean square error of a block's texels
            may grow by, in squares, in levels of 255, to make the file smaller; 0 for none.
        video_quality: Of video: 0 to 100 of AV1, or levels where these are no worse and take fewer bytes; from 101 on
            levels, see `wlm.lightmap.level_packing.STEPS`, of 105 as exact as 10 bits of a channel's own range allow.
        video_speed: Of its encoder, 0 (the smallest file, very slow) to 10.
    """

    FILES: ClassVar[str] = "lightmap"

    hidden: int = Field(16, ge=4, le=128)
    uvt_resolution: int = Field(32, ge=4, le=128, multiple_of=4)
    uvt_slices: int = Field(12, ge=1, le=_MOST_ALONG_TIME)
    plane_columns: int = Field(64, ge=1, le=128)
    plane_rows: int = Field(24, ge=1, le=_MOST_ALONG_TIME)
    follow_times: bool = False
    net_bits: Literal[8, 16] = 16
    map_bits: int = Field(8, ge=4, le=8)
    gelu: Literal["exact", "tanh"] = "tanh"
    gamma: float = Field(2.2, ge=1.0, le=4.0)
    time_axis: Literal["paper", "frames"] = "frames"
    interpolation: Literal["radiance", "network"] = "radiance"
    steps: int = Field(20000, ge=10)
    samples: int = Field(4096, ge=128, multiple_of=128)
    map_rate: float = Field(2e-2, gt=0.0, lt=1.0)
    net_rate: float = Field(1e-2, gt=0.0, lt=1.0)
    final_rate: float = Field(1e-3, ge=0.0, le=1.0)
    adam_epsilon: float = Field(1e-8, gt=0.0)
    adam_decay: float = Field(0.999, ge=0.5, lt=1.0)
    metric_weight: float = Field(0.5, ge=0.0, le=1.0)
    quantise_from: float = Field(0.5, ge=0.0, le=1.0)
    freeze_from: float = Field(0.95, ge=0.0, le=1.0)
    peak: float | None = Field(None, gt=0.0)
    static_budget_db: float = Field(60.0, gt=0.0)
    frames: Literal["auto", "never", "always", "video"] = "auto"
    frames_loss: float = Field(0.2, ge=0.0, le=255.0)
    video_quality: int = Field(96, ge=0, le=max(STEPS))
    video_speed: int = Field(3, ge=0, le=10)

    @model_validator(mode="after")
    def _stages_in_order(self) -> "Profile":
        if self.quantise_from > self.freeze_from:
            raise ValueError("quantise_from must not be later than freeze_from")
        return self

    @property
    def map_step(self) -> int:
        """What the numbers of maps are multiples of."""
        return 1 << (8 - self.map_bits)

    def for_times(self, times: int) -> "Profile":
        """The settings of a set of so many times.

        With `follow_times` F_uvt, F_ut and F_vt have no more along time than there are stored times, each of which then
        has a slice and a row of its own: more would be mixtures. Beyond 26 times they grow in proportion, up to 64.
        """
        if not self.follow_times:
            return self
        sizes = {
            name: min(times, _MOST_ALONG_TIME, max(fixed, round(fixed * times / _USUAL_TIMES)))
            for name, fixed in (("uvt_slices", self.uvt_slices), ("plane_rows", self.plane_rows))
        }
        return self.override(sizes | {"follow_times": False})

    def inputs(self, temporal: bool) -> int:
        """Inputs of the network of a tile with or without temporal maps."""
        return TEMPORAL_INPUTS if temporal else STATIC_INPUTS

    def tile_bytes(self, temporal: bool) -> int:
        """Bytes of one tile's maps and network before they are deflated: the arithmetic of table 3."""
        inputs = self.inputs(temporal)
        count = 2 * mlp.parameter_count(inputs, self.hidden)
        size = TILE * TILE + (packed_bytes(inputs, self.hidden) if self.net_bits == 8 else count)
        if temporal:
            size += self.uvt_slices * self.uvt_resolution**2 + 2 * 2 * self.plane_rows * self.plane_columns
        return size

    def frames_bytes(self, times: int, share: float) -> float:
        """Bytes of one tile's frames before they are packed, where a share of its blocks is in use."""
        return times * (share * TILE * TILE + _RANGE_BYTES)


@dataclass(frozen=True)
class TimeAxis:
    """Places a time on the features' time axis; see `Profile.time_axis`.

    Attributes:
        times: float64 [T], increasing.
        period: Length of the day, or None.
        kind: "paper" or "frames".
        interpolation: "radiance" or "network", see `Profile.interpolation`.
    """

    times: np.ndarray
    period: float | None
    kind: str
    interpolation: str = "radiance"

    @property
    def periodic(self) -> bool:
        """Whether the features' time axis wraps round."""
        return self.period is not None and self.kind == "frames" and len(self.times) > 1

    @property
    def turn(self) -> float:
        """Radians that tau is multiplied by in gamma(t) of eq. 4: a full turn where the axis wraps."""
        return (2.0 if self.periodic else 1.0) * math.pi

    def wrap(self, t: float) -> float:
        """Wraps a time by the period, or clamps it to the first and last stored time."""
        if self.period is not None:
            return t % self.period
        return float(np.clip(t, self.times[0], self.times[-1]))

    def neighbours(self, t: float) -> tuple[int, int, float]:
        """Indices of the stored times around t, and the weight of the second in the interpolation of eq. 2."""
        t = self.wrap(t)
        n = len(self.times)
        after = int(np.searchsorted(self.times, t, side="right"))
        before = after - 1
        if self.period is None:
            before, after = max(before, 0), min(after, n - 1)
            gap = self.times[after] - self.times[before]
            return before, after, float((t - self.times[before]) / gap) if gap > 0 else 0.0
        before, after = before % n, after % n
        gap = (self.times[after] - self.times[before]) % self.period
        gap = gap if gap > 0 else self.period  # one stored time: the day is one interval
        return before, after, float(((t - self.times[before]) % self.period) / gap)

    def place(self, t: float) -> float:
        """tau in [0, 1] at which the features are read at time t."""
        if self.kind == "paper":
            first = 0.0 if self.period is not None else self.times[0]
            span = self.period if self.period is not None else max(self.times[-1] - self.times[0], 1e-12)
            return float((self.wrap(t) - first) / span)
        before, _, share = self.neighbours(t)
        tau = (before + share + 0.5) / len(self.times)
        return tau % 1.0 if self.periodic else tau

    def reads(self, t: float) -> list[tuple[float, float]]:
        """The times at which the network is evaluated for a time, each with its share of the radiance."""
        before, after, share = self.neighbours(t)
        if self.interpolation == "network":
            return [(t, 1.0)]
        pair = [(float(self.times[before]), 1.0 - share), (float(self.times[after]), share)]
        return [read for read in pair if read[1] > 0.0]

    def encode(self, t: float) -> np.ndarray:
        """gamma(t) of eq. 4, float32 [4]."""
        turn = self.turn * self.place(t)
        return np.array([math.sin(turn), math.cos(turn), math.sin(2 * turn), math.cos(2 * turn)], np.float32)


def encode_scale(values: np.ndarray, gamma: float, up: bool = False) -> np.ndarray:
    """8-bit logarithmic codes of values >= 0: 0 is exactly 0, codes 1 to 255 share `SCALE_SPAN` evenly.

    That makes steps of 4.7% at gamma 2.2. The span is fixed, so that a tile's bytes don't depend on its
    neighbours'. Smaller values take code 1.

    Args:
        values: Any shape, in gamma space.
        gamma: Of that space.
        up: Round up rather than to the nearest, for bounds.
    """
    low, high = (bound / gamma for bound in SCALE_SPAN)
    with np.errstate(divide="ignore"):
        position = (np.log2(np.maximum(values, 0.0)) - low) / (high - low) * 254.0
    position = np.where(values > 0, position, 0.0)
    code = np.ceil(position - 1e-6) if up else np.rint(position)
    return np.where(values > 0, 1 + np.clip(code, 0, 254), 0).astype(np.uint8)


def decode_scale(codes: np.ndarray, gamma: float) -> np.ndarray:
    """The values that `encode_scale` stands for, float32."""
    low, high = (bound / gamma for bound in SCALE_SPAN)
    value = np.exp2(low + (codes.astype(np.float64) - 1.0) * ((high - low) / 254.0))
    return np.where(codes > 0, value, 0.0).astype(np.float32)


def part_table(profile: Profile, kind: np.ndarray, times: int) -> dict[str, Part]:
    """The arrays of a model, in the order of its file.

    N_m tiles have maps (STATIC and DYNAMIC, by number), N_d of them temporal ones; N_c tiles are constant, N_f are
    frames, N_v video and N_l levels.

    Args:
        profile: The settings.
        kind: uint8 [tiles], as in `LightmapModel`.
        times: T.
    """
    counted = TileKind.DYNAMIC, TileKind.STATIC, TileKind.CONSTANT, TileKind.FRAMES, TileKind.VIDEO, TileKind.LEVELS
    dynamic, static, constant, framed, filmed, levelled = (int((kind == value).sum()) for value in counted)
    streamed = None if filmed else 0  # of any size, where there are any
    mapped, r = dynamic + static, profile.uvt_resolution // 4
    plane = Part(np.uint8, (dynamic, profile.plane_rows, profile.plane_columns, 2))
    parameters, static_parameters = (mlp.parameter_count(profile.inputs(t), profile.hidden) for t in (True, False))
    return {
        "uv": Part(np.uint8, (mapped, TILE // 4, TILE // 4, 16)),
        "uvt": Part(np.uint8, (dynamic, profile.uvt_slices, r, r, 16)),
        "ut": plane,
        "vt": plane,
        "net": Part(np.float16, (dynamic, parameters)),
        "net_static": Part(np.float16, (static, static_parameters)),
        "scale": Part(np.uint8, (dynamic, times, 3)),
        "scale_static": Part(np.float16, (static, times, 3), least=0.0),
        "peak": Part(np.uint8, (mapped, times)),
        "affine": Part(np.float16, (mapped, 2, 3), least=0.0),
        "constant": Part((np.float16, np.float32), (constant, times, 3), least=0.0, most=HALF_MAX),
        "frames": Part(np.uint8, (framed, times, TILE // 4, TILE // 4, 16)),
        "ranges": Part(np.float16, (framed, times, 2, 3), least=0.0),
        "video": Part(np.uint8, (streamed,)),
        "video_sizes": Part(np.uint32, (streamed,)),
        "video_ranges": Part(np.float16, (filmed, times, 2), least=0.0),
        "levels": Part(np.uint8, (None if levelled else 0,)),
        "level_sizes": Part(np.uint32, (levelled,)),
        "level_ranges": Part(np.float16, (levelled, times, 2, 3), least=0.0),
    }


@dataclass
class LightmapModel(Model):
    """A compressed lightmap set: what the file holds, as arrays. Their types and shapes are in `part_table`.

    Attributes:
        name, width, height, times, period, source: Of the input, see `LightmapSet`.
        profile: The settings of the fit.
        mask: bool [H, W], true where a texel is valid; the gaps are filled by `wlm.lightmap.gaps` after decoding.
        kind: uint8 [tiles], `TileKind` of each tile of the grid, row-major; EMPTY also where not compressed.
        uv: BC7 blocks of F_uv.
        uvt: BC7 blocks of F_uvt, slice by slice.
        ut, vt: F_ut and F_vt, time down the rows.
        net: Networks of dynamic tiles, `hidden` rows and then `output` rows, see `wlm_kernels.mlp`.
        net_static: Those of static tiles.
        scale: Codes of the mean of each channel at each time, in gamma space.
        scale_static: The means themselves in static tiles: their network doesn't know the time, so it can't make up
            for rounding.
        peak: Codes of an upper bound of the tile at each time, in gamma space: 255 of the 8-bit output.
        affine: Shift and spread.
        constant: Radiance of constant tiles: half floats, or float32 where one would be more than 1% off.
        frames: BC7 blocks of the tiles that are stored as frames, of any mode; black where no read reaches.
        ranges: Their least and greatest colour, in gamma space.
        video: The streams of the tiles that are stored as video, see `wlm.lightmap.video`.
        video_sizes: Bytes of each stream.
        video_ranges: Colour of the tiles' levels 0 and 1023, in gamma space.
        levels: The streams of the tiles that are stored as levels, see `wlm.lightmap.level_packing`.
        level_sizes: Bytes of each stream.
        level_ranges: Colour of their levels 0 and 1023, in gamma space.
        warnings: What the fit fell back on, one line each; not in the file.
    """

    SYSTEM: ClassVar[str] = "lightmap"

    name: str
    width: int
    height: int
    times: np.ndarray
    period: float | None
    source: str
    profile: Profile
    mask: np.ndarray
    kind: np.ndarray
    uv: np.ndarray
    uvt: np.ndarray
    ut: np.ndarray
    vt: np.ndarray
    net: np.ndarray
    net_static: np.ndarray
    scale: np.ndarray
    scale_static: np.ndarray
    peak: np.ndarray
    affine: np.ndarray
    constant: np.ndarray
    frames: np.ndarray
    ranges: np.ndarray
    video: np.ndarray
    video_sizes: np.ndarray
    video_ranges: np.ndarray
    levels: np.ndarray
    level_sizes: np.ndarray
    level_ranges: np.ndarray
    warnings: tuple[str, ...] = ()

    @property
    def parts(self) -> dict[str, np.ndarray]:
        """The arrays by name, in the order of the file; `kind` is the last."""
        return {name: getattr(self, name) for name in (*part_table(self.profile, self.kind, len(self.times)), "kind")}

    @property
    def axis(self) -> TimeAxis:
        """The time axis of the features."""
        return TimeAxis(self.times, self.period, self.profile.time_axis, self.profile.interpolation)

    @property
    def mapped(self) -> np.ndarray:
        """int [N_m], numbers of the tiles that have maps; `uv`, `peak` and `affine` have their rows."""
        return np.flatnonzero(np.isin(self.kind, (TileKind.STATIC, TileKind.DYNAMIC)))

    @property
    def scales(self) -> np.ndarray:
        """The scale of every mapped tile, float32 [N_m, T, 3]."""
        kinds = self.kind[self.mapped]
        result = np.empty((len(kinds), len(self.times), 3), np.float32)
        result[kinds == TileKind.DYNAMIC] = decode_scale(self.scale, self.profile.gamma)
        result[kinds == TileKind.STATIC] = self.scale_static
        return result

    @property
    def unpacked(self) -> np.ndarray:
        """int [N_v + N_l], numbers of the tiles of `UNPACKED`; `words`, `word_ranges`, `word_peaks` have their rows."""
        return np.flatnonzero(np.isin(self.kind, UNPACKED))

    @cached_property
    def words(self) -> np.ndarray:
        """Their levels, uint32 [N_v + N_l, T, 128, 128] as of `unpack_video`, decoded once.

        Raises:
            ValueError, WlmError: As `unpack_video` and `unpack_levels`.
        """
        times, kinds = len(self.times), self.kind[self.unpacked]
        video = unpack_video(self.video, self.video_sizes, self.kind, self.tile_columns, times)
        levels = unpack_levels(self.levels, self.level_sizes, self.kind, self.mask, times)
        if not len(video) or not len(levels):
            return levels if len(levels) else video
        return _by_kind(kinds, video, levels)

    @property
    def word_ranges(self) -> np.ndarray:
        """Colour of their levels 0 and 1023 by channel, in gamma space, half [N_v + N_l, T, 2, 3]."""
        shared = self.video_ranges[..., None].repeat(3, -1)
        return _by_kind(self.kind[self.unpacked], shared, self.level_ranges)

    @cached_property
    def word_peaks(self) -> np.ndarray:
        """The greatest colour of their valid texels, in gamma space, float32 [N_v + N_l, T]."""
        least, greatest = np.moveaxis(self.word_ranges.astype(np.float32), 2, 0)
        peaks = np.zeros(least.shape, np.float32)
        for row, number in enumerate(self.unpacked.tolist()):
            inside = valid_texels(self.mask, number)
            if inside.any():
                peaks[row] = levels_of(self.words[row][:, inside]).max(1)
        return (least + peaks / np.float32(WHITE) * (greatest - least)).max(2)

    @property
    def tile_columns(self) -> int:
        """Tiles in a row of the grid."""
        return -(-self.width // TILE)


def _by_kind(kinds: np.ndarray, video: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """The rows of tiles of video and of those of levels in the order of their numbers."""
    result = np.empty((len(kinds), *levels.shape[1:]), levels.dtype)
    result[kinds == TileKind.VIDEO], result[kinds == TileKind.LEVELS] = video, levels
    return result


def encode_time(axis: TimeAxis) -> tuple[np.ndarray, np.ndarray]:
    """tau [T] and gamma(t) [T, 4] of every stored time, float32."""
    tau = np.array([axis.place(t) for t in axis.times], np.float32)
    return tau, np.stack([axis.encode(t) for t in axis.times])
