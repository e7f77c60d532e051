"""Facts that hold for every system: the front door, files, damage, progress, resume, export."""

import dataclasses
import json
import shutil
from contextlib import suppress
from pkgutil import iter_modules

import numpy as np
import pytest
from builders.contract import SUBJECTS, Subject
from builders.running import report_always

import wlm
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.system import Meter, load

SYSTEMS = ("lightmap", "atlas", "probe", "smoke")
VERBS = {"load", "evaluate", "Profile", "Report", "Decoder"}
PROFILES = {"lightmap": "M", "atlas": "standard", "probe": "small", "smoke": "fast"}
FITTED = ["lightmap", "probe", "atlas-tiles"]


@pytest.fixture
def subject(request) -> Subject:
    return SUBJECTS[request.param]()


every_file = pytest.mark.parametrize("subject", SUBJECTS, indirect=True)
every_fit = pytest.mark.parametrize("subject", FITTED, indirect=True)
every_kept_fit = pytest.mark.parametrize("subject", [*FITTED, "atlas-cascade"], indirect=True)


def one_line(call, *words: str) -> None:
    """Holds an error that is meant for the user: one line with these words."""
    with pytest.raises(wlm.WlmError) as caught:
        call()
    assert "\n" not in str(caught.value) and all(word in str(caught.value) for word in words), caught.value


@pytest.mark.parametrize("name", [*SYSTEMS, "ops", "fluid"])
def test_the_front_door_opens(name):
    package = getattr(wlm, name)
    modules = {module.name for module in iter_modules(package.__path__)}
    assert set(package.__all__) <= set(dir(package))
    for public in package.__all__:
        value = getattr(package, public)
        # A submodule, once imported, would take the place of a function of its name.
        assert public not in modules or value.__name__ == f"wlm.{name}.{public}"
    with pytest.raises(AttributeError, match=f"module 'wlm.{name}' has no attribute 'nothing'"):
        _ = package.nothing


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_systems_have_the_same_verbs(name):
    assert VERBS | {"train" if name == "smoke" else "compress"} <= set(getattr(wlm, name).__all__)


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_profile_is_a_name_a_file_or_itself(name, tmp_path):
    profile = getattr(wlm, name).Profile
    loaded = profile.load(PROFILES[name])
    assert profile.load(loaded) is loaded and loaded.override({}) is loaded
    (tmp_path / "mine.yaml").write_text("name: mine\n")
    assert profile.load(tmp_path / "mine.yaml").name == "mine"
    one_line(lambda: profile.load("nothing"), "profile 'nothing'", PROFILES[name])
    one_line(lambda: loaded.override({"nothing": 1}), "unknown key 'nothing'")


def in_steps(progress) -> bool:
    """Whether it is the stage that is kept from time to time; others, of atlases, are done again."""
    return progress.stage in ("fit", "curves") and progress.total > 0


@every_file
def test_old_files_decode_to_what_they_did(subject):
    decoded = subject.decode(wlm.load(subject.file))
    with np.load(subject.stored) as stored:
        assert set(stored.files) == set(decoded)
        for name in stored.files:
            assert decoded[name].shape == stored[name].shape and decoded[name].dtype == stored[name].dtype
            scale = float(np.abs(stored[name]).max())
            np.testing.assert_allclose(decoded[name], stored[name], rtol=0, atol=2e-6 * scale)


@every_file
def test_a_file_that_is_saved_again_is_the_same(subject, tmp_path):
    model = wlm.load(subject.file)
    size = model.save(tmp_path / "again.wlm")
    assert size == model.file_bytes() == subject.file.stat().st_size
    assert (tmp_path / "again.wlm").read_bytes() == subject.file.read_bytes()


@every_file
def test_every_flipped_byte_and_every_cut_is_refused(subject, tmp_path):
    content = subject.file.read_bytes()
    path = tmp_path / "damaged.wlm"
    for place in [*range(0, 200, 7), *range(200, len(content), max(97, len(content) // 60)), len(content) - 1]:
        damaged = bytearray(content)
        damaged[place] ^= 0x41
        for text in (bytes(damaged), content[:place]):
            path.write_bytes(text)
            one_line(lambda: wlm.load(path).check(), "damaged.wlm")


@every_file
def test_a_file_of_another_system_is_refused(subject):
    system = read_artifact(subject.file).system
    other = "atlas" if system == "probe" else "probe"
    one_line(lambda: load(subject.file, other), subject.file.name, f"of {other}, found one of {system}")


def test_files_of_no_system_are_one_line(tmp_path):
    one_line(lambda: wlm.load(tmp_path / "absent.wlm"), "absent.wlm")
    one_line(lambda: wlm.load(tmp_path), "expected a file, found a folder")
    write_artifact(tmp_path / "a.wlm", "lightmap-checkpoint", {}, {}, "0")
    one_line(lambda: wlm.load(tmp_path / "a.wlm"), "a.wlm", "lightmap-checkpoint")


@every_fit
def test_one_seed_gives_one_file_and_a_report(subject, tmp_path, monkeypatch):
    monkeypatch.setattr(Meter, "due", lambda self, done: True)
    data, reports = subject.data(), []
    model = subject.compress(data, progress=reports.append)
    assert reports and all(0 <= report.done <= max(report.total, report.done) for report in reports)
    again = subject.compress(data)
    model.save(tmp_path / "a.wlm")
    again.save(tmp_path / "b.wlm")
    assert (tmp_path / "a.wlm").read_bytes() == (tmp_path / "b.wlm").read_bytes()
    report = subject.evaluate(model, data)
    assert report.bytes == model.file_bytes() and 0 < report.psnr <= 120.0
    assert json.loads(json.dumps(report.to_json(), allow_nan=False))["bytes"] == report.bytes
    assert set(report.to_json()) == {field.name for field in dataclasses.fields(report)}


@every_fit
def test_an_unknown_setting_is_one_line(subject):
    one_line(lambda: subject.compress(subject.data(), nothing=1), "unknown key 'nothing'")


@every_kept_fit
def test_a_stopped_fit_goes_on_to_the_same_bytes(subject, tmp_path, monkeypatch):
    monkeypatch.setattr(Meter, "due", lambda self, done: True)
    data = subject.data()
    subject.compress(data).save(tmp_path / "whole.wlm")

    def stop(progress):
        if in_steps(progress) and progress.done:
            raise KeyboardInterrupt

    output = tmp_path / "part.wlm"
    with pytest.raises(KeyboardInterrupt):
        subject.compress(data, progress=stop, checkpoint=subject.open_checkpoint(data, output, False))
    checkpoint = subject.open_checkpoint(data, output, True)
    assert checkpoint.resumed and not output.exists()
    subject.compress(data, checkpoint=checkpoint).save(output)
    assert output.read_bytes() == (tmp_path / "whole.wlm").read_bytes()


@every_kept_fit
def test_a_killed_fit_goes_on_from_its_last_save(subject, tmp_path, monkeypatch):
    """Nothing is saved on the way out; what was saved before, and how often, changes no byte."""
    report_always(monkeypatch)
    data, reports, output = subject.data(), [], tmp_path / "part.wlm"
    subject.compress(data, progress=reports.append).save(tmp_path / "whole.wlm")
    places = [report.done for report in reports if in_steps(report)]

    def kill(progress):
        if in_steps(progress):
            done.append(progress.done)
        if len(done) == max(3, len(places) // 5):
            raise ZeroDivisionError

    first = None
    while True:
        done = []
        checkpoint = subject.open_checkpoint(data, output, True, every=0.0)
        with suppress(ZeroDivisionError):
            subject.compress(data, progress=kill, checkpoint=checkpoint).save(output)
            break
        assert first in (None, done[0]), "it goes on where it was killed"
        first = done[-1]
    assert places.index(first) > len(places) // 2, "it was killed again and again"
    assert output.read_bytes() == (tmp_path / "whole.wlm").read_bytes()


@every_fit
def test_an_export_keeps_to_its_own_folder(subject, tmp_path):
    data = subject.data()
    model = subject.compress(data)
    folder = tmp_path / "engine"
    files = subject.export(model, folder)
    content = {path: path.read_bytes() for path in files}
    assert files and all(path.parent == folder for path in files) and set(folder.iterdir()) == set(files)
    (folder / "readme.txt").write_text("mine")
    assert set(subject.export(model, folder)) == set(files), "an earlier export is written over"
    assert {path: path.read_bytes() for path in files} == content
    assert (folder / "readme.txt").read_text() == "mine", "and nothing else"
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "notes.txt").write_text("mine")
    one_line(lambda: subject.export(model, foreign), "foreign", "expected an empty folder")
    assert [path.name for path in foreign.iterdir()] == ["notes.txt"]
    shutil.rmtree(folder)
    folder.write_text("a file")
    one_line(lambda: subject.export(model, folder), "engine")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["engine", "foreign"], "nothing is left behind"
