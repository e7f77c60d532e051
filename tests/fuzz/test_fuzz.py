"""Cases of every reader, and that the faults which they look for would be found."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from wlm.errors import WlmError

from .bench import ROOT, Bench, Limits
from .reader import Reader
from .readers import READERS

CASES, PART = int(os.environ.get("WLM_FUZZ_CASES", "40")), 1000
"""Cases of a reader, and of one test at the most."""


def _parts():
    for name, reader in READERS.items():
        cases = range(max(CASES // reader.cost, 1))
        for first in cases[::PART]:
            # Fits that go on to their end cost most.
            marks = [pytest.mark.slow] * (reader.cost > 2)
            yield pytest.param(name, cases[first : first + PART], marks=marks, id=f"{name}-{first}")


@pytest.mark.filterwarnings("ignore")  # of Pillow
@pytest.mark.parametrize("name, cases", list(_parts()))
def test_a_changed_file_is_accepted_or_refused_in_one_line(tmp_path, name, cases):
    """In this process, which ends with "Profiling timer expired" or "Alarm clock" if a case takes too long; its file
    is in the folder of temporary files then."""
    bench = Bench(tmp_path, Limits(), READERS)
    bench.prepare(name)
    outcomes = [bench.run(name, index) for index in cases]
    assert [outcome for outcome in outcomes if outcome.failed] == []
    assert any(outcome.kind == "refused" for outcome in outcomes)


def test_a_case_depends_on_its_reader_and_index_alone():
    for name in ("lightmap", "exr", "gltf", "probes-npz", "volume-nvdb", "yaml-scene"):
        cases = [READERS[name].case(index) for index in range(20)]
        assert cases == [READERS[name].case(index) for index in range(20)] and len(set(cases)) > 15, name


def _refuse(path):
    raise WlmError(f"{path}: expected something else")


def _raise(path):
    raise KeyError("part")


def _control(path):
    error = WlmError(path)
    # Its maker escapes them.
    error.args = (f"{path}: found \x1b[31m",)
    raise error


def _nameless(path):
    raise WlmError("expected something else")


def _hog(path):
    try:
        path.write_bytes(bytes(1 << 40))
    except MemoryError as error:
        raise WlmError(f"{path}: too large") from error


def _accept_wrong(path):
    raise AssertionError("accepted, but it is not")


FAULTS = {
    "accepted": (Path.exists, ""),
    "refused": (_refuse, "expected something else"),
    "traceback": (_raise, "KeyError: 'part'"),
    "message": (_control, "control characters"),
    "nameless": (_nameless, "does not name the file"),
    "memory": (_hog, "too large"),
    "left": (lambda path: path.with_name("temporary").touch(), "temporary"),
    "wrong": (_accept_wrong, "accepted, but it is not"),
}


def _reader(name, fault):
    """Makes a reader that accepts its good file, as every reader must, and has a fault with any other."""

    def read(path):
        if path.read_bytes() != b"good":
            fault(path)

    return Reader(name, "a", lambda: (b"good",), lambda draw, data: b"bad", read, blind=0.0)


def test_every_fault_is_found_and_the_next_case_runs(tmp_path):
    readers = {name: _reader(name, fault) for name, (fault, _) in FAULTS.items()}
    readers["picky"] = Reader("picky", "a", lambda: (b"good",), lambda draw, data: b"bad", _refuse)
    bench = Bench(tmp_path, Limits(memory=1 << 30), readers)
    for name, (_, detail) in FAULTS.items():
        bench.prepare(name)
        for index in (5, 6):
            outcome = bench.run(name, index)
            assert outcome.kind == ("message" if name == "nameless" else name) and outcome.index == index
            assert detail in outcome.detail and outcome.failed == (name not in ("accepted", "refused"))
    with pytest.raises(AssertionError, match="picky: expected seed 0 to be accepted: .*expected something else"):
        bench.prepare("picky")


@pytest.mark.parametrize(
    "work, ended", [("[0 for _ in iter(int, 1)]", signal.SIGPROF), ("time.sleep(60)", signal.SIGALRM)]
)
def test_a_case_that_takes_too_long_ends_its_process(work, ended):
    code = f"import time; from tests.fuzz.bench import Limits\nwith Limits(0.2, 0.6).held(): {work}"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == -ended
