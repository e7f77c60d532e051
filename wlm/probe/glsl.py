"""Generates GLSL that all shaders of probes share: storage buffers, and macros that read them."""

_BUFFER = """\
#ifndef WLM_{PART}_{NAME}
#ifndef WLM_{PART}_{NAME}_BINDING
#define WLM_{PART}_{NAME}_BINDING {number}
#endif
layout(std430, binding = WLM_{PART}_{NAME}_BINDING) readonly buffer Wlm{Part}{Name}
{{
    {kind} wlm_{part}_{name}[];
}};
#define WLM_{PART}_{NAME}(i) wlm_{part}_{name}[i]
#endif
"""


def buffer_glsl(part: str, name: str, number: int, kind: str = "uint") -> str:
    """Returns the GLSL of a storage buffer and of the macro `WLM_PART_NAME(i)`, which reads entry i of the buffer.

    Args:
        part, name: Words for PART and NAME in the macro's name, in upper or lower case.
        number: Default binding of the buffer.
        kind: GLSL type of an entry.
    """
    part, name = part.lower(), name.lower()
    words = {"part": part, "name": name, "Part": part.title(), "Name": name.title()}
    return _BUFFER.format(number=number, kind=kind, PART=part.upper(), NAME=name.upper(), **words)
