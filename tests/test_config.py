import re
from pathlib import Path
from typing import Literal

import pytest
from builders.checks import error_of
from pydantic import BaseModel, Field

import wlm.config
from wlm.config import load_settings, profile_names, profile_path


class Net(BaseModel):
    width: int = Field(16, ge=1, le=64)
    activation: Literal["gelu", "relu"] = "gelu"


class Settings(BaseModel):
    steps: int
    rate: float = 0.01
    net: Net = Net()
    sizes: tuple[int, ...] = ()


def _load(tmp_path: Path, text: str | bytes) -> Settings:
    path = tmp_path / "s.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_settings(Settings, path)


def test_settings_are_read_and_typed(tmp_path):
    # YAML 1.1 reads 1e-3, without a dot, as text: it must still arrive as a number.
    settings = _load(tmp_path, "steps: 10\nrate: 1e-3\nnet: {width: 32, activation: relu}\nsizes: [1, 2]\n")
    assert settings == Settings(steps=10, rate=0.001, net=Net(width=32, activation="relu"), sizes=(1, 2))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["empty"]),
        ("- 1\n- 2\n", ["mapping", "[1, 2]"]),
        ("steps: [1\n", ["expected YAML", "line 2"]),
        ("steps: !!python/object:os.system x\n", ["expected YAML", "line 1"]),
        ("steps: 1\nsteps: 2\n", ["expected YAML", "'steps' is given twice", "line 2"]),
        (b"steps: \xff\xfe\n", ["UTF-8"]),
        ("steps: many\n", ["steps: expected a valid integer", "'many'"]),
        ("steps: 1\nstepps: 2\n", ["unknown key 'stepps'", "did you mean 'steps'"]),
        ("steps: 1\nqqq: 2\n", ["unknown key 'qqq'", "steps, rate, net, sizes"]),
        ("steps: 1\nnet: {width: 0}\n", ["net.width: expected greater than or equal to 1", "got 0"]),
        ("steps: 1\nnet: {activation: tanh}\n", ["net.activation: expected 'gelu' or 'relu'", "'tanh'"]),
        ("steps: 1\nsizes: [1, x]\n", ["sizes.1: expected a valid integer", "'x'"]),
        ("steps: x\nrate: y\nnet: 1\n", ["steps: expected", "(and 2 more)"]),
        ("steps: " + "x" * 5000, ["steps: expected", "..."]),
    ],
)
def test_a_wrong_file_is_one_line(tmp_path, text, words):
    line = error_of(_load, tmp_path, text)
    assert len(line) < 400
    assert line.startswith(f"{tmp_path / 's.yaml'}: ")
    for word in words:
        assert word in line


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A checkout's layout with two profiles, and no installed ones."""
    (tmp_path / "configs").mkdir()
    (tmp_path / "wlm").mkdir()
    for name in ("lightmap-M", "lightmap-S", "probe-M"):
        (tmp_path / "configs" / f"{name}.yaml").write_text("steps: 1\n")
    (tmp_path / "pyproject.toml").touch()
    (tmp_path / "secret.yaml").touch()
    monkeypatch.setattr(wlm.config, "__file__", str(tmp_path / "wlm" / "config.py"))
    monkeypatch.setattr(wlm.config.resources, "files", _not_installed)
    return tmp_path


def _not_installed(package: str) -> None:
    raise ModuleNotFoundError(package)


def test_a_profile_is_found_in_a_checkout(checkout):
    assert profile_path("lightmap", "M") == checkout / "configs" / "lightmap-M.yaml"
    assert profile_names("lightmap") == ["M", "S"]


@pytest.mark.parametrize("name", ["XL", "", "*", "../secret", "M.yaml", "m"])
def test_an_unknown_profile_lists_the_known_ones(checkout, name):
    assert re.search("known profiles: M, S$", error_of(profile_path, "lightmap", name))
    assert re.search("known profiles: none$", error_of(profile_path, "smoke", "M"))


def test_a_profile_is_found_in_the_installed_package(checkout, monkeypatch):
    # Of another package: a folder of this name beside `wlm` means nothing without a pyproject.toml.
    (checkout / "pyproject.toml").unlink()
    installed = checkout / "wlm" / "configs"
    installed.mkdir(parents=True)
    (installed / "atlas-M.yaml").touch()
    monkeypatch.setattr(wlm.config.resources, "files", {"wlm.configs": installed}.get)
    assert (profile_names("atlas"), profile_names("lightmap")) == (["M"], [])
    assert profile_path("atlas", "M") == installed / "atlas-M.yaml"
