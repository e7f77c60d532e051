"""The shader of a six-way flip book: where a frame lies, its light from a direction or a point, its motion."""

from wlm.shading import LANGUAGES, translate
from wlm.smoke.camera import ALPHA, EMISSION, LAYOUTS
from wlm.smoke.flipbook_motion import ZERO, mip_levels

_TEXT = """\
// Six-way smoke of {count} frames, in {rows} x {columns} cells, in the channels of "{layout}".
// (Neural Six-way Lightmaps for Real-time Smoke Rendering, eq. 4; lights weigh by squares, as in engines.)
// For GLSL 3.30, GLSL ES 3.00 and later; include it below #version.
// Both textures are linear, not sRGB; sample both at wlm_smoke_uv, clamped to their edge.
//
//     light = sum over lights of irradiance / (4 pi) * wlm_smoke_light(first, second, toward)
//     and over lights at a point, of way = wlm_smoke_point(place, size, depth, position, radius),
//             of intensity / (4 pi) * way.w * wlm_smoke_light(first, second, way.xyz)
//     pixel = light + colour * wlm_smoke_emission(first, second) + behind * (1 - wlm_smoke_alpha(first, second))

// The texture's coordinates of a frame, from 0 on, at a place on the billboard: (0, 0) its top left, (1, 1) its bottom
// right.
vec2 wlm_smoke_uv(vec2 place, float frame)
{{
    float cell = clamp(floor(frame), 0.0, {last:.1f});
    float row = floor((cell + 0.5) / {columns:.1f});
    float column = cell - {columns:.1f} * row;
    float x = column + {inset_x} + place.x * {share_x};
    float y = row + {inset_y} + place.y * {share_y};
    return vec2(x / {columns:.1f}, y / {rows:.1f});
}}

// The light of irradiance 4 pi from a direction, of length 1, from the smoke to the light: x to the billboard's right,
// y up, z to the viewer.
float wlm_smoke_light(vec4 first, vec4 second, vec3 toward)
{{
    float x = toward.x > 0.0 ? {right} : {left};
    float y = toward.y > 0.0 ? {top} : {bottom};
    float z = toward.z > 0.0 ? {front} : {back};
    return (toward.x * toward.x * x + toward.y * toward.y * y + toward.z * toward.z * z) * {factor};
}}

// Of a light at a point the direction from the smoke at a place, of length 1, and the falloff, its irradiance there
// over its intensity: an engine's own may stand for that. The size is the billboard's width and height; the position is
// from its middle, x to its right, y up, z to the viewer, in the unit of the size; within the radius, in that unit too,
// the falloff is as at it. The depth is how far the smoke lies before the billboard, in its heights: 0 is flat.
vec4 wlm_smoke_point(vec2 place, vec2 size, float depth, vec3 position, float radius)
{{
    vec3 smoke = vec3((place.x - 0.5) * size.x, (0.5 - place.y) * size.y, depth * size.y);
    vec3 way = position - smoke;
    float far = max(dot(way, way), {nearest});
    return vec4(way / sqrt(far), 1.0 / max(far, radius * radius));
}}

float wlm_smoke_alpha(vec4 first, vec4 second)
{{
    return {alpha};
}}

float wlm_smoke_emission(vec4 first, vec4 second)
{{
    return {emission};
}}

// The level for textureLod, of how many texels a pixel of the screen is wide: {levels} at most, beyond which
// frames show their neighbours.
float wlm_smoke_level(float texels)
{{
    return clamp(log2(max(texels, 1.0)), 0.0, {levels:.1f});
}}
"""

_DEPTH = """
// The depth for wlm_smoke_point, of the depth texture's texel at wlm_smoke_uv; that is linear too.
float wlm_smoke_depth(vec4 texel)
{{
    return (texel.x - {zero}) * {reach};
}}
"""

_MOTION = """
// Between two frames, at a share of 0 to 1 of the way from one to the next, both textures are read twice and mixed:
//
//     vec2 way = wlm_smoke_motion(texture(motion, wlm_smoke_uv(place, frame)));
//     way = wlm_smoke_motion(texture(motion, wlm_smoke_uv(wlm_smoke_before(place, way, share), frame)));
//     first = mix(texture(first, wlm_smoke_uv(wlm_smoke_before(place, way, share), frame)),
//                 texture(first, wlm_smoke_uv(wlm_smoke_after(place, way, share), frame + 1.0)), share)
//
// The motion from a frame to the next, on the billboard, of the motion texture's texel; that is linear too.
vec2 wlm_smoke_motion(vec4 texel)
{{
    vec2 way = texel.xy - vec2({zero}, {zero});
    return vec2(way.x * {reach}, way.y * -{reach});
}}

// Where the earlier frame shows what is at a place.
vec2 wlm_smoke_before(vec2 place, vec2 motion, float share)
{{
    return clamp(place - motion * share, vec2(0.0, 0.0), vec2(1.0, 1.0));
}}

// Where the later frame does.
vec2 wlm_smoke_after(vec2 place, vec2 motion, float share)
{{
    return clamp(place + motion * (1.0 - share), vec2(0.0, 0.0), vec2(1.0, 1.0));
}}
"""

_NEAREST = 1e-12  # squared distance to a light below which it counts the same


def smoke_shader(
    language: str,
    layout: str,
    *,
    rows: int,
    columns: int,
    count: int,
    size: tuple[int, int],
    padding: int = 0,
    gain: float = 1.0,
    hot: bool = True,
    motion: float | None = None,
    depth: float | None = None,
) -> str:
    """Writes the shader of a flip book.

    Args:
        language: One of `wlm.shading.LANGUAGES`.
        layout: One of `wlm.smoke.camera.LAYOUTS`.
        rows, columns, count: Of cells, and of frames in them.
        size: Height and width of a frame in pixels, without padding.
        padding: Pixels around it.
        gain: The factor on the light in the textures.
        hot: Whether they have a channel of emission.
        motion, depth: The scales of its textures of motion and of depth; None: it has none.

    Raises:
        ValueError: No such language or layout.
    """
    if language not in LANGUAGES or layout not in LAYOUTS:
        known = f"{', '.join(LANGUAGES)} and of {', '.join(LAYOUTS)}"
        raise ValueError(f"expected one of {known}, got {language!r} and {layout!r}")
    places = {
        name: f"{texture}.{letter}"
        for texture, names in zip(("first", "second"), LAYOUTS[layout], strict=True)
        for name, letter in zip(names, "rgba", strict=True)
    }
    height, width = (n + 2 * padding for n in size)
    alpha, emission = places.pop(ALPHA), places.pop(EMISSION)
    text = _TEXT.format(
        layout=layout,
        rows=rows,
        columns=columns,
        count=count,
        last=count - 1,
        inset_x=_literal(padding / width),
        inset_y=_literal(padding / height),
        share_x=_literal(size[1] / width),
        share_y=_literal(size[0] / height),
        factor=_literal(1.0 / gain),
        nearest=_literal(_NEAREST),
        levels=mip_levels(*size, padding),
        alpha=alpha,
        emission=f"{emission} * {_literal(1.0 / gain)}" if hot else "0.0",
        **places,
    )
    if depth is not None:
        text += _DEPTH.format(zero=_literal(ZERO), reach=_literal(2.0 * depth))
    if motion is not None:
        text += _MOTION.format(zero=_literal(ZERO), reach=_literal(2.0 * motion))
    return translate(text, language)


def _literal(number: float) -> str:
    """A number that GLSL ES too takes for a float."""
    text = f"{number:.9g}"
    return text if "." in text or "e" in text else f"{text}.0"
