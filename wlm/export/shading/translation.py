"""Translates exported shaders from GLSL into the shading languages of engines."""

from collections.abc import Iterable
from typing import Any

from wlm.errors import WlmError
from wlm.export.shading.hlsl import HlslWriter
from wlm.export.shading.source import read_words
from wlm.export.shading.tree import read_shader
from wlm.export.shading.wgsl import WgslWriter

LANGUAGES = ("glsl", "glsl-es", "hlsl", "wgsl")
"""Languages in which shaders are exported."""

ENDINGS = {"glsl": ".glsl", "glsl-es": ".glsl", "hlsl": ".hlsl", "wgsl": ".wgsl"}
"""Endings of shader files by language."""

_WRITERS: dict[str, Any] = {"hlsl": HlslWriter, "wgsl": WgslWriter}
_VERSIONS = {"hlsl": "HLSL, shader model 5 and later", "wgsl": "WGSL"}
_PRECISIONS = "".join(
    f"precision highp {kind};\n" for kind in ("float", "int", "sampler2D", "usampler2D", "sampler2DArray")
)


def check_language(language: str) -> None:
    """Checks the name of a shading language."""
    if language not in LANGUAGES:
        raise WlmError(f"shader: expected one of {', '.join(LANGUAGES)}, got {language!r}")


def translate(text: str, language: str, defined: Iterable[str] = ()) -> str:
    """Translates a shader of this package to another language.

    GLSL is not changed, except for macros and precisions at its head; conditional directives are left to the including
    shader. In the other languages macros are expanded, which a comment at the head states. Functions and textures keep
    their names, and one sampler, linear and clamped to the edge, reads all filtered textures.

    Args:
        text: GLSL of this package, in the subset of the language that `wlm.export.shading.tree` parses.
        language: One of `LANGUAGES`.
        defined: Macros to define, for example `WLM_ATLAS_EXACT`.

    Raises:
        WlmError: Unknown language.
        ValueError: The text uses GLSL that `wlm.export.shading.tree` cannot parse.
    """
    check_language(language)
    if not language.startswith("glsl"):
        defined = tuple(defined)
        macros = f" with {', '.join(defined)} defined" if defined else ""
        head = (
            f"// {_VERSIONS[language]}, translated from the GLSL that is described below{macros}; macros are expanded."
        )
        return _WRITERS[language](read_shader(read_words(f"{head}\n//\n{text}", defined))).text()
    defines = "".join(f"#define {name}\n" for name in defined)
    return (_PRECISIONS if language == "glsl-es" else "") + defines + text
