"""How large a lightmap's maps must be for a wanted PSNR, or may be for a wanted size: fits of a few tiles, and a curve.

F_uvt takes the bits that change with the scene, so its resolution is what is chosen, one for the whole set. Its bytes
grow with the square, and PSNR by the tiled protocol is nearly linear in the logarithm of all bytes. To choose by tile
was measured on the living room and the city, with every tile at its best of seven sizes: it saves under 2% of the bytes
at equal PSNR, since a mean of decibels gains as much from doubling the bytes of one tile as of another.
"""

import math
from bisect import bisect_left
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.lightmap.codec import encode
from wlm.lightmap.data import LightmapSet
from wlm.lightmap.evaluation import bits_per_texel, evaluate, psnr_of_tiles
from wlm.lightmap.fit import compress
from wlm.lightmap.model import LightmapModel, Profile
from wlm.lightmap.packing import STREAMS
from wlm.lightmap.tiles import TileKind
from wlm.lightmap.video import TRIAL_SPEED
from wlm.system import OnProgress, Progress

RESOLUTIONS = tuple(range(4, 129, 4))
"""Those of F_uvt that are chosen from, see `Profile.uvt_resolution`."""

_SHORT = 0.1  # of the steps: enough for how much harder one tile is than another
_PART = 0.125  # of the tiles, in fits to the end
_FEWEST = 4  # tiles: fewer don't stand for a set
_PER_OCTAVE = 2.3  # dB for twice the bytes: 2.1 in the living room, 2.1 to 3 in the city
_OCTAVES = 0.15  # between two sizes whose PSNR gives the figure of this scene
_LEAST_PER_OCTAVE, _MOST_PER_OCTAVE = 1.0, 4.0
_TIMES = 6  # that say how much easier a part of the tiles is
_ROOM = 0.99  # of the largest size
_QUALITIES = range(101)  # of video


@dataclass(frozen=True)
class Choice:
    """What was chosen for a set.

    Attributes:
        profile: The settings, with the resolution that was chosen, or the quality of video.
        bpp: Expected, see `Report.bpp`.
        psnr: Expected, dB, see `Report.psnr`; None where no PSNR was asked for.
        limited: Whether the largest size holds it below the wanted PSNR.
    """

    profile: Profile
    bpp: float
    psnr: float | None = None
    limited: bool = False


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
    """Chooses the resolution of F_uvt, in a quarter to a third of the time of the fit that follows.

    Of video it chooses the quality, by bisection: the least that reaches the PSNR, the greatest that fits the size,
    from up to seven encodings of the set, with both up to fourteen.

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
    profile = profile.override({"frames": "never"})
    search = _Search(lightmaps, profile, options)
    allowed = [r for r in RESOLUTIONS if max_bpp is None or search.bpp(r) <= _ROOM * max_bpp]
    if not allowed:
        least = search.bpp(RESOLUTIONS[0]) / _ROOM
        raise WlmError(f"--max-bpp: expected at least {least:.3f} for profile {profile.name}, got {max_bpp:g}")
    if target_psnr is None:
        return Choice(profile.override({"uvt_resolution": allowed[-1]}), search.bpp(allowed[-1]))
    curve = search.curve(target_psnr, allowed)
    chosen = curve.nearest(target_psnr, allowed)
    psnr = curve.psnr(chosen)
    short = chosen == allowed[-1] and psnr < target_psnr
    if short and max_bpp is None:
        raise WlmError(f"--target-psnr: expected at most {psnr:.1f} for profile {profile.name}, got {target_psnr:g}")
    return Choice(profile.override({"uvt_resolution": chosen}), search.bpp(chosen), psnr, short)


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
        if not len(model.video_ranges):
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
    best = fitting - 1
    if target_psnr is None:
        return Choice(profile.override({"video_quality": best}), trial(best)[0])
    chosen = min(bisect_left(_QUALITIES[:fitting], True, key=lambda quality: trial(quality)[1] >= target_psnr), best)
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
    """Two fits at the profile's resolution, a short one of all tiles and a full one of a part, and what follows."""

    def __init__(self, lightmaps: LightmapSet, profile: Profile, options: dict[str, Any]) -> None:
        self._lightmaps, self._profile, self._options = lightmaps, profile, options
        # The device of a cluster is none of this machine's.
        self._device = options["device"] if options["cluster"] is None else "cpu"
        self._first = profile.uvt_resolution
        model = self._fit(self._first, None, max(10, round(_SHORT * profile.steps)))
        dynamic = np.flatnonzero(model.kind == TileKind.DYNAMIC)
        if not len(dynamic):
            raise WlmError(f"{lightmaps.name}: no tile changes over time, so there is no size to choose")
        count = max(math.ceil(_PART * len(dynamic)), min(_FEWEST, len(dynamic)))
        self._part = dynamic[np.linspace(0, len(dynamic) - 1, count).round().astype(int)].tolist()
        # A short fit says what each tile is beside the others, a part of them what all steps make of it.
        some = np.unique(np.linspace(0, len(model.times) - 1, _TIMES).round().astype(int)).tolist()
        scores, part = (
            psnr_of_tiles(model, lightmaps, dynamic, some, self._device),
            self._fit(self._first, self._part, profile.steps),
        )
        self._easier = np.nanmean(scores[np.isin(dynamic, self._part)]) - np.nanmean(scores)
        self._first_level = self._level(part)
        short, full = _stream_bytes(model), _stream_bytes(part)
        grown = full.sum(0) / short[np.searchsorted(model.mapped, self._part)].sum(0)
        volume, others = short.sum(0) * grown
        self._per_square = volume / self._first**2
        self._others = others + model.file_bytes() - short.sum()
        self._bpp = bits_per_texel(model, lightmaps.mask, 1_000_000) / 1e6

    def bytes(self, resolution: int) -> float:
        """Size of the file, expected."""
        return self._others + self._per_square * resolution**2

    def bpp(self, resolution: int) -> float:
        """The same in bits per texel and time."""
        return self.bytes(resolution) * self._bpp

    def curve(self, psnr: float, allowed: list[int]) -> _Curve:
        """The curve through what fits of a part of the tiles reach, at the profile's resolution and near `psnr`."""
        curve = _Curve(self, self.bytes(self._first), self._first_level)
        second = curve.nearest(psnr, allowed)
        octaves = math.log2(self.bytes(second) / curve.bytes)
        if abs(octaves) < _OCTAVES:
            return curve
        level = self._level(self._fit(second, self._part, self._profile.steps))
        slope = min(max((level - curve.level) / octaves, _LEAST_PER_OCTAVE), _MOST_PER_OCTAVE)
        return _Curve(self, self.bytes(second), level, slope)

    def _level(self, part: LightmapModel) -> float:
        """PSNR of the set, from a fit of the part: less what that is easier, as the short fit says."""
        every = range(len(part.times))
        return float(np.nanmean(psnr_of_tiles(part, self._lightmaps, self._part, every, self._device)) - self._easier)

    def _fit(self, resolution: int, tiles: list[int] | None, steps: int) -> LightmapModel:
        changes = {"uvt_resolution": resolution, "steps": steps}
        return compress(self._lightmaps, self._profile.override(changes), tiles=tiles, **self._options)


def _stream_bytes(model: LightmapModel) -> np.ndarray:
    """Bytes of F_uvt and of the rest of each tile with maps, float64 [N_m, 2]."""
    sizes = encode(model)[1]["stream_sizes"].astype(np.float64)
    volume = np.array([name == "uvt" for name in STREAMS])
    return np.stack([sizes[:, volume].sum(1), sizes[:, ~volume].sum(1)], 1)


def _renamed(progress: OnProgress | None) -> OnProgress | None:
    """Progress of trials, not of the fit that a user waits for."""
    if progress is None:
        return None

    def report(step: Progress) -> None:
        progress(replace(step, stage="trial"))

    return report
