"""Capture of messages that C libraries write to the stderr of the process."""

import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO

_STDERR = 2
_LOCK = threading.RLock()


@contextmanager
def captured_stderr(chosen: Callable[[bytes], bool]) -> Iterator[list[bytes]]:
    """Captures the lines inside the block for which `chosen` is true; other lines, for example of other threads, are
    passed on afterwards. Yields the list of the captured lines, which is filled at the end of the block."""
    captured: list[bytes] = []
    with _LOCK, _sink() as sink:
        sys.stderr.flush()
        saved = os.dup(_STDERR)
        os.dup2(sink.fileno(), _STDERR)
        try:
            yield captured
        finally:
            os.dup2(saved, _STDERR)
            sink.seek(0)
            for line in sink.read().splitlines(keepends=True):
                if chosen(line):
                    captured.append(line)
                else:
                    os.write(saved, line)
            os.close(saved)


def _sink() -> IO[bytes]:
    # Memory where the system can: a file takes longer, and the folder for temporary files may be full.
    return os.fdopen(os.memfd_create("stderr"), "w+b") if hasattr(os, "memfd_create") else tempfile.TemporaryFile()
