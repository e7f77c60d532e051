"""Speed against error: timing, the rows that every system reports, and their tables and plots."""

from wlm.bench.compare import Change, compare
from wlm.bench.figures import FIGURES
from wlm.bench.plot import Panel, pareto_front, plot
from wlm.bench.report import pages, tables
from wlm.bench.rows import Row, Run, describe_environment, read_json, read_runs, write_json
from wlm.bench.timing import Timing, time_together

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
