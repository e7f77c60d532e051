"""Long commands are killed at random moments, go on, and end with the bytes of one that was not killed.

Moments are drawn from a seed, but where they fall depends on the machine; what has to hold holds at each.
"""

import json
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from builders import atlas_meshes, probe_sets, small_sets
from builders.killing import Command, Run, drive, file_bytes
from builders.running import call
from builders.smoke_plumes import SCENE, write_frames
from builders.smoke_samples import file_content

import wlm
from wlm.errors import WlmError
from wlm.export import export
from wlm.formats.exr import write_exr
from wlm.formats.folder import UNFINISHED, read_index
from wlm.probe.data import save_probes
from wlm.smoke.data import CHECKPOINT

KILLS = {
    "lightmap compress": 16,
    "probe compress": 9,
    "atlas compress": 10,
    "atlas compress cascade": 10,
    "smoke simulate": 14,
    "smoke train": 12,
    "smoke bake": 10,
    "lightmap export": 6,
    "probe export": 6,
}
FILES = Path(__file__).resolve().parents[1] / "files"
JET = SCENE | {"grid": {"cells": [16, 20, 16], "cell": 0.0625, "refine": 2, "origin": [-0.5, 0, -0.5]}, "rate": 4.0}
NETWORK = {
    "name": "tiny",
    "network": {"guide": "six", "width": 8, "levels": 2, "stem": 2},
    "training": {"rounds": 3, "steps": 60, "batch": 2, "rate": 2e-5, "warmup": 1, "average": 0.5},
    "dataset": {
        "guide": "six", "guide_step": 0.1, "cells": 16, "refine": 2, "resolution": 16, "sequences": 1, "frames": 1,
        "views": 2, "views_a_frame": 1, "warmup": 0.6, "validation_sequences": 1, "moving": 0.0,
    },
}  # fmt: skip
EVERY = ("--checkpoint-every", 0.2)


def kept_or_whole(path: Path, earlier: dict, whole: dict) -> None:
    """A file is that of the earlier run or of this one."""
    assert file_bytes(path) in (earlier, whole)


def some_of_the_frames(path: Path, earlier: dict, whole: dict) -> None:
    """Every frame is one of the whole run's, unless nothing has been removed yet."""
    now = {name: content for name, content in file_bytes(path).items() if name in whole and name != "scene.json"}
    assert all(content == whole[name] for name, content in now.items()) or now.items() <= earlier.items()


def earlier_or_unfinished(index: str, content=file_bytes):
    """An export is the earlier one, this one, or says that it isn't finished."""

    def check(path: Path, earlier: dict, whole: dict) -> None:
        if UNFINISHED not in read_index(path / index):
            assert content(path) in (earlier, whole)

    return check


def networks(path: Path) -> dict:
    return {path.name: file_content(path)}


def a_network(path: Path, earlier: dict, whole: dict) -> None:
    """The best so far can be read."""
    wlm.load(path)


def beside(path: Path) -> Path:
    return Path(f"{path}.partial")


@pytest.fixture(scope="session")
def command(request, tmp_path_factory):
    """The command of a name, with its inputs."""
    place = tmp_path_factory.mktemp("inputs")

    def settings(content: dict) -> Path:
        (place / "settings.yaml").write_text(yaml.safe_dump(content))
        return place / "settings.yaml"

    def older(name: str):
        return lambda path: path.write_bytes((FILES / name).read_bytes())

    def exported(name: str):
        model = wlm.load(FILES / name)
        return lambda path: export(model, path)

    words = tuple(request.param.split())
    if words[0] != "smoke":
        words = words[1:2]  # the input says which system
    match request.param:
        case "lightmap compress":
            lightmaps = small_sets.moving_light(40, 24).light
            for hour, frame in zip(lightmaps.times, lightmaps.frames, strict=True):
                write_exr(place / f"light_{hour:g}h.exr", frame)
            profile = settings(small_sets.tiny_profile(steps=1500).model_dump(mode="json"))
            words += (place, "--times", ",".join(f"{time:g}" for time in lightmaps.times), "--profile", profile, *EVERY)
            return Command(words, "a.wlm", older("lightmap.wlm"), file_bytes, kept_or_whole, beside)
        case "probe compress":
            probes = probe_sets.synthetic(300, dead=5)
            save_probes(place / "room.npz", probes.position, probes.values)
            tiny = {"name": "tiny", "method": "gaussians", "ratio": 0.1, "hidden": 16, "latent": 3, "steps": 400}
            profile = settings(tiny)
            words += (place / "room.npz", "--profile", profile, *EVERY)
            return Command(words, "a.wlm", older("probe.wlm"), file_bytes, kept_or_whole, beside)
        case "atlas compress" | "atlas compress cascade":
            cascade = {"name": "tiny", "method": "cascade", "steps": 400, "resolution": 64, "views": 4}
            tiles = {"name": "tiny", "views": 4}
            light = atlas_meshes.sheet(height=200, width=240)
            profile = settings(cascade | {"fallback": False} if "cascade" in request.param else tiles)
            words += (*atlas_meshes.write_files(place, light), "--profile", profile, *EVERY)
            return Command(words, "a.wlm", older("atlas-tiles.wlm"), file_bytes, kept_or_whole, beside)
        case "smoke simulate":
            words += (settings(JET | {"frames": 40}), *EVERY)
            earlier = JET | {"frames": 3, "name": "older"}
            return Command(
                words,
                "out",
                lambda path: write_frames(path, **earlier),
                file_bytes,
                some_of_the_frames,
                lambda path: path / CHECKPOINT,
            )
        case "smoke train":
            words += (settings(NETWORK), *EVERY)
            return Command(words, "a.safetensors", older("smoke.wlm"), networks, a_network, beside)
        case "smoke bake":
            frames = write_frames(place / "frames", frames=30).path
            words += (frames, "--resolution", 64, "--step", 0.2)
            return Command(
                words,
                "out",
                lambda path: wlm.smoke.data.NumberedFiles(path, "six", ".exr").file(1).write_bytes(b"older"),
                file_bytes,
                some_of_the_frames,
                lambda path: path / "six.partial",
            )
        case "lightmap export":
            lightmaps = small_sets.moving_light(40, 24)
            wlm.lightmap.compress(lightmaps, small_sets.tiny_profile()).save(place / "a.wlm")
            check = earlier_or_unfinished("bundle.json")
            earlier = exported("lightmap.wlm")
            return Command((*words, place / "a.wlm"), "out", earlier, file_bytes, check, None)
        case "probe export":
            profile = wlm.probe.Profile(name="tiny", method="gaussians", ratio=0.1, steps=30, hidden=16, latent=3)
            wlm.probe.compress(probe_sets.synthetic(300), profile).save(place / "a.wlm")
            check = earlier_or_unfinished("bundle.json")
            return Command((*words, place / "a.wlm"), "out", exported("probe.wlm"), file_bytes, check, None)
    raise WlmError(request.param)


@pytest.mark.parametrize("command", ["probe compress"], indirect=True)
def test_a_killed_command_goes_on_to_the_same_bytes(command, tmp_path):
    """Only the run that is killed has a process of its own; the whole run and the resumed one are in this process."""
    whole, output = tmp_path / command.output, tmp_path / "killed" / command.output
    output.parent.mkdir()
    words = (*command.words, "--checkpoint-every", 0, "--steps", 100)
    call(*words, "-o", whole)
    command.earlier(output)
    earlier, expected = command.content(output), command.content(whole)
    run = Run(replace(command, words=words), output, False)
    while run.process.poll() is None and not command.partial(output).exists():
        time.sleep(0.002)
    run.process.send_signal(signal.SIGKILL)
    assert run.wait() == -signal.SIGKILL, run.errors()
    command.state(output, earlier, expected)
    call(*words, "-o", output, "--resume")
    assert command.content(output) == expected and os.listdir(output.parent) == [command.output]


@pytest.mark.slow
@pytest.mark.parametrize("command", KILLS, indirect=True)
def test_a_hundred_kills(command, tmp_path, request):
    """Prints what came of them; `-rP` shows it."""
    name = request.node.callspec.params["command"]
    counts = drive(command, tmp_path, kills=KILLS[name], seed=2)
    print(json.dumps({"command": name, **vars(counts)}))
    assert counts.runs and sum(counts.kills.values()) == KILLS[name]
