"""The verbs of the root: which system a command line belongs to, its options, and the size of the command line."""

import inspect
import re
from typing import Annotated, Any, Literal

import numpy as np
import pytest
import typer
from builders.checks import error_of
from builders.contract import FILES
from builders.running import call, fails
from PIL import Image
from pydantic import BaseModel, Field
from typer.testing import CliRunner

from wlm.cli import app
from wlm.cli.settings import Generated, command_of, with_settings
from wlm.cli.verbs import SYSTEMS, VERBS, first_argument, functions, variant
from wlm.errors import WlmError
from wlm.formats.exr import write_exr
from wlm.inspection import input_system
from wlm.lightmap import Profile
from wlm.system import _PACKAGES, Settings

MOST_COMMANDS, MOST_OPTIONS = 25, 15


class Inner(BaseModel, use_attribute_docstrings=True):
    rate: float = Field(0.5, gt=0.0, le=1.0)
    """Rate of the inner part."""


class Tiny(Settings):
    """Settings that have every kind of field."""

    FILES = "tiny"

    steps: int = Field(5, ge=1)
    """Steps of the fit. A second sentence is left out."""
    mips: bool = False
    """Store smaller levels."""
    kind: Literal["a", "b"] = "a"
    """Kind of the fit."""
    bits: Literal[8, 16] = 16
    """Bits of a number."""
    pair: tuple[float, float] = (1.0, 2.0)
    """Two numbers."""
    least: float | None = None
    """Least value."""
    inner: Inner = Inner()


given: dict[str, Any] = {}


@with_settings(f"{__name__}:Tiny")
def go(file: str, settings: dict[str, Any], plain: Annotated[int, typer.Option(help="Own option.")] = 3) -> None:
    """Do something."""
    given.update(settings)
    Tiny(name="").override(settings, "--")


def run(*words: str) -> str:
    given.clear()
    group = typer.Typer()
    group.command(cls=Generated)(go)
    group.command()(lambda: None)
    result = CliRunner().invoke(group, ["go", "a", *words])
    return f"error: {result.exception}" if isinstance(result.exception, WlmError) else result.output


def test_options_are_those_of_the_fields():
    run(*"--steps 7 --mips --kind b --bits 8 --pair 3,4 --least 0.5 --inner-rate 0.1".split())
    assert given == {
        "steps": "7", "mips": True, "kind": "b", "bits": 8, "pair": ["3", "4"], "least": "0.5", "inner": {"rate": "0.1"}
    }  # fmt: skip
    run("--no-mips")
    assert given == {"mips": False}
    run()
    assert given == {}
    text = " ".join(run("--help").replace("│", " ").split())
    for word in ("Steps of the fit (at least 1).", "--mips", "--no-mips", "a|b", "N,N", "(above 0, at most 1)"):
        assert word in text
    assert "second sentence" not in text and "Own option." in text and "--name" not in text


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--steps", "0"), "--steps: expected greater than or equal to 1, got '0'"),
        (("--kind", "c"), "--kind: expected 'a' or 'b'"),
        (("--bits", "9"), "--bits: expected 8 or 16"),
        (("--pair", "1"), "--pair"),
    ],
)
def test_wrong_settings_are_named_as_options(words, line):
    assert line in run(*words)
    order = {"quantise_from": "0.9", "freeze_from": "0.5"}
    assert error_of(Profile(name="").override, order, "--") == "--quantise-from: expected at most freeze-from"


def test_the_systems_are_those_of_the_files():
    assert {package.split(".")[1] for package in _PACKAGES.values()} == set(SYSTEMS)


def test_the_first_argument_is_found_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("set", "out.wlm"):
        (tmp_path / name).touch()
    options = {"-o": True, "--mask": True, "--resume": False}
    for words, first in (
        (["set", "-o", "out.wlm"], "set"),
        (["-o", "out.wlm", "set"], "set"),
        (["--steps", "500", "-o", "out.wlm", "set"], "set"),
        (["--mask", "set", "out.wlm"], "out.wlm"),
        (["absent", "set"], "absent"),
        (["--help"], None),
    ):
        assert first_argument(words, options) == first, words


def test_the_file_chooses_the_system(tmp_path):
    assert "wlm info" in call("info", "--help") and "--layer" not in call("decode", "--help")
    assert "--layer" in call("decode", FILES / "lightmap.wlm", "--help")
    assert "--layer" in call("decode", "--system", "lightmap", "--help")
    assert "--layer" not in call("decode", "--system=probe", "--help")
    assert "expected one of lightmap, atlas, probe, smoke, got 'sound'" in fails("info", "--system", "sound")
    assert "Missing argument" in fails("info")
    assert "expected an artifact" in fails("info", __file__)
    line = fails("info", "--system", "probe", FILES / "lightmap.wlm")
    assert "lightmap.wlm" in line and "probe" in line
    line = fails("decode", "--system", "smoke", "a.wlm")
    assert "wlm decode: does not apply to files of smoke; use wlm smoke predict" in line


def test_the_kind_of_an_input_chooses_the_system(tmp_path):
    position = np.random.default_rng(0).random((9, 3))
    np.savez(tmp_path / "probes.npz", position=position, sh=np.ones((9, 9, 3)))
    np.savez(tmp_path / "smoke.npz", density=np.ones((4, 4, 4)))
    np.savez(tmp_path / "other.npz", a=np.ones(3))
    (tmp_path / "mesh.glb").write_bytes(b"glTF\2\0\0\0")
    for hour, size in ((6, 8), (12, 8)):
        write_exr(tmp_path / f"light_{hour}h.exr", np.ones((size, 8, 3), np.float32))
    assert input_system(tmp_path / "probes.npz") == "probe"
    assert input_system(tmp_path / "smoke.npz") == "smoke"
    assert input_system(tmp_path / "mesh.glb") == "atlas"
    assert input_system(tmp_path) == "lightmap"
    said = ("other.npz", "the kind of input is not clear"), ("light_6h.exr", "wlm compress MESH LIGHTMAP")
    for name, line in (*said, ("absent", "no such file or folder")):
        assert line in fails("compress", tmp_path / name, "-o", tmp_path / "a.wlm")
    assert "already compressed" in fails("compress", FILES / "lightmap.wlm", "-o", tmp_path / "a.wlm")
    assert "use wlm smoke bake" in fails("compress", tmp_path / "smoke.npz", "-o", tmp_path / "a.wlm")
    write_exr(tmp_path / "light_18h.exr", np.ones((9, 8, 3), np.float32))
    assert "wlm compress MESH FOLDER" in fails("compress", tmp_path, "-o", tmp_path / "a.wlm")
    (tmp_path / "empty").mkdir()
    Image.new("L", (8, 8)).save(tmp_path / "empty" / "mask.png")
    assert "--system NAME" in fails("compress", tmp_path / "empty", "-o", tmp_path / "a.wlm")
    Image.new("RGB", (8, 8)).save(tmp_path / "empty" / "light_6h.png")
    assert input_system(tmp_path / "empty") == "lightmap"
    assert "; with --encoding .png" in fails("compress", tmp_path / "empty", "-o", tmp_path / "a.wlm")


def commands(group, path=()):
    """Yields every command of the command line by its path, those of the verbs for each system."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, (*path, name))
        elif name in VERBS and not path:
            for system in functions(name):
                yield (name, "--system", system), variant(name, system)
        else:
            yield (*path, name), command_of(name, command.callback) if isinstance(command, Generated) else command


@pytest.fixture(scope="module")
def every_command():
    return dict(commands(typer.main.get_command(app)))


def test_the_command_line_is_small(every_command):
    assert len({path[0] if path[0] in VERBS else path for path in every_command}) <= MOST_COMMANDS
    for path, command in every_command.items():
        options = [each for each in command.params if each.param_type_name == "option"]
        own = [each for each in options if not each.name.startswith("set__")]
        assert len(own) <= MOST_OPTIONS, path


FRAGMENT = re.compile(r"^(Of|What|Those|That|Told|Whose|Which|As|How|Where|When)\b")


def test_every_help_is_written_in_sentences(every_command):
    for path, command in every_command.items():
        texts = [inspect.cleandoc(command.help or ""), *(each.help for each in command.params if each.help is not None)]
        for text in texts:
            assert re.match(r"\w|[\"`]", text) and text.rstrip().endswith("."), (path, text)
            assert not FRAGMENT.match(text) and "so many" not in text and "but for" not in text, (path, text)


def test_every_help_renders_in_a_narrow_terminal(every_command):
    for path in {path if path[0] in VERBS else path for path in every_command}:
        result = CliRunner().invoke(app, [*path, "--help"], env={"COLUMNS": "40", "TERMINAL_WIDTH": "40"})
        assert result.exit_code == 0 and "Usage" in result.output, path
        assert max(map(len, result.output.splitlines())) <= 40, path
