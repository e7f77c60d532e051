"""The shader of a flip book on a billboard: its pixel at any time, under directional lights and an even sky.

It ends with the functions that engines' materials call; those of `wlm.smoke.shader` come before them.
"""

import math

from wlm.bundle import sampler
from wlm.shading import LANGUAGES, translate
from wlm.smoke.book import Book
from wlm.smoke.shading import Ramp

_READ = """
// Both textures' texels at a place of the billboard: (0, 0) its top left, (1, 1) its bottom right. The time is in
// frames from 0 on, between two of which both are mixed; texels: how many of a frame a pixel of the screen is wide.
void wlm_smoke_texels(vec2 place, float time, float texels, out vec4 first, out vec4 second)
{{
    float frame = clamp(floor(time), 0.0, {last:.1f});
    float share = clamp(time - frame, 0.0, 1.0);
    float mip = wlm_smoke_level(texels);
{between}
    first = mix(textureLod(WLM_SMOKE_FIRST_MAP, early, mip), textureLod(WLM_SMOKE_FIRST_MAP, late, mip), share);
    second = mix(textureLod(WLM_SMOKE_SECOND_MAP, early, mip), textureLod(WLM_SMOKE_SECOND_MAP, late, mip), share);
}}

// The light that the smoke throws to the viewer under a light of an irradiance, as of `toward` of wlm_smoke_light.
vec3 wlm_smoke_lit(vec4 first, vec4 second, vec3 toward, vec3 irradiance)
{{
    return irradiance * (wlm_smoke_light(first, second, toward) * {share});
}}

// The same under a sky of one radiance all round: the mean of the six lightmaps.
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

// The light that the smoke gives off itself.
vec3 wlm_smoke_glow(vec4 first, vec4 second)
{{
{glow}
}}

// All of it under one light and the sky, and in the fourth place the opacity: pixel = rgb + behind * (1 - opacity).
vec4 wlm_smoke_pixel(vec2 place, float time, float texels, vec3 toward, vec3 irradiance, vec3 sky)
{{
    vec4 first;
    vec4 second;
    wlm_smoke_texels(place, time, texels, first, second);
    vec3 light = wlm_smoke_lit(first, second, toward, irradiance) + wlm_smoke_sky(first, second, sky);
    return vec4(light + wlm_smoke_glow(first, second), wlm_smoke_alpha(first, second));
}}
"""

_FADE = """\
    vec2 early = wlm_smoke_uv(place, frame);
    vec2 late = wlm_smoke_uv(place, frame + 1.0);"""
# The motion of what is here at this time, which was elsewhere in the first frame.
_MOVE = """\
    vec4 here = textureLod(WLM_SMOKE_MOTION_MAP, wlm_smoke_uv(place, frame), mip);
    vec2 start = wlm_smoke_before(place, wlm_smoke_motion(here), share);
    vec4 there = textureLod(WLM_SMOKE_MOTION_MAP, wlm_smoke_uv(start, frame), mip);
    vec2 way = wlm_smoke_motion(there);
    vec2 early = wlm_smoke_uv(wlm_smoke_before(place, way, share), frame);
    vec2 late = wlm_smoke_uv(wlm_smoke_after(place, way, share), frame + 1.0);"""


def billboard_shader(book: Book, language: str = "glsl") -> str:
    """Writes the shader of a flip book on a billboard.

    Its textures are `wlm_smoke_first_map`, `wlm_smoke_second_map` and, with motion, `wlm_smoke_motion_map`.

    Args:
        book: The flip book.
        language: One of `wlm.shading.LANGUAGES`.

    Raises:
        ValueError: No such language.
    """
    if language not in LANGUAGES:
        raise ValueError(f"expected one of {', '.join(LANGUAGES)}, got {language!r}")
    textures = "\n".join(sampler(f"wlm_smoke_{name}_map", "sampler2D") for name in book.pages)
    text = _READ.format(
        last=book.count - 1,
        between=_FADE if book.motion is None else _MOVE,
        share=f"{0.25 / math.pi:.9g}",
        glow=_glow(book.ramp) if book.hot else "    return vec3(0.0, 0.0, 0.0);",
    )
    return translate(f"{book.shader('glsl')}\n{textures}{text}", language)


def _glow(ramp: Ramp | None) -> str:
    """The colour of an emission: each mix leaves what the ones before gave, or takes its own stop's colour whole."""
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
    """A number that GLSL ES too takes for a float, in brackets below 0."""
    text = f"{number:.9g}"
    text = text if "." in text or "e" in text else f"{text}.0"
    return f"({text})" if number < 0 else text
