"""What comes in: a set of lightmaps over time, read from files or arrays and checked.

The stated behaviours. "Inside" is inside the mask. Repairs are counted in texels, whichever channels they touch, and
listed in `LightmapSet.warnings`, one line per file and kind.

====================================  ================================================================
input                                 behaviour
====================================  ================================================================
NaN, Inf inside                       the texel takes the value of the nearest finite texel inside the
                                      mask at that time; warning
a frame with no finite texel inside   error
negative inside                       the channel is clamped to 0; warning
above 65,504 inside (half's maximum)  the channel is clamped to 65,504; warning
any of these outside                  0, 0 and 65,504, without a warning: those texels are never seen
all zero                              fine
an empty mask                         error
one time                              fine
times out of order                    sorted, with their frames; warning
two equal times                       error that names both files
more than 100,000 times               error
an alpha NaN or infinite              the texel is outside a mask from alpha; warning
frames of unlike atlases              warning, where light or an alpha ends at the charts' borders
texels that some frames alone have    kept: fitted at the other times to the frame nearest in time
                                      that has them, and scored at their own; warning
files, mask or mesh outside the       error, unless the set is trusted
folder of their `set.json`
frames beyond 1 GiB that small files  error, unless the set is trusted
only claim
frames beyond 1 GiB                   in a file without a name in the folder for temporary files
                                      (TMPDIR); without that much space there: error
a time outside [0, period)            error: 24 h is 0 h, and wrapping would hide a mistake in the list
a NaN or infinite time                error
frames, mask or `set.json` that     error that names both files
disagree in size
PNG, integers, arrays, cubes, XYZ,    error that says what was found; what is read: docs/formats.md
and what else is no linear light
a file missing or damaged, a          error that names the file, and the field
malformed `set.json` or `config.json`
====================================  ================================================================

Layout of a set and its evaluation: neural-dynamic-gi, section 10.1.
"""

import hashlib
import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from pathlib import Path

import numpy as np

from wlm.errors import WlmError
from wlm.formats.light import EXPECTED, SUFFIXES, read_light
from wlm.formats.limits import FRAMES, PICTURE_GROWTH, TIMES, check_growth
from wlm.formats.mask import read_mask
from wlm.formats.scratch import room
from wlm.lightmap.contest import CONFIG_FILE, is_contest, list_contest, read_coverage, read_raw
from wlm.lightmap.layout import odd_layout
from wlm.lightmap.listing import SET_FILE, Listing, list_folder, parse_set
from wlm.texels import repair

_READERS = 2  # decompression releases the GIL; more threads than this only fight over the disk


@dataclass(frozen=True, eq=False)
class LightmapSet:
    """Lightmaps of one texture atlas at several times, checked and repaired as the module's table says.

    Attributes:
        name: The set's name.
        times: `[T]` float64, strictly increasing, in hours or any other unit.
        frames: `[T, H, W, 3]` float32, linear RGB irradiance, finite, in [0, 65504]. Row 0 is v = 0. More than 1 GiB
            of them are mapped from a file, see `wlm.formats.scratch`.
        mask: `[H, W]` bool, true where a texel belongs to a chart; at least one is.
        period: Length of the day in the unit of `times`, all of which are then in [0, period); None where the
            set is not periodic and times outside its ends are clamped.
        source: 16 hexadecimal digits of BLAKE2b over the checked pixels, the times and the mask.
        warnings: What was repaired, one line each.
        mesh: The mesh that the lightmaps belong to, as the set names it; it need not be there. None: no name.
        covered: `[T, H, W]` bool, the valid texels that each frame has; None where every frame has all of them.
            What a frame lacks holds the light of the frame nearest in time that has it.
    """

    name: str
    times: np.ndarray
    frames: np.ndarray
    mask: np.ndarray
    period: float | None
    source: str
    warnings: tuple[str, ...]
    mesh: Path | None = None
    covered: np.ndarray | None = None

    def valid(self, index: int) -> np.ndarray:
        """The valid texels that a frame has, bool [H, W]."""
        return self.mask if self.covered is None else self.covered[index]


def load(
    path: str | os.PathLike[str],
    *,
    times: Sequence[float] | None = None,
    mask: str | os.PathLike[str] | None = None,
    period: float | None = None,
    trust: bool = False,
    map_id: str | None = None,
) -> LightmapSet:
    """Reads a lightmap set: a `set.json`, a folder that holds one, a plain folder of lightmaps, or one of a contest.

    A lightmap is an EXR, Radiance (`.hdr`), KTX2 or DDS file of light (`wlm.formats.light`); a set may mix them.

    `set.json` is an object with `width`, `height` and `lightmaps` (a list of `{"time_hours", "file"}`), and
    may have `name`, `period_hours`, `mask` (a PNG's name, or "alpha"; absent means that all texels are valid) and
    `mesh` (a glTF or OBJ file's name, read by `evaluate` alone). Other keys are ignored. Names of files are relative
    to it.

    The files of a plain folder that end in `.exr`, `.hdr`, `.ktx2` or `.dds` are taken in natural order of their names
    ("2" before "10"). Without `times`, the hours are read from the names if every one ends like `_18_55h`, `_18.55h`,
    `_18h` or `_18.55`, the digits after the second separator being decimals, not minutes. A `mask.png` among them is
    the mask unless `mask` says otherwise.

    A folder with a `config.json` and no lightmap of these is read as `wlm.lightmap.contest` says.

    Args:
        path: The `set.json` or the folder.
        times: One time for each lightmap in the order of the list or the names; replaces those of `set.json`.
        mask: A PNG (a texel is valid where any colour channel is above 0), "alpha" (valid where the alpha
            channel of a frame is above 0; frames may differ) or "all"; None takes what the set says.
        period: Length of the day in the unit of the times; None takes the set's `period_hours`, if any.
        trust: Whether a `set.json` may name files outside its folder, and small files may hold large frames
            (`wlm.formats.limits`).
        map_id: Which lightmap of a contest's folder, `ID` or `LEVEL/ID`; None where it has but one.

    Returns:
        The set, repaired as the module's table says.

    Raises:
        WlmError: One line that names the file and the field, for each error of the module's table.
    """
    path = Path(path)
    if path.is_dir() and (path / SET_FILE).is_file():
        path = path / SET_FILE
    if path.is_dir() and is_contest(path):
        listing = list_contest(path, map_id, times, trust)
    elif map_id is not None:
        raise WlmError(f"{path}: expected a contest's folder with a {CONFIG_FILE} to choose map {map_id} of")
    elif path.is_dir():
        listing = list_folder(path, times)
    elif path.is_file():
        if path.suffix.lower() != ".json":
            lone = path.suffix.lower() in SUFFIXES
            found = "one lightmap, which wlm atlas compress takes with its mesh" if lone else "a file of another kind"
            raise WlmError(f"{path}: expected a {SET_FILE} or a folder of lightmaps ({EXPECTED}), found {found}")
        listing = parse_set(path, times, trust)
    else:
        raise WlmError(f"{path}: no such file or folder; expected a {SET_FILE} or a folder of lightmaps ({EXPECTED})")

    labels = [file.name for file in listing.files]
    stamps = np.asarray(listing.times, np.float64)
    period = listing.period if period is None else period
    # Before the files are read: of a bad list that would be in vain.
    check_times(str(path), labels, stamps, period)
    mask_source = str(mask) if mask is not None else listing.mask
    need_alpha = mask_source == "alpha"
    if need_alpha and listing.raw is not None:
        raise WlmError(f"{path}: expected files of RGBA for a mask from alpha, found raw lightmaps without it")
    order = np.argsort(stamps, kind="stable")
    frames, covered, warnings = _read_frames(listing, order, need_alpha, trust)
    height, width = frames.shape[1:3]
    if need_alpha:
        valid = covered
    elif mask is None and listing.coverage is not None:
        valid = read_coverage(listing.coverage, (height, width))
    elif mask_source == "all":
        valid = np.ones((height, width), bool)
    else:
        valid = read_mask(Path(mask_source), listing.files[0], (height, width), ', "alpha" or "all"')
    lightmaps = checked_set(
        listing.name,
        labels,
        stamps,
        order,
        frames,
        valid,
        period,
        where=str(path),
        mask_from="the alpha channels" if need_alpha else mask_source,
        warn_order=listing.warn_order,
        warnings=warnings,
    )
    return replace(lightmaps, mesh=listing.mesh)


def from_arrays(
    frames: np.ndarray,
    times: Sequence[float] | np.ndarray,
    mask: np.ndarray | None = None,
    period: float | None = None,
    name: str = "array",
) -> LightmapSet:
    """Makes a checked set from arrays, under the same rules as `load`.

    Args:
        frames: `[T, H, W, 3]` of numbers, linear RGB irradiance; copied.
        times: `[T]`, in any order.
        mask: `[H, W]`, true where a texel is valid, or `[T, H, W]`, where each frame has it; None for all.
        period: Length of the day in the unit of the times; None for a set that is not periodic.
        name: The set's name, used in messages too.

    Returns:
        The set, repaired as the module's table says; a frame is called "frame 3 (time 5)" in its warnings.

    Raises:
        WlmError: A shape is wrong, or an error of the module's table.
    """
    frames = np.asarray(frames)
    stamps = np.asarray(times, np.float64)
    if frames.ndim != 4 or frames.shape[3] != 3 or 0 in frames.shape:
        raise WlmError(f"{name}: expected frames [T, H, W, 3], none of them 0, got {frames.shape}")
    if stamps.shape != frames.shape[:1]:
        raise WlmError(f"{name}: expected {len(frames)} times, one per frame, got shape {stamps.shape}")
    valid = np.ones(frames.shape[1:3], bool) if mask is None else np.asarray(mask).astype(bool)
    if valid.shape not in (frames.shape[1:3], frames.shape[:3]):
        raise WlmError(f"{name}: expected a mask of {frames.shape[1:3]}, got {valid.shape}")
    labels = [f"frame {i} (time {time:g})" for i, time in enumerate(stamps)]
    check_times(name, labels, stamps, period)
    order = np.argsort(stamps, kind="stable")
    copied = room(frames.shape, np.float32, name)
    with np.errstate(over="ignore"):  # float64 beyond float32 becomes Inf and is repaired as Inf
        for frame, index in zip(copied, order, strict=True):
            frame[...] = frames[index]
    valid = valid[order] if valid.ndim == 3 else valid.copy()
    return checked_set(name, labels, stamps, order, copied, valid, period, where=name, mask_from="the mask")


def parse_times(text: str) -> list[float]:
    """Reads a list of times: numbers and `start:stop:step` ranges, separated by commas.

    A range leaves `stop` out, as Python's do: "0:24:1" is 0, 1, ... 23, one day without its first hour twice.

    Args:
        text: Such as "0,1,2.5", "0:24:1" or "0:18:1,18.45,18.55,19:24:1".

    Returns:
        The times in the order written, at least one.

    Raises:
        WlmError: A part that is no number or range, a step that never reaches the stop, or more than 100,000
            times.
    """
    times: list[float] = []
    for part in text.split(","):
        try:
            numbers = [float(piece) for piece in part.split(":")]
        except ValueError:
            numbers = []
        if len(numbers) not in (1, 3) or not all(map(math.isfinite, numbers)):
            raise WlmError(f"times: expected a number or start:stop:step, got {part.strip()!r} in {text!r}")
        if len(numbers) == 1:
            times.append(numbers[0])
            continue
        start, stop, step = numbers
        # The small slack keeps 0.1:0.4:0.1 at three times, although (0.4 - 0.1) / 0.1 is a little above 3.
        steps = (stop - start) / step - 1e-9 if step else 0.0
        if not 0.0 < steps < math.inf:
            raise WlmError(f"times: the range {part.strip()!r} holds no time before its stop")
        if len(times) + steps > TIMES:
            raise WlmError(f"times: the range {part.strip()!r} holds more than {TIMES:,} times")
        times.extend(start + i * step for i in range(math.ceil(steps)))
    return times


def _read_frames(
    listing: Listing, order: np.ndarray, need_alpha: bool, trust: bool
) -> tuple[np.ndarray, np.ndarray | None, tuple[str, ...]]:
    """Reads all files into one array [T, H, W, 3], in an order; if asked for, also where alphas are above 0 [T, H, W].

    Returns:
        Both, and warnings.
    """
    first, alpha = _read_rgb(listing, 0, need_alpha)
    size = first.shape[:2]
    if listing.size is not None and size != listing.size:
        raise WlmError(f"{listing.files[0]}: is {_size(size)}, but {listing.stated_by} states {_size(listing.size)}")
    if not trust:
        held = sum(os.path.getsize(file) for file in set(listing.files) if os.path.exists(file))
        check_growth(f"{listing.stated_by}: lightmaps", held, len(listing.files) * first.nbytes, PICTURE_GROWTH, FRAMES)
    # One array from the start: a list of frames stacked at the end would need twice the memory.
    where = f"{listing.stated_by}: {len(listing.files)} lightmaps of {_size(size)}"
    frames = room((len(listing.files), *first.shape), np.float32, where)
    place = np.argsort(order)
    frames[place[0]] = first
    covered, warnings = np.zeros(frames.shape[:3], bool) if need_alpha else None, []

    def read(index: int) -> np.ndarray | None:
        rgb, alpha = _read_rgb(listing, index, need_alpha)
        if rgb.shape[:2] != size:
            raise WlmError(
                f"{listing.files[index]}: is {_size(rgb.shape)}, but {listing.files[0]} is {_size(size)}; "
                "expected one size"
            )
        frames[place[index]] = rgb
        return alpha

    pool = ThreadPoolExecutor(_READERS)
    try:
        # In order, so that of several bad files the first is the one named.
        alphas = chain([alpha], pool.map(read, range(1, len(listing.files))))
        for i, (file, alpha) in enumerate(zip(listing.files, alphas, strict=True)):
            if covered is None:
                continue
            covered[place[i]] = np.isfinite(alpha) & (alpha > 0)
            if broken := np.count_nonzero(~np.isfinite(alpha)):
                warnings.append(f"{file.name}: {broken} texels with an alpha NaN or infinite: not valid")
    finally:
        pool.shutdown(cancel_futures=True)
    return frames, covered, tuple(warnings)


def _read_rgb(listing: Listing, index: int, need_alpha: bool) -> tuple[np.ndarray, np.ndarray | None]:
    """Reads one lightmap: colour [H, W, 3] and, if asked for, its alpha [H, W]."""
    if listing.raw is not None:
        return read_raw(listing.raw[index], listing.size), None
    path = listing.files[index]
    pixels, names = read_light(path)
    if need_alpha and "A" not in names:
        raise WlmError(f"{path}: expected a channel A, which the mask is to come from, found {', '.join(names)}")
    return pixels[..., :3], pixels[..., 3] if need_alpha else None


def _size(shape: Sequence[int]) -> str:
    """Writes [H, W, ...] with the width first."""
    return f"{shape[1]}x{shape[0]}"


def check_times(where: str, labels: Sequence[str], times: np.ndarray, period: float | None) -> None:
    """Applies the module's table to the times [T] of the frames of these labels."""
    if period is not None and not (math.isfinite(period) and period > 0):
        raise WlmError(f"{where}: expected a finite period above 0, got {period:g}")
    for label, time in zip(labels, times, strict=True):
        if not math.isfinite(time):
            raise WlmError(f"{where}: the time of {label} is {time:g}; expected a finite number")
        if period is not None and not 0 <= time < period:
            raise WlmError(f"{where}: the time of {label} is {time:g}; expected 0 to below {period:g}, the period")
    order = np.argsort(times, kind="stable")
    for i, j in pairwise(order):
        if times[i] == times[j]:
            raise WlmError(f"{where}: {labels[i]} and {labels[j]} have the same time, {times[i]:g}")


def checked_set(
    name: str,
    labels: Sequence[str],
    times: np.ndarray,  # [T]
    order: np.ndarray,  # [T], that of the times
    frames: np.ndarray,  # [T, H, W, 3] in that order, repaired in place
    mask: np.ndarray,  # [H, W], or [T, H, W] in that order
    period: float | None,
    *,
    where: str,
    mask_from: str,
    warn_order: bool = True,
    warnings: Sequence[str] = (),
) -> LightmapSet:
    """Applies the module's table to frames from files or arrays, whose times have been checked."""
    if not mask.any():
        raise WlmError(f"{where}: the mask is empty: no texel is valid ({mask_from})")
    warnings = list(warnings)
    if (np.diff(order) < 0).any() and warn_order:
        warnings.append(f"{where}: the times were not in order: sorted, with their frames")
    times, labels = times[order], [labels[i] for i in order]
    covered = mask if mask.ndim == 3 and any((valid != mask[0]).any() for valid in mask) else None
    mask = mask.any(0) if mask.ndim == 3 else mask
    for i, (label, frame) in enumerate(zip(labels, frames, strict=True)):
        inside = mask if covered is None else covered[i]
        warnings += [f"{label}: {text}" for text in repair(frame, inside, f"{where}: {label}")]
    odd = odd_layout(len(frames), lambda i: frames[i].any(-1) if covered is None else covered[i])
    if odd is not None:
        warnings.append(
            f"{where}: {labels[odd[0]]} and {labels[odd[1]]} don't look like one atlas at two times: their charts "
            "end in other texels"
        )
    if covered is not None:
        covered = covered & mask
        _fill_in_time(frames, covered, times, period)
        missing = np.count_nonzero(mask & ~covered.all(0))
        warnings.append(
            f"{where}: {missing} texels are in some lightmaps alone: at the other times they are fitted to the nearest "
            "lightmap that has them, and not scored"
        )
    return LightmapSet(
        name=name,
        times=times,
        frames=frames,
        mask=mask,
        period=None if period is None else float(period),
        source=_hash(frames, times, mask if covered is None else covered),
        warnings=tuple(warnings),
        covered=covered,
    )


def _fill_in_time(frames: np.ndarray, covered: np.ndarray, times: np.ndarray, period: float | None) -> None:
    """Gives texels that a frame lacks the light of the frame nearest in time that has them, in place."""
    mask = covered.any(0)
    for i, time in enumerate(times):
        apart = np.abs(times - time)
        if period is not None:
            apart = np.minimum(apart, period - apart)
        missing = mask & ~covered[i]
        for j in np.argsort(apart, kind="stable"):
            found = missing & covered[j]
            frames[i][found] = frames[j][found]
            missing &= ~found
            if not missing.any():
                break


def _hash(frames: np.ndarray, times: np.ndarray, mask: np.ndarray) -> str:
    """Hashes the input to 16 hexadecimal digits, the same on every machine."""
    digest = hashlib.blake2b(digest_size=8)
    digest.update(np.asarray(frames.shape, "<i8").tobytes())
    digest.update(np.asarray(times, "<f8").tobytes())
    digest.update(np.packbits(mask).tobytes())
    for frame in frames:
        digest.update(np.ascontiguousarray(frame, "<f4"))
    return digest.hexdigest()
