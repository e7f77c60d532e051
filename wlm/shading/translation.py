"""The exported shaders in the languages of engines, from their one GLSL text."""

from collections.abc import Iterable

from wlm.errors import WlmError
from wlm.shading.heads import decided
from wlm.shading.hlsl import HlslWriter
from wlm.shading.metal import MetalWriter
from wlm.shading.source import read_words
from wlm.shading.tree import read_shader
from wlm.shading.wgsl import WgslWriter

LANGUAGES = ("glsl", "glsl-es", "hlsl", "msl", "wgsl")
"""Languages that shaders are exported in."""

ENDINGS = {"glsl": ".glsl", "glsl-es": ".glsl", "hlsl": ".hlsl", "msl": ".metal", "wgsl": ".wgsl"}
"""Of their files."""

_WRITERS = {"hlsl": HlslWriter, "msl": MetalWriter, "wgsl": WgslWriter}
_VERSIONS = {"hlsl": "HLSL, shader model 5 and later", "msl": "Metal 2 and later", "wgsl": "WGSL"}
_PRECISIONS = "".join(
    f"precision highp {kind};\n" for kind in ("float", "int", "sampler2D", "usampler2D", "sampler2DArray")
)


def check_language(language: str) -> None:
    """Checks a language's name.

    Raises:
        WlmError: It is none of `LANGUAGES`.
    """
    if language not in LANGUAGES:
        raise WlmError(f"shader: expected one of {', '.join(LANGUAGES)}, got {language!r}")


def translate(text: str, language: str, defined: Iterable[str] = ()) -> str:
    """Writes one of our shaders in another language.

    GLSL stays as it is: conditions and macros are its includer's. The other languages have what holds with `defined`:
    functions of the same names, the textures under their names and one sampler, linear and clamped to the edge.

    Args:
        text: GLSL of `wlm`, with the words and types that our shaders use.
        language: One of `LANGUAGES`.
        defined: Macros that are defined, for example `WLM_ATLAS_EXACT`.

    Raises:
        WlmError: No such language.
        ValueError: GLSL beyond what our shaders are made of.
    """
    check_language(language)
    if not language.startswith("glsl"):
        defined = tuple(defined)
        text = decided(text, _VERSIONS[language], defined)
        return _WRITERS[language](read_shader(read_words(text, defined))).text()
    defines = "".join(f"#define {name}\n" for name in defined)
    return (_PRECISIONS if language == "glsl-es" else "") + defines + text
