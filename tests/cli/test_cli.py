import json
import os
import re
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from builders.contest_sets import write_contest
from builders.running import call, check_a_stop_is_resumed, fails
from builders.small_sets import HOURS, moving_light, tiny_profile
from PIL import Image

import wlm
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
    for hour, frame in zip(HOURS, moving_light(40, 24).frames, strict=True):
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
    call("lightmap", "compress", folder, "-o", path, "--profile", profile, "--period", 24)
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


def test_help_lists_the_commands():
    systems = {
        "lightmap": "compress decode evaluate info export",
        "atlas": "compress decode evaluate info export",
        "probe": "compress decode evaluate info export walk",
        "smoke": "simulate guide bake shade flipbook",
    }
    assert {*systems, "doctor"} <= set(call().split())
    for system, commands in systems.items():
        assert set(commands.split()) <= set(call(system, "--help").split())


def test_doctor_names_the_devices_and_the_cache():
    text = call("doctor")
    for word in ("python", "warp", "torch", "cpu", "extra", "kernel cache"):
        assert word in text
    assert call.stderr == ""


def test_doctor_says_which_extra_lacks_what(monkeypatch):
    stated = ["numpy", "typer; extra == 'one'", 'no-such-package>=2; extra == "two"']
    monkeypatch.setattr("importlib.metadata.requires", lambda name: stated)
    text = call("doctor")
    assert re.search(r"extra one +│ complete", text)
    assert "missing: no-such-package; pip install 'wlm[two]'" in text


def test_compress_prints_one_table(folder, profile, tmp_path):
    out = tmp_path / "a.wlm"
    text = call("lightmap", "compress", folder, "-o", out, "--profile", profile, "--steps", 10, "--seed", 4)
    size = out.stat().st_size
    assert f"{size:,}" in text and f"{size * 8 / (40 * 24 * 5):.3f}" in text
    assert re.search(r"fit: 10 of 10, loss [\d.]+, PSNR -?[\d.]+ dB", call.stderr)
    model = wlm.load(out)
    assert (model.profile.steps, model.profile.samples, model.period) == (10, 128, None)
    assert [path.name for path in tmp_path.iterdir()] == ["a.wlm"], "no checkpoint is left"


def test_the_options_of_compress_reach_the_fit(folder, profile, tmp_path):
    out = tmp_path / "a.wlm"
    mask = np.zeros((40, 24), np.uint8)
    mask[:9] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    options = ["--times", "0:10:2", "--mask", tmp_path / "mask.png", "--period", 12, "--tiles", "0"]
    options += ["--steps", 12, "--samples", 256]
    call("lightmap", "compress", folder, "-o", out, "--profile", profile, *options)
    model = wlm.load(out)
    assert model.times.tolist() == [0, 2, 4, 6, 8] and model.period == 12
    assert (model.profile.steps, model.profile.samples) == (12, 256)
    again = wlm.lightmap.load(folder, times=[0, 2, 4, 6, 8], mask=tmp_path / "mask.png", period=12)
    assert model.source == again.source
    # The seed of the command is the seed of the fit.
    for seed, same in ((0, True), (1, False)):
        other = tmp_path / "b.wlm"
        call("lightmap", "compress", folder, "-o", other, "--profile", profile, *options, "--seed", seed)
        assert (other.read_bytes() == out.read_bytes()) is same


def test_warnings_of_the_set_are_shown(folder, profile, tmp_path):
    write_exr(tmp_path / "light_0h.exr", np.full((8, 8, 3), -1.0, np.float32))
    write_exr(tmp_path / "light_1h.exr", np.ones((8, 8, 3), np.float32))
    call("lightmap", "compress", tmp_path, "-o", tmp_path / "a.wlm", "--profile", profile)
    assert "warning: light_0h.exr: 64 texels negative: clamped to 0" in call.stderr


def test_decode_writes_the_frame(fitted, tmp_path):
    words = ["-o", tmp_path / "f.exr", "--eight-bit", tmp_path / "f.png"]
    text = call("lightmap", "decode", fitted, "--time", 18.5, *words)
    assert "18.5" in text and "24x40" in text
    decoder = wlm.load(fitted).decoder()
    np.testing.assert_allclose(read_exr(tmp_path / "f.exr")[0], decoder.frame(18.5), rtol=1e-3, atol=1e-6)
    with Image.open(tmp_path / "f.png") as image:
        np.testing.assert_array_equal(np.asarray(image), decoder.frame_8bit(18.5)[0])
        about = json.loads(image.text["wlm"])
    assert about["gamma"] == 2.2
    np.testing.assert_allclose(about["bounds"], decoder.frame_8bit(18.5)[1])


def test_evaluate_prints_and_writes_the_report(fitted, folder, tmp_path):
    words = ["lightmap", "evaluate", fitted, folder, "--json", tmp_path / "r.json", "--period", 24]
    text = call(*words)
    report = wlm.lightmap.evaluate(wlm.load(fitted), wlm.lightmap.load(folder, period=24.0))
    stored = json.loads((tmp_path / "r.json").read_text())
    assert {**stored, "seconds": 0} == {**report.to_json(), "seconds": 0}
    assert f"{report.psnr:.2f}" in text and f"{report.bpp:.3f}" in text and "tile 0" in text
    for hour, psnr in zip(HOURS, report.psnr_by_time, strict=True):
        assert re.search(rf"time {hour:g} .*{psnr:.2f}", text)
    assert "worst:" in call.stderr and "worst seen:" in call.stderr and "worst between times:" in call.stderr
    scores = text.split("as it is seen")[1]
    assert f"{report.seen:.2f}" in scores and f"{report.between:.2f}" in scores
    # No gaps, one tile and no mesh.
    assert not any(title in scores for title in ("ring", "border", "views"))


def test_evaluate_adds_a_contests_score_of_a_contests_map(profile, tmp_path):
    contest = write_contest(tmp_path)
    out, report = tmp_path / "17.wlm", tmp_path / "r.json"
    assert "1 (6x4), 17 (20x300)" in fails("lightmap", "compress", contest, "-o", out, "--profile", profile)
    call("lightmap", "compress", contest, "--map", 17, "-o", out, "--profile", profile)
    words = ["lightmap", "evaluate", out, contest, "--map", 17, "--json", report]
    text = call(*words, "--score", "hprc")
    score = json.loads(report.read_text())["hprc"]
    assert score["device"] == "cpu" and score["times"] == 3 and score["most"] == 60.0
    assert score["total"] == pytest.approx(sum(score["points"].values()))
    assert f"{score['total']:.2f}" in text.split("hprc")[1]
    assert "LPIPS (10)" in call.stderr and "on cpu" in call.stderr
    assert "hprc" not in call(*words) and "hprc" not in json.loads(report.read_text())


def test_info_says_what_is_in_the_file(fitted):
    facts = json.loads(call("lightmap", "info", fitted, "--json"))
    assert facts["bytes"] == fitted.stat().st_size == sum(facts["parts"].values())
    assert facts["times"] == list(HOURS) and facts["period"] == 24.0
    assert sum(facts["tiles"].values()) == facts["tiles"]["dynamic"] == 1 and list(facts["tiles"])[-1] == "levels"
    assert facts["profile"]["name"] == "tiny"
    text = call("lightmap", "info", fitted)
    assert f"{facts['bytes']:,}" in text and facts["source"] in text and "24x40" in text
    (tile,) = json.loads(call("lightmap", "info", fitted, "--tiles", "--json"))["each_tile"]
    assert tile["kind"] == "dynamic" and 0 < tile["bytes"] < facts["bytes"] and "each_tile" not in facts
    assert tile["why"].split(",")[0] in " ".join(call("lightmap", "info", fitted, "--tiles").split())
    # The maps as stored, the network in float32.
    model = wlm.load(fitted)
    stored = sum(getattr(model, part).nbytes for part in ("uv", "uvt", "ut", "vt")) + 2 * model.net.nbytes
    assert facts["device"] == "cpu" and facts["device_bytes"] == stored
    assert "device 'tpu'" in fails("lightmap", "info", fitted, "--device", "tpu")


def test_export_lists_what_it_wrote(fitted, tmp_path):
    text = call("lightmap", "export", fitted, "-o", tmp_path / "out")
    files = list((tmp_path / "out").iterdir())
    assert files and all(file.name in text for file in files)
    call("lightmap", "decode", fitted, "--time", str(HOURS[0]), "-o", tmp_path / "same.exr")
    np.testing.assert_allclose(
        read_exr(tmp_path / "out" / "frame.exr")[0], read_exr(tmp_path / "same.exr")[0], rtol=2**-10, atol=1e-6
    )
    call("lightmap", "export", fitted, "-o", tmp_path / "out", "--device", "cpu")  # over an earlier one
    assert "device 'tpu'" in fails("lightmap", "export", fitted, "-o", tmp_path / "none", "--device", "tpu")
    assert not (tmp_path / "none").exists()


def test_export_for_an_engine_and_in_a_language(fitted, tmp_path):
    out = ["lightmap", "export", fitted, "-o", tmp_path / "out"]
    assert "decode.hlsl" in call(*out, "--shader", "hlsl")
    assert "decode.wgsl" in call(*out, "--shader", "wgsl", "--exact")
    assert not (tmp_path / "out" / "decode.hlsl").exists()
    assert "lightmap.js" in call("lightmap", "export", fitted, "-o", tmp_path / "three", "--engine", "three")
    assert "found other files" in fails(*out, "--engine", "three")
    text = (tmp_path / "out" / "decode.wgsl").read_text()
    assert "textureSampleLevel" not in text and "fn wlm_radiance(texel: vec2i) -> vec3f" in text
    assert "--shader: means nothing with --engine unity" in fails(*out, "--engine", "unity", "--shader", "hlsl")
    assert "--exact: means nothing with --engine godot" in fails(*out, "--engine", "godot", "--exact")
    assert "--device: means nothing with --engine three" in fails(*out, "--engine", "three", "--device", "cuda")


def test_names_that_look_like_markup_are_shown_as_they_are(fitted, tmp_path):
    odd = tmp_path / "[red]a[b].wlm"
    odd.write_bytes(fitted.read_bytes())
    assert "[red]a[b].wlm" in call("lightmap", "info", odd).replace("\n", "")


def test_a_set_that_names_files_elsewhere_needs_trust(folder, fitted, tmp_path):
    entries = [{"time_hours": hour, "file": str(folder / f"light_{hour:g}h.exr")} for hour in HOURS]
    path = tmp_path / "set.json"
    path.write_text(json.dumps({"width": 24, "height": 40, "period_hours": 24, "lightmaps": entries}))
    assert "lightmaps[0].file: expected a file within" in fails("lightmap", "evaluate", fitted, path)
    assert "PSNR" in call("lightmap", "evaluate", fitted, path, "--trust")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["compress", "absent", "-o", "{tmp}/a.wlm"], "absent: no such file or folder"),
        (["compress", "{set}", "-o", "{tmp}/absent/a.wlm"], "does not exist"),
        (["compress", "{set}", "-o", "{set}/light_0h.exr"], "ends in .wlm"),
        (["compress", "{set}"], "--output"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--steps", "9"], "--steps: expected"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--steps", "many"], "'--steps'"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--samples", "100"], "--samples: expected"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--seed", "-1"], "--seed"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--tiles", "0-9"], "tile 9 is out of range"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--tiles", "x"], "expected a number or first-last"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--times", "1,2"], "2 times for 5"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--times", "noon"], "expected a number or start"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--mask", "absent.png"], "absent.png"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--period", "nan"], "period"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--profile", "XXL"], "profile 'XXL'"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--profile", "{tmp}/x.yaml"], "x.yaml"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--device", "cuda:9"], "device 'cuda:9'"),
        (["compress", "{set}", "-o", "{tmp}/a.wlm", "--colour"], "--colour"),
        (["decode", "{fit}", "--time", "nan", "-o", "{tmp}/f.exr"], "time: expected a finite number"),
        (["decode", "{fit}", "--time", "1", "-o", "{tmp}/f.png"], "ends in .exr"),
        (["decode", "{set}/light_0h.exr", "--time", "1", "-o", "{tmp}/f.exr"], "expected an artifact"),
        (["decode", "absent.wlm", "--time", "1", "-o", "{tmp}/f.exr"], "absent.wlm"),
        (["evaluate", "{fit}", "{set}", "--times", "1,2,3,4,5"], "time 0 is 1"),
        (["evaluate", "{fit}", "{set}", "--json", "{tmp}"], "ends in .json"),
        (["info", "{tmp}"], "expected a file, found a folder"),
        (["info"], "Missing argument"),
        (["frobnicate"], "frobnicate"),
        ([], "Missing command"),
    ],
    ids=lambda value: "-".join(value[:1] + value[-2:]).replace("/", "_") if isinstance(value, list) else "",
)
def test_bad_input_is_one_line_and_exit_code_2(words, says, folder, fitted, tmp_path):
    places = {"set": folder, "fit": fitted, "tmp": tmp_path}
    assert says in fails("lightmap", *(word.format(**places) for word in words))
    assert not list(tmp_path.iterdir()), "nothing is left behind"


def test_an_unknown_exception_is_a_bug_and_shows(fitted, monkeypatch):
    def broken(artifact):
        raise ZeroDivisionError

    monkeypatch.setattr(codec, "decode", broken)
    with pytest.raises(ZeroDivisionError):
        call("lightmap", "info", fitted)


def test_a_full_disk_is_one_line_and_keeps_what_was_there(fitted, folder, profile, tmp_path):
    out, report = tmp_path / "a.wlm", tmp_path / "r.json"
    for path in (out, report):
        path.write_bytes(b"old")
    # Its kernels too are files, of Warp's cache: they have to be there before.
    call("lightmap", "evaluate", fitted, folder)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200, limits[1]))
    try:
        call("lightmap", "compress", folder, "-o", out, "--profile", profile, code=2)
        assert re.search(r"^error: .+a\.wlm\.partial: cannot write: ", call.stderr.splitlines()[-1])
        call("lightmap", "evaluate", fitted, folder, "--json", report, code=2)
        assert re.search(r"^error: .+r\.json: cannot write: ", call.stderr.splitlines()[-1])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.wlm", "r.json"]
    assert out.read_bytes() == report.read_bytes() == b"old"


def test_a_ctrl_c_is_kept_and_resumed_to_the_same_bytes(folder, profile, tmp_path, monkeypatch):
    words = ["lightmap", "compress", folder, "--profile", profile, "--steps", 40]
    check_a_stop_is_resumed(monkeypatch, tmp_path, words)


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow)]
)
def test_a_signal_keeps_the_fit(number, code, folder, profile, tmp_path):
    # Ten thousand times more steps than can be done before the signal comes.
    words = ["lightmap", "compress", folder, "--profile", profile, "--steps", 3_000_000]
    program = (
        "import sys\nfrom wlm.cli import main\nfrom wlm.cli import console\n"
        "console._PLAIN_REPORTS = 10**7\nmain()\n"  # a line at every report
    )
    with spawn(*words, "-o", tmp_path / "a.wlm", code=program) as process:
        for line in process.stderr:
            if line.startswith("fit: "):
                process.send_signal(number)
                break
        text, errors = process.communicate()
    assert process.returncode == code and text == ""
    assert re.search(r"^stopped at step \d+: .* --resume goes on from .+a\.wlm\.partial$", errors, re.MULTILINE)
    assert "Traceback" not in errors
    assert [path.name for path in tmp_path.iterdir()] == ["a.wlm.partial"]


def test_a_damaged_checkpoint_is_one_line(folder, profile, tmp_path):
    (tmp_path / "a.wlm.partial").write_bytes(b"nonsense, and enough of it")
    line = fails("lightmap", "compress", folder, "--profile", profile, "-o", tmp_path / "a.wlm", "--resume")
    assert "a.wlm.partial" in line


def test_a_closed_pipe_is_no_traceback(fitted):
    read, write = os.pipe()
    os.close(read)
    with spawn("lightmap", "info", fitted, "--json", stdout=write) as process:
        os.close(write)
        _, errors = process.communicate()
    assert process.returncode == 1 and errors == ""


def test_bench_report_makes_pages(tmp_path):
    from benchmarks import Row, describe_environment, write_json

    file, index = tmp_path / "here.json", tmp_path / "index.md"
    row = Row("lightmap", "city", "ours", "M", {"psnr": 45.98})
    write_json(file, [row], describe_environment("cpu", "python -m benchmarks"))
    text = call("bench", "report", file)
    assert "`here.json`" in text and "| 45.98 |" in text
    call("bench", "report", file, "-o", index)
    assert "index/lightmap.md" in index.read_text(encoding="utf-8")
    assert "| 45.98 |" in (tmp_path / "index" / "lightmap.md").read_text(encoding="utf-8")
    assert "ends in" in fails("bench", "report", file, "-o", tmp_path / "index.txt")
    assert "absent.json" in fails("bench", "report", tmp_path / "absent.json")


def test_bench_checks_its_outputs_before_the_work(tmp_path):
    (tmp_path / "mine.json").write_text("{}")
    assert "ends in" in fails("bench", "lightmap", "--plot", tmp_path / "p.txt")
    assert "not a result file" in fails("bench", "smoke", "--json", tmp_path / "mine.json")
