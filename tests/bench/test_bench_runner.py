"""Rows, their files and their table."""

import json
import math
import os
import stat
from dataclasses import replace

import pytest

from wlm.bench import Row, Run, Timing, describe_environment, read_json, read_runs, run_peers, table, write_json
from wlm.errors import WlmError

FULL = Row(
    system="lightmap",
    scene="city",
    method="ours",
    option="M",
    bytes=1234567,
    bpp=0.676,
    encode_seconds=53.2,
    decode_ms=0.153,
    decode_ms_spread=0.004,
    psnr=42.5,
    ssim=0.991,
    flip=0.0173,
    max_error=2e-4,
    notes="a note",
)
BARE = Row("probe", "city", "PCA")


def test_round_trip(tmp_path):
    path = tmp_path / "results.json"
    environment = {"device": "cpu", "threads": 2, "cuda": None}
    write_json(path, [FULL, BARE], environment)
    assert read_json(path) == ([FULL, BARE], environment)
    assert os.listdir(tmp_path) == ["results.json"]  # nothing temporary is left
    assert path.read_bytes().endswith(b"\n")
    assert stat.S_ISREG(path.stat().st_mode)


def test_nan_is_written_as_null_and_infinity_refused(tmp_path):
    path = tmp_path / "results.json"
    write_json(path, [replace(FULL, ssim=math.nan)], {})
    assert read_json(path)[0] == [replace(FULL, ssim=None)]
    before = path.read_bytes()
    with pytest.raises(WlmError, match="ours on city: psnr is infinite"):
        write_json(path, [replace(FULL, psnr=math.inf)], {})
    with pytest.raises(WlmError, match="environment"):
        write_json(path, [FULL], {"x": math.nan})
    with pytest.raises(WlmError, match="environment"):
        write_json(path, [FULL], {"x": object()})
    assert path.read_bytes() == before  # a failed write leaves the old file
    with pytest.raises(WlmError, match="nowhere"):
        write_json(tmp_path / "nowhere" / "r.json", [FULL], {})


def test_a_run_keeps_what_other_systems_and_scenes_left(tmp_path):
    path = tmp_path / "results.json"
    write_json(path, [FULL, replace(FULL, option="H")], {"date": "1"})
    write_json(path, [BARE], {"date": "2"})
    assert read_runs(path) == [Run({"date": "1"}, [FULL, replace(FULL, option="H")]), Run({"date": "2"}, [BARE])]
    assert read_json(path) == ([FULL, replace(FULL, option="H"), BARE], {"date": "2"})
    # A run of a system replaces the one before.
    write_json(path, [replace(FULL, psnr=50.0)], {"date": "3"})
    assert read_runs(path) == [Run({"date": "2"}, [BARE]), Run({"date": "3"}, [replace(FULL, psnr=50.0)])]
    write_json(path, [FULL, BARE], {"date": "4"})
    assert read_runs(path) == [Run({"date": "4"}, [FULL, BARE])]
    # Of a run of both, the other system's rows stay with its environment.
    write_json(path, [replace(BARE, psnr=1.0)], {"date": "5"})
    assert read_runs(path) == [Run({"date": "4"}, [FULL]), Run({"date": "5"}, [replace(BARE, psnr=1.0)])]
    write_json(path, [replace(FULL, scene="another")], {"date": "6"})
    assert [run.environment["date"] for run in read_runs(path)] == ["4", "5", "6"]


def test_what_is_no_result_file_is_not_replaced(tmp_path):
    path = tmp_path / "mine.json"
    path.write_text('{"mine": 1}')
    with pytest.raises(WlmError, match="mine.json: not a result file"):
        write_json(path, [FULL], {})
    assert path.read_text() == '{"mine": 1}'


def first_version(path):
    """A file of one run as the version before wrote it."""
    document = json.loads(path.read_text())
    return {"format": document["format"], "version": 1} | document["runs"][0]


def test_the_version_before_is_read_and_kept(tmp_path):
    path = tmp_path / "results.json"
    write_json(path, [FULL], {"threads": 2})
    path.write_text(json.dumps(first_version(path)))
    assert read_json(path) == ([FULL], {"threads": 2})
    write_json(path, [BARE], {})
    assert read_runs(path) == [Run({"threads": 2}, [FULL]), Run({}, [BARE])]


def change(document, **values):
    return document | values


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: change(d, format="other"), "not a result file"),
        (lambda d: [], "not a result file"),
        (lambda d: change(d, version=3), "expected version 1 or 2, got 3"),
        (lambda d: change(d, version=2), "expected a list 'runs'"),
        (lambda d: change(d, version=2, runs=[]), "expected a list 'runs'"),
        (lambda d: change(d, version=2, runs=[7]), "expected a list 'rows'"),
        (
            lambda d: change(d, version=2, runs=[{"rows": [], "environment": {}}, {"rows": [3], "environment": {}}]),
            "run 1: row 0",
        ),
        (lambda d: change(d, rows={}), "'rows'"),
        (lambda d: change(d, environment=[]), "'environment'"),
        (lambda d: change(d, rows=[3]), "row 0: expected an object"),
        (lambda d: change(d, rows=[d["rows"][0] | {"speed": 1}]), "unknown field 'speed'"),
        (lambda d: change(d, rows=d["rows"] + [{"system": "probe"}]), "row 1: field 'scene' is missing"),
        (lambda d: change(d, rows=[d["rows"][0] | {"psnr": "42"}]), "'psnr'.*got '42'"),
        (lambda d: change(d, rows=[d["rows"][0] | {"psnr": True}]), "'psnr'.*got True"),
        (lambda d: change(d, rows=[d["rows"][0] | {"bytes": 1.5}]), "'bytes'.*got 1.5"),
        (lambda d: change(d, rows=[d["rows"][0] | {"method": None}]), "'method'.*got None"),
    ],
)
def test_a_broken_file_is_named_with_its_fault(tmp_path, edit, message):
    path = tmp_path / "results.json"
    write_json(path, [FULL], {})
    path.write_text(json.dumps(edit(first_version(path))))
    with pytest.raises(WlmError, match=message) as caught:
        read_json(path)
    assert "results.json" in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe"])
def test_no_json_at_all(tmp_path, content):
    path = tmp_path / "results.json"
    path.write_bytes(content)
    with pytest.raises(WlmError, match="can't read"):
        read_json(path)
    with pytest.raises(WlmError, match="can't read"):
        read_json(tmp_path / "absent.json")


def test_environment_says_what_a_number_depends_on(tmp_path):
    import numpy
    import torch
    import warp

    environment = describe_environment("cpu", "wlm bench city")
    assert environment["numpy"] == numpy.__version__
    assert environment["torch"].split("+")[0] == torch.__version__.split("+")[0]
    assert environment["warp"] == warp.config.version
    assert environment["threads"] == torch.get_num_threads()
    assert environment["command"] == "wlm bench city"
    assert environment["device_name"]
    write_json(tmp_path / "r.json", [], environment)
    assert read_json(tmp_path / "r.json") == ([], environment)
    with pytest.raises(WlmError):
        describe_environment("cuda:77", "")


def test_peers_get_their_own_times():
    counts = [0, 0]

    def call(index):
        def run():
            counts[index] += 1

        return run

    # Equal rows must not be confused with each other.
    rows = run_peers([(BARE, call(0)), (BARE, call(1))], warmup=1, repeats=2)
    assert len(rows) == 2 and min(counts) >= 4
    for row in rows:
        assert row.decode_ms > 0.0 and row.decode_ms_spread >= 0.0
        assert replace(row, decode_ms=None, decode_ms_spread=None) == BARE


def test_with_timing():
    row = BARE.with_timing(Timing(median_ms=2.0, p10_ms=1.5, p90_ms=3.0, n=30))
    assert (row.decode_ms, row.decode_ms_spread) == (2.0, 1.5)
    assert BARE.decode_ms is None


def test_table():
    assert table([]) == ""
    text = table([replace(FULL, ssim=None, notes="a | b\nc"), replace(BARE, psnr=math.nan, bytes=7)])
    assert text == (
        "| system | scene | method | option | bytes | bpp | encode s | decode ms | p90−p10 ms "
        "| PSNR dB | FLIP | max error | notes |\n"
        "|---|---|---|---|---:|---:|---:|---:|---:|---:|---:|---:|---|\n"
        "| lightmap | city | ours | M | 1,234,567 | 0.676 | 53.2 | 0.153 | 0.004 | 42.50 | 0.0173 | 0.0002 "
        "| a \\| b c |\n"
        "| probe | city | PCA |  | 7 |  |  |  |  |  |  |  |  |\n"
    )
