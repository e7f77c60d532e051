"""Comparison of a result file with an older one."""

from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks.figures import FIGURES
from benchmarks.rows import Row, Run

_LEAST_DB = 0.05
_LEAST_TIME = 0.05  # share of the old time
_SPREAD = "_spread"


@dataclass(frozen=True)
class Change:
    """The change of one measured figure between an old and a new row of the same method, option and scene.

    Attributes:
        row: The new row.
        name: Name of the figure in `benchmarks.figures`.
        old, new: Values of the figure before and after.
        worse: Whether a figure in dB fell by more than 0.05 dB, or a time grew by more than 5% and by more than the
            scatter of its samples.
    """

    row: Row
    name: str
    old: float
    new: float
    worse: bool


def compare(new: Run, runs: Sequence[Run]) -> list[Change]:
    """Compares a run with an older result file.

    Args:
        new: The new run. Times are compared only with rows that the same machine measured.
        runs: The runs of the older file.

    Returns:
        The changes of all figures in decibels and all times that both files have, in the order of the new rows.
    """
    older = {_key(row): (row, run.environment.get("device_name")) for run in runs for row in run.rows}
    changes = []
    for row in new.rows:
        old, machine = older.get(_key(row), (None, None))
        for name in row.figures if old is not None else ():
            before, unit = old.get(name), FIGURES[name].unit
            if before is None or name.endswith(_SPREAD):
                continue
            if unit == "dB":
                changes.append(Change(row, name, before, row[name], row[name] < before - _LEAST_DB))
            elif unit in ("ms", "s") and machine == new.environment.get("device_name"):
                # Half of each spread: a median may lie there by chance.
                chance = sum(each.get(name + _SPREAD) or 0.0 for each in (row, old)) / 2
                least = max(_LEAST_TIME * before, chance)
                changes.append(Change(row, name, before, row[name], row[name] > before + least))
    return changes


def _key(row: Row) -> tuple[str, str, str, str]:
    return row.system, row.scene, row.method, row.option
