"""`python -m benchmarks`: the options of every measuring command reach its `run`, and errors are one line."""

import json
from pathlib import Path

import pytest
from builders.bench_rows import check_command
from typer.testing import CliRunner

from benchmarks import Row, describe_environment, read_json, write_json
from benchmarks.app import _COMMANDS, app

# The words of a command; the command that the result file states, where it differs; and some arguments of `run`.
COMMANDS = [
    (["lightmap", "--set", "a/city"], "lightmap --device cpu --set city", {"set_path": Path("a/city"), "quick": False}),
    (
        ["lightmap", "--quick", "--profile", "M", "--profile", "a/b.yaml", "--no-rivals"],
        "lightmap --quick --profile M --profile b.yaml --no-rivals --device cpu",
        {"profiles": ["M", "a/b.yaml"], "rivals": False, "rivals_only": False, "rival_names": None},
    ),
    (["lightmap", "--rivals-only"], "lightmap --rivals-only --device cpu", {"rivals_only": True, "rivals": True}),
    (["lightmap", "--rival", "bc7"], "lightmap --rival bc7 --device cpu", {"rival_names": ["bc7"]}),
    (
        ["lightmap-ablation", "--quick", "--set", "city", "--steps", "20", "--only", "3D alone"],
        "lightmap-ablation --quick --device cpu --set city --steps 20 --only '3D alone'",
        {"only": ["3D alone"], "steps": 20},
    ),
    (
        ["lightmap-run-time", "--set", "a/city", "--quick"],
        "lightmap-run-time --set city --quick --device cpu",
        {"walked_path": Path("a/city"), "quick": True},
    ),
    (
        ["probe", "--probes", "a/room.npz", "--key", "sh", "--key", "sh_noon"],
        "probe --device cpu --probes room.npz --key sh --key sh_noon",
        {"keys": ["sh", "sh_noon"], "quick": False, "volume_only": False, "table": False},
    ),
    (
        ["probe", "--table", "--only", "ours", "--nearest", "8", "--nearest", "40"],
        "probe --table --only ours --nearest 8 --nearest 40 --device cpu",
        {"table": True, "only": ["ours"], "nearest": [8, 40]},
    ),
    (["probe", "--mesh", "a/b.glb"], "probe --mesh b.glb --device cpu", {"lit_path": Path("a/b.glb"), "table": False}),
    (
        ["probe", "--speed", "--many", "900"],
        "probe --speed --many 900 --device cpu",
        {"speed": True, "many": 900, "probes_path": None},
    ),
    (["probe", "--volume-only"], "probe --volume-only --device cpu", {"volume_only": True}),
    (
        ["atlas", "--quick", "--meshes", "a/Cube", "--profile", "astc"],
        "atlas --quick --device cpu --meshes Cube --profile astc",
        {"meshes_path": Path("a/Cube"), "profiles": ["astc"], "rivals": True},
    ),
    (
        ["atlas-scene", "--set", "town", "--hour", "6", "--side", "48", "--quick", "--budget", "0.1", "--no-parts"],
        "atlas-scene --set town --hour 6.0 --side 48 --budget 0.1 --no-parts --quick --device cpu",
        {"scene_path": Path("town"), "hours": [6.0], "side": 48, "budget": 0.1, "parts": False},
    ),
    (
        ["atlas-ablation", "--quick", "--profile", "cascade", "--only", "ASTC", "--steps", "9"],
        "atlas-ablation --quick --profile cascade --device cpu --steps 9 --only ASTC",
        {"profile": "cascade", "only": ["ASTC"], "steps": 9},
    ),
    (
        ["kernels", "--quick", "--only", "atlas, read"],
        "kernels --quick --device cpu --only 'atlas, read'",
        {"quick": True},
    ),
    (["smoke-orders"], "smoke-orders --device cpu", {"quick": False}),
    (
        ["smoke-network", "--network", "a/young.safetensors", "--profile", "paper"],
        "smoke-network --device cpu --network young.safetensors --profile paper",
        {"networks": [Path("a/young.safetensors")], "profiles": ["paper"]},
    ),
    (["smoke-sizes", "--volume", "b.vdb"], "smoke-sizes --volume b.vdb --device cpu", {"smoke_path": Path("b.vdb")}),
    (["kernels-profile", "--only", "rasterize"], "kernels-profile --device cpu --only rasterize", {}),
    (["ops", "--only", "plane"], "ops --device cpu --only plane", {"only": ["plane"]}),
    *(
        ([name, "--quick"], f"{name} --quick --device cpu", {"quick": True})
        for name in ("shader-speed", "scene", "lightmap-file", "smoke", "growth", "fluid-gradients")
    ),
]


def call(*words, code=0) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == code, result.output
    return result.output


@pytest.mark.parametrize(("words", "command", "arguments"), COMMANDS, ids=lambda value: " ".join(value)[:40])
def test_options_reach_the_run_and_the_result_file(words, command, arguments, given_rows, tmp_path, monkeypatch):
    stated, options = check_command(monkeypatch, given_rows, words, tmp_path)
    assert stated == f"python -m benchmarks {command}"
    assert options["device"] == "cpu" and arguments.items() <= options.items()


def test_every_command_is_tested():
    assert {words[0] for words, *_ in COMMANDS} == _COMMANDS.keys()


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
