"""Six-way smoke for an engine: a flip book, a billboard that plays and lights it, and a page about it."""

import os
import re
from collections.abc import Callable
from pathlib import Path

from wlm.engines.kit import ENGINES, README_FILE, check_sides, filled, godot_uniforms
from wlm.engines.unreal import asset_name
from wlm.errors import WlmError
from wlm.formats.folder import made_parents, staged, write_index
from wlm.shading import ENDINGS, check_language, custom_node, translate
from wlm.smoke.camera import ALPHA
from wlm.smoke.flipbook.book import Book
from wlm.smoke.flipbook.shader import billboard_shader
from wlm.smoke.flipbook.textures import write_page

FORMAT = "wlm-smoke-engine"
_VERSION = 1
INFO_FILE = "smoke.json"
_ABOUT = (
    "A flip book of six-way lightmaps of smoke: frames in rows of cells from the top left, each of frame_size pixels in"
    " so much padding, linear and premultiplied, its light times gain; channels by the direction that their light comes"
    " from, seen from the camera. motion: to the right and up to the next frame, in shares of one, 127/255 + motion /"
    " (2 motion_scale). rate: frames a second. extent: width and height of what a frame shows, in the world's unit."
    " levels: of mips, beyond which frames show their neighbours. The shader says how they are read."
)


_NO_MIPS = "The shader reads no mips of the textures; `--mips 3` of the export makes room for some around the frames."


def export_smoke(
    book: Book, directory: str | os.PathLike[str], engine: str, *, name: str = "smoke", shader: str = "glsl"
) -> tuple[list[Path], int]:
    """Writes a flip book for an engine: textures as PNGs, a shader, what plays and lights it, and a page about it.

    Args:
        book: The flip book, with an opacity; for an engine by name in the layout "unity".
        directory: The folder; made if it isn't there. A new export replaces an earlier one.
        engine: One of `wlm.engines.ENGINES`, or "raw": the shader alone beside the textures.
        name: Of the smoke, for the engine's own names.
        shader: Of "raw", its language, one of `wlm.shading.LANGUAGES`.

    Returns:
        The files written, `smoke.json` last, and how many numbers were above 8 bits' range and became its greatest.

    Raises:
        ValueError: Another layout for an engine by name.
        WlmError: No such engine or language, no opacity, a texture larger than the engine takes, light that isn't
            finite, the folder holds something else or can't be written.
    """
    if engine not in (*ENGINES, "raw"):
        raise WlmError(f"engine: expected one of raw, {', '.join(ENGINES)}, got {engine!r}")
    check_language(shader)
    if engine != "raw" and book.layout != "unity":
        raise ValueError(f"layout: expected unity for {engine}, got {book.layout!r}")
    if not any(ALPHA in names for names in book.channels.values()):
        raise WlmError(f"{name}: has no opacity: expected an alpha, or a texture of it")
    textures = {each: f"{each}.png" for each in book.pages}
    for each, page in book.pages.items():
        if engine != "raw":
            check_sides(name, engine, textures[each], page)
    texts = _raw(book, shader) if engine == "raw" else _TEXTS[engine](book, name)
    folder = Path(directory)
    with made_parents(folder), staged(folder, INFO_FILE, FORMAT, _is_exported) as staging:
        clipped = sum(write_page(staging / file, book.pages[each]) for each, file in textures.items())
        for file, text in texts.items():
            (staging / file).write_bytes(text.encode())
        write_index(staging / INFO_FILE, _info(book, name, textures, next(iter(texts))))
    return [folder / file for file in (*texts, *textures.values(), INFO_FILE)], clipped


def _info(book: Book, name: str, textures: dict[str, str], shader: str) -> dict[str, object]:
    height, width = book.size
    return {
        "format": FORMAT,
        "version": _VERSION,
        "about": _ABOUT,
        "name": name,
        "textures": textures,
        "layout": book.layout,
        "channels": {each: list(names) for each, names in book.channels.items()},
        "rows": book.rows,
        "columns": book.columns,
        "frames": book.count,
        "frame_size": [width, height],
        "padding": book.padding,
        "levels": book.levels,
        "gain": book.gain,
        "motion_scale": book.scale,
        "rate": book.rate,
        "extent": list(_extent(book)),
        "shader": shader,
    }


def _extent(book: Book) -> tuple[float, float]:
    height, width = book.size
    return book.extent * width / height, book.extent


def _facts(book: Book, name: str) -> dict[str, str]:
    """What the pages say of a flip book."""
    height, width = book.size
    cells = f"{book.rows} x {book.columns} cells of {width} x {height} pixels, {book.padding} around each"
    moving = "" if book.scale is None else f", motion of at most {book.scale:.4g} of a frame"
    facts = f"{book.count} frames at {book.rate:.4g} a second, in {cells};\nlight times {book.gain:.4g}{moving}."
    mips = f"The shader reads the textures' mips down to level {book.levels}." if book.levels else _NO_MIPS
    return {"NAME": name, "FACTS": facts, "MIPS": mips}


def _raw(book: Book, language: str) -> dict[str, str]:
    return {"smoke" + ENDINGS[language]: billboard_shader(book, language)}


def _three(book: Book, name: str) -> dict[str, str]:
    return {
        "smoke.glsl": billboard_shader(book),
        "smoke.js": filled("three_smoke.js"),
        README_FILE: filled("three_smoke.md", **_facts(book, name)),
    }


def _godot(book: Book, name: str) -> dict[str, str]:
    height, width = book.size
    shader = godot_uniforms(billboard_shader(book), mips=book.levels > 0)
    settings = filled("godot_smoke.import", MIPS="true" if book.levels else "false")
    return {
        "smoke.gdshader": filled("godot_smoke.gdshader", SHADER=shader, SIZE=f"{width}.0, {height}.0"),
        "wlm_smoke.gd": filled("godot_smoke.gd"),
        **{f"{each}.png.import": settings for each in book.pages},
        README_FILE: filled("godot_smoke.md", **_facts(book, name)),
    }


def _unity(book: Book, name: str) -> dict[str, str]:
    height, width = book.size
    parts = {"NAME": re.sub(r"[^\w .-]", "_", name), "SIZE": f"{width}.0, {height}.0"}
    parts["MOTION"] = "" if book.motion is None else 'wlm_smoke_motion_map ("Motion", 2D) = "gray" {}'
    return {
        "WlmSmoke.hlsl": translate(billboard_shader(book), "hlsl"),
        "WlmSmoke.shader": filled("unity_smoke.shader", **parts),
        "WlmSmoke.cs": filled("unity_smoke.cs"),
        README_FILE: filled("unity_smoke.md", **_facts(book, name)),
    }


def _unreal(book: Book, name: str) -> dict[str, str]:
    height, width = book.size
    # Where derivatives are known, in the pixel's own code: UV goes over the billboard once, v down.
    size = f"float2({width}.0, {height}.0)"
    texels = f"max(length(ddx(UV) * {size}), length(ddy(UV) * {size}))"
    # Unreal's view has z into the screen.
    toward = "float3(Toward.xy, -Toward.z)"
    arguments = f"UV, fmod(max(Frame, 0.0), {book.count}.0), {texels}, {toward}, Irradiance, Sky"
    code, _ = custom_node(billboard_shader(book), "wlm_smoke_pixel", arguments)
    place = asset_name(name)
    parts = {"CODE": code, "MIPS": str(book.levels > 0), "RATE": f"{book.rate:.6g}"}
    return {
        "wlm_smoke.py": filled("unreal_smoke.py.in", NAME=place, **parts, KIT=filled("unreal_kit.py.in")),
        README_FILE: filled("unreal_smoke.md", **_facts(book, name), PLACE=place),
    }


_TEXTS: dict[str, Callable[[Book, str], dict[str, str]]] = {
    "three": _three,
    "godot": _godot,
    "unity": _unity,
    "unreal": _unreal,
}
_STEMS = {"smoke", "wlm_smoke", "WlmSmoke", "first", "second", "motion"}
_OWN = {*ENDINGS.values(), ".png", ".js", ".gd", ".gdshader", ".shader", ".cs", ".py"}
_IMPORTS = {"first.png.import", "second.png.import", "motion.png.import"}


def _is_exported(name: str) -> bool:
    """Whether a file's name is one that such a folder may have."""
    path = Path(name)
    return name in {README_FILE, INFO_FILE} | _IMPORTS or (path.stem in _STEMS and path.suffix in _OWN)
