"""Generates the GLSL that reads a volume from the buffers of `wlm.probe.volume.bundle`."""

from wlm.bundle import filled
from wlm.probe.glsl import buffer_glsl
from wlm.probe.sphere import sh_count

HEAD_WORDS = 8  # words of the buffer `volume` before the levels
LEVEL_WORDS = 16

_BUFFERS = ("HEAD", "PAGE", "POOL")  # in the order of their bindings


def row_words(outputs: int) -> int:
    """Returns the number of 32-bit words of a row of the pool: a factor, and D half floats."""
    return 1 + (outputs + 1) // 2


def volume_glsl(outputs: int) -> str:
    """Returns the GLSL that reads a volume: functions to be included below `#version`. `outputs` is D, the count of
    numbers per probe; for spherical harmonics of L0 to L2 in RGB there is also a function for a diffuse surface. It is
    GLSL 4.30, which is also valid Vulkan GLSL."""
    buffers = [buffer_glsl("volume", name, number) for number, name in enumerate(_BUFFERS)]
    words = {"head": HEAD_WORDS, "level_words": LEVEL_WORDS, "row_words": row_words(outputs)}
    text = filled(__package__, "read.glsl", buffers="".join(buffers), outputs=outputs, **words)
    coefficients = sh_count(outputs)
    if coefficients in (1, 4, 9):
        text += filled(__package__, "diffuse.glsl", coefficients=coefficients, outputs=outputs)
    return text
