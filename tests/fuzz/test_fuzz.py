"""Some cases of every reader, and that the faults which they look for would be found."""

import json

import pytest

from . import faulty
from .campaign import campaign
from .readers import READERS
from .worker import Bench, Limits

CASES = 40
"""A reader; five times as many in `make test-all`, and five hundred times in `make fuzz`."""


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    return Bench(tmp_path_factory.mktemp("fuzz"), Limits())


@pytest.mark.filterwarnings("ignore")  # of Pillow
# Fits that go on to their end cost most.
@pytest.mark.parametrize("name", [name for name, reader in READERS.items() if reader.cost <= 2])
def test_a_changed_file_is_accepted_or_refused_in_one_line(bench, name):
    """In this process, which ends with "Profiling timer expired" if a case takes too long."""
    bench.prepare(name)
    outcomes = [bench.run(name, index) for index in range(CASES // READERS[name].cost)]
    assert [outcome for outcome in outcomes if outcome.failed] == []
    assert any(outcome.kind == "refused" for outcome in outcomes)


@pytest.mark.slow
def test_more_files_in_processes_of_their_own():
    seen = []
    cases = {name: range(5 * CASES // reader.cost) for name, reader in READERS.items()}
    tallies = campaign(cases, 2, done=lambda name, tally: seen.append(name))
    assert sorted(seen) == sorted(READERS)
    rows = {name: tally.to_json() for name, tally in tallies.items()}
    assert json.dumps([row["failures"] for row in rows.values() if row["failures"]], indent=1) == "[]"
    assert all(row["refused"] and row["cases"] == len(cases[name]) for name, row in rows.items())


def test_a_case_depends_on_its_reader_and_index_alone():
    for name in ("lightmap", "exr", "gltf", "probes-npz", "volume-nvdb", "yaml-scene"):
        cases = [READERS[name].case(index) for index in range(20)]
        assert cases == [READERS[name].case(index) for index in range(20)] and len(set(cases)) > 15, name


FAULTS = {
    "accepted": ("accepted", None),
    "refused": ("refused", None),
    "traceback": ("traceback", "KeyError: 'part'"),
    "control": ("message", "control characters"),
    "nameless": ("message", "does not name the file"),
    "memory": ("memory", "too large"),
    "left": ("left", "temporary"),
    "wrong": ("wrong", "accepted, but it is not"),
    "spin": ("time", "0.5 s of the processor"),
    "wait": ("time", "no answer in 2 s"),
    "crash": ("crash", "SIGABRT"),
}


def test_every_fault_is_found_and_the_next_case_runs():
    limits = Limits(seconds=0.5, wait=2.0, memory=1 << 30)
    tallies = campaign(dict.fromkeys([*FAULTS, "accepted"], range(5, 6)), 1, limits, faulty.__name__)
    for name, (kind, detail) in FAULTS.items():
        assert tallies[name].counts == {kind: 1}, name
        assert [outcome.index for outcome in tallies[name].failures] == ([] if detail is None else [5])
        assert detail is None or detail in tallies[name].failures[0].detail, name


def test_a_reader_that_refuses_its_own_good_file_is_an_error():
    with pytest.raises(RuntimeError, match="picky: .*expected seed 0 to be accepted: .*expected something else"):
        campaign({"picky": range(1)}, 1, Limits(), faulty.__name__)
