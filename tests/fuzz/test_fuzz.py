"""Some cases of every reader, and that the faults which they look for would be found."""

import json

import pytest

from .campaign import Tally, Worker, campaign
from .limits import Limits
from .readers import READERS

CASES = 200
"""A reader; `make fuzz` runs a hundred times as many."""


@pytest.fixture(scope="module")
def worker():
    with Worker() as worker:
        yield worker


@pytest.mark.parametrize("name", READERS)
def test_a_changed_file_is_accepted_or_refused_in_one_line(worker, name):
    tally = Tally()
    for outcome in worker.run(name, 0, CASES // READERS[name].cost):
        tally.add(outcome)
    assert tally.failures == [], json.dumps(tally.to_json()["failures"], indent=1)
    assert tally.counts["refused"] and not tally.failed
    assert tally.counts.total() == CASES // READERS[name].cost


def test_a_case_depends_on_its_reader_and_index_alone():
    for name in ("lightmap", "exr", "gltf", "probes-npz", "volume-nvdb", "yaml-scene"):
        cases = [READERS[name].case(index) for index in range(20)]
        assert cases == [READERS[name].case(index) for index in range(20)] and len(set(cases)) > 15, name


@pytest.fixture(scope="module")
def faulty():
    with Worker(Limits(seconds=0.5, memory=1 << 30), "tests.fuzz.faulty") as worker:
        yield worker


@pytest.mark.parametrize(
    ("name", "kind", "detail"),
    [
        ("accepted", "accepted", ""),
        ("refused", "refused", "expected something else"),
        ("traceback", "traceback", "KeyError: 'part'"),
        ("control", "message", "control characters"),
        ("nameless", "message", "does not name the file"),
        ("memory", "memory", "too large"),
        ("left", "left", "temporary"),
        ("wrong", "wrong", "accepted, but it is not"),
        ("spin", "time", "of the processor"),
        ("crash", "crash", "SIGABRT"),
    ],
)
def test_a_fault_is_found_and_the_next_case_runs(faulty, name, kind, detail):
    outcomes = list(faulty.run(name, 5, 2))
    assert [(outcome.index, outcome.kind) for outcome in outcomes] == [(5, kind), (6, kind)]
    assert detail in outcomes[0].detail and outcomes[0].failed == (kind not in ("accepted", "refused"))


def test_a_case_that_waits_is_ended():
    with Worker(Limits(wait=0.5), "tests.fuzz.faulty") as worker:
        assert [outcome.kind for outcome in worker.run("wait", 0, 1)] == ["time"]


def test_a_reader_that_refuses_its_own_good_file_is_an_error(faulty):
    with pytest.raises(RuntimeError, match="KeyError: 'nothing'"):
        next(faulty.run("nothing", 0, 1))


@pytest.mark.slow
def test_counts_of_several_workers():
    seen = []
    tallies = campaign({"obj": 30, "yaml-atlas": 20}, 2, done=lambda name, tally: seen.append(name))
    assert seen == ["obj", "yaml-atlas"]
    rows = {name: tally.to_json() for name, tally in tallies.items()}
    assert [rows[name]["cases"] for name in seen] == [30, 20]
    assert all(row["refused"] + row["accepted"] + row["failed"] == row["cases"] for row in rows.values())
