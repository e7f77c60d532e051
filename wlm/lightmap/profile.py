"""Settings of a lightmap fit, and the time axis of the feature maps."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from wlm.errors import WlmError
from wlm.formats.hours import neighbours
from wlm.lightmap.sheet import Sheet
from wlm.system import Settings

_MOST_ALONG_TIME = 64
_USUAL_TIMES = 26  # number of times of the paper's sets


class Profile(Settings):
    """Settings of a fit: the sizes of the feature maps (table 3 of the paper) and the training. Each field is described
    by the string below it."""

    FILES: ClassVar[str] = "lightmap"

    hidden: int = Field(16, ge=4, le=128)
    """Units in each of the two hidden layers of the network; a GPU fits networks of 16, 32, 48 and 64 units."""
    uvt_resolution: int = Field(32, ge=4, le=128, multiple_of=4)
    """Size of the feature map F_uvt along u and along v, in texels."""
    uvt_slices: int = Field(12, ge=1, le=_MOST_ALONG_TIME)
    """Number of slices of the feature map F_uvt along time."""
    plane_columns: int = Field(64, ge=1, le=128)
    """Size of the feature maps F_ut along u and F_vt along v, in texels."""
    plane_rows: int = Field(24, ge=1, le=_MOST_ALONG_TIME)
    """Size of the feature maps F_ut and F_vt along time, in texels."""
    follow_times: bool = False
    """Adapt the sizes of the maps along time to the number of stored times, see `Profile.for_times`."""
    net_bits: Literal[8, 16] = 16
    """Bits of a network weight in the file: 16 (half floats) or 8."""
    gelu: Literal["exact", "tanh"] = "tanh"
    """Formula of the GELU activation: exact, or the approximation by tanh, for which GPUs have an instruction."""
    gamma: float = Field(2.2, ge=1.0, le=4.0)
    """Exponent of the space in which light is fitted: radiance ** (1 / gamma)."""
    time_axis: Literal["paper", "frames"] = "frames"
    """Time axis of the features. "paper": the hour divided by the period, clamped at its ends. "frames": every interval
    between stored times has the same length, so that a lamp that is switched within minutes gets as many texels as an
    hour of the afternoon; the axis wraps if the set is periodic."""
    interpolation: Literal["radiance", "network"] = "radiance"
    """The way to decode between two stored times. "radiance": decode both times and interpolate the radiance linearly.
    "network": evaluate the network once, with features that are interpolated in time, as in the paper."""
    steps: int = Field(20000, ge=10)
    """Number of training steps."""
    samples: int = Field(4096, ge=128, multiple_of=128)
    """Number of random samples (texel and time) of each tile in one training step."""
    map_rate: float = Field(2e-2, gt=0.0, lt=1.0)
    """Initial learning rate of the feature maps (Adam)."""
    net_rate: float = Field(1e-2, gt=0.0, lt=1.0)
    """Initial learning rate of the network (Adam)."""
    final_rate: float = Field(1e-3, ge=0.0, le=1.0)
    """Final learning rate as a fraction of the initial one; the schedule is half a cosine."""
    adam_decay: float = Field(0.999, ge=0.5, lt=1.0)
    """Adam's beta 2, the decay of the mean of squared gradients. A texel is sampled only every few steps, and its
    gradient shrinks by orders of magnitude during a fit. 0.99 adapts faster and gains 0.1 to 0.8 dB over 0.999 in short
    fits, and nothing in long ones."""
    muon: bool = False
    """Optimiser of the hidden layers' weights: Muon (Jordan et al., 2024), whose steps move all directions of a layer
    alike, instead of Adam. A wide network then needs a third of the steps; a narrow one gains nothing in long fits."""
    metric_weight: float = Field(0.5, ge=0.0, le=1.0)
    """Error that training minimises. 0: squared error in normalised gamma space, as in the paper. 1: squared error of
    linear radiance relative to the tile's range at the time, as in PSNR. Between: the weighted geometric mean."""
    quantise_from: float = Field(0.5, ge=0.0, le=1.0)
    """Fraction of the steps after which the maps are quantised to the exact levels of the file."""
    freeze_from: float = Field(0.95, ge=0.0, le=1.0)
    """Fraction of the steps after which the maps are frozen and only the network is trained."""
    peak: float | None = Field(None, gt=0.0)
    """Range of values that errors are relative to, for data other than light; default: the range of the tile at each
    time, as in the paper's protocol."""
    frames: Literal["auto", "never", "always"] = "auto"
    """The tiles stored as a BC7 image for each time instead of feature maps and a network. "auto": the tiles that
    take no more bytes of GPU memory as BC7 images."""

    @model_validator(mode="after")
    def _stages_in_order(self) -> "Profile":
        if self.quantise_from > self.freeze_from:
            raise ValueError("quantise_from: expected at most freeze_from")
        return self

    def for_times(self, times: int) -> "Profile":
        """Returns the settings with the feature maps' size along time adapted to a set of `times` times.

        With `follow_times`, or one time, F_uvt, F_ut and F_vt have at most one slice or row for each stored time: more
        could only hold interpolated values. Beyond 26 times the sizes grow in proportion, up to 64.
        """
        if not self.follow_times and times > 1:
            return self
        sizes = {
            name: min(times, _MOST_ALONG_TIME, max(fixed, round(fixed * times / _USUAL_TIMES)))
            for name, fixed in (("uvt_slices", self.uvt_slices), ("plane_rows", self.plane_rows))
        }
        return self.override(sizes | {"follow_times": False})

    def for_sheet(self, sheet: Sheet) -> "Profile":
        """Returns the settings for one sheet; values that are not light get gamma 1, and errors relative to [0, 1]."""
        return self.override({"gamma": 1.0, "peak": 1.0}) if sheet.linear else self


@dataclass(frozen=True)
class TimeAxis:
    """Converts times, float64 [T], increasing, to positions on the time axis of the feature maps.

    `period` is the length of the day, None if the set is not periodic; for `kind` see `Profile.time_axis`, for
    `interpolation` the setting of this name.
    """

    times: np.ndarray
    period: float | None
    kind: str
    interpolation: str = "radiance"

    @property
    def periodic(self) -> bool:
        """Whether the time axis of the feature maps wraps around, as for a day."""
        return self.period is not None and self.kind == "frames" and len(self.times) > 1

    @property
    def turn(self) -> float:
        """Angle in radians that one length of the time axis takes in the time encoding (neural-dynamic-gi, eq. 4)."""
        return (2.0 if self.periodic else 1.0) * math.pi

    def wrap(self, t: float) -> float:
        """Wraps a time into the period; without a period, clamps it to the first and last stored time."""
        if not math.isfinite(t):
            raise WlmError(f"time: expected a finite number, got {t}")
        if self.period is not None:
            return t % self.period
        return float(np.clip(t, self.times[0], self.times[-1]))

    def neighbours(self, t: float) -> tuple[int, int, float]:
        """Returns the indices of the stored times before and after t, and the weight of the later one, 0 to 1."""
        return neighbours(self.times, self.period, self.wrap(t))

    def place(self, t: float) -> float:
        """Returns tau in [0, 1], the position on the time axis at which the feature maps are read for time t."""
        if self.kind == "paper":
            first = 0.0 if self.period is not None else self.times[0]
            span = self.period if self.period is not None else max(self.times[-1] - self.times[0], 1e-12)
            return float((self.wrap(t) - first) / span)
        before, _, share = self.neighbours(t)
        tau = (before + share + 0.5) / len(self.times)
        return tau % 1.0 if self.periodic else tau

    def reads(self, t: float) -> list[tuple[float, float]]:
        """Returns the one or two times at which the network is evaluated for time t, and the weights of the results."""
        before, after, share = self.neighbours(t)
        if self.interpolation == "network":
            return [(t, 1.0)]
        pair = [(float(self.times[before]), 1.0 - share), (float(self.times[after]), share)]
        return [read for read in pair if read[1] > 0.0]

    def encode(self, t: float) -> np.ndarray:
        """Returns the time encoding of t, float32 [4]: sines and cosines (neural-dynamic-gi, eq. 4)."""
        turn = self.turn * self.place(t)
        return np.array([math.sin(turn), math.cos(turn), math.sin(2 * turn), math.cos(2 * turn)], np.float32)


def encode_time(axis: TimeAxis) -> tuple[np.ndarray, np.ndarray]:
    """Returns each stored time's position on the time axis, [T], and its encoding, [T, 4], both float32."""
    tau = np.array([axis.place(t) for t in axis.times], np.float32)
    return tau, np.stack([axis.encode(t) for t in axis.times])
