"""Benchmark files as one page of tables."""

import os
from collections.abc import Sequence
from pathlib import Path

from wlm.bench.runner import Run, read_runs, table

__all__ = ["report"]


def report(paths: Sequence[str | os.PathLike[str]]) -> str:
    """Makes a Markdown page of benchmark files, a section each; of a file with several runs, a part each.

    Args:
        paths: Files that ``write_json`` wrote.

    Returns:
        The page: where and with what each run was measured, the command that measures it again, and its rows.

    Raises:
        WlmError: A file is missing or is no benchmark.
    """
    parts = ["# Results\n", "Made from the files under `benchmarks/` by `wlm bench report`.\n"]
    for path in paths:
        # By name, so that a part stays in its place when it is measured again.
        runs = sorted(read_runs(path), key=lambda run: (_systems(run), _scenes(run)))
        first = runs[0].environment
        parts.append(f"## {first['device_name'] or first['device']}: `{Path(path).name}`\n")
        for run in runs:
            environment = run.environment
            if len(runs) > 1:
                parts.append(f"### {', '.join(_systems(run))}: {', '.join(_scenes(run))}\n")
            cuda = f", CUDA {environment['cuda']}" if environment.get("cuda") else ""
            parts.append(
                f"`{environment['command']}`, {environment['date'][:10]}; {environment['threads']} threads, Python "
                f"{environment['python']}, Warp {environment['warp']}, torch {environment['torch']}{cuda}.\n"
            )
            parts.append(table(run.rows))
    return "\n".join(parts)


def _scenes(run: Run) -> list[str]:
    return sorted({row.scene for row in run.rows})


def _systems(run: Run) -> list[str]:
    return sorted({row.system for row in run.rows})
