"""Interrupted fits: what their checkpoint keeps, and what it refuses."""

import numpy as np
import pytest
from builders.running import report_always
from builders.small_sets import moving_light, static_light, tiny_profile

from wlm.errors import WlmError
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.formats.checkpoint import Checkpoint, Pace
from wlm.formats.parts import Part
from wlm.lightmap.data import from_arrays
from wlm.lightmap.fit import compress, open_checkpoint

PROFILE = tiny_profile(steps=40)


@pytest.fixture(autouse=True)
def report_every_chunk(monkeypatch):
    report_always(monkeypatch)


def both_kinds():
    """A dynamic tile beside a static one: two batches."""
    static, moving = static_light().light, moving_light().light
    return from_arrays(np.concatenate([static.frames, moving.frames], axis=2), moving.times, period=24.0)


def stop_after(step):
    def report(progress):
        if progress.done >= step:
            raise KeyboardInterrupt

    return report


def interrupted(path, lightmaps, step, profile=PROFILE, **options):
    checkpoint = open_checkpoint(path, lightmaps, profile, **options)
    with pytest.raises(KeyboardInterrupt):
        compress(lightmaps, profile, progress=stop_after(step), checkpoint=checkpoint, **options)
    return checkpoint


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The file of a fit that was not interrupted."""
    path = tmp_path_factory.mktemp("whole") / "whole.wlm"
    compress(both_kinds(), PROFILE, seed=3).save(path)
    return path.read_bytes()


# One step into the fit, in each of its stages (of 40 steps, 28 are continuous and 38 move the maps), and in the
# second batch.
@pytest.mark.parametrize("step", [1, 30, 65])
def test_a_resumed_fit_gives_the_bytes_of_one_that_was_not_interrupted(tmp_path, whole, step):
    lightmaps = both_kinds()
    interrupted(tmp_path / "resumed.wlm", lightmaps, step, seed=3)
    checkpoint = open_checkpoint(tmp_path / "resumed.wlm", lightmaps, PROFILE, seed=3, resume=True)
    steps = []
    model = compress(lightmaps, PROFILE, seed=3, progress=lambda now: steps.append(now.done), checkpoint=checkpoint)
    model.save(tmp_path / "resumed.wlm")

    assert (tmp_path / "resumed.wlm").read_bytes() == whole
    assert steps[0] > step and steps[-1] == 80, "what was done is not done again"
    checkpoint.remove()
    assert [path.name for path in tmp_path.iterdir() if "partial" in path.name] == []


def test_what_is_kept_comes_back(tmp_path):
    lightmaps = moving_light(40, 24)
    checkpoint = open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE)
    assert checkpoint.finished(0, {}) is None and checkpoint.running(0) is None
    table = {"uv": Part(np.uint8, (2, 3, 4)), "net": Part(np.float16, (2, 5))}
    parts = {"uv": np.arange(24, dtype=np.uint8).reshape(2, 3, 4), "net": np.ones((2, 5), np.float16)}
    checkpoint.add_finished(0, parts)
    checkpoint.save_running(1, {"maps": np.arange(5.0, dtype=np.float32), "adam.0.step": np.array(7.0, np.float32)})

    back = open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE, resume=True)
    assert back.resumed
    for name, value in parts.items():
        np.testing.assert_array_equal(back.finished(0, table)[name], value)
        assert back.finished(0, table)[name].dtype == value.dtype
    assert back.running(1)["adam.0.step"] == 7.0 and back.running(1)["adam.0.step"].shape == ()
    assert back.finished(1, table) is None and back.running(0) is None

    back.add_finished(1, parts)
    assert open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE, resume=True).running(1) is None


def test_it_is_due_a_while_after_the_last_save(tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    checkpoint = open_checkpoint(tmp_path / "a.wlm", moving_light(40, 24), PROFILE, every=2.0)
    dues = []
    for now[0] in (101.0, 102.0, 103.0, 104.0, 105.0, 106.0):
        dues.append(checkpoint.due())
        if dues[-1]:
            checkpoint.save_running(0, {"step": np.array(now[0])})
    assert dues == [False, True, False, True, False, True]
    checkpoint.add_finished(0, {"uv": np.zeros(4, np.uint8)})
    assert not checkpoint.due()


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
        ({"tiles": [0]}, "tiles None, not [0]"),
        ({"device": "cuda:0"}, "device cpu, not cuda"),
        ({"profile": tiny_profile(steps=41)}, "profile steps=40, not 41"),
        ({"lightmaps": moving_light(40, 24, seed=9)}, "input"),
        ({"lightmaps": moving_light(40, 24, period=None)}, "period 24.0, not None"),
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
    Checkpoint(tmp_path / "a.wlm", "probe", fit_of, "0f").save_running(0, {"step": np.array(3)})
    assert Checkpoint(tmp_path / "a.wlm", "probe", fit_of, "0f", resume=True).running(0)["step"] == 3
    with pytest.raises(WlmError, match="expected an artifact of lightmap-checkpoint, found one of probe-checkpoint"):
        open_checkpoint(tmp_path / "a.wlm", moving_light(40, 24), PROFILE, resume=True)
    with pytest.raises(ValueError):
        Checkpoint(tmp_path / "a.wlm", "probe", {"rate": float("nan")}, "0f")


@pytest.mark.parametrize("part", ["uv", "finished.x.uv", "other.0.uv"])
def test_unknown_parts_are_refused(tmp_path, part):
    lightmaps = moving_light(40, 24)
    checkpoint = open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE)
    checkpoint.add_finished(0, {"uv": np.zeros(4, np.uint8)})
    settings = read_artifact(checkpoint.path).settings
    write_artifact(checkpoint.path, checkpoint.system, settings, {part: np.zeros(4, np.uint8)}, lightmaps.source)
    with pytest.raises(WlmError, match="expected one of a finished or a running batch"):
        open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE, resume=True)
    write_artifact(checkpoint.path, checkpoint.system, {}, {}, lightmaps.source)
    with pytest.raises(WlmError, match="does not state its fit"):
        open_checkpoint(tmp_path / "a.wlm", lightmaps, PROFILE, resume=True)
