"""Fits by several workers, interrupted fits and their checkpoints, and sets beyond memory."""

import functools
import os
import re
import signal
import subprocess
import sys
import threading
import tracemalloc
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from builders.checks import error_of
from builders.running import report_always
from builders.small_sets import moving_light, tiny_profile, write_set
from builders.worker_pools import Several

import wlm
from wlm import dispatch
from wlm.dispatch import Place
from wlm.errors import WlmError
from wlm.formats import scratch
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.formats.checkpoint import Checkpoint, Pace
from wlm.formats.parts import Part
from wlm.lightmap import fit
from wlm.lightmap.data import from_arrays, load
from wlm.lightmap.fit import open_checkpoint
from wlm.lightmap.trainer import Trainer
from wlm.workers import Processes, Threads

PROFILE = tiny_profile(steps=40)


@pytest.fixture
def lightmaps(monkeypatch):
    """Six tiles, each a batch of its own."""
    monkeypatch.setattr(fit, "CPU_TILES", 1)
    return moving_light(256, 384)


def bytes_of(model, folder):
    model.save(folder / "bytes.wlm")
    return (folder / "bytes.wlm").read_bytes()


def stop_after(step):
    def report(progress):
        if progress.done >= step:
            raise KeyboardInterrupt

    return report


def test_the_order_of_answers_and_lost_workers_change_nothing(lightmaps, tmp_path, monkeypatch):
    profile = tiny_profile(steps=20)
    whole = bytes_of(fit.compress(lightmaps, profile), tmp_path)
    checkpoint = fit.open_checkpoint(tmp_path / "a.wlm", lightmaps, profile, every=0)
    for order, lose, kept in ((1, (), None), (2, (1, 9, 20, 21), checkpoint)):
        monkeypatch.setattr(dispatch, "start_workers", functools.partial(Several, order=order, lose=lose))
        assert bytes_of(fit.compress(lightmaps, profile, workers=3, checkpoint=kept), tmp_path) == whole


def test_what_several_workers_were_at_is_resumed_by_another_number(lightmaps, tmp_path, monkeypatch):
    report_always(monkeypatch)
    whole = bytes_of(fit.compress(lightmaps, PROFILE), tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr(dispatch, "start_workers", Several)
        checkpoint = fit.open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE)
        with pytest.raises(KeyboardInterrupt):
            fit.compress(lightmaps, PROFILE, workers=3, progress=stop_after(100), checkpoint=checkpoint)
    checkpoint = fit.open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE, resume=True)
    assert sum(checkpoint.running(number) is not None for number in range(6)) > 1
    steps = []
    model = fit.compress(lightmaps, PROFILE, progress=lambda now: steps.append(now.done), checkpoint=checkpoint)
    # Steps that waiting batches were at count once their batch begins.
    assert bytes_of(model, tmp_path) == whole and steps[-1] == 240 and len(steps) <= (240 - 100) / 5


def in_threads(worker, place, tasks):
    """Workers on two GPUs, here both the CPU."""
    return Threads([worker[0](place.device, *worker[1:]) for _ in range(min(2, tasks))])


def test_threads_of_two_gpus_share_a_fit_evenly_and_one_resumes_it(lightmaps, tmp_path, monkeypatch):
    report_always(monkeypatch)
    monkeypatch.setattr(fit, "CPU_TILES", None)
    whole = bytes_of(fit.compress(lightmaps, PROFILE), tmp_path)
    checkpoint = fit.open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE)
    with monkeypatch.context() as patched:
        patched.setattr(dispatch, "start_workers", in_threads)
        patched.setattr(Place, "devices", lambda self: ["cpu", "the other"])
        patched.setattr(dispatch, "_SLICE", 0.0)
        assert bytes_of(fit.compress(lightmaps, PROFILE), tmp_path) == whole
        with pytest.raises(KeyboardInterrupt):
            fit.compress(lightmaps, PROFILE, progress=stop_after(30), checkpoint=checkpoint)
    again = fit.open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE, resume=True)
    assert again.split == 2 and any(len((again.running(number) or {"loss": ()})["loss"]) == 3 for number in (0, 1))
    assert bytes_of(fit.compress(lightmaps, PROFILE, checkpoint=again), tmp_path) == whole
    settings = read_artifact(again.path).settings | {"split": -1}
    write_artifact(again.path, again.system, settings, {}, lightmaps.source)
    with pytest.raises(WlmError, match="partial: split: expected an integer of at least 0, found -1"):
        fit.open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE, resume=True)


def test_an_error_in_one_thread_ends_all(lightmaps, monkeypatch):
    monkeypatch.setattr(dispatch, "start_workers", in_threads)
    monkeypatch.setattr(Trainer, "check", lambda trainer: exec("raise WlmError('tile 4: the fit diverged')"))
    before = threading.active_count()
    assert re.search("^tile 4: the fit diverged$", error_of(fit.compress, lightmaps, PROFILE, workers=2))
    assert threading.active_count() == before


def test_a_batch_that_no_worker_survives_is_named(lightmaps, monkeypatch):
    monkeypatch.setattr(dispatch, "start_workers", functools.partial(Several, lose=range(100)))
    with pytest.raises(WlmError, match="^fit: 3 workers died of task 0: it was unlucky$"):
        fit.compress(lightmaps, PROFILE, workers=2)


@pytest.mark.parametrize(
    ("options", "says"),
    [({"workers": 0}, "workers: expected at least 1, got 0"), ({"cluster": "auto", "device": "cuda:1"}, "cpu or cuda")],
)
def test_wrong_places_are_told_at_once(options, says):
    assert re.search(says, error_of(fit.compress, None, PROFILE, **options))


def processes_of(parent):
    """Processes that another one has started."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            if int(stat.read_text().rpartition(")")[2].split()[1]) == parent:
                found.append(int(stat.parent.name))
        except OSError:
            continue
    return found


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_stopped_command_leaves_no_process_behind(number, lightmaps, tmp_path):
    folder, out = tmp_path / "set", tmp_path / "out" / "a.wlm"
    write_set(folder, lightmaps)
    out.parent.mkdir()
    words = ["compress", folder, "-o", out, "--steps", 10_000, "--samples", 128, "--workers", 2]
    code = "from wlm.cli import main\nfrom wlm.cli import console\nconsole._PLAIN_REPORTS = 10**7\nmain()"
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2]), "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-c", code, *map(str, words), "--checkpoint-every", "0.1"]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, env=environment
    ) as run:
        for line in run.stderr:
            if line.startswith("fit: ") and int(line.split()[1]) > 100 and Path(f"{out}.partial").exists():
                break
        workers = processes_of(run.pid)
        run.send_signal(number)
        errors = run.stderr.read()
    assert len(workers) == 2
    if number != signal.SIGKILL:
        assert run.returncode == 128 + number and "--resume to continue from" in errors and "Traceback" not in errors
    # An orphan ends once it has answered.
    for pid in workers:
        for _ in range(100):
            if not Path(f"/proc/{pid}").exists() or Path(f"/proc/{pid}/stat").read_text().split()[2] == "Z":
                break
            subprocess.run(["sleep", "0.1"], check=True)
        else:
            raise AssertionError("a worker outlives the command")
    settings = {"steps": 10_000, "samples": 128}
    assert fit.open_checkpoint(out, load(folder), "M", resume=True, **settings).resumed
    # Torch keeps a folder of its own among the temporary files.
    left = {path.name for path in tmp_path.iterdir() if not path.name.startswith("torch")}
    assert left == {"set", "out"}
    if number != signal.SIGKILL:
        assert [path.name for path in out.parent.iterdir()] == ["a.wlm.partial"]


def test_a_process_answers_or_says_why_not():
    before = processes_of(os.getpid())
    workers = Processes(Fraction, [(22, 7), ("wrong",)])
    try:
        workers.call(0, "limit_denominator", 3)
        workers.call(1, "limit_denominator", 3)
        answers = dict(workers.wait(60.0) for _ in range(2))
        assert answers[0] == 3 and isinstance(answers[1], ValueError)
        assert workers.wait(0.0) is None
        workers._processes[0].kill()
        assert "ended by signal 9" in str(workers.wait(60.0)[1])
        workers.renew(0)
        workers.call(0, "limit_denominator", 7)
        assert workers.wait(60.0) == (0, Fraction(22, 7))
    finally:
        workers.close()
    assert processes_of(os.getpid()) == before


def test_a_mapped_set_is_the_same_set(tmp_path, monkeypatch):
    lightmaps = moving_light(40, 24)
    order = [3, 0, 4, 1, 2]
    write_set(tmp_path / "set", lightmaps)
    monkeypatch.setattr(scratch, "IN_MEMORY", 1000)
    times = lightmaps.times
    frames = lightmaps.light.frames
    mapped = [load(tmp_path / "set", period=24.0), from_arrays(frames[order], times[order], None, 24.0, lightmaps.name)]
    for each in mapped:
        assert each.source == lightmaps.source
        assert each.light.frames.base is not None and type(each.light.frames) is np.ndarray
    assert wlm.lightmap.compress(mapped[1], PROFILE).file_bytes() == fit.compress(lightmaps, PROFILE).file_bytes()


def test_a_fit_never_holds_all_tiles():
    lightmaps = moving_light(512, 512, hours=(0.0, 8.0, 16.0, 20.0))
    tracemalloc.start()
    try:
        fit.SheetFit(lightmaps.light, PROFILE)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 0.6 * lightmaps.light.frames.nbytes  # two threads have a few tiles each


@pytest.mark.parametrize(("every", "waits"), [(10.0, [10.0, 10.0, 57.0]), (0.0, [0.0, 0.0, 0.0])])
def test_saving_takes_a_small_share_of_the_time(every, waits, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    pace = Pace(every)
    for seconds, wait in zip((0.25, 3.0, 0.0), waits, strict=True):
        now[0] += wait - 1e-6 if wait else 0.0
        assert pace.due() == (wait == 0.0)
        now[0] += 2e-6
        assert pace.due()
        with pace.saving():
            now[0] += seconds


def test_without_resume_an_old_checkpoint_is_left_out_and_replaced(tmp_path):
    lightmaps = moving_light(40, 24)
    old = open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE, seed=1)
    old.add_finished(0, {"uv": np.zeros(4, np.uint8)})
    new = open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE, seed=2)
    assert not new.resumed and new.finished(0, {}) is None
    new.add_finished(0, {"uv": np.ones(4, np.uint8)})
    again = open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE, seed=2, resume=True)
    assert again.finished(0, {"uv": Part(np.uint8, (4,))})["uv"].all()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"seed": 1}, "seed 0, not 1"),
        ({"device": "cuda:0"}, "device cpu, not cuda"),
        ({"profile": tiny_profile(steps=41)}, "profile steps=40, not 41"),
        ({"lightmaps": moving_light(40, 24, seed=9)}, "input"),
    ],
)
def test_another_fit_is_refused_by_name(tmp_path, change, says):
    fit_of = {"lightmaps": moving_light(40, 24), "profile": PROFILE}
    open_checkpoint(tmp_path / "a.wlm", **fit_of).add_finished(0, {"uv": np.zeros(4, np.uint8)})
    with pytest.raises(WlmError) as error:
        open_checkpoint(tmp_path / "a.wlm", **fit_of | change, resume=True)
    assert says in str(error.value) and "another fit" in str(error.value)
    assert "\n" not in str(error.value)


def test_the_order_of_tiles_and_the_number_of_the_gpu_do_not_matter(tmp_path):
    lightmaps = moving_light(40, 24)
    first = open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE, tiles=[2, 0], device="cuda:1")
    first.add_finished(0, {"uv": np.zeros(4, np.uint8)})
    same = open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE, tiles=[0, 2], device="cuda:0", resume=True)
    assert same.finished(0, {"uv": Part(np.uint8, (4,))})


def test_a_checkpoint_of_another_system_is_refused(tmp_path):
    fit_of = {"input": "0f", "levels": (1, 2)}
    Checkpoint(tmp_path / "a.wlm", "probe", fit_of, "0f").save({0: {"step": np.array(3)}})
    assert Checkpoint(tmp_path / "a.wlm", "probe", fit_of, "0f", resume=True).running(0)["step"] == 3
    with pytest.raises(WlmError, match="expected an artifact of lightmap-checkpoint, found one of probe-checkpoint"):
        open_checkpoint(tmp_path / "a.wlm", moving_light(40, 24), PROFILE, resume=True)


@pytest.mark.parametrize("part", ["uv", "finished.x.uv", "other.0.uv"])
def test_unknown_parts_are_refused(tmp_path, part):
    lightmaps = moving_light(40, 24)
    checkpoint = open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE)
    checkpoint.add_finished(0, {"uv": np.zeros(4, np.uint8)})
    settings = read_artifact(checkpoint.path).settings
    write_artifact(checkpoint.path, checkpoint.system, settings, {part: np.zeros(4, np.uint8)}, lightmaps.source)
    with pytest.raises(WlmError, match="is of neither a finished nor a running batch"):
        open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE, resume=True)
    write_artifact(checkpoint.path, checkpoint.system, {}, {}, lightmaps.source)
    with pytest.raises(WlmError, match="does not state the inputs of its fit"):
        open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE, resume=True)
