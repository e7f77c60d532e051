"""Rows, their files, tables and pages, what all benches share, how calls are timed, and the simulated growth."""

import json
import math
import os
from dataclasses import replace

import numpy as np
import pytest
from builders.bench_rows import ENVIRONMENT
from builders.checks import error_of, misuse_of

from benchmarks import Row, Run, Timing, growth, pages, read_json, read_runs, tables, time_together, timing, write_json
from benchmarks.growth import CORES, STORAGE, Costs, run, simulate
from benchmarks.runner import Bench, exact_errors
from wlm.errors import WlmError

OURS = Row("lightmap", "city", "ours", "M", {"bytes": 1234567, "bpp": 0.676, "psnr": 42.5, "max_error": 2e-4}, "a note")
BARE = Row("probe", "city", "PCA")


def test_round_trip(tmp_path):
    path = tmp_path / "results.json"
    environment = {"device": "cpu", "threads": 2, "cuda": None}
    write_json(path, [OURS, BARE], environment)
    assert read_json(path) == ([OURS, BARE], environment)
    assert os.listdir(tmp_path) == ["results.json"]  # nothing temporary is left
    assert path.read_bytes().endswith(b"\n")


def test_figures_are_known_finite_and_plain():
    row = Row(
        "l", "s", "m", figures={"psnr": np.float32(2.5), "bytes": 3, "ssim": None, "flip": math.nan, "bpp": math.inf}
    )
    assert row.figures == {"psnr": 2.5, "bytes": 3} and type(row["psnr"]) is float and type(row["bytes"]) is int
    assert row.get("ssim") is None and row.with_figures(ssim=1.0, psnr=None).figures == {"bytes": 3, "ssim": 1.0}
    assert "unknown measured quantity 'speed'" in misuse_of(row.with_figures, speed=1.0)


def test_a_run_keeps_what_other_systems_and_scenes_left(tmp_path):
    path = tmp_path / "results.json"
    write_json(path, [OURS, replace(OURS, option="H")], {"date": "1"})
    write_json(path, [BARE], {"date": "2"})
    assert read_runs(path) == [Run({"date": "1"}, [OURS, replace(OURS, option="H")]), Run({"date": "2"}, [BARE])]
    assert read_json(path) == ([OURS, replace(OURS, option="H"), BARE], {"date": "2"})
    # A run of a system replaces the one before.
    write_json(path, [OURS.with_figures(psnr=50.0)], {"date": "3"})
    assert read_runs(path) == [Run({"date": "2"}, [BARE]), Run({"date": "3"}, [OURS.with_figures(psnr=50.0)])]
    write_json(path, [OURS, BARE], {"date": "4"})
    assert read_runs(path) == [Run({"date": "4"}, [OURS, BARE])]
    # A run of some rows replaces those alone.
    better = replace(OURS, option="H").with_figures(psnr=50.0)
    write_json(path, [better], {"date": "5"}, partial=True)
    assert read_runs(path) == [Run({"date": "4"}, [OURS, BARE]), Run({"date": "5"}, [better])]
    write_json(path, [OURS, BARE], {"date": "4"})
    # Of a run of both, the other system's rows stay with its environment.
    write_json(path, [BARE.with_figures(psnr=1.0)], {"date": "5"})
    assert read_runs(path) == [Run({"date": "4"}, [OURS]), Run({"date": "5"}, [BARE.with_figures(psnr=1.0)])]
    write_json(path, [replace(OURS, scene="another")], {"date": "6"})
    assert [run.environment["date"] for run in read_runs(path)] == ["4", "5", "6"]


def rows(*changes):
    """The document with its one row changed, and maybe more of them."""
    return lambda d: (
        d | {"runs": [d["runs"][0] | {"rows": [{**d["runs"][0]["rows"][0], **change} for change in changes]}]}
    )


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d | {"format": "other"}, "not a result file"),
        (lambda d: b"\xff\xfe", "cannot read|not valid JSON"),
        (lambda d: d | {"version": 2}, "version: expected 3, got 2: files of another version .* measured again"),
        (lambda d: d | {"runs": [7]}, "run 0: expected a list 'rows'"),
        (lambda d: d | {"runs": [*d["runs"], {"rows": [3], "environment": {}}]}, "run 1: row 0: expected an object"),
        (rows({}, {"speed": 1}), "row 1: unknown field 'speed'"),
        (rows({"method": None}), "row 0: field 'method': expected str, got None"),
        (rows({"figures": {"psnr": "42"}}), "quantity 'psnr': expected a number, got '42'"),
        (rows({"figures": {"speed": 1.0}}), "unknown measured quantity 'speed'"),
    ],
)
def test_a_broken_file_is_named_with_its_fault(tmp_path, edit, message):
    path = tmp_path / "results.json"
    write_json(path, [OURS], {})
    content = edit(json.loads(path.read_text()))
    path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    with pytest.raises(WlmError, match=message) as caught:
        read_json(path)
    assert "results.json" in str(caught.value)


def test_a_bench_times_its_rows_and_stores_its_fits():
    counts, said = [0, 0], []
    bench = Bench("probe", "cpu", said.append, scene="city", warmup=1, repeats=2)

    def call(index):
        def run():
            counts[index] += 1

        return run

    # Equal rows must not be confused with each other.
    row = bench.row("PCA")
    timed = bench.time_rows([(row, call(0)), (row, call(1))])
    assert row == BARE and len(timed) == 2 and min(counts) >= 4 and said == ["city: timing the decoders, in turns"]
    for row in timed:
        assert set(row.figures) == {"decode_ms", "decode_ms_spread"} and row["decode_ms"] > 0.0
    assert bench.missing_row("PCA", "half", WlmError("no room")).notes == "not measured: no room"
    assert "tpu" in error_of(Bench, "probe", "tpu")


def test_times_of_a_call_that_does_several_things():
    timing = Timing(median_ms=8.0, p10_ms=7.0, p90_ms=9.0, n=3)
    assert BARE.with_timing(timing, "time_ms", 4).figures == {"time_ms": 2.0, "time_ms_spread": 0.5}
    assert BARE.with_timing(replace(timing, n=1)).figures == {"decode_ms": 8.0}  # one sample has no spread


def test_errors_against_float64():
    exact = np.zeros((2000, 2))
    decoded = np.full((2000, 2), 0.25)
    decoded[7] = 3.0
    assert exact_errors(decoded, exact) == {"max_error": 3.0, "error_999": 0.25}


def test_a_wide_table_is_parted_and_has_footnotes():
    plain = replace(OURS.with_figures(decode_ms=0.5), notes="")
    wide = [OURS.with_figures(encode_seconds=2.0), replace(plain, method="strip"), replace(OURS, notes="words " * 30)]
    assert tables(wide) == (
        "#### city\n\n"
        "Size and error:\n\n"
        "|  |  | size, bytes | size, bpp | PSNR, dB | largest error | note |\n"
        "| --- | --- | ---: | ---: | ---: | ---: | --- |\n"
        "| ours | M | 1,234,567 | 0.676 | 42.50 | 0.0002 | 1 |\n"
        "| strip | M | 1,234,567 | 0.676 | 42.50 | 0.0002 |  |\n"
        "| ours | M | 1,234,567 | 0.676 | 42.50 | 0.0002 | 2 |\n"
        "\nTime:\n\n"
        "|  |  | encode, s | decode time, ms | note |\n"
        "| --- | --- | ---: | ---: | --- |\n"
        "| ours | M | 2 |  | 1 |\n"
        "| strip | M |  | 0.5 |  |\n"
        "\n1. a note\n"
        f"2. {'words ' * 30}\n"
    )


def test_pages_by_system(tmp_path, monkeypatch):
    """A page has the row of a method and option that has most figures, and the command that measured it."""
    monkeypatch.chdir(tmp_path)
    write_json("a.json", [OURS], ENVIRONMENT)
    scene = "plume, 128³, 256² pixels"
    frame = Row("smoke-network", scene, "coarse march", "step 2", {"psnr": 50.0, "time_ms": 1.0})
    write_json("a.json", [frame, replace(frame, scene="another")], ENVIRONMENT)
    write_json("b.json", [OURS.with_figures(seen=40.0)], ENVIRONMENT | {"device_name": ""})
    made = pages(["a.json", "b.json"], "docs/all.md")
    assert list(made) == ["all.md", "all/lightmap.md", "all/smoke.md"]
    head = "`python -m benchmarks report a.json b.json -o docs/all.md` makes this page."
    assert all(head in page for page in made.values())
    assert "- [lightmap](all/lightmap.md)" in made["all.md"]
    lightmap = made["all/lightmap.md"]
    assert "| ours | M | b | 1,234,567 | 0.676 | 42.50 | 40.00 |" in lightmap and "| ours | M | a |" not in lightmap
    assert "- `python -m benchmarks --json b.json`: cpu, 1 threads, Python 3, Warp 1, torch 2, 2026-01-02" in lightmap
    assert "| coarse march | step 2 | a | 1 | 50.00 |" in made["all/smoke.md"] and "another" not in made["all/smoke.md"]
    write_json("c.json", [replace(OURS, option=str(i)) for i in range(90)], ENVIRONMENT)
    assert pages(["c.json"])["results/lightmap.md"].count("\n| ours") == 60


def fake_clock(monkeypatch, seconds_a_call):
    """A clock that only calls move, by name."""
    now = [0.0]
    log = []

    def make(name):
        def call():
            log.append(name)
            now[0] += seconds_a_call[name]

        return call

    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])
    return {name: make(name) for name in seconds_a_call}, log


def test_distribution_is_of_one_call(monkeypatch):
    now = [0.0]
    durations = iter([9.0, 9.0, 9.0, *(k / 1000.0 for k in (2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22))])

    def call():
        now[0] += next(durations)

    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])
    # Two calls to warm up and one to see how long a call is are not in the distribution.
    result = time_together({"": call}, warmup=2, repeats=11)[""]
    assert result.n == 11
    assert (result.median_ms, result.p10_ms, result.p90_ms) == pytest.approx((12.0, 4.0, 20.0))


def test_short_calls_are_batched_to_a_millisecond(monkeypatch):
    calls, log = fake_clock(monkeypatch, {"a": 0.0003})
    result = time_together(calls, warmup=1, repeats=3)["a"]
    assert len(log) == 1 + 1 + 3 * 4
    assert result.median_ms == pytest.approx(0.3)


def test_a_call_that_takes_no_time_ends(monkeypatch):
    calls, log = fake_clock(monkeypatch, {"a": 0.0})
    assert time_together(calls, warmup=1, repeats=1)["a"].median_ms == 0.0
    assert len(log) == 2 + 1000


def test_peers_take_turns_and_the_first_changes(monkeypatch):
    calls, log = fake_clock(monkeypatch, {"a": 0.01, "b": 0.02, "c": 0.03})
    result = time_together(calls, warmup=2, repeats=3)
    assert log[:9] == ["a"] * 3 + ["b"] * 3 + ["c"] * 3
    assert "".join(log[9:]) == "abcbcacab"
    assert {name: t.median_ms for name, t in result.items()} == pytest.approx({"a": 10, "b": 20, "c": 30})


def test_bounds():
    """Each resource alone bounds the time; GPUs halve it until the storage that all share is always busy."""
    costs = Costs(read=0.1 * STORAGE, written=0.0, core_seconds=0.5 * CORES, gpu_seconds=2.0)
    one, eight, many = (simulate(costs, gpus, 2000) for gpus in (1, 8, 64))
    assert one.seconds == pytest.approx(2000 * 2.0, rel=0.01) and one.gpus > 0.99
    assert eight.seconds == pytest.approx(one.seconds / 8, rel=0.01)
    assert many.seconds == pytest.approx(2000 * 0.1, rel=0.03) and many.storage > 0.97 and many.gpus < 0.35
    slow = simulate(Costs(0.1 * STORAGE, 0.0, 4.0 * CORES, 2.0), 8, 2000)
    assert slow.seconds == pytest.approx(2000 * 4.0 / 8, rel=0.01) and slow.cores > 0.98


def test_failures(monkeypatch: pytest.MonkeyPatch):
    """A GPU that fails repeats its lightmap, and nothing is lost or done twice."""
    monkeypatch.setattr(growth, "HOURS_TO_FAIL", 0.05)
    costs = Costs(0.001 * STORAGE, 0.0, 0.01, 2.0)
    failing = simulate(costs, 4, 1000)
    assert failing.repeated > 3
    assert failing.seconds * failing.gpus * 4 == pytest.approx(1000 * 2.0 + failing.repeated, rel=0.02)


def test_rows():
    first, *rows = run(quick=True, device="cpu")
    assert first["read_bytes"] > 1e8 and first["core_seconds"] > 0.0 and first["fit_seconds"] > 1.0
    assert [row.option for row in rows] == ["1 GPU", "8 GPUs", "64 GPUs"]
    assert rows[0]["hours"] > rows[1]["hours"] > rows[2]["hours"]
