"""`python -m benchmarks`: reports as pages, and checks of outputs before the work."""

import json

from typer.testing import CliRunner

from benchmarks import Row, describe_environment, write_json
from benchmarks.app import app


def call(*words, code=0) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == code, result.output
    return result.output


def test_report_makes_pages(tmp_path):
    file, index = tmp_path / "here.json", tmp_path / "index.md"
    row = Row("lightmap", "city", "ours", "M", {"psnr": 45.98})
    write_json(file, [row], describe_environment("cpu", "python -m benchmarks"))
    text = call("report", file)
    assert "`here.json`" in text and "| 45.98 |" in text
    call("report", file, "-o", index)
    assert "index/lightmap.md" in index.read_text(encoding="utf-8")
    assert "| 45.98 |" in (tmp_path / "index" / "lightmap.md").read_text(encoding="utf-8")
    assert "ends in" in call("report", file, "-o", tmp_path / "index.txt", code=2)
    assert "absent.json" in call("report", tmp_path / "absent.json", code=2)


def test_outputs_are_checked_before_the_work(tmp_path):
    (tmp_path / "mine.json").write_text(json.dumps({}))
    assert "not a result file" in call("smoke", "--json", tmp_path / "mine.json", code=2)
