"""Benchmarks of speed and error: timing of calls, one format of results for all systems, tables and plots."""

from benchmarks.compare import Change, compare
from benchmarks.figures import FIGURES
from benchmarks.plot import Panel, pareto_front, plot
from benchmarks.report import pages, tables
from benchmarks.rows import Row, Run, describe_environment, read_json, read_runs, write_json
from benchmarks.timing import Timing, time_together

__all__ = [
    "FIGURES",
    "Change",
    "Panel",
    "Row",
    "Run",
    "Timing",
    "compare",
    "describe_environment",
    "pages",
    "pareto_front",
    "plot",
    "read_json",
    "read_runs",
    "tables",
    "time_together",
    "write_json",
]
