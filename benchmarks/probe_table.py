"""The table of light probes: our methods and their rivals at equal bytes of GPU memory, by four kinds of error.

A row compresses a set to at most a share of its size as float32, and measures the probes that it decodes to:

- by themselves: PSNR over all numbers of all probes, and the relative error of live probes (`wlm.probe.relative`), root
  mean square, also in dB, -20 log10 of it;
- held out: the light at every fifth live probe, interpolated from the eight nearest decoded others with weights
  1 / distance^2, whatever the method, since most have no value between probes. Nothing of the probes left out is read,
  although their light took part in the fit;
- in the volume: a viewer stands at some places of a walk until the cascaded volume around is filled from the decoded
  probes, and reads it at probes within the finest window;
- in pictures: white balls, lit at their centres by that volume, beside those lit by one that the original probes fill,
  as table 1 of gaussian-probe-compression has them.

The row "original" has the errors of uncompressed probes: those of reading between probes, which no method can be
expected to avoid. All errors are against the original probes, except those of pictures. The relative error of a probe
counts as 100% at most where light is read between probes. Rivals minimise squared errors, as published. Lists of dead
probes and positions count for no method.

Our methods are fitted for either error, `Profile.error`. "ours" is the better of Gaussians and principal components by
the error of the fit, which is what `compress` takes with `max_bytes`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.rivals.probe import WEIGHT_BITS, at_bytes, unreal_packing
from benchmarks.rows import Row
from benchmarks.runner import Bench, Note, check_only
from wlm.errors import WlmError
from wlm.metrics import Pictures, psnr_from_mse
from wlm.probe.data import ProbeSet, from_arrays
from wlm.probe.fit import compress
from wlm.probe.model import Profile
from wlm.probe.places import ball_exposure, nearest_weights
from wlm.probe.relative import magnitudes, norms
from wlm.probe.sphere import sh_count
from wlm.probe.views import ball_mesh, look, shown, viewers
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.light import StoredLight
from wlm.probe.volume.walk import settle

SHARES = (1, 2, 3, 5, 7, 10)
"""Largest sizes, in per cent of float32."""

SMALL_SHARES = (5, 10, 25, 50, 100)
"""The same for a set of less than `SMALL` probes, of which most methods need more."""

SMALL = 1000

RIVALS: Mapping[str, Callable[..., object]] = {
    # The paper's own rival: clusters of places, nothing but half floats.
    "CPCA in halves": partial(at_bytes, "clustered_pca", bits=(None,)),
    **{
        name: partial(at_bytes, key, bits=WEIGHT_BITS)
        for name, key in (
            ("global PCA", "global_pca"),
            ("clustered PCA", "clustered_pca"),
            ("CPCA by signal", "clustered_pca_signal"),
            ("moving basis", "moving_basis"),
        )
    },
}
"""Rivals by the names that the table prints: functions of positions, values and `budget_bytes`."""

METHODS = ("ours", "PCA", "rivals")
"""Names for `--only`: "ours" are Gaussians, principal components and the better of both, "PCA" the second of these."""

_EVERY, _NEIGHBOURS = 5, 8
_VIEWS, _RESOLUTION, _SAMPLES, _BUDGET = 8, 96, 256, 1024
_MOST = 1.0  # of a relative error between probes: a nearly black one beside a bright one would drown all others
_KINDS = {"Gaussians": "gaussians", "PCA": "pca"}


class Decoded(NamedTuple):
    """Light of live probes [V, D] as one method decodes it, its size in bytes, and the settings that it chose."""

    values: np.ndarray
    bytes: int
    notes: str


def table_rows(
    sets: Sequence[ProbeSet],
    profile: Profile,
    *,
    device: str,
    only: Sequence[str] | None = None,
    shares: Sequence[int] | None = None,
    progress: Note | None = None,
    done: Callable[[Sequence[Row]], None] | None = None,
) -> list[Row]:
    """Measures the table of some sets.

    Args:
        sets: The sets, each of one hour.
        profile: Settings of the Gaussians; number and error are replaced.
        device: "cpu" or "cuda:0", for the fits and the volume.
        only: Names of `METHODS`; None or empty: all.
        shares: Largest sizes in per cent of float32; None: `SHARES` or `SMALL_SHARES`.
        progress: Called with a line before each part of the work.
        done: Called with all rows so far after each size.

    Raises:
        WlmError: A name is unknown, the device does not exist, or a fit diverged.
    """
    check_only(only or (), METHODS)
    rows: list[Row] = []
    for probes in sets:
        key = probes.key.removeprefix("sh").removeprefix("_")
        bench = Bench("probe", device, progress, scene=f"{probes.name} {key}".strip().replace(" ,", ","))
        table = _Table(bench, probes, profile, only or METHODS)
        if "rivals" in table.only:
            rows += table.fixed()
        for share in shares or (SHARES if probes.live.sum() >= SMALL else SMALL_SHARES):
            rows += table.at(share)
            if done is not None:
                done(rows)
    return rows


def nearest_probes(probes: ProbeSet, count: int) -> ProbeSet:
    """Returns the set of the `count` live probes nearest to the one in the middle of the box.

    Raises:
        WlmError: There are fewer live probes.
    """
    live = np.flatnonzero(probes.live)
    if not 1 <= count <= len(live):
        raise WlmError(f"--nearest: expected 1 to {len(live)} live probes of {probes.name}, got {count}")
    position = probes.position[live]
    tree = cKDTree(position)
    middle = position[tree.query((position.min(0) + position.max(0)) / 2)[1]]
    chosen = live[np.sort(tree.query(middle, np.arange(1, count + 1))[1])]
    key = f"{probes.key}, {count} probes"
    return from_arrays(probes.position[chosen], probes.values[chosen], name=probes.name, key=key)


class _Table:
    """The rows of one set."""

    def __init__(self, bench: Bench, probes: ProbeSet, profile: Profile, only: Sequence[str]) -> None:
        self.only, self._bench, self._probes, self._profile = only, bench, probes, profile
        self._errors = Errors(probes, bench.device)
        self._position, self._values = probes.position[probes.live], probes.values[probes.live]

    def fixed(self) -> list[Row]:
        """Returns the rows whose sizes are not chosen: the original probes, and Unreal's packing."""
        original = Decoded(self._values, self._probes.float_bytes, "errors of reading between uncompressed probes")
        found: dict[str, Decoded | WlmError] = {"original": original}
        found["Unreal packing"] = self._try(lambda: self._rival(unreal_packing))
        return self._rows(found, "")

    def at(self, share: int) -> list[Row]:
        """Returns the rows of all methods within a share of float32 in per cent."""
        size = share * self._probes.float_bytes // 100
        calls: dict[str, Callable[[], Decoded]] = {}
        for name, method in _KINDS.items():
            for error in ("relative", "absolute"):
                if "ours" in self.only or name in self.only:
                    calls[f"{name}, {error}"] = partial(self._ours, method, error, size)
        if "rivals" in self.only:
            for name, rival in RIVALS.items():
                calls[name] = partial(self._rival, partial(rival, budget_bytes=size))
        found = {}
        for name, call in calls.items():
            self._bench.note(f"{name}, {share}%")
            found[name] = self._try(call)
        return self._rows(found, f"{share}%")

    def _rows(self, found: Mapping[str, Decoded | WlmError], option: str) -> list[Row]:
        """Measures what methods decode, and adds the rows of the better of our methods."""
        measured = {name: each for name, each in found.items() if isinstance(each, Decoded)}
        errors = dict(zip(measured, self._errors.of([each.values for each in measured.values()]), strict=True))
        rows = []
        for name, each in found.items():
            if isinstance(each, WlmError):
                rows.append(self._bench.missing_row(name, option, each))
                continue
            share = each.bytes / self._probes.float_bytes
            sizes = {"bytes": each.bytes, "bpp": 8 * each.bytes / self._probes.probes, "share_of_float32": share}
            rows.append(self._bench.row(name, option, each.notes, **sizes, **errors[name]))
        for error, figure in (("relative", "relative_db"), ("absolute", "psnr")):
            ours = [row for row in rows if row.method in [f"{name}, {error}" for name in _KINDS] and row.figures]
            if "ours" in self.only and ours:
                best = max(ours, key=lambda row: row[figure])
                notes = f"{best.method.partition(',')[0]}: {best.notes}"
                rows.append(self._bench.row(f"ours, {error}", option, notes, **best.figures))
        return rows

    def _ours(self, method: str, error: str, size: int) -> Decoded:
        settings = {"method": method, "error": error, "max_bytes": size}
        model = compress(self._probes, self._profile.model_copy(update=settings), device=self._bench.device)
        decoded = model.decoder(self._bench.device, position=self._probes.position).decode_probes()
        facts = ", ".join(f"{value} {name}" for name, value in model.content.facts().items())
        return Decoded(decoded[self._probes.live], model.content.nbytes, facts)

    def _rival(self, encode: Callable[..., object]) -> Decoded:
        rival = encode(position=self._position, values=self._values)
        return Decoded(rival.decoded, rival.bytes, f"{rival.option}; on the CPU")

    def _try(self, call: Callable[[], Decoded]) -> Decoded | WlmError:
        try:
            return call()
        except WlmError as error:  # nothing fits
            return error


class Errors:
    """Measures decoded probes of one set by themselves, held out, in the volume and in pictures, many at a time."""

    def __init__(self, probes: ProbeSet, device: str, views: int = _VIEWS) -> None:
        """Places the viewers and draws what they see."""
        self._probes, self._device = probes, device
        self._position, self._values = probes.position[probes.live], probes.values[probes.live].astype(np.float64)
        self._light = magnitudes(probes.values[probes.live])[:, 0]
        self._peak = float(np.ptp(probes.values))
        self._normal = None if probes.normal is None else probes.normal[probes.live]
        number = np.arange(len(self._position))
        self._out, kept = number[_EVERY - 1 :: _EVERY], np.delete(number, slice(_EVERY - 1, None, _EVERY))
        near, self._share = nearest_weights(cKDTree(self._position[kept]), self._position[self._out], _NEIGHBOURS)
        self._near = kept[near]
        mesh = ball_mesh(self._position)
        self._views = [
            (eye, look(mesh, eye, forward, 1, _RESOLUTION, device))
            for eye, forward in viewers(self._position, views, 1)
        ]

    def of(self, decoded: Sequence[np.ndarray]) -> list[dict[str, float]]:
        """Returns the figures of rows for light [V, D] of live probes."""
        if not decoded:
            return []
        alone = np.stack(decoded, 1).astype(np.float64)
        errors = {"": (_sums(alone - self._values[:, None], self._light), len(self._values))}
        between = np.einsum("pk,pkmd->pmd", self._share, alone[self._near])
        held = _sums(between - self._values[self._out, None], self._light[self._out], _MOST)
        errors["held_out_"] = held, len(self._out)
        read, pictures = self._walk(alone)
        errors["volume_"] = read
        figures = []
        for number in range(len(decoded)):
            row = {}
            for name, ((squares, relative), count) in errors.items():
                if count:
                    # Dead probes count in the PSNR of all probes: they decode exactly.
                    probes = self._probes.probes if name == "" else count
                    mse = squares[number] / (probes * self._values.shape[1])
                    row[f"{name}psnr"] = psnr_from_mse(mse, self._peak)
                    row[f"{name}relative_db"] = psnr_from_mse(relative[number] / count, 1.0)
            row["relative_error"] = math.sqrt(errors[""][0][1][number] / len(self._values))
            if pictures:
                row |= {"view_psnr": pictures[number].psnr, "view_flip": pictures[number].flip}
            figures.append(row)
        return figures

    def _walk(self, decoded: np.ndarray) -> tuple[tuple[tuple[np.ndarray, np.ndarray], int], list[Pictures]]:
        """Fills one volume with the original and all decoded light [V, M, D], and reads it around each viewer.

        Returns:
            Sums of squared errors as of `_sums`, and the number of probes read; and the pictures of each method.
        """
        probes, methods, width = decoded.shape
        light = np.concatenate([self._values[:, None], decoded], 1).reshape(probes, -1)
        volume = Volume(self._position, StoredLight(light, self._device), normal=self._normal, budget=_BUDGET)
        coefficients = sh_count(width)
        pictures = [Pictures() for _ in range(methods)] if coefficients else []
        exposure = ball_exposure(self._values.reshape(probes, -1, 3)[:, :coefficients]) if coefficients else 0.0
        total, count, random = np.zeros((2, methods)), 0, np.random.default_rng(0)

        def read(numbers: np.ndarray) -> np.ndarray:
            ahead = None if self._normal is None else self._normal[numbers]
            return volume.read(self._position[numbers], ahead).values.reshape(len(numbers), -1, width)

        for eye, (seen, _, normal, owner) in self._views:
            settle(volume, eye)
            low = volume.sizes[0] * volume.base[0]
            inside = ((self._position > low) & (self._position < low + volume.sizes[0] * volume.sides[0])).all(1)
            near = np.flatnonzero(inside)
            near = random.choice(near, _SAMPLES, replace=False) if len(near) > _SAMPLES else near
            total += _sums(read(near)[:, 1:] - self._values[near, None], self._light[near], _MOST)
            count += len(near)
            if pictures and seen.any():
                balls, index = np.unique(owner, return_inverse=True)
                lit = read(balls).reshape(len(balls), 1 + methods, coefficients, 3)
                first, *others = (shown(lit[index, number], normal, seen, exposure) for number in range(1 + methods))
                for each, picture in zip(pictures, others, strict=True):
                    each.add(first, picture, seen)
        return ((total[0], total[1]), count), pictures


def _sums(error: np.ndarray, light: np.ndarray, most: float = math.inf) -> np.ndarray:
    """Returns the sums over probes of squared errors [P, M, D], plain and relative to the probes' light, [2, M]; of a
    relative error no more than `most` counts."""
    norm = norms(error)
    return np.stack([np.square(norm).sum(0), np.square(np.minimum(norm / light[:, None], most)).sum(0)])
