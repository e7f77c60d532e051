"""Functions that write parts of an engine kit, for the kits of all kinds of models."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from wlm import bundle
from wlm.errors import WlmError, printable

ENGINES = ("three", "godot", "unity", "unreal")
"""Engines for which kits are written: three.js, Godot 4, Unity, Unreal Engine 5."""

PROBE_ENGINES = (*ENGINES, "bevy")
"""Engines for which probes are written."""

README_FILE = "README.md"

# Most texels along a side of a picture that the editor imports, or that WebGL2 supports on most machines.
_MOST_SIDE = {"unreal": 8192, "godot": 16384, "unity": 16384, "three": 16384}

_MARKDOWN = re.compile(r"[\\`*<>&!\[\]]")
_SAMPLER = re.compile(
    r"#ifndef (\w+)\n#ifndef \1_BINDING\nuniform (\w+) (\w+);\n#else\n.*\n#endif\n#define \1 \3\n#endif\n"
)


def filled(asset: str, **parts: str) -> str:
    """Reads a template from `assets` and replaces its marks `@NAME@` by `parts`.

    In Markdown, the characters of NAME that have a meaning there, or in HTML, are escaped. Raises a KeyError if a mark
    of the template is not among `parts`."""
    if asset.endswith(".md"):
        parts["NAME"] = _MARKDOWN.sub(r"\\\g<0>", printable(parts["NAME"]))
    return bundle.filled(__package__, asset, **{name: text.rstrip("\n") for name, text in parts.items()})


def write_texts(folder: Path, texts: dict[str, str]) -> None:
    """Writes text files into a folder; `texts` maps each file name to its text."""
    for name, text in texts.items():
        (folder / name).write_bytes(text.encode())


def check_sides(name: str, engine: str, file: str, pixels: np.ndarray) -> None:
    """Checks that an engine accepts the size of a picture [H, W, C]; `name` is the model's name for messages."""
    height, width = pixels.shape[:2]
    if max(height, width) > _MOST_SIDE[engine]:
        most = f"expected at most {_MOST_SIDE[engine]} texels along a side"
        raise WlmError(f"{name}: cannot export for {engine}: {file}: {most}, found {width}x{height}")


def picture_entry(file: str, pixels: np.ndarray, layers: int = 0) -> dict[str, Any]:
    """Returns the index entry of a picture [H, W, C] that replaces a texture, whose layers are stacked vertically."""
    return {"file": file, "width": pixels.shape[1], "height": pixels.shape[0], "layers": layers}


def stacked(images: np.ndarray) -> np.ndarray:
    """Stacks the layers of an array [L, H, W, C] vertically to [L * H, W, C]; a picture [H, W, C] is unchanged."""
    return images.reshape(-1, *images.shape[-2:])


def label(name: str) -> str:
    """Converts a model's name to one that is valid in a Unity shader."""
    return re.sub(r"[^\w .-]", "_", name)


def asset_name(name: str) -> str:
    """Converts a model's name to one that is valid for an Unreal asset."""
    return re.sub(r"\W", "_", name, flags=re.ASCII) or "_"


def godot_uniforms(text: str, *, mips: bool = False) -> str:
    """Rewrites the texture declarations of our GLSL in Godot's shading language. Integer textures become float
    textures, which hold their numbers exactly. With `mips` the filter reads mip levels."""
    hints = f"filter_linear{'_mipmap' * mips}, repeat_disable"
    integer = [match[1] for match in _SAMPLER.finditer(text) if match[2] == "usampler2D"]

    def declared(match: re.Match[str]) -> str:
        hint = "filter_nearest, repeat_disable" if match[1] in integer else hints
        kind = match[2].removeprefix("u")
        return f"uniform {kind} {match[3]} : {hint};\n#define {match[1]} {match[3]}\n"

    text = _SAMPLER.sub(declared, text)
    for name in integer:
        text = re.sub(rf"texelFetch\({name}, [^;]*?, 0\)(\.\w+)?", _as_integer, text)
    return text


def _as_integer(read: re.Match[str]) -> str:
    count = len(read[1]) - 1 if read[1] else 4
    return f"{'uint' if count == 1 else f'uvec{count}'}({read[0]})"
