"""Results beside older ones."""

from dataclasses import replace

import pytest
from builders.bench_rows import ENVIRONMENT
from typer.testing import CliRunner

from benchmarks import Row, Run, compare, describe_environment, write_json
from benchmarks.app import app

OLD = Row("lightmap", "city", "ours", "M", {"psnr": 45.0, "encode_seconds": 10.0, "bytes": 100})


def worse(new: dict, old: Row = OLD, machine: str = "a CPU") -> list[str]:
    environment = ENVIRONMENT | {"device_name": machine}
    changes = compare(Run(environment, [replace(OLD, figures=new)]), [Run(ENVIRONMENT, [old])])
    return [change.name for change in changes if change.worse]


@pytest.mark.parametrize(
    ("new", "names"),
    [
        ({"psnr": 44.96, "encode_seconds": 10.4, "bytes": 900}, []),
        ({"psnr": 44.94, "encode_seconds": 10.4}, ["psnr"]),
        ({"psnr": 46.0, "encode_seconds": 10.6}, ["encode_seconds"]),
        ({"psnr": 46.0, "encode_seconds": 1.0}, []),
        ({}, []),
    ],
)
def test_a_loss_of_decibels_or_of_time_is_worse(new, names):
    assert worse(new) == names


def test_times_of_another_machine_are_not_compared():
    assert worse({"psnr": 40.0, "encode_seconds": 99.0}, machine="another") == ["psnr"]


def test_a_time_within_the_spread_of_its_samples_is_not_worse():
    old = replace(OLD, figures={"decode_ms": 1.0, "decode_ms_spread": 0.1})
    new = {"decode_ms": 1.09, "decode_ms_spread": 0.1}
    assert worse(new, old) == []
    assert worse(new | {"decode_ms": 1.11}, old) == ["decode_ms"]


def test_only_rows_that_both_have_are_compared():
    others = [replace(OLD, option="H"), replace(OLD, scene="room"), replace(OLD, method="BC7")]
    assert compare(Run(ENVIRONMENT, [OLD]), [Run(ENVIRONMENT, others)]) == []
    changes = compare(Run(ENVIRONMENT, [OLD]), [Run(ENVIRONMENT, others), Run(ENVIRONMENT, [OLD])])
    assert [(change.name, change.old, change.new) for change in changes] == [
        ("psnr", 45.0, 45.0),
        ("encode_seconds", 10.0, 10.0),
    ]


def invoke(folder, new: Row, old: Row):
    """Runs `python -m benchmarks compare` on files of one row each."""
    environment = describe_environment("cpu", "python -m benchmarks")
    for name, row in (("new.json", new), ("old.json", old)):
        write_json(folder / name, [row], environment)
    return CliRunner().invoke(app, ["compare", str(folder / "new.json"), str(folder / "old.json")])


def test_the_command_fails_where_a_figure_is_worse(tmp_path):
    assert invoke(tmp_path, OLD, OLD).exit_code == 0
    result = invoke(tmp_path, OLD.with_figures(psnr=44.0), OLD)
    assert result.exit_code == 1
    assert "worse: city ours M: PSNR, dB: 45.00 before, 44.00 now" in result.stderr


def test_the_command_says_what_it_cannot_compare(tmp_path):
    assert "no row has the method" in invoke(tmp_path, OLD, replace(OLD, option="H")).stderr
    result = CliRunner().invoke(app, ["compare", str(tmp_path / "old.json"), str(tmp_path / "absent.json")])
    assert "absent.json" in result.stderr
