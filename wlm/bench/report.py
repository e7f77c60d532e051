"""Benchmark files as one page of tables."""

import os
from collections.abc import Sequence
from pathlib import Path

from wlm.bench.runner import read_json, table

__all__ = ["report"]


def report(paths: Sequence[str | os.PathLike[str]]) -> str:
    """Makes a Markdown page of benchmark files, a section each.

    Args:
        paths: Files that ``write_json`` wrote.

    Returns:
        The page: where and with what each was measured, the command that measures it again, and its rows.

    Raises:
        WlmError: A file is missing or is no benchmark.
    """
    parts = ["# Results\n", "Made from the files under `benchmarks/` by `wlm bench report`.\n"]
    for path in paths:
        rows, environment = read_json(path)
        cuda = f", CUDA {environment['cuda']}" if environment.get("cuda") else ""
        parts.append(f"## {environment['device_name'] or environment['device']}: `{Path(path).name}`\n")
        parts.append(
            f"`{environment['command']}`, {environment['date'][:10]}; {environment['threads']} threads, Python "
            f"{environment['python']}, Warp {environment['warp']}, torch {environment['torch']}{cuda}.\n"
        )
        parts.append(table(rows))
    return "\n".join(parts)
