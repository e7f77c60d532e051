"""A part of all shaders of probes: storage buffers, and macros that read them."""

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
    """Returns the GLSL of a storage buffer and of `WLM_PART_NAME(i)`, which reads its entry i.

    Args:
        part, name: Words of the macro's name, in any case.
        number: Default binding.
        kind: Type of an entry.
    """
    part, name = part.lower(), name.lower()
    words = {"part": part, "name": name, "Part": part.title(), "Name": name.title()}
    return _BUFFER.format(number=number, kind=kind, PART=part.upper(), NAME=name.upper(), **words)
