"""Runs a Python file that reads risky data in a process of its own, with limits of memory and time.

Some C libraries end their process on damaged data, or allocate what the data claims. The new process runs this file,
which imports nothing of this package. It imports the library, sets the limits, and calls the file's `main`.

The file has the name of the library, `PACKAGE`; its limits beyond the import, `MEMORY` in bytes and `SECONDS` of CPU
time; and `main`, which gets the data and returns arrays by name.
"""

import contextlib
import importlib
import io
import runpy
import subprocess
import sys
from types import ModuleType

import numpy as np

_WAIT = 120.0  # wall-clock limit in seconds


def run_child(reader: ModuleType, data: bytes, *arguments: str) -> dict[str, np.ndarray]:
    """Runs the function `main` of a module on data and arguments in a limited process; returns its arrays by name.
    Raises a ValueError if the process raised an error, crashed or exceeded a limit, or could not be started."""
    # With -P, a module beside the program cannot replace a package.
    command = [sys.executable, "-P", __file__, str(reader.__file__), *arguments]
    try:
        run = subprocess.run(command, input=data, capture_output=True, timeout=_WAIT, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ValueError(str(error)) from error
    if run.returncode:
        lines = run.stderr.decode(errors="replace").strip().splitlines()
        limits = f"{reader.SECONDS} s and {reader.MEMORY} bytes"
        crashed = f"{reader.PACKAGE} crashed, or exceeded its limits of {limits}"
        raise ValueError(lines[-1] if run.returncode > 0 and lines else crashed)
    with np.load(io.BytesIO(run.stdout)) as arrays:
        return dict(arrays)


def _limit(memory: int, seconds: int) -> None:
    import resource  # which Windows lacks: it can import this file, not run a child

    with open("/proc/self/statm") as file:
        memory += int(file.read().split()[0]) * resource.getpagesize()
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds += int(used.ru_utime + used.ru_stime)
    for kind, most in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, seconds), (resource.RLIMIT_CORE, 0)):
        resource.setrlimit(kind, (most, most))


if __name__ == "__main__":
    _reader = runpy.run_path(sys.argv[1])
    importlib.import_module(_reader["PACKAGE"])
    _limit(_reader["MEMORY"], _reader["SECONDS"])
    with contextlib.redirect_stdout(io.StringIO()):  # libraries print messages about data that they cannot read
        _arrays = _reader["main"](sys.stdin.buffer.read(), *sys.argv[2:])
    np.savez(sys.stdout.buffer, **_arrays)
