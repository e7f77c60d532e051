"""Exports light probes to the files of three.js, Godot, Unity, Unreal and Bevy."""

from importlib import resources


def asset(name: str) -> str:
    """Returns the text of a file of `assets`."""
    return (resources.files(__name__) / "assets" / name).read_text(encoding="utf-8")
