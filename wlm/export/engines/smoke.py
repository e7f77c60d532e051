"""Kits of six-way smoke: a flip book, and a billboard that plays and lights it; or a network that lights it live."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from wlm.bundle import Bundle
from wlm.errors import WlmError
from wlm.export.engines.kit import (
    README_FILE,
    asset_name,
    check_sides,
    filled,
    godot_uniforms,
    label,
    picture_entry,
    write_texts,
)
from wlm.export.files import decode_texture, write_buffer
from wlm.export.page.html import asset
from wlm.export.shading import custom_node, translate

_LAYOUT = "unity"
_NO_MIPS = "The shader reads no mips of the textures; `--mips 3` of the export makes room for some around the frames."


def write_kit(bundle: Bundle, folder: Path, engine: str) -> dict[str, Any]:
    """Writes the kit of a flip book in the layout "unity", with its textures as PNGs, for one of `wlm.export.ENGINES`
    into an existing folder, or of a network for three.js; returns the entries of the folder's index."""
    if bundle.system == "smoke-network":
        if engine != "three" or bundle.document["settings"]["guide"] != "six":
            raise WlmError(f"{bundle.name}: expected the engine three and a network with the guide six, got {engine}")
        core = "\n".join(map(asset, ("graphics.js", "live.js")))
        texts = {"live.js": filled("three_live.js", CORE=core), "smoke.js": filled("three_smoke.js")}
        write_texts(folder, texts | {README_FILE: filled("three_live.md", NAME=bundle.name)})
        return {"script": "live.js", "buffers": {"weights": write_buffer(folder, "weights", bundle.buffers["weights"])}}
    if bundle.document["layout"] != _LAYOUT:
        raise WlmError(f"layout: expected {_LAYOUT} for {engine}, got {bundle.document['layout']}")
    textures = {}
    for name, texture in bundle.textures.items():
        pixels, file = decode_texture(texture), f"{name}.png"
        check_sides(bundle.name, engine, file, pixels)
        opaque = bool((pixels[..., 3] == np.iinfo(pixels.dtype).max).all())
        Image.fromarray(pixels[..., :3] if opaque else pixels).save(folder / file)
        textures[name] = picture_entry(file, pixels)
    texts = _TEXTS[engine](bundle)
    write_texts(folder, texts)
    return {"shader": next(iter(texts)), "textures": textures}


def _facts(bundle: Bundle) -> dict[str, str]:
    """Returns the texts that describe the flip book in a README, by the names of their marks in the template."""
    book = bundle.document
    width, height = book["frame_size"]
    cells = f"{book['rows']} x {book['columns']} cells of {width} x {height} pixels, padded by {book['padding']}"
    facts = f"{book['frames']} frames at {book['rate']:.4g} a second, in {cells};\n"
    facts += f"light is multiplied by {book['gain']:.4g}."
    mips = f"The shader reads the textures' mips down to level {book['levels']}." if book["levels"] else _NO_MIPS
    return {"NAME": bundle.name, "FACTS": facts, "MIPS": mips}


def _size(bundle: Bundle) -> str:
    width, height = bundle.document["frame_size"]
    return f"{width}.0, {height}.0"


def _three(bundle: Bundle) -> dict[str, str]:
    return {
        "smoke.glsl": bundle.shader,
        "smoke.js": filled("three_smoke.js"),
        README_FILE: filled("three_smoke.md", **_facts(bundle)),
    }


def _godot(bundle: Bundle) -> dict[str, str]:
    levels = bundle.document["levels"]
    shader = godot_uniforms(bundle.shader, mips=levels > 0)
    settings = filled("godot_smoke.import", MIPS="true" if levels else "false")
    return {
        "smoke.gdshader": filled("godot_smoke.gdshader", SHADER=shader, SIZE=_size(bundle)),
        "wlm_smoke.gd": filled("godot_smoke.gd"),
        **{f"{name}.png.import": settings for name in bundle.textures},
        README_FILE: filled("godot_smoke.md", **_facts(bundle)),
    }


def _unity(bundle: Bundle) -> dict[str, str]:
    parts = {"NAME": label(bundle.name), "SIZE": _size(bundle)}
    return {
        "WlmSmoke.hlsl": translate(bundle.shader, "hlsl"),
        "WlmSmoke.shader": filled("unity_smoke.shader", **parts),
        "WlmSmoke.cs": filled("unity_smoke.cs"),
        README_FILE: filled("unity_smoke.md", **_facts(bundle)),
    }


def _unreal(bundle: Bundle) -> dict[str, str]:
    book = bundle.document
    # Derivatives are known only in the pixel's own code. UV covers the billboard once, with v down.
    size = f"float2({_size(bundle)})"
    texels = f"max(length(ddx(UV) * {size}), length(ddy(UV) * {size}))"
    # In Unreal's view space z points into the screen.
    toward = "float3(Toward.xy, -Toward.z)"
    arguments = f"UV, fmod(max(Frame, 0.0), {book['frames']}.0), {texels}, {toward}, Irradiance, Sky"
    code, _ = custom_node(bundle.shader, "wlm_smoke_pixel", arguments)
    place = asset_name(bundle.name)
    parts = {"CODE": code, "MIPS": str(book["levels"] > 0), "RATE": f"{book['rate']:.6g}"}
    return {
        "wlm_smoke.py": filled("unreal_smoke.py.in", NAME=place, **parts, KIT=filled("unreal_kit.py.in")),
        README_FILE: filled("unreal_smoke.md", **_facts(bundle), PLACE=place),
    }


_TEXTS: dict[str, Callable[[Bundle], dict[str, str]]] = {
    "three": _three,
    "godot": _godot,
    "unity": _unity,
    "unreal": _unreal,
}
