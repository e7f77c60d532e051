"""What the folders for engines have in common."""

import re
from importlib import resources

import numpy as np

from wlm.errors import WlmError

ENGINES = ("three", "godot", "unity", "unreal")
"""Engines that folders are made for."""

README_FILE = "README.md"

# Texels along a side of a picture that the editor imports, or that WebGL2 has on most machines.
_MOST_SIDE = {"unreal": 8192, "godot": 16384, "unity": 16384, "three": 16384}

_MARK = re.compile(r"@(\w+)@")
_SAMPLER = re.compile(
    r"#ifndef (\w+)\n#ifndef \1_BINDING\nuniform (\w+) (\w+);\n#else\n.*\n#endif\n#define \1 \3\n#endif\n"
)


def filled(asset: str, **parts: str) -> str:
    """A file of `assets`, with what its marks, `@NAME@`, stand for.

    Raises:
        KeyError: A mark that isn't given.
    """
    text = (resources.files("wlm.engines") / "assets" / asset).read_text(encoding="utf-8")
    return _MARK.sub(lambda match: parts[match[1]].rstrip("\n"), text)


def check_sides(name: str, engine: str, file: str, pixels: np.ndarray) -> None:
    """Checks that an engine takes a picture; `name` is the model's.

    Raises:
        WlmError: It is too large.
    """
    height, width = pixels.shape[:2]
    if max(height, width) > _MOST_SIDE[engine]:
        most = f"expected at most {_MOST_SIDE[engine]} texels along a side"
        raise WlmError(f"{name}: cannot export for {engine}: {file}: {most}, found {width}x{height}")


def _whole(read: re.Match[str]) -> str:
    count = len(read[1]) - 1 if read[1] else 4
    return f"{'uint' if count == 1 else f'uvec{count}'}({read[0]})"


def godot_uniforms(text: str, *, mips: bool = False) -> str:
    """Our GLSL as Godot's shading language has it: textures with hints, and none of whole numbers.

    Of a table of whole numbers Godot has floats, which hold them exactly. With `mips` it reads those of the textures.
    """
    hints = f"filter_linear{'_mipmap' * mips}, repeat_disable"
    whole = [match[1] for match in _SAMPLER.finditer(text) if match[2] == "usampler2D"]

    def declared(match: re.Match[str]) -> str:
        hint = "filter_nearest, repeat_disable" if match[1] in whole else hints
        kind = match[2].removeprefix("u")
        return f"uniform {kind} {match[3]} : {hint};\n#define {match[1]} {match[3]}\n"

    text = _SAMPLER.sub(declared, text)
    for name in whole:
        text = re.sub(rf"texelFetch\({name}, [^;]*?, 0\)(\.\w+)?", _whole, text)
    return text
