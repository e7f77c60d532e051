"""The model of a temporal lightmap: its settings, its time axis, its scales and its arrays.

A tile of 128 x 128 texels over T times is F_uv, F_uvt, F_ut, F_vt and a small MLP (neural-dynamic-gi, eq. 5). The
network's answer y is the colour in gamma space after three undone steps:

    colour(u, v, t) = (shift + spread y) * scale(t),     radiance = max(colour, 0) ** gamma

``scale`` is the mean of each channel at each time (section 4), ``shift`` and ``spread`` the mean and the deviation
of what is left over all times. The paper stops at the mean; a tile whose lighting hardly varies would then ask the
network for 1 +- 0.001. All three are stored rounded, and the fit divides by the rounded values, so that rounding
them costs nothing.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from wlm.config import load_settings, profile_path
from wlm.lightmap.tiles import TILE, TileKind
from wlm_kernels import mlp
from wlm_kernels.lightmap.features import STATIC_INPUTS, TEMPORAL_INPUTS

__all__ = [
    "LightmapModel",
    "Profile",
    "TimeAxis",
    "decode_scale",
    "encode_scale",
    "encode_time",
    "load_profile",
]

SCALE_SPAN = (-21.0, 16.0)  # log2 of radiance: from half float's small numbers to its largest


class Profile(BaseModel):
    """Settings of a fit. Sizes are the paper's table 3; the rest says how the fit goes.

    Attributes:
        name: Shown in reports.
        hidden: Width of both hidden layers.
        uvt_resolution: Texels of F_uvt along u and along v.
        uvt_slices: Slices of F_uvt along time.
        plane_columns, plane_rows: Size of F_ut and F_vt: along u or v, and along time.
        gelu: "exact", or its "tanh" form, which the GPU has an instruction for.
        gamma: The maps hold radiance ** (1 / gamma).
        time_axis: "paper": the features' time axis is the hour over the period, clamped at its ends. "frames": every
            interval between stored times gets an equal part of it, so that a lamp switched within minutes has as much
            room as an hour of afternoon; it wraps round where the set is periodic.
        steps, samples: Steps of the fit, and random samples of each tile in one.
        map_rate, net_rate: Adam's first learning rate of the maps and of the network.
        final_rate: Both end here, on half a cosine, as a share of the first.
        adam_epsilon: Adam's epsilon; the loss is a mean over a tile's samples and channels.
        metric_weight: 0: the squared error in normalised gamma space, as the paper; 1: each texel, channel and time
            weighted so that the loss is the squared error of linear radiance over the tile's range at that time,
            which is what PSNR measures; between: the geometric mean.
        between: Share of the samples that are drawn at times between two stored ones, where the fit follows their
            interpolation (eq. 2); 0 leaves those times to the network.
        quantise_from: Share of the steps after which the maps are used on the exact levels of the file.
        freeze_from: Share of the steps after which the maps stand still and the network alone is tuned.
        static_budget_db, see ``wlm.lightmap.tiles.classify``.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    hidden: int = Field(16, ge=4, le=128)
    uvt_resolution: int = Field(32, ge=4, le=128, multiple_of=4)
    uvt_slices: int = Field(12, ge=1, le=64)
    plane_columns: int = Field(64, ge=1, le=128)
    plane_rows: int = Field(24, ge=1, le=64)
    gelu: Literal["exact", "tanh"] = "tanh"
    gamma: float = Field(2.2, ge=1.0, le=4.0)
    time_axis: Literal["paper", "frames"] = "frames"
    steps: int = Field(20000, ge=10)
    samples: int = Field(4096, ge=128, multiple_of=128)
    map_rate: float = Field(2e-2, gt=0.0, lt=1.0)
    net_rate: float = Field(1e-2, gt=0.0, lt=1.0)
    final_rate: float = Field(1e-3, ge=0.0, le=1.0)
    adam_epsilon: float = Field(1e-8, gt=0.0)
    metric_weight: float = Field(0.5, ge=0.0, le=1.0)
    between: float = Field(0.25, ge=0.0, lt=1.0)
    quantise_from: float = Field(0.5, ge=0.0, le=1.0)
    freeze_from: float = Field(0.95, ge=0.0, le=1.0)
    static_budget_db: float = Field(60.0, gt=0.0)

    @model_validator(mode="after")
    def _stages_in_order(self) -> "Profile":
        if self.quantise_from > self.freeze_from:
            raise ValueError("quantise_from must not be later than freeze_from")
        return self

    def inputs(self, temporal: bool) -> int:
        """Inputs of the network of a tile with or without temporal maps."""
        return TEMPORAL_INPUTS if temporal else STATIC_INPUTS

    def tile_bytes(self, temporal: bool) -> int:
        """Bytes of one tile's maps and network as stored: the arithmetic of table 3."""
        size = TILE * TILE + 2 * mlp.parameter_count(self.inputs(temporal), self.hidden)
        if temporal:
            size += self.uvt_slices * self.uvt_resolution**2 + 2 * 2 * self.plane_rows * self.plane_columns
        return size


def load_profile(name: str) -> Profile:
    """Loads ``configs/lightmap-NAME.yaml``, or a YAML file of one's own.

    Raises:
        WlmError: Unknown profile, unreadable file, or a wrong setting.
    """
    path = name if name.endswith((".yaml", ".yml")) else profile_path("lightmap", name)
    return load_settings(Profile, path)


@dataclass(frozen=True)
class TimeAxis:
    """Places a time on the features' time axis; see ``Profile.time_axis``.

    Attributes:
        times: float64 [T], increasing.
        period: Length of the day, or None.
        kind: "paper" or "frames".
    """

    times: np.ndarray
    period: float | None
    kind: str

    @property
    def periodic(self) -> bool:
        """Whether the features' time axis wraps round."""
        return self.period is not None and self.kind == "frames" and len(self.times) > 1

    @property
    def turn(self) -> float:
        """gamma(t) is sine and cosine of turn tau and of 2 turn tau: whole turns where the axis wraps."""
        return (2.0 if self.periodic else 1.0) * math.pi

    def wrap(self, t: float) -> float:
        """The time in the set's own range: modulo the period, or clamped to the first and last stored time."""
        if self.period is not None:
            return t % self.period
        return float(np.clip(t, self.times[0], self.times[-1]))

    def neighbours(self, t: float) -> tuple[int, int, float]:
        """The stored times around t, and the share of the second: radiance there is interpolated (eq. 2)."""
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
        return (
            ((before + share + 0.5) / len(self.times)) % 1.0
            if self.periodic
            else (before + share + 0.5) / len(self.times)
        )

    def encode(self, t: float) -> np.ndarray:
        """gamma(t) of eq. 4, float32 [4]."""
        turn = self.turn * self.place(t)
        return np.array([math.sin(turn), math.cos(turn), math.sin(2 * turn), math.cos(2 * turn)], np.float32)


def encode_scale(values: np.ndarray, gamma: float, up: bool = False) -> np.ndarray:
    """8-bit logarithmic codes of values >= 0: 0 is exactly 0, codes 1 to 255 share ``SCALE_SPAN`` evenly.

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
    """The values that ``encode_scale`` stands for, float32."""
    low, high = (bound / gamma for bound in SCALE_SPAN)
    value = np.exp2(low + (codes.astype(np.float64) - 1.0) * ((high - low) / 254.0))
    return np.where(codes > 0, value, 0.0).astype(np.float32)


@dataclass
class LightmapModel:
    """A compressed lightmap set: what the file holds, as arrays.

    N_m tiles have maps (STATIC and DYNAMIC, in the order of their numbers), N_d of them temporal ones, N_c tiles are
    constants. S slices of F_uvt of R x R texels.

    Attributes:
        name, width, height, times, period, source: Of the input, see ``LightmapSet``.
        profile: The settings of the fit.
        kind: uint8 [tiles], ``TileKind`` of each tile of the grid, row-major; EMPTY also where not compressed.
        uv: uint8 [N_m, 32, 32, 16], BC7 blocks of F_uv.
        uvt: uint8 [N_d, S, R/4, R/4, 16], BC7 blocks of F_uvt, slice by slice.
        ut, vt: uint8 [N_d, rows, columns, 2].
        net: float16 [N_d, P], the networks of dynamic tiles, ``hidden`` rows and then ``output`` rows.
        net_static: float16 [N_m - N_d, P'], those of static tiles.
        scale: uint8 [N_d, T, 3], codes of the mean of each channel at each time, in gamma space.
        scale_static: float16 [N_m - N_d, T, 3], the means themselves in static tiles: their network doesn't know the
            time, so that it can't make up for rounding.
        peak: uint8 [N_m, T], codes of a bound of the tile at each time, in gamma space: 255 of the 8-bit output.
        affine: float16 [N_m, 2, 3], shift and spread.
        constant: float16 [N_c, T, 3], the radiance of constant tiles.
    """

    name: str
    width: int
    height: int
    times: np.ndarray
    period: float | None
    source: str
    profile: Profile
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

    @property
    def axis(self) -> TimeAxis:
        """The time axis of the features."""
        return TimeAxis(self.times, self.period, self.profile.time_axis)

    @property
    def scales(self) -> np.ndarray:
        """The scale of every mapped tile, float32 [N_m, T, 3]."""
        kinds = self.kind[self.kind >= TileKind.STATIC]
        result = np.empty((len(kinds), len(self.times), 3), np.float32)
        result[kinds == TileKind.DYNAMIC] = decode_scale(self.scale, self.profile.gamma)
        result[kinds == TileKind.STATIC] = self.scale_static
        return result

    @property
    def tile_columns(self) -> int:
        """Tiles in a row of the grid."""
        return -(-self.width // TILE)


def encode_time(axis: TimeAxis) -> tuple[np.ndarray, np.ndarray]:
    """tau [T] and gamma(t) [T, 4] of every stored time, float32."""
    tau = np.array([axis.place(t) for t in axis.times], np.float32)
    return tau, np.stack([axis.encode(t) for t in axis.times])
