"""Long commands are killed at random moments, go on, and end with the bytes of one that was not killed.

Moments are drawn from a seed, but where they fall depends on the machine; what has to hold holds at each.
"""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from builders import atlas_meshes, probe_sets, small_sets
from builders.running import call
from builders.smoke_plumes import SCENE, write_frames
from builders.smoke_samples import file_content

import wlm
from wlm.export import export
from wlm.formats.folder import UNFINISHED, read_index
from wlm.probe.data import save_probes
from wlm.smoke.data import CHECKPOINT

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
WORKS = ("fit", "train", "simulate", "compress")  # the first word of a report


def file_bytes(path: Path) -> dict[str, Any]:
    """The bytes of a file, or of each file in a folder."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    return {file.name: file.read_bytes() for file in files}


def kept_or_whole(path: Path, earlier: dict, whole: dict) -> None:
    """A file is that of the earlier run or of this one."""
    assert file_bytes(path) in (earlier, whole)


def some_of_the_frames(path: Path, earlier: dict, whole: dict) -> None:
    """Every frame is one of the whole run's, unless nothing has been removed yet."""
    now = {name: content for name, content in file_bytes(path).items() if name in whole and name != "scene.json"}
    assert all(content == whole[name] for name, content in now.items()) or now.items() <= earlier.items()


def earlier_or_unfinished(path: Path, earlier: dict, whole: dict) -> None:
    """An export is the earlier one, this one, or says that it isn't finished."""
    assert UNFINISHED in read_index(path / "bundle.json") or file_bytes(path) in (earlier, whole)


@dataclass(frozen=True)
class Command:
    """A command whose output has to outlast kills.

    Attributes:
        words: Its words but for the output.
        output: Name of the output.
        earlier: Writes the output of an earlier run.
        state: Checks the output after a kill, given the content of the earlier and of the whole output.
        content: Reads an output.
        partial: Name of the checkpoint in the output or beside it; None for a command that begins anew.
    """

    words: tuple[Any, ...]
    output: str
    earlier: Callable[[Path], Any]
    state: Callable[[Path, dict, dict], Any] = kept_or_whole
    content: Callable[[Path], dict[str, Any]] = file_bytes
    partial: str | None = "../{}.partial"


def command_of(name: str, place: Path) -> Command:
    """Makes the inputs of a command, with settings of a fit of some seconds."""

    def settings(content: dict) -> Path:
        (place / "settings.yaml").write_text(yaml.safe_dump(content))
        return place / "settings.yaml"

    def older(name: str):
        return lambda path: path.write_bytes((FILES / name).read_bytes())

    match name:
        case "lightmap compress":
            small_sets.write_set(place / "set", small_sets.moving_light(40, 24))
            profile = settings(small_sets.tiny_profile(steps=1500).model_dump(mode="json"))
            return Command(("compress", place / "set", "--profile", profile, *EVERY), "a.wlm", older("lightmap.wlm"))
        case "probe compress":
            probes = probe_sets.synthetic(300, dead=5)
            save_probes(place / "room.npz", probes.position, probes.values)
            tiny = {"name": "tiny", "method": "gaussians", "ratio": 0.1, "hidden": 16, "latent": 3, "steps": 400}
            words = ("compress", place / "room.npz", "--profile", settings(tiny), *EVERY)
            return Command(words, "a.wlm", older("probe.wlm"))
        case "atlas compress":
            files = atlas_meshes.write_files(place, atlas_meshes.sheet(height=200, width=240))
            words = ("compress", *files, "--profile", settings({"name": "tiny", "views": 4}), *EVERY)
            return Command(words, "a.wlm", older("atlas-tiles.wlm"))
        case "smoke simulate":
            earlier = JET | {"frames": 3, "name": "older"}
            words = ("smoke", "simulate", settings(JET | {"frames": 40}), *EVERY)
            frames = some_of_the_frames
            return Command(words, "out", lambda path: write_frames(path, **earlier), frames, partial=CHECKPOINT)
        case "smoke train":
            words = ("smoke", "train", settings(NETWORK), *EVERY)
            # The best so far can be read.
            return Command(
                words,
                "a.safetensors",
                older("smoke.wlm"),
                lambda path, *_: wlm.load(path),
                lambda path: {path.name: file_content(path)},
            )
        case _:
            wlm.load(FILES / "probe.wlm").save(place / "a.wlm")
            model = wlm.load(FILES / "lightmap.wlm")
            words = ("export", place / "a.wlm")
            return Command(words, "out", lambda path: export(model, path), earlier_or_unfinished, partial=None)


def works(command: Command, output: Path, errors: Path) -> bool:
    """Whether a command has begun its work: it has reported, or written temporary files."""
    if command.partial is None:
        return any(name.startswith(".wlm-") for name in os.listdir(output.parent))
    return any(line.split(":")[0] in WORKS for line in errors.read_text(encoding="utf-8").splitlines())


def kill(command: Command, output: Path, number: int, pause: float, resume: bool = False) -> bool:
    """Runs a command in a process of its own and kills it while it works; says whether a signal ended it."""
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    words, errors = [*command.words, "-o", output, *["--resume"] * resume], output.parent.parent / "stderr"
    with open(errors, "wb") as file:
        line = [sys.executable, "-m", "wlm", *map(str, words)]
        process = subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=file, env=environment)
    while process.poll() is None and not works(command, output, errors):
        time.sleep(0.002)
    time.sleep(pause)
    process.send_signal(number)
    code, text = process.wait(600.0), errors.read_text(encoding="utf-8")
    # Before Python has come to its handler the signal itself ends the process.
    assert code in (0, -number, 128 + number) and "Traceback" not in text, (code, text)
    return code != 0


def check_kills(command: Command, folder: Path, kills: int) -> None:
    """Kills a command several times, and goes on each time; the first and the last run are in this process."""
    whole, output, chance = folder / command.output, folder / "killed" / command.output, random.Random(2)
    output.parent.mkdir()
    begin = time.monotonic()
    call(*command.words, "-o", whole)
    span = time.monotonic() - begin
    command.earlier(output)
    earlier, expected, resume = command.content(output), command.content(whole), False
    for _ in range(kills):
        number = chance.choice([signal.SIGKILL, signal.SIGTERM]) if kills > 1 else signal.SIGKILL
        if not kill(command, output, number, chance.uniform(0.0, 0.3 * span), resume):
            break
        command.state(output, earlier, expected)
        resume = command.partial is not None and (output / command.partial.format(output.name)).resolve().exists()
    else:
        call(*command.words, "-o", output, *["--resume"] * resume)
    assert command.content(output) == expected
    assert set(os.listdir(output.parent)) <= set(os.listdir(folder))


QUICK = "probe compress"
OTHERS = ("lightmap compress", "probe compress", "atlas compress", "smoke simulate", "smoke train", "probe export")


@pytest.mark.parametrize(
    ("name", "kills"), [(QUICK, 1), *(pytest.param(name, 4, marks=pytest.mark.slow) for name in OTHERS)]
)
def test_a_killed_command_goes_on_to_the_same_bytes(name, kills, tmp_path, tmp_path_factory):
    check_kills(command_of(name, tmp_path_factory.mktemp("inputs")), tmp_path, kills)
