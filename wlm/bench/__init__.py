"""Speed against error: timing, the rows that every system reports, and their tables and plots."""

from wlm.bench.plot import Panel, pareto_front, plot
from wlm.bench.runner import Row, Run, describe_environment, read_json, read_runs, run_peers, table, write_json
from wlm.bench.timing import Timing, cpu_threads, time_call, time_together

__all__ = [
    "Panel",
    "Row",
    "Run",
    "Timing",
    "cpu_threads",
    "describe_environment",
    "pareto_front",
    "plot",
    "read_json",
    "read_runs",
    "run_peers",
    "table",
    "time_call",
    "time_together",
    "write_json",
]
