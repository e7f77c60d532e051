"""Reads light probes at free positions from `.npz`, `.json`, tables, and files of Godot, Unity, three.js and Bevy.

A probe holds spherical harmonics (gaussian-probe-compression, eq. 1, with 3, 12 or 27 numbers), or any other numbers,
at one or several hours of the day.
The table of hard cases in docs/probe.md lists what is repaired and what is refused. `ProbeSet.warnings` has a line for
each kind of repair; probes are counted from 0.
"""

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from wlm.errors import WlmError, counted
from wlm.formats.atomic import atomic_path, atomic_write
from wlm.formats.folder import rounded
from wlm.formats.godot import read_lmbake
from wlm.formats.hours import DAY, hours_of_names
from wlm.formats.limits import NUMBERS, PROBES
from wlm.formats.npz import read_npz
from wlm.formats.scratch import room
from wlm.formats.unity_asset import read_lighting_data
from wlm.probe.ambient_cube import READING, read_irradiance_volume
from wlm.probe.axes import read_axes, turned
from wlm.probe.conventions import CANONICAL, CONVENTIONS, from_canonical, to_canonical
from wlm.probe.fields import read_fields, read_positions, read_table
from wlm.probe.hours import hour_factors, listed_times
from wlm.probe.layouts import COEFFICIENT, ORDERS, choose_order, coefficients_first, described
from wlm.probe.sphere import sh_count, unit_or_zero

LARGEST = float(np.sqrt(np.finfo(np.float32).max))
"""Largest number whose square fits float32."""

_ROWS = 1 << 16  # probes per piece, so that float64 copies stay at some tens of MB
_FARTHEST = 1e150  # squares of distances fit float64
_POSITION, _CONVENTION, _PROBES, _SH = "position", "convention", "probes", "sh"
_NORMAL, _VALID = _BESIDE = "normal", "valid"
_Key = str | Sequence[str] | None


@dataclass(frozen=True, eq=False)
class ProbeSet:
    """Light probes, checked and repaired.

    Attributes:
        name: Name of the set.
        position: float64 [N, 3], in the unit and the axes of the input.
        values: float32 [N, T D], finite: D numbers at the first of T hours, then at the second, and so on; zero where a
            probe is dead. Arrays above 1 GiB are mapped to a temporary file. For spherical harmonics D = 3 C, and
            `values.reshape(N, T, C, 3)` are canonical coefficients of radiance (`wlm.probe.conventions`), RGB last.
        key: Name of the array that was read, or the names of several.
        live: bool [N], false where the probe takes no part in the fit and decodes to zero, which is so if it is dark at
            all hours; at least one is true.
        source: Hash of the positions, the values and `live`, 16 hexadecimal digits of BLAKE2b.
        warnings: A line of text for each kind of repair.
        normal: float64 [N, 3], unit normal of each probe's surface, 0 for a probe on no surface; None if unknown.
        reading: How the numbers were understood, in one line: convention, order, axes; and what was assumed.
        times: float64 [T], increasing hours of the day in [0, 24), if there are several; else empty.
    """

    name: str
    position: np.ndarray
    values: np.ndarray
    key: str
    live: np.ndarray
    source: str
    warnings: tuple[str, ...]
    normal: np.ndarray | None = None
    reading: str = ""
    times: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def probes(self) -> int:
        """The number of probes, N, live and dead."""
        return self.values.shape[0]

    @property
    def outputs(self) -> int:
        """The count of numbers per probe at one hour, D: 27 for second-order spherical harmonics in three colours."""
        return self.values.shape[1] // max(len(self.times), 1)

    @property
    def float_bytes(self) -> int:
        """The bytes of all values in float32, to which compressed sizes are compared."""
        return self.values.size * 4

    def at(self, time: float | None = None) -> "ProbeSet":
        """Returns the set at one hour of the day, between two hours their light mixed linearly; None: the only hour.
        Probes that are dark then are dead, perhaps all.

        Raises:
            WlmError: The set has several hours and no time is given, or the time is not finite.
        """
        factors = hour_factors(self.name, self.times, time)
        if factors is None:
            return self
        values = np.zeros((self.probes, self.outputs), np.float32)
        for hour in np.flatnonzero(factors):
            values += np.float32(factors[hour]) * self.values[:, hour * self.outputs : (hour + 1) * self.outputs]
        return replace(self, values=values, live=values.any(1), times=np.zeros(0))


@dataclass(frozen=True)
class _Raw:
    """The unchecked content of a file: `key` is the name of `values`, which have an array for each of `times`, or only
    one; `convention` is the name that the file states."""

    position: np.ndarray
    values: list[np.ndarray]
    key: str
    convention: str = ""
    beside: Mapping[str, np.ndarray] = field(default_factory=dict)
    axes: str = ""
    reading: str = ""  # if the file determines everything about its numbers
    times: np.ndarray = field(default_factory=lambda: np.zeros(0))


def load(
    path: str | os.PathLike[str],
    *,
    key: str | Sequence[str] | None = None,
    convention: str | None = None,
    order: str | None = None,
    axes: str | None = None,
) -> ProbeSet:
    """Reads light probes from a file.

    - `.npz`: arrays `position` (N, 3) and `sh...` (N, C, 3) or (N, D), and a string `convention` if `sh...` is not
      canonical; optionally `normal` (N, 3) and `valid` (N), as for `from_arrays`.
    - `.json`: `{"position": [[x, y, z], ...], "sh": [[[r, g, b], ...], ...]}`, or
      `{"probes": [{"position": [x, y, z], "sh": [[r, g, b], ...]}, ...]}`; optional fields as for `.npz`. The names
      and forms of other writers are known too (`wlm.probe.fields`), and scenes of three.js.
    - `.csv`, `.tsv`: a probe in each line, x, y, z and its numbers, below an optional line of names.
    - `.lmbake`, `.res`: a lightmap bake of Godot 4.
    - `.ktx2`: an irradiance volume of Bevy (`wlm.probe.ambient_cube`).
    - `.asset`: the lighting data or light probes of Unity's editor, as text, or binary (extra `unity`).

    Args:
        path: The file; its suffix determines the kind.
        key: Name of the array of values, or that name without the prefix "sh_" ("12.00" for "sh_12.00"), or several
            names that end in an hour of the day. None takes all arrays whose names begin with "sh".
        convention: Convention of the file's numbers, one of `wlm.probe.conventions.CONVENTIONS`. None takes the file's
            own: "godot" for `.lmbake`, "unity" for `.asset`, otherwise the field `convention`, or else canonical.
        order: Order of the numbers of spherical harmonics: "coefficient" (r0 g0 b0 r1 ...) or "channel" (r0 r1 ... g0
            ...). None takes the order that the shape shows, (N, C, 3) or (N, 3, C), or for (N, D) the one that fits
            light better, with a warning if that is "channel".
        axes: Old axes that become the new x, y and z of positions, normals and light, for example "x,z,-y" or, to
            mirror x, "-x,y,z"; None: no change.

    Returns:
        The set, with its faults repaired where that is possible; see `ProbeSet.warnings`.

    Raises:
        WlmError: The content is wrong or cannot be read; the message names the file and the field.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise WlmError(f"{path}: expected a name that ends in {' or '.join(_READERS)}, found {path.suffix or 'none'}")
    probes, matrix = _check(str(path), path.stem, reader(path, key), convention, order), read_axes(axes)
    if axes is None:
        return probes
    hours = [probes.values[:, i : i + probes.outputs] for i in range(0, probes.values.shape[1], probes.outputs)]
    values = np.concatenate([turned(hour, matrix) for hour in hours], 1)
    position = probes.position @ matrix.T
    normal = None if probes.normal is None else probes.normal @ matrix.T
    source = _hash(position, values, probes.live, probes.times)
    reading = f"{probes.reading}; then x, y, z from {axes}"
    return replace(probes, position=position, values=values, normal=normal, source=source, reading=reading)


def load_positions(path: str | os.PathLike[str]) -> np.ndarray:
    """Reads the positions of a probe file, or a list of points.

    Args:
        path: A file as for `load`; `.npz` and `.json` need no values. Any other file is read as JSON, `[[x, y, z],
            ...]`.

    Returns:
        float64 [M, 3], finite, M at least 1.

    Raises:
        WlmError: The file is missing, damaged, or has other content.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind == ".npz":
        position = read_npz(path, lambda _: [_POSITION], numbers=3 * PROBES)[_POSITION]
    elif kind in _READERS and kind != ".json":
        position = _READERS[kind](path, None).position
    else:
        position = read_positions(path)
    return _check_positions(str(path), position)


def from_arrays(
    position: np.ndarray,
    values: np.ndarray,
    *,
    name: str = "array",
    key: str = _SH,
    convention: str = CANONICAL,
    order: str | None = None,
    normal: np.ndarray | None = None,
    valid: np.ndarray | None = None,
    times: Sequence[float] | np.ndarray | None = None,
) -> ProbeSet:
    """Builds a checked set from arrays, under the same rules as `load`.

    Args:
        position: [N, 3] of numbers; copied.
        values: [N, C, 3], RGB last, [N, 3, C] or [N, D] of numbers; with `times` an array of one of these for each of
            them; copied.
        name: Name of the set, also used in messages.
        key: Name of the array of values.
        convention: Convention of the values, one of `wlm.probe.conventions.CONVENTIONS`.
        order: Order of the values, as for `load`.
        normal: [N, 3], normal of each probe's surface, of any length, 0 for a probe on no surface; copied.
        valid: [N], true or false, or from 0 to 1: a probe below 0.5 is dead.
        times: [T], hours of the day, 0 to 24; None: the light does not change.

    Returns:
        The set, with its faults repaired where that is possible; see `ProbeSet.warnings`.

    Raises:
        WlmError: A shape is wrong, or numbers are out of range.
    """
    beside = {_NORMAL: normal, _VALID: valid}
    beside = {field: np.asarray(array) for field, array in beside.items() if array is not None}
    numbers = [np.asarray(values)]
    hours = np.zeros(0)
    if times is not None:
        hours = _checked_hours(name, times)
        if len(numbers[0]) != len(hours):
            raise WlmError(f"{name}: {key}: expected an array for each of {len(hours)} hours, got {len(numbers[0])}")
        numbers = [numbers[0][i] for i in np.argsort(hours)]
        hours = np.sort(hours) if len(hours) > 1 else np.zeros(0)
    return _check(name, name, _Raw(np.asarray(position), numbers, key, beside=beside, times=hours), convention, order)


def save_probes(
    path: str | os.PathLike[str],
    position: np.ndarray,
    values: np.ndarray,
    *,
    key: str = _SH,
    convention: str = CANONICAL,
) -> None:
    """Writes probes atomically as `.npz` or `.json`, in a form that `load` reads.

    Spherical harmonics in RGB are written as (N, C, 3), other numbers as (N, D). The file states the convention.

    Args:
        path: The file to write; its suffix determines the kind, and its folder must exist.
        position: [N, 3].
        values: float32 [N, D], finite, in this package's own convention (canonical).
        key: Name of the array of values.
        convention: Convention to write the values in, one of `wlm.probe.conventions.CONVENTIONS`.

    Raises:
        ValueError: The shapes do not fit, or a number is NaN or infinite.
        WlmError: The suffix is unknown, the convention does not fit the values, the key is the name of another field,
            or the file cannot be written.
    """
    path = Path(path)
    position, values = np.asarray(position), np.asarray(values, np.float32)
    if values.ndim != 2 or position.shape != (len(values), 3) or 0 in values.shape:
        raise ValueError(f"expected positions [N, 3] and values [N, D], got {position.shape} and {values.shape}")
    if not (np.isfinite(position).all() and np.isfinite(values).all()):
        raise ValueError("expected finite positions and values, got NaN or infinity")
    # `file` and `allow_pickle` are parameters of NumPy's writer.
    if key in (_POSITION, _CONVENTION, _PROBES, *_BESIDE, "file", "allow_pickle"):
        raise WlmError(f"{path}: key: expected a name that no other field of the file has, got {key!r}")
    engine = _convert(str(path), values, convention, from_canonical)
    if position.dtype != np.float32:  # float32 takes half the bytes, if the caller has no more digits
        position = position.astype(np.float64)
    suffix = path.suffix.lower()
    if suffix == ".npz":
        arrays = {_POSITION: position, key: engine, _CONVENTION: np.array(convention)}
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, **arrays)
    elif suffix == ".json":
        content = {_CONVENTION: convention, _POSITION: position.tolist(), key: rounded(engine)}
        atomic_write(path, json.dumps(content).encode())
    else:
        raise WlmError(f"{path}: expected a name that ends in .npz or .json, found {path.suffix or 'none'}")


def _read_npz(path: Path, key: _Key) -> _Raw:
    chosen: list[str] = []

    def choose(names: Sequence[str]) -> list[str]:
        chosen[:] = _choose(path, names, key)
        return [_POSITION, *chosen, *({_CONVENTION, *_BESIDE} & set(names) - set(chosen))]

    arrays = read_npz(path, choose, numbers=PROBES * NUMBERS)
    stated = arrays[_CONVENTION] if _CONVENTION in arrays else np.array("")
    if stated.dtype.kind != "U" or stated.ndim:
        raise WlmError(f"{path}: {_CONVENTION}: expected a string, got {stated.dtype} {stated.shape}")
    beside = {field: arrays[field] for field in _BESIDE if field in arrays and field not in chosen}
    return _raw(path, arrays[_POSITION], chosen, arrays.__getitem__, convention=str(stated), beside=beside)


def _read_json(path: Path, key: _Key) -> _Raw:
    fields = read_fields(path)
    chosen = _choose(path, fields.names, key)
    beside = {field: fields.read(field) for field in _BESIDE if field in fields.names}
    position = fields.read(_POSITION)

    def read(name: str) -> np.ndarray:
        values = fields.read(name)
        flat = values.ndim == 1 and len(position) and len(values) % len(position) == 0
        return values.reshape(len(position), -1) if flat else values

    return _raw(path, position, chosen, read, convention=fields.convention, beside=beside, axes=fields.axes)


def _raw(path: Path, position: np.ndarray, names: list[str], read: Callable[[str], np.ndarray], **known: Any) -> _Raw:
    """Reads the named arrays, in the order of the hours in their names if there are several."""
    if len(names) == 1:
        return _Raw(position, [read(names[0])], names[0], **known)
    hours, _ = hours_of_names(names)
    if None in hours:
        listed = f"{', '.join(names)}; hours are read from names such as sh_6h"
        raise WlmError(f"{path}: found several arrays of values; choose one by its key: {listed}")
    times = _checked_hours(str(path), hours)
    order = np.argsort(times)
    key = ", ".join(names[i] for i in order)
    return _Raw(position, [read(names[i]) for i in order], key, times=times[order], **known)


def _checked_hours(where: str, hours: Any) -> np.ndarray:
    times = np.asarray(hours, np.float64)
    if not (len(times) and (times >= 0).all() and (times <= DAY).all() and len(np.unique(times % DAY)) == len(times)):
        raise WlmError(f"{where}: expected different hours of the day, 0 to 24, got {listed_times(times) or 'none'}")
    return times % DAY


def _lighting_data(path: Path) -> tuple[np.ndarray, np.ndarray]:
    data = read_lighting_data(path)
    if not len(data.position):
        raise WlmError(f"{path}: expected light probes, found none: the scene has no baked LightProbeGroup")
    return data.position, data.values


def _only_sh(read: Callable[[Path], tuple], **known: str) -> Callable[[Path, _Key], _Raw]:
    """Makes a function that reads a file of positions and one array "sh"; `known` are further fields of its result."""

    def reader(path: Path, key: _Key) -> _Raw:
        position, values, *remark = read(path)
        (name,) = _choose(path, (_POSITION, _SH), key)
        return _Raw(position, [values], name, **known | ({"axes": remark[0]} if remark else {}))

    return reader


_GODOT = _only_sh(read_lmbake, convention="godot", axes="Godot's axes, right-handed, y up, in metres")
_UNITY = _only_sh(_lighting_data, convention="unity", axes="Unity's axes, left-handed, y up, in metres")
_READERS = {
    ".npz": _read_npz,
    ".json": _read_json,
    ".lmbake": _GODOT,
    ".res": _GODOT,
    ".asset": _UNITY,
    ".csv": _only_sh(read_table),
    ".tsv": _only_sh(read_table),
    ".ktx2": _only_sh(read_irradiance_volume, reading=READING),
}


def _choose(path: Path, names: Sequence[str], key: _Key) -> list[str]:
    """Returns the names of the arrays of values: `key`, with or without "sh_", or else those that begin with "sh"."""
    if _POSITION not in names:
        raise WlmError(f"{path}: the field {_POSITION} is missing; found {', '.join(names) or 'nothing'}")
    fields = [name for name in names if name not in (_POSITION, _CONVENTION, *_BESIDE)]
    listed = ", ".join(fields) or "nothing"
    if key is not None:
        wanted = [key] if isinstance(key, str) else key
        return [_named(path, fields, each, listed) for each in dict.fromkeys(wanted)]
    candidates = [name for name in fields if name.startswith(_SH)]
    if not candidates:
        raise WlmError(
            f"{path}: expected an array of light, whose name begins with {_SH} or is given as --key; found {listed}"
        )
    return candidates


def _named(path: Path, fields: Sequence[str], key: str, listed: str) -> str:
    for name in (key, f"{_SH}_{key}"):
        if name in fields:
            return name
    raise WlmError(f"{path}: expected values named {key} or {_SH}_{key}; found {listed}")


def _convert(where: str, values: np.ndarray, name: str, change: Callable[[np.ndarray, str], np.ndarray]) -> np.ndarray:
    """Converts values [N, C, 3] or [N, D] from or to a convention. Returns [N, C, 3] if D = 3 C, else [N, D]."""
    if name not in CONVENTIONS:
        raise WlmError(f"{where}: {_CONVENTION}: expected {', '.join(CONVENTIONS)}, got {name!r}")
    coefficients = sh_count(int(np.prod(values.shape[1:])))
    if coefficients is not None:
        values = values.reshape(len(values), coefficients, 3)
    if name == CANONICAL:
        return values
    if coefficients is None:
        raise WlmError(
            f"{where}: convention {name}: expected spherical harmonics of 1, 4, 9 ... RGB coefficients, "
            f"got {values.shape[1:]} numbers per probe"
        )
    try:
        with np.errstate(over="ignore"):
            return change(values, name).astype(values.dtype)
    except WlmError as error:
        raise WlmError(f"{where}: {error}") from error


def _check(where: str, name: str, raw: _Raw, convention: str | None, order: str | None) -> ProbeSet:
    """Checks the content of a file and returns it as a set, repaired where possible. `convention` and `order` are those
    that the caller states."""
    position, key, beside = _check_positions(where, raw.position), raw.key, raw.beside
    count, values = len(position), raw.values[0]
    for hour in raw.values:
        if hour.dtype.kind not in "iuf":
            raise WlmError(f"{where}: {key}: expected numbers, got {hour.dtype}")
        if hour.shape != values.shape:
            raise WlmError(f"{where}: {key}: expected one shape at all hours, got {values.shape} and {hour.shape}")
    coefficients = sh_count(values.size // count) if values.ndim > 1 else None
    by_channel = coefficients is not None and values.shape[1:] == (3, coefficients)
    fits = values.ndim == 2 or (values.ndim == 3 and (values.shape[2] == 3 or by_channel))
    if not fits or len(values) != count or values.size == 0:
        raise WlmError(
            f"{where}: {key}: expected the shape ({count}, C, 3) with RGB last or ({count}, D), a row for each "
            f"position, got {values.shape}"
        )
    if (total := values.size // count * len(raw.values)) > NUMBERS:
        raise WlmError(f"{where}: {key}: expected at most {NUMBERS} numbers a probe, got {total}")
    if order is not None and (order not in ORDERS or coefficients is None):
        raise WlmError(
            f"{where}: order: expected {' or '.join(ORDERS)}, for 3, 12, 27 ... numbers a probe, got {order!r} for "
            f"{values.size // count}"
        )
    if raw.reading and (convention or order):
        raise WlmError(f"{where}: --convention and --order have no meaning for this kind of file: {raw.reading}")
    origin = "as given" if convention else "as the file states" if raw.convention else ""
    convention = convention or raw.convention or CANONICAL
    doubts: tuple[str, ...] = ()
    reading = f"{values.size // count} numbers a probe, which are no SH in RGB"
    if raw.reading:
        order = COEFFICIENT
    elif coefficients is not None:
        _convert(where, values[:1], convention, to_canonical)  # refuses what does not fit
        certain = order is not None or values.ndim == 3 or coefficients == 1
        every = values if len(raw.values) == 1 else np.concatenate(raw.values)
        order, doubts = choose_order(every, convention, order)
        reading = described(convention, origin, order, certain)
    reading = raw.reading or f"{reading}; {raw.axes or 'positions and axes as stored'}"

    outputs = values.size // count
    checked = room((count, len(raw.values) * outputs), np.float32, where)
    finite = np.ones(count, bool)
    for number, hour in enumerate(raw.values):
        for start in range(0, count, _ROWS):
            rows = slice(start, start + _ROWS)
            # float64 distinguishes numbers that do not fit float32 from Inf.
            wide = hour[rows].astype(np.float64)
            whole = np.isfinite(wide).all(axis=tuple(range(1, wide.ndim)))
            finite[rows] &= whole
            if coefficients is not None and order is not None:
                wide = coefficients_first(wide, order)
            wide = _convert(where, wide, convention, to_canonical).reshape(len(wide), -1)
            beyond = np.flatnonzero(whole & (np.abs(wide).max(axis=1) > LARGEST))
            if len(beyond):
                worst = np.abs(wide[beyond[0]]).max()
                raise WlmError(
                    f"{where}: {key}[{start + beyond[0]}]: expected numbers of at most {LARGEST:.2g}, got {worst:.3g}"
                )
            wide[~whole] = 0.0
            checked[rows, number * outputs : (number + 1) * outputs] = wide
    checked[~finite] = 0.0
    if _VALID in beside:
        valid = _check_beside(where, _VALID, beside[_VALID], "biuf", (count,))
        for bad in np.flatnonzero((valid < 0) | (valid > 1))[:1]:
            raise WlmError(f"{where}: {_VALID}[{bad}]: expected true or false, or 0 to 1, got {valid[bad]:g}")
        checked[valid < 0.5] = 0.0
    live = (checked != 0.0).any(axis=1)
    if not live.any():
        raise WlmError(f"{where}: {key}: every probe is zero, not finite or not valid: there is nothing to fit")
    normal = None
    if _NORMAL in beside:
        normal = unit_or_zero(_check_beside(where, _NORMAL, beside[_NORMAL], "iuf", (count, 3)))

    warnings = [f"{name}: {key}: {doubt}" for doubt in doubts]
    broken = np.flatnonzero(~finite)
    if len(broken):
        warnings.append(
            f"{name}: {counted(len(broken), 'probe')} with a NaN or infinite number in {key}, first probe {broken[0]}: "
            "set to zero and left out"
        )
    if repeated := _repeated(position):
        warnings.append(
            f"{name}: {counted(repeated, 'probe')} at the position of another: Gaussians decode them to one value"
        )
    source = _hash(position, checked, live, raw.times)
    return ProbeSet(name, position, checked, key, live, source, tuple(warnings), normal, reading, raw.times)


def _check_positions(where: str, position: np.ndarray) -> np.ndarray:
    """Returns checked positions, float64 [N, 3]."""
    if position.dtype.kind not in "iuf":
        raise WlmError(f"{where}: {_POSITION}: expected numbers, got {position.dtype}")
    count = len(position) if position.ndim else 0
    if count == 0:
        raise WlmError(f"{where}: {_POSITION}: expected at least one probe, found none")
    if position.shape != (count, 3):
        raise WlmError(f"{where}: {_POSITION}: expected the shape (N, 3), got {position.shape}")
    if count > PROBES:
        raise WlmError(f"{where}: {_POSITION}: expected at most {PROBES} probes, got {count}")
    position = position.astype(np.float64)
    bad = np.flatnonzero(~np.isfinite(position).all(axis=1))
    if len(bad):
        text = ", ".join(f"{x:g}" for x in position[bad[0]])
        raise WlmError(f"{where}: {_POSITION}[{bad[0]}]: expected finite numbers, got ({text})")
    with np.errstate(over="ignore"):
        extent = np.ptp(position, axis=0).max()
    if not extent <= _FARTHEST:
        raise WlmError(f"{where}: {_POSITION}: expected positions within {_FARTHEST:g} of each other, got {extent:.3g}")
    return position


def _repeated(position: np.ndarray) -> int:
    """Returns how many probes have the same position as an earlier probe."""
    x, y, z = position.T
    # Equal positions have equal keys. Nearly always no two keys are equal, and one sort is enough.
    keys = np.sort(0.2718 * x + 0.3141 * y + 0.4142 * z)
    if (keys[1:] != keys[:-1]).all():
        return 0
    ordered = position[np.lexsort(position.T)]
    return int((ordered[1:] == ordered[:-1]).all(axis=1).sum())


def _hash(position: np.ndarray, values: np.ndarray, live: np.ndarray, times: np.ndarray) -> str:
    digest = hashlib.blake2b(digest_size=8)
    digest.update(np.asarray(values.shape, "<i8").tobytes())
    digest.update(np.ascontiguousarray(position, "<f8"))
    digest.update(np.ascontiguousarray(values, "<f4"))
    digest.update(np.packbits(live).tobytes())
    digest.update(times.astype("<f8"))
    return digest.hexdigest()


def _check_beside(where: str, field: str, array: np.ndarray, kinds: str, shape: tuple[int, ...]) -> np.ndarray:
    """Returns a field beside the values as float64, after checking its type, its shape and that it is finite."""
    if array.dtype.kind not in kinds or array.shape != shape:
        expected = "numbers" if kinds == "iuf" else "numbers, or true and false,"
        raise WlmError(f"{where}: {field}: expected {expected} {list(shape)}, got {array.dtype} {list(array.shape)}")
    array = array.astype(np.float64)
    finite = np.isfinite(array)
    bad = np.flatnonzero(~(finite.all(1) if array.ndim > 1 else finite))
    if len(bad):
        raise WlmError(f"{where}: {field}[{bad[0]}]: expected finite numbers, got {array[bad[0]].tolist()}")
    return array
