"""Shaders of six-way flip books: functions that read the textures, and a billboard that plays and lights a book."""

import math

from wlm.bundle import filled, sampler
from wlm.smoke.camera import ALPHA, EMISSION, LAYOUTS
from wlm.smoke.flipbook.book import Book
from wlm.smoke.shading import Ramp


def smoke_shader(book: Book) -> str:
    """Returns the shader code of functions that read a flip book's textures."""
    places = {
        name: f"{texture}.{letter}"
        for texture, names in zip(("first", "second"), LAYOUTS[book.layout], strict=True)
        for name, letter in zip(names, "rgba", strict=True)
    }
    height, width = (n + 2 * book.padding for n in book.size)
    alpha, emission = places.pop(ALPHA), places.pop(EMISSION)
    return filled(
        __package__,
        "book.glsl",
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


def billboard_shader(book: Book) -> str:
    """Returns the code of a shader that plays and lights a flip book on a billboard. Its textures are
    `wlm_smoke_first_map` and `wlm_smoke_second_map`."""
    textures = "\n".join(sampler(f"wlm_smoke_{name}_map", "sampler2D") for name in book.pages)
    text = filled(
        __package__,
        "billboard.glsl",
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
    text = f"{number:.9g}"
    text = text if "." in text or "e" in text else f"{text}.0"
    return f"({text})" if number < 0 else text
