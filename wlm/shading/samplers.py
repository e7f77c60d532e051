"""Declarations of textures that the includer of a shader can take over or place."""

_TEXT = """\
#ifndef {macro}
#ifndef {macro}_BINDING
uniform {kind} {name};
#else
layout(binding = {macro}_BINDING) uniform {kind} {name};
#endif
#define {macro} {name}
#endif
"""


def sampler(name: str, kind: str) -> str:
    """Declares a texture, unless the macro of its name in capitals is defined before as another one's name.

    Where the macro with `_BINDING` at its end is defined, as Vulkan needs it, it is at that binding.

    Args:
        name: Of the uniform, `wlm_atlas_colour` for example.
        kind: `sampler2D`, `usampler2D` or `sampler2DArray`.
    """
    return _TEXT.format(macro=name.upper(), name=name, kind=kind)
