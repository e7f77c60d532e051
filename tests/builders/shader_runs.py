"""Runs shaders on a machine without a GPU: GLSL through Mesa's llvmpipe (moderngl), WGSL through wgpu."""

import functools
import re

import numpy as np
import pytest

ES = "#version 300 es\nprecision highp float;\nprecision highp int;\nprecision highp sampler2D;\n"
ES += "precision highp usampler2D;\nprecision highp sampler2DArray;\n"
HEADS = {"glsl": "#version 330\n", "glsl-es": ES}
_WHOLE = "void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }"
_FORMS = {"uint8": ("f1", 1), "uint16": ("u2", 2), "uint32": ("u4", 4), "float16": ("f2", 2), "float32": ("f4", 4)}


@functools.cache
def _context():
    import moderngl

    return moderngl.create_context(standalone=True, backend="egl", require=330)


def gl():
    """A GL context without a display; skips the test, with what to install, where there is none."""
    pytest.importorskip("moderngl", reason="moderngl is not installed (pip, extra test)")
    try:
        return _context()
    except Exception as error:  # noqa: BLE001  # moderngl has no class of its own for it
        pytest.skip(f"no OpenGL without a display: install Mesa (libegl1, libgl1-mesa-dri): {error}")


def run_glsl(text, main, size, textures, language="glsl", uniforms=None):
    """Draws one picture, float32 [height, width, 4].

    Args:
        text: The functions.
        main: What is below them, which writes `light`; `ivec2 pixel` is the place in the picture.
        size: Height and width.
        textures: By name: [h, w, c], uint8 for levels from 0 to 1, other integers as they are; [n, h, w, c]: an array.
        language: A key of `HEADS`.
        uniforms: By name.
    """
    context = gl()
    vertex = re.sub(r"\A(#version.*\n)[^\0]*", r"\1", HEADS[language]) + _WHOLE
    body = f"out vec4 light;\nvoid main()\n{{\n    ivec2 pixel = ivec2(gl_FragCoord.xy);\n    {main}\n}}\n"
    program = context.program(vertex_shader=vertex, fragment_shader=HEADS[language] + text + body)
    made = []
    for unit, (name, values) in enumerate(textures.items()):
        if name not in program:
            continue
        values = np.ascontiguousarray(values)
        shape = (values.shape[-2], values.shape[-3], *values.shape[:-3])
        kind = _FORMS[values.dtype.name][0]
        make = context.texture_array if values.ndim == 4 else context.texture
        texture = make(shape, values.shape[-1], values.tobytes(), dtype=kind, alignment=1)
        linear = kind in ("f1", "f2", "f4")
        texture.filter = (context.LINEAR, context.LINEAR) if linear else (context.NEAREST, context.NEAREST)
        texture.repeat_x = texture.repeat_y = False
        texture.use(unit)
        program[name].value = unit
        made.append(texture)
    for name, value in (uniforms or {}).items():
        program[name].value = value
    target = context.texture(size[::-1], 4, dtype="f4")
    frame = context.framebuffer([target])
    frame.use()
    array = context.vertex_array(program, [])
    array.render(context.TRIANGLES, vertices=3)
    error = context.error
    assert error == "GL_NO_ERROR", error
    picture = np.frombuffer(target.read(), np.float32).reshape(*size, 4).copy()
    for thing in made:
        thing.release()
    return picture
