import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from builders.running import call, check_a_stop_is_resumed, fails
from builders.small_sets import HOURS, moving_light, tiny_profile
from PIL import Image

import wlm
from wlm.cli.console import COMPILING
from wlm.formats.exr import read_exr, write_exr
from wlm.lightmap import codec

ROOT = Path(__file__).resolve().parents[2]


def spawn(*words, code="from wlm.cli import main\nmain()", **options):
    """Starts a command as a process of its own."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": environment}
    return subprocess.Popen([sys.executable, "-c", code, *map(str, words)], **pipes | options)


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """A set of five times as a plain folder, and a profile of few steps."""
    folder = tmp_path_factory.mktemp("set")
    for hour, frame in zip(HOURS, moving_light(40, 24).light.frames, strict=True):
        write_exr(folder / f"light_{hour:g}h.exr", frame)
    return folder


@pytest.fixture(scope="session")
def profile(tmp_path_factory):
    path = tmp_path_factory.mktemp("profile") / "tiny.yaml"
    path.write_text(yaml.safe_dump(tiny_profile().model_dump(mode="json")))
    return path


@pytest.fixture(scope="session")
def fitted(folder, profile, tmp_path_factory):
    path = tmp_path_factory.mktemp("fitted") / "a.wlm"
    call("compress", folder, "-o", path, "--profile", profile, "--period", 24)
    return path


def test_the_version_is_quick_to_tell():
    assert call("--version") == f"wlm {wlm.__version__}\n"
    # Neither torch nor Warp nor NumPy is imported for it: they take seconds.
    code = (
        "import sys\nfrom wlm.cli import main\nsys.argv = ['wlm', '--version']\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code\n"
        "sys.exit(', '.join({'torch', 'warp', 'numpy', 'pydantic'} & set(sys.modules)) or None)"
    )
    done = subprocess.run([sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": str(ROOT)}, check=False)
    assert done.returncode == 0


def test_a_run_that_compiles_kernels_says_so_once(tmp_path):
    text = "import warp as wp\nfrom wlm.cli.console import quiet_warp\nquiet_warp()\n"
    for n in (1, 2):
        text += f"@wp.kernel(module='unique')\ndef k{n}(a: wp.array(dtype=float)):\n    a[0] = float({n})\n"
        text += f"wp.launch(k{n}, 1, [wp.zeros(1, dtype=float, device='cpu')], device='cpu')\n"
    (tmp_path / "script.py").write_text(text)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "WARP_CACHE_PATH": str(tmp_path / "cache")}
    for said in (f"{COMPILING}\n", ""):
        run = spawn(code="import runpy\nrunpy.run_path('script.py')", env=environment, cwd=tmp_path)
        assert run.communicate() == ("", said)


def test_compress_prints_one_table(folder, profile, tmp_path):
    out = tmp_path / "a.wlm"
    text = call("compress", folder, "-o", out, "--profile", profile, "--steps", 10, "--seed", 4)
    assert f"{out.stat().st_size:,}" in text and "0/light RGB" in text and "1 dynamic" in text
    assert re.search(r"fit: 10 of 10, loss [\d.]+, PSNR -?[\d.]+ dB", call.stderr)
    model = wlm.load(out)
    assert (model.profile.steps, model.profile.samples, model.period) == (10, 128, 24.0)
    assert [path.name for path in tmp_path.iterdir()] == ["a.wlm"], "no checkpoint is left"


def test_the_options_of_compress_reach_the_fit(folder, profile, tmp_path):
    out = tmp_path / "a.wlm"
    mask = np.zeros((40, 24), np.uint8)
    mask[:9] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    options = ["--times", "0:10:2", "--mask", tmp_path / "mask.png", "--period", 12]
    options += ["--steps", 12, "--samples", 256]
    call("compress", folder, "-o", out, "--profile", profile, *options)
    model = wlm.load(out)
    assert model.times.tolist() == [0, 2, 4, 6, 8] and model.period == 12
    assert (model.profile.steps, model.profile.samples) == (12, 256)
    again = wlm.lightmap.load(folder, times=[0, 2, 4, 6, 8], mask=tmp_path / "mask.png", period=12)
    assert model.source == again.source
    # The seed of the command is the seed of the fit.
    for seed, same in ((0, True), (1, False)):
        other = tmp_path / "b.wlm"
        call("compress", folder, "-o", other, "--profile", profile, *options, "--seed", seed)
        assert (other.read_bytes() == out.read_bytes()) is same


def test_warnings_of_the_set_are_shown(folder, profile, tmp_path):
    write_exr(tmp_path / "light_0h.exr", np.full((8, 8, 3), -1.0, np.float32))
    write_exr(tmp_path / "light_1h.exr", np.ones((8, 8, 3), np.float32))
    call("compress", tmp_path, "-o", tmp_path / "a.wlm", "--profile", profile)
    assert "warning: light_0h.exr: 64 texels negative: clamped to 0" in call.stderr


def test_decode_writes_the_frame(fitted, tmp_path):
    text = call("decode", fitted, "--time", 18.5, "-o", tmp_path / "f.exr")
    assert "18.5" in text and "24x40" in text
    decoder = wlm.load(fitted).decoder()
    np.testing.assert_allclose(read_exr(tmp_path / "f.exr")[0], decoder.frame(18.5), rtol=1e-3, atol=1e-6)


def test_evaluate_prints_and_writes_the_report(fitted, folder, tmp_path):
    words = ["evaluate", fitted, folder, "--json", tmp_path / "r.json", "--period", 24]
    text = call(*words)
    report = wlm.lightmap.evaluate(wlm.load(fitted), wlm.lightmap.load(folder, period=24.0))
    stored = json.loads((tmp_path / "r.json").read_text())
    assert {**stored, "seconds": 0} == {**report.to_json(), "seconds": 0}
    assert f"{report.psnr:.2f}" in text and f"{report.bpp:.3f}" in text
    for hour, psnr in zip(HOURS, report.light.psnr_by_time, strict=True):
        assert re.search(rf"time {hour:g} .*{psnr:.2f}", text)
    assert all(f"worst PSNR{each}:" in call.stderr for each in ("", ", filtered read", ", between stored times"))
    scores = text.split("where light is shown")[1]
    assert f"{report.light.seen:.2f}" in scores and f"{report.light.between:.2f}" in scores
    # There are no gaps, one tile and no mesh.
    assert not any(title in scores for title in ("beside charts", "tile borders", "views"))


def test_info_says_what_is_in_the_file(fitted):
    facts = json.loads(call("info", fitted, "--json"))
    assert facts["bytes_on_disk"] == fitted.stat().st_size == sum(facts["parts"].values())
    assert facts["times"] == list(HOURS) and facts["period"] == 24.0
    (sheet,) = facts["sheets"]
    assert sheet["tiles"] == {"dynamic": 1} and (sheet["width"], sheet["height"]) == (24, 40)
    assert facts["profile"]["name"] == "tiny"
    text = call("info", fitted)
    assert f"{facts['bytes_on_disk']:,}" in text and facts["source"] in text and "24x40" in text
    assert facts["device"] == "cpu" and facts["bytes_on_device"] == wlm.load(fitted).decoder().device_bytes
    assert facts["GPU_bytes"] == wlm.load(fitted).memory_bytes
    assert "device 'tpu'" in fails("info", fitted, "--device", "tpu")


def test_export_lists_what_it_wrote(fitted, tmp_path):
    out = ["export", fitted, "-o", tmp_path / "out"]
    text = call(*out)
    files = list((tmp_path / "out").iterdir())
    assert files and all(file.name in text for file in files)
    assert "lightmap.hlsl" in call(*out, "--shader", "hlsl")
    assert "lightmap.wgsl" in call(*out, "--shader", "wgsl", "--exact")
    assert not (tmp_path / "out" / "lightmap.hlsl").exists()
    assert "lightmap.js" in call("export", fitted, "-o", tmp_path / "three", "--engine", "three")
    assert "--shader: has no meaning with --engine unity" in fails(*out, "--engine", "unity", "--shader", "hlsl")
    assert "--exact: has no meaning with --engine godot" in fails(*out, "--engine", "godot", "--exact")
    assert "device 'tpu'" in fails("export", fitted, "-o", tmp_path / "none", "--device", "tpu")
    assert not (tmp_path / "none").exists()


def test_names_that_look_like_markup_are_shown_as_they_are(fitted, tmp_path):
    odd = tmp_path / "[red]a[b].wlm"
    odd.write_bytes(fitted.read_bytes())
    assert "[red]a[b].wlm" in call("info", odd).replace("\n", "")


def test_a_set_that_names_files_elsewhere_needs_trust(folder, fitted, tmp_path):
    entries = [{"time_hours": hour, "file": str(folder / f"light_{hour:g}h.exr")} for hour in HOURS]
    path = tmp_path / "set.json"
    path.write_text(json.dumps({"width": 24, "height": 40, "period_hours": 24, "lightmaps": entries}))
    assert "lightmaps.0.file: expected a file within" in fails("evaluate", fitted, path)
    assert "PSNR" in call("evaluate", fitted, path, "--trust")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["compress", "absent", "-o", "{tmp}/a.wlm"], "absent: no such file or folder"),
        (["compress", "{set}", "-o", "{tmp}/absent/a.wlm"], "does not exist"),
        (["compress", "{set}", "-o", "{set}/light_0h.exr"], "ends in .wlm"),
        (["compress", "{set}"], "--output"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--steps", "9"], "--steps: expected"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--times", "noon"], "expected a number or start"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--profile", "XXL"], "profile 'XXL'"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--device", "cuda:9"], "device 'cuda:9'"),
        (["decode", "{fit}", "--time", "nan", "-o", "{tmp}/f.exr"], "time: expected a finite number"),
        (["decode", "{fit}", "--time", "1", "-o", "{tmp}/f.png"], "ends in .exr"),
        (["decode", "{set}/light_0h.exr", "--time", "1", "-o", "{tmp}/f.exr"], "expected an artifact"),
        (["evaluate", "{fit}", "{set}", "--json", "{tmp}"], "ends in .json"),
        (["info", "{tmp}"], "expected a file, found a folder"),
        (["info"], "Missing argument"),
        (["frobnicate"], "frobnicate"),
    ],
    ids=lambda value: "-".join(value[:1] + value[-2:]).replace("/", "_") if isinstance(value, list) else "",
)
def test_bad_input_is_one_line_and_exit_code_2(words, says, folder, fitted, tmp_path):
    places = {"set": folder, "fit": fitted, "tmp": tmp_path}
    assert says in fails(*(word.format(**places) for word in words))
    assert not list(tmp_path.iterdir()), "nothing is left behind"


def test_an_unknown_exception_is_a_bug_and_shows(fitted, monkeypatch):
    def broken(artifact):
        raise ZeroDivisionError

    monkeypatch.setattr(codec, "decode", broken)
    with pytest.raises(ZeroDivisionError):
        call("info", fitted)


def test_a_ctrl_c_is_kept_and_resumed_to_the_same_bytes(folder, profile, tmp_path, monkeypatch):
    words = ["compress", folder, "--profile", profile, "--steps", 40]
    check_a_stop_is_resumed(monkeypatch, tmp_path, words)


def test_a_closed_pipe_is_no_traceback():
    read, write = os.pipe()
    os.close(read)
    code = (
        "from wlm.cli import app, console, main\n@app.command()\ndef work():\n    console.show_json({})\n"
        "import sys\nsys.argv = ['wlm', 'work']\nmain()"
    )
    with spawn(code=code, stdout=write) as process:
        os.close(write)
        _, errors = process.communicate()
    assert process.returncode == 1 and errors == ""
