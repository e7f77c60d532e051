"""Fuzzing of every reader of files: seeded changes of good files, each read within a time and a memory limit.

    mutate.py      changes of bytes, numbers, JSON, text and arrays
    containers.py  the same inside a container, which is closed again: digests, CRCs, lengths
    readers.py     the table of readers: what a case is made of, how it is read, what an accepted one must be
    models.py      those of artifacts and checkpoints
    corpus/        the small good files
    bench.py       reads cases within limits of time and memory
    __main__.py    `python -m tests.fuzz`, for one case

A case depends on its reader's name and its index alone. It must be accepted, or be refused with one `WlmError` of one
line; an accepted one must be what docs/formats.md says. Anything else is a failure.
"""

import sys
from pathlib import Path

# Modules here import `builders`, which pytest finds by itself; `python -m tests.fuzz` and its processes do not.
sys.path.append(str(Path(__file__).resolve().parents[1]))
