"""Shaders of flip books, and the results that they must give."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from builders.shader_subjects import POINTS, Subject, points_of
from builders.smoke_books import IRRADIANCE, SKY, TOWARD, random_book, random_frames
from builders.smoke_books import shown as shown_book

from wlm.smoke.camera import LAYOUTS, Camera
from wlm.smoke.flipbook.book import Shot, pack_book
from wlm.smoke.flipbook.shader import billboard_shader, smoke_shader
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.shading import Light


def smoke(layout, _) -> Subject:
    """Compares the functions with `shade` of the frames in the textures, and with the places of the frames."""
    random = np.random.default_rng(5)
    maps = torch.tensor(random.uniform(0, 1, (5, 8, 6, 9)), dtype=torch.float32)
    frames = [SixWay(m[:6], m[6], m[7]) for m in maps]
    camera = Camera.look_at((0, 0, 5), (0, 0, 0), extent=6.0, height=6, width=9)
    book = pack_book([Shot(n, frame) for n, frame in enumerate(frames)], layout, gain=0.5, padding=2)
    text = smoke_shader(book)
    asked, way, expected = [], [], []
    for n, frame in enumerate(frames):
        for row, column in ((0, 0), (3, 7), (5, 8)):
            texel = n // 3 * 10 + 2 + row, n % 3 * 13 + 2 + column
            for toward in ((0.6, 0.0, 0.8), (-0.6, 0.8, 0.0), (0.48, -0.6, -0.64)):
                light = replace(frame, camera=camera, emission=None).shade([Light(toward)])[row, column, 0]
                asked.append([(column + 0.5) / 9, (row + 0.5) / 6, n])
                way.append(toward)
                alpha = 1 - frame.transparency[row, column]
                expected.append([*texel[::-1], light, 2 * alpha + 4 * frame.emission[row, column]])
    main = (
        POINTS
        + """uniform sampler2D u_ways;
uniform sampler2D u_first;
uniform sampler2D u_second;
vec4 shown(ivec2 pixel)
{
    vec4 asked = texelFetch(u_points, pixel, 0);
    vec2 at = wlm_smoke_uv(asked.xy, asked.z);
    ivec2 texel = ivec2(floor(at * vec2(textureSize(u_first, 0))));
    vec4 a = texelFetch(u_first, texel, 0);
    vec4 b = texelFetch(u_second, texel, 0);
    float light = wlm_smoke_light(a, b, texelFetch(u_ways, pixel, 0).xyz);
    return vec4(vec2(texel), light, 2.0 * wlm_smoke_alpha(a, b) + 4.0 * wlm_smoke_emission(a, b));
}
"""
    )
    pages = {"u_first": book.first, "u_second": book.second}
    bound = {"u_points": points_of(asked), "u_ways": points_of(way), **pages}
    return Subject(text, main, np.array(expected, np.float32)[None], bound, "", 2e-5)


def smoke_level(_) -> Subject:
    """Compares the mip level with the logarithm of the width of a screen pixel in texels."""
    text = smoke_shader(random_book(random_frames(size=(24, 24)), padding=4))
    width = 2.0 ** np.random.default_rng(7).uniform(-1, 5, 12)
    level = np.clip(np.log2(np.maximum(width, 1.0)), 0.0, 3.0)
    main = (
        POINTS
        + """vec4 shown(ivec2 pixel)
{
    return vec4(wlm_smoke_level(texelFetch(u_points, pixel, 0).x));
}
"""
    )
    bound = {"u_points": points_of(np.repeat(width[:, None], 3, 1))}
    return Subject(text, main, np.float32(np.repeat(level[:, None], 4, 1))[None], bound, "", 2e-5)


def billboard(_) -> Subject:
    """Compares a billboard of fire with `shade`, at and between frames."""
    frames = random_frames()
    book = random_book(frames)
    times = (0.0, 1.5, 3.25)
    expected = np.concatenate([shown_book(frames, book, time) for time in times])
    main = f"""
vec4 shown(ivec2 pixel)
{{
    vec2 place = (vec2(float(pixel.x), float(pixel.y % 12)) + vec2(0.5, 0.5)) / vec2(16.0, 12.0);
    float time = pixel.y < 12 ? {times[0]} : pixel.y < 24 ? {times[1]} : {times[2]};
    return wlm_smoke_pixel(place, time, 1.0, vec3{TOWARD}, vec3{IRRADIANCE}, vec3{SKY});
}}
"""
    levels = {f"wlm_smoke_{name}_map": np.uint8(np.rint(page * 255.0)) for name, page in book.pages.items()}
    full = {name: np.pad(page, ((0, 0), (0, 0), (0, 4 - page.shape[2]))) for name, page in levels.items()}
    # Eight bits of each of the textures, and of a filter's place between two texels.
    return Subject(billboard_shader(book), main, np.float32(expected), full, "", 1.6 / 255)


def smoke_subjects() -> dict[str, Callable[[object], Subject]]:
    """Returns all subjects by name."""
    layouts = {f"smoke {layout}": partial(smoke, layout) for layout in LAYOUTS}
    return {"smoke level": smoke_level, "smoke billboard": billboard} | layouts
