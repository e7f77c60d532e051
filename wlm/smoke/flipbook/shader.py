"""Shaders of six-way flip books: functions that read the textures, and a billboard that plays and lights a book."""

import math

from wlm.bundle import sampler
from wlm.smoke.camera import ALPHA, EMISSION, LAYOUTS
from wlm.smoke.flipbook.book import Book
from wlm.smoke.shading import Ramp

_TEXT = """\
// Six-way smoke of {count} frames, in {rows} x {columns} cells, in the channels of "{layout}".
// (Neural Six-way Lightmaps for Real-time Smoke Rendering, eq. 4; weights are squares, as in engines.)
// For GLSL 3.30, GLSL ES 3.00 and later; include it below #version.
// Both textures are linear, not sRGB; sample both at wlm_smoke_uv, clamped to their edge.
//
//     light = sum over lights of irradiance / (4 pi) * wlm_smoke_light(first, second, toward)
//     pixel = light + colour * wlm_smoke_emission(first, second) + behind * (1 - wlm_smoke_alpha(first, second))

// Returns the texture coordinates of a frame, counted from 0, at a place on the billboard: (0, 0) is the top left,
// (1, 1) the bottom right.
vec2 wlm_smoke_uv(vec2 place, float frame)
{{
    float cell = clamp(floor(frame), 0.0, {last:.1f});
    float row = floor((cell + 0.5) / {columns:.1f});
    float column = cell - {columns:.1f} * row;
    float x = column + {inset_x} + place.x * {share_x};
    float y = row + {inset_y} + place.y * {share_y};
    return vec2(x / {columns:.1f}, y / {rows:.1f});
}}

// Returns the scattered light of a light of irradiance 4 pi. The direction to it has length 1: x to the billboard's
// right, y up, z to the viewer.
float wlm_smoke_light(vec4 first, vec4 second, vec3 toward)
{{
    float x = toward.x > 0.0 ? {right} : {left};
    float y = toward.y > 0.0 ? {top} : {bottom};
    float z = toward.z > 0.0 ? {front} : {back};
    return (toward.x * toward.x * x + toward.y * toward.y * y + toward.z * toward.z * z) * {factor};
}}

float wlm_smoke_alpha(vec4 first, vec4 second)
{{
    return {alpha};
}}

float wlm_smoke_emission(vec4 first, vec4 second)
{{
    return {emission};
}}

// Returns the level for textureLod from the width of a screen pixel in texels. The largest is {levels}: beyond it
// frames show their neighbours.
float wlm_smoke_level(float texels)
{{
    return clamp(log2(max(texels, 1.0)), 0.0, {levels:.1f});
}}
"""


def smoke_shader(book: Book) -> str:
    """Returns the shader code of functions that read a flip book's textures."""
    places = {
        name: f"{texture}.{letter}"
        for texture, names in zip(("first", "second"), LAYOUTS[book.layout], strict=True)
        for name, letter in zip(names, "rgba", strict=True)
    }
    height, width = (n + 2 * book.padding for n in book.size)
    alpha, emission = places.pop(ALPHA), places.pop(EMISSION)
    return _TEXT.format(
        layout=book.layout,
        rows=book.rows,
        columns=book.columns,
        count=book.count,
        last=book.count - 1,
        inset_x=_number(book.padding / width),
        inset_y=_number(book.padding / height),
        share_x=_number(book.size[1] / width),
        share_y=_number(book.size[0] / height),
        factor=_number(1.0 / book.gain),
        levels=book.levels,
        alpha=alpha,
        emission=f"{emission} * {_number(1.0 / book.gain)}" if book.hot else "0.0",
        **places,
    )


_READ = """
// Reads both textures at a place of the billboard: (0, 0) is the top left, (1, 1) the bottom right. The time is in
// frames, counted from 0; between two frames both are mixed. The width of a screen pixel is given in texels.
void wlm_smoke_texels(vec2 place, float time, float texels, out vec4 first, out vec4 second)
{{
    float frame = clamp(floor(time), 0.0, {last:.1f});
    float share = clamp(time - frame, 0.0, 1.0);
    float mip = wlm_smoke_level(texels);
    vec2 early = wlm_smoke_uv(place, frame);
    vec2 late = wlm_smoke_uv(place, frame + 1.0);
    first = mix(textureLod(WLM_SMOKE_FIRST_MAP, early, mip), textureLod(WLM_SMOKE_FIRST_MAP, late, mip), share);
    second = mix(textureLod(WLM_SMOKE_SECOND_MAP, early, mip), textureLod(WLM_SMOKE_SECOND_MAP, late, mip), share);
}}

// Returns the light that the smoke scatters to the viewer under a light of an irradiance; see wlm_smoke_light.
vec3 wlm_smoke_lit(vec4 first, vec4 second, vec3 toward, vec3 irradiance)
{{
    return irradiance * (wlm_smoke_light(first, second, toward) * {share});
}}

// Returns the scattered light under a sky of constant radiance: the mean of the six lightmaps.
vec3 wlm_smoke_sky(vec4 first, vec4 second, vec3 radiance)
{{
    vec3 x = vec3(1.0, 0.0, 0.0);
    vec3 y = vec3(0.0, 1.0, 0.0);
    vec3 z = vec3(0.0, 0.0, 1.0);
    float sum = wlm_smoke_light(first, second, x) + wlm_smoke_light(first, second, -x);
    sum += wlm_smoke_light(first, second, y) + wlm_smoke_light(first, second, -y);
    sum += wlm_smoke_light(first, second, z) + wlm_smoke_light(first, second, -z);
    return radiance * (sum / 6.0);
}}

// Returns the light that the smoke emits.
vec3 wlm_smoke_glow(vec4 first, vec4 second)
{{
{glow}
}}

// Returns all light under one light and the sky, and the opacity: pixel = rgb + behind * (1 - opacity).
vec4 wlm_smoke_pixel(vec2 place, float time, float texels, vec3 toward, vec3 irradiance, vec3 sky)
{{
    vec4 first;
    vec4 second;
    wlm_smoke_texels(place, time, texels, first, second);
    vec3 light = wlm_smoke_lit(first, second, toward, irradiance) + wlm_smoke_sky(first, second, sky);
    return vec4(light + wlm_smoke_glow(first, second), wlm_smoke_alpha(first, second));
}}
"""


def billboard_shader(book: Book) -> str:
    """Returns the code of a shader that plays and lights a flip book on a billboard.

    Its textures are `wlm_smoke_first_map` and `wlm_smoke_second_map`.
    """
    textures = "\n".join(sampler(f"wlm_smoke_{name}_map", "sampler2D") for name in book.pages)
    text = _READ.format(
        last=book.count - 1,
        share=f"{0.25 / math.pi:.9g}",
        glow=_glow(book.ramp) if book.hot else "    return vec3(0.0, 0.0, 0.0);",
    )
    return f"{smoke_shader(book)}\n{textures}{text}"


def _glow(ramp: Ramp | None) -> str:
    """Returns shader code that computes the colour of the emission from the stops of a colour ramp."""
    lines = ["float emission = wlm_smoke_emission(first, second);"]
    if ramp is None:
        lines.append("return vec3(emission, emission, emission);")
    else:
        lines.append(f"vec3 colour = {_colour(ramp.colours[0])};")
        for low, high, colour in zip(ramp.stops, ramp.stops[1:], ramp.colours[1:], strict=False):
            share = f"clamp((emission - {_number(low)}) * {_number(1.0 / (high - low))}, 0.0, 1.0)"
            lines.append(f"colour = mix(colour, {_colour(colour)}, {share});")
        lines.append("return colour;")
    return "\n".join("    " + line for line in lines)


def _colour(colour: tuple[float, float, float]) -> str:
    return f"vec3({', '.join(map(_number, colour))})"


def _number(number: float) -> str:
    """Returns a number as a float literal of GLSL ES; negative numbers are in brackets."""
    text = f"{number:.9g}"
    text = text if "." in text or "e" in text else f"{text}.0"
    return f"({text})" if number < 0 else text
