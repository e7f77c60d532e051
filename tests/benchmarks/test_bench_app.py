"""`python -m benchmarks`: the options of every measuring command reach its `run`, and errors are one line."""

import json
import shlex
from pathlib import Path

import pytest
from builders.bench_rows import check_command
from typer.testing import CliRunner

from benchmarks import Row, describe_environment, read_json, write_json
from benchmarks.app import _COMMANDS, app

# Words that set each option, and the argument of `run` that they give; result files name files without their folders.
OPTIONS = {
    **{name.replace("-", "_"): ([f"--{name}"], True) for name in "quick rivals-only speed table volume-only".split()},
    **{name: ([f"--no-{name}"], False) for name in ("rivals", "parts")},
    "profiles": (["--profile", "M", "--profile", "a/b.yaml"], ["M", "a/b.yaml"]),
    "profile": (["--profile", "cascade"], "cascade"),
    "rival_names": (["--rival", "bc7"], ["bc7"]),
    "keys": (["--key", "sh", "--key", "sh_noon"], ["sh", "sh_noon"]),
    "only": (["--only", "3D alone"], ["3D alone"]),
    "nearest": (["--nearest", "8", "--nearest", "40"], [8, 40]),
    "hours": (["--hour", "6.0"], [6.0]),
    "budget": (["--budget", "0.1"], 0.1),
    **{name: ([f"--{name}", "9"], 9) for name in ("many", "side", "steps")},
    **{f"{name}_path": ([f"--{name}", f"a/{name}"], Path("a", name)) for name in ("probes", "meshes", "mesh", "mask")},
    **{name: (["--set", "a/city"], Path("a/city")) for name in ("set_path", "walked_path", "scene_path")},
    "lit_path": (["--mesh", "a/b.glb"], Path("a/b.glb")),
    "lightmap_paths": (["--lightmap", "a/b.exr"], [Path("a/b.exr")]),
    "smoke_path": (["--volume", "b.vdb"], Path("b.vdb")),
    "networks": (["--network", "a/young.safetensors"], [Path("a/young.safetensors")]),
    "baseline_path": (["--baseline", "a/old.json"], Path("a/old.json")),
    "plot_path": (["--plot", "a/b.png"], Path("a/b.png")),
    "device": (["--device", "cpu"], "cpu"),
}


def call(*words, code=0) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == code, result.output
    return result.output


@pytest.mark.parametrize("name", _COMMANDS)
def test_options_reach_the_run_and_the_result_file(name, given_rows, tmp_path, monkeypatch):
    """All options of a command at once, and those alone that are always stated."""
    every = _COMMANDS[name][1]
    for given in (every, [option for option in every if option in ("scene_path", "profile")]):
        words = [name, *(word for option in given for word in OPTIONS[option][0])]
        stated, options = check_command(monkeypatch, given_rows, words, tmp_path)
        plain = [word if word.startswith("-") else Path(word).name for word in words]
        assert shlex.split(stated) == ["python", "-m", "benchmarks", *plain, *["--device", "cpu"] * (given != every)]
        assert {option: OPTIONS[option][1] for option in given}.items() <= options.items()
        left = [option for option in every if option not in given and option != "device"]
        assert all(options[option] in (None, option in ("rivals", "parts")) for option in left)


def test_some_rows_replace_those_alone(given_rows, tmp_path, monkeypatch):
    path, other = tmp_path / "rows.json", Row("lightmap", "three", "BC7", "", {"psnr": 30.0})
    write_json(path, [*given_rows, other], {})
    monkeypatch.setattr("benchmarks.lightmap.run", lambda **options: [other.with_figures(psnr=1.0)])
    call("lightmap", "--rival", "bc7", "--json", path)
    assert read_json(path)[0] == [*given_rows, other.with_figures(psnr=1.0)]
    call("lightmap", "--json", path)
    assert read_json(path)[0] == [other.with_figures(psnr=1.0)]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["lightmap", "--rival", "jpeg"], "unknown method 'jpeg'"),
        (["lightmap", "--device", "tpu"], "device 'tpu'"),
        (["lightmap-ablation", "--only", "4D", "--set", "absent"], "--only: expected one of hybrid, 2D alone"),
        (["probe", "--volume-only", "--table"], "--volume-only: cannot be combined with"),
        (["probe", "--nearest", "8"], "--only, --nearest: expected --table beside them"),
        (["probe", "--probes", "absent.npz"], "No such file"),
        (["atlas", "--meshes", "absent"], "absent: no such folder"),
        (["atlas-scene"], "--set"),
        (["atlas-ablation", "--profile", "standard"], "--profile: expected a profile of method cascade"),
        (["report", "absent.json"], "absent.json"),
        (["plot", "absent.json", "--system", "sound", "-o", "a.png"], "--system: expected lightmap"),
    ],
    ids=lambda value: " ".join(value)[:40] if isinstance(value, list) else "",
)
def test_errors_are_one_line(words, line):
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 2 and line in result.stderr
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") <= 1


def test_report_makes_pages(tmp_path):
    file, index = tmp_path / "here.json", tmp_path / "index.md"
    row = Row("lightmap", "city", "ours", "M", {"bytes": 1.0, "psnr": 45.98})
    write_json(file, [row], describe_environment("cpu", "python -m benchmarks"))
    text = call("report", file)
    assert "`here.json`" in text and "| 45.98 |" in text
    call("report", file, "-o", index)
    assert "index/lightmap.md" in index.read_text(encoding="utf-8")
    assert "| 45.98 |" in (tmp_path / "index" / "lightmap.md").read_text(encoding="utf-8")
    assert "ends in" in call("report", file, "-o", tmp_path / "index.txt", code=2)


def test_outputs_are_checked_before_the_work(tmp_path):
    (tmp_path / "mine.json").write_text(json.dumps({}))
    assert "not a result file" in call("smoke", "--json", tmp_path / "mine.json", code=2)
