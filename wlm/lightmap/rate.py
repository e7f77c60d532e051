"""How large a lightmap's maps must be for a wanted PSNR, or may be for a wanted size: short fits, and a curve.

F_uvt takes the bits that change with the scene, so its resolution is what is chosen, one for the whole set. Its bytes
grow with the square, and PSNR by the tiled protocol is nearly linear in the logarithm of all bytes. To choose by tile
was measured on the living room and the city, with every tile at its best of seven sizes: it saves under 2% of the bytes
at equal PSNR, since a mean of decibels gains as much from doubling the bytes of one tile as of another.
"""

import math
from bisect import bisect_left
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats.artifact import encode_artifact
from wlm.lightmap.codec import encode
from wlm.lightmap.data import LightmapSet
from wlm.lightmap.evaluation import bits_per_texel, evaluate
from wlm.lightmap.fit import Trials, compress
from wlm.lightmap.level_packing import STEPS
from wlm.lightmap.model import LightmapModel, Profile
from wlm.lightmap.packing import STREAMS
from wlm.lightmap.survey import Survey
from wlm.lightmap.tiles import TileKind
from wlm.lightmap.video import TRIAL_SPEED
from wlm.system import OnProgress, Progress

RESOLUTIONS = tuple(range(4, 129, 4))
"""Those of F_uvt that are chosen from, see `Profile.uvt_resolution`."""

_LENGTHS = 0.05, 0.1  # of the steps
# What the other steps bring, of what the second length brings over the first: errors fall with a power of the steps.
_REST = 1.31
_STEEPER = 1.085  # the curve over the bytes after all steps than after the second length's
_PER_OCTAVE = 2.3  # dB for twice the bytes: 2.1 in the living room, 2.1 to 3 in the city
_OCTAVES = 0.15  # between two sizes whose PSNR gives the figure of this scene
_LEAST_PER_OCTAVE, _MOST_PER_OCTAVE = 1.0, 4.0
_ROOM = 0.99  # of the largest size
_QUALITIES = (*range(100), *STEPS)  # of video; without 100, which takes more bytes than the next


@dataclass(frozen=True)
class Choice:
    """What was chosen for a set.

    Attributes:
        profile: The settings, with the resolution that was chosen, or the quality of video.
        bpp: Expected, see `Report.bpp`.
        psnr: Expected, dB, see `Report.psnr`; None where no PSNR was asked for.
        limited: Whether the largest size holds it below the wanted PSNR.
        survey: Of the set, for `wlm.lightmap.fit.compress`, which then needn't look at it again; None of video.
    """

    profile: Profile
    bpp: float
    psnr: float | None = None
    limited: bool = False
    survey: Survey | None = field(default=None, repr=False, compare=False)


def choose(
    lightmaps: LightmapSet,
    profile: Profile,
    *,
    target_psnr: float | None = None,
    max_bpp: float | None = None,
    seed: int = 0,
    device: str = "cpu",
    workers: int | None = None,
    cluster: str | None = None,
    progress: OnProgress | None = None,
) -> Choice:
    """Chooses the resolution of F_uvt, in a quarter of the steps of the fit that follows.

    Of video it chooses the quality, by bisection, levels above AV1 included: the least that reaches the PSNR, the
    greatest that fits the size, from up to seven encodings of the set, with both up to fourteen.

    Args:
        lightmaps: The set.
        profile: All other settings. No tile is stored as frames, whose size doesn't follow from maps.
        target_psnr: The PSNR to reach, dB, by the tiled protocol.
        max_bpp: The most bits per texel and time that the file may have. With both, the size comes first.
        seed, device, workers, cluster, progress: As for `compress`.

    Raises:
        WlmError: Neither is given or one isn't above 0, the profile asks for frames, no tile changes over time, or no
            resolution is small enough or, without a largest size, large enough.
    """
    if target_psnr is None and max_bpp is None:
        raise WlmError("rate: expected a PSNR or a size, got neither")
    for name, value in (("--target-psnr", target_psnr), ("--max-bpp", max_bpp)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise WlmError(f"{name}: expected a finite number above 0, got {value:g}")
    if profile.frames == "always":
        raise WlmError(f"rate: expected a profile of networks or video, got {profile.name}, whose tiles are frames")
    options = {"seed": seed, "device": device, "workers": workers, "cluster": cluster, "progress": _renamed(progress)}
    if profile.frames == "video":
        return _choose_quality(lightmaps, profile, target_psnr, max_bpp, options)
    search = _Search(lightmaps, profile, options)
    profile = profile.override({"frames": "never"})
    allowed = [r for r in RESOLUTIONS if max_bpp is None or search.bpp(r) <= _ROOM * max_bpp]
    if not allowed:
        least = search.bpp(RESOLUTIONS[0]) / _ROOM
        raise WlmError(f"--max-bpp: expected at least {least:.3f} for profile {profile.name}, got {max_bpp:g}")
    if target_psnr is None:
        return Choice(profile.override({"uvt_resolution": allowed[-1]}), search.bpp(allowed[-1]), survey=search.survey)
    curve = search.curve(target_psnr, allowed)
    chosen = curve.nearest(target_psnr, allowed)
    psnr = curve.psnr(chosen)
    short = chosen == allowed[-1] and psnr < target_psnr
    if short and max_bpp is None:
        raise WlmError(f"--target-psnr: expected at most {psnr:.1f} for profile {profile.name}, got {target_psnr:g}")
    return Choice(profile.override({"uvt_resolution": chosen}), search.bpp(chosen), psnr, short, search.survey)


def _choose_quality(
    lightmaps: LightmapSet, profile: Profile, target_psnr: float | None, max_bpp: float | None, options: dict[str, Any]
) -> Choice:
    """Chooses the quality of video, see `choose`."""
    device = options["device"] if options["cluster"] is None else "cpu"

    @cache
    def trial(quality: int) -> tuple[float, float]:
        """Bits per texel and time, and PSNR, where it is asked for."""
        changes = {"video_quality": quality, "video_speed": max(profile.video_speed, TRIAL_SPEED)}
        model = compress(lightmaps, profile.override(changes), **options)
        if not len(model.unpacked):
            raise WlmError(f"{lightmaps.name}: no tile is more than a colour, so there is no size to choose")
        bpp = bits_per_texel(model, lightmaps.mask, model.file_bytes())
        if target_psnr is None:
            return bpp, math.nan
        return bpp, evaluate(model, lightmaps, device=device, metrics=("psnr",), views=0).psnr

    fitting = len(_QUALITIES)
    if max_bpp is not None:
        fitting = bisect_left(_QUALITIES, True, key=lambda quality: trial(quality)[0] > _ROOM * max_bpp)
        if fitting == 0:
            least = trial(0)[0] / _ROOM
            raise WlmError(f"--max-bpp: expected at least {least:.3f} for profile {profile.name}, got {max_bpp:g}")
    best = _QUALITIES[fitting - 1]
    if target_psnr is None:
        return Choice(profile.override({"video_quality": best}), trial(best)[0])
    reached = bisect_left(_QUALITIES[:fitting], True, key=lambda quality: trial(quality)[1] >= target_psnr)
    chosen = _QUALITIES[min(reached, fitting - 1)]
    bpp, psnr = trial(chosen)
    if psnr < target_psnr and max_bpp is None:
        raise WlmError(f"--target-psnr: expected at most {psnr:.1f} for profile {profile.name}, got {target_psnr:g}")
    return Choice(profile.override({"video_quality": chosen}), bpp, psnr, psnr < target_psnr)


@dataclass(frozen=True)
class _Curve:
    """PSNR over the bytes: `psnr` dB at `bytes`, and `per_octave` more for twice as many."""

    search: "_Search"
    bytes: float
    level: float
    per_octave: float = _PER_OCTAVE

    def psnr(self, resolution: int) -> float:
        return self.level + self.per_octave * math.log2(self.search.bytes(resolution) / self.bytes)

    def nearest(self, psnr: float, allowed: list[int]) -> int:
        return min(allowed, key=lambda resolution: abs(self.psnr(resolution) - psnr))


class _Search:
    """Short fits of all tiles, and what follows.

    On the city, the city with its sun and the living room, at sizes a factor of four apart, the other steps brought 1.2
    to 1.3 times what doubling 6% of the steps to 12% did.
    """

    def __init__(self, lightmaps: LightmapSet, profile: Profile, options: dict[str, Any]) -> None:
        self._trials = Trials(lightmaps, profile, **options)
        self._profile, self._first = profile, profile.uvt_resolution
        model, self._longer = self._fit(self._first, _LENGTHS[1])
        if not (model.kind == TileKind.DYNAMIC).any():
            raise WlmError(f"{lightmaps.name}: no tile changes over time, so there is no size to choose")
        # A whole fit's maps are smoother: its file is smaller by some percent.
        encoded = encode(model)
        volume = float(encoded[1]["stream_sizes"].sum(0, dtype=np.float64)[STREAMS.index("uvt")])
        self._per_square = volume / self._first**2
        self._others = sum(memoryview(part).nbytes for part in encode_artifact(model.SYSTEM, *encoded)) - volume
        self._bpp = bits_per_texel(model, lightmaps.mask, 1_000_000) / 1e6

    @property
    def survey(self) -> Survey:
        """Of the set."""
        return self._trials.survey

    def bytes(self, resolution: int) -> float:
        """Size of the file, expected."""
        return self._others + self._per_square * resolution**2

    def bpp(self, resolution: int) -> float:
        """The same in bits per texel and time."""
        return self.bytes(resolution) * self._bpp

    def curve(self, psnr: float, allowed: list[int]) -> _Curve:
        """The curve through what a fit reaches at the profile's resolution, as steep as short ones near `psnr` say."""
        level = self._longer + _REST * (self._longer - self._fit(self._first, _LENGTHS[0])[1])
        curve = _Curve(self, self.bytes(self._first), level)
        second = curve.nearest(psnr, allowed)
        octaves = math.log2(self.bytes(second) / curve.bytes)
        if abs(octaves) < _OCTAVES:
            return curve
        gain = _STEEPER * (self._fit(second, _LENGTHS[1])[1] - self._longer)
        return replace(curve, per_octave=min(max(gain / octaves, _LEAST_PER_OCTAVE), _MOST_PER_OCTAVE))

    def _fit(self, resolution: int, length: float) -> tuple[LightmapModel, float]:
        steps = max(10, round(length * self._profile.steps))
        return self._trials.fit(uvt_resolution=resolution, steps=steps)


def _renamed(progress: OnProgress | None) -> OnProgress | None:
    """Progress of trials, not of the fit that a user waits for."""
    if progress is None:
        return None

    def report(step: Progress) -> None:
        progress(replace(step, stage="trial"))

    return report
