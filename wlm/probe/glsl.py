"""Generates GLSL that all shaders of probes share: storage buffers, and macros that read them."""

from wlm.probe.sphere import ambient_numbers

_BUFFER = """\
#ifndef WLM_{PART}_{NAME}
#ifndef WLM_{PART}_{NAME}_BINDING
#define WLM_{PART}_{NAME}_BINDING {number}
#endif
layout(std430, binding = WLM_{PART}_{NAME}_BINDING) {access}buffer Wlm{Part}{Name}
{{
    {kind} wlm_{part}_{name}[];
}};
#define WLM_{PART}_{NAME}(i) wlm_{part}_{name}[i]
#endif
"""
_SH = """
// Spherical harmonics of the light: {coefficients} coefficients, RGB.
void {name}({arguments}, out vec3 sh[{coefficients}])
{{
    float values[WLM_PROBE_OUTPUTS];
    {call};
    for (int c = 0; c < {coefficients}; ++c)
        sh[c] = vec3(values[3 * c], values[3 * c + 1], values[3 * c + 2]);
}}
"""


def buffer_glsl(part: str, name: str, number: int, kind: str = "uint", written: bool = False) -> str:
    """Returns the GLSL of a storage buffer and of the macro `WLM_PART_NAME(i)`, which reads entry i of the buffer.

    Args:
        part, name: Words for PART and NAME in the macro's name, in upper or lower case.
        number: Default binding of the buffer.
        kind: GLSL type of an entry.
        written: Whether shaders write the buffer, too.
    """
    part, name = part.lower(), name.lower()
    words = {"part": part, "name": name, "Part": part.title(), "Name": name.title()}
    access = "" if written else "readonly "
    return _BUFFER.format(number=number, kind=kind, access=access, PART=part.upper(), NAME=name.upper(), **words)


def clamp_glsl(outputs: int) -> str:
    """Returns the GLSL statements that clamp the ambient light among D numbers, `values`, at 0."""
    lines = ["for (int i = 0; i < 3; ++i)", "    values[i] = max(values[i], 0.0);"] if ambient_numbers(outputs) else []
    return "".join(f"\n    {line}" for line in lines)


def sh_glsl(name: str, arguments: str, call: str, coefficients: int) -> str:
    """Returns a GLSL function that gives the numbers of a probe as spherical harmonics in RGB.

    Args:
        name: Name of the function.
        arguments: Its parameters before the output `sh`, an array of vec3.
        call: Function call that writes the array of numbers, `values`.
        coefficients: Number of coefficients.
    """
    return _SH.format(name=name, arguments=arguments, call=call, coefficients=coefficients)
