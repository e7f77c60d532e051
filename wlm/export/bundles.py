"""Bundles of the systems that do not make their own yet."""

from typing import Any

import numpy as np

from wlm.bundle import Bundle, Texture
from wlm.errors import WlmError


def bundle_of(model: Any, device: str) -> Bundle:
    """Makes the bundle of a model.

    Args:
        model: The model, or a bundle, which is returned.
        device: Device that decodes the reference.
    """
    if isinstance(model, Bundle):
        return model
    if hasattr(model, "bundle"):
        return model.bundle(device=device)
    kind = type(model).__name__
    if kind == "LightmapModel":
        return _lightmap(model, device)
    if kind == "LayeredModel":
        return _layers(model, device)
    if kind == "Book":
        return _book(model)
    raise TypeError(f"expected a model with a bundle, got {kind}")


def _lightmap(model: Any, device: str, values: tuple[float, float] | None = None, name: str | None = None) -> Bundle:
    from wlm.lightmap import exporter, packed
    from wlm.lightmap.decode import Decoder
    from wlm.lightmap.shader import EXACT, decode_glsl

    tables, (nets, starts) = packed.hour_tables(model), packed.networks(model)
    made = packed.textures(model)
    document = exporter.document(model, made, starts) | {"hour_fours": tables.shape[1]}
    images = document.pop("textures")
    for key in ("format", "version", "name"):
        document.pop(key)
    document["images"] = {key: {"size": each["image"], "across": each["across"]} for key, each in images.items()}
    frame = Decoder(model, device).frame(float(model.times[0]))
    if values is not None:
        document["values"] = list(values)
        frame = np.float32(values[0]) + np.float32(values[1] - values[0]) * frame
    textures = {key: Texture(each.data, each.fmt, each.width, each.height, each.layers) for key, each in made.items()}
    textures["valid"] = Texture.from_texels(model.mask.astype(np.uint8) * 255, "R8_UNORM")
    buffers = {"hours": tables.astype("<f4")} | ({"networks": nets.astype("<f4")} if len(nets) else {})
    shader = decode_glsl(model, values)
    return Bundle(
        "lightmap", name or model.name, shader, document, textures, buffers, {"frame": frame}, exact=EXACT, model=model
    )


def _layers(model: Any, device: str) -> Bundle:
    from wlm.lightmap.layers.sheet import ENCODINGS

    parts, sheets = {}, []
    for number, (sheet, own) in enumerate(model.sheets.items()):
        values = ENCODINGS[sheet.encoding] if sheet.linear else None
        key = f"sheet_{number:02d}"
        parts[key] = _lightmap(own, device, values, f"{model.name} {sheet.label.replace('/', ' ')}")
        sheets.append({"part": key, "atlas": sheet.atlas, "layer": sheet.layer, "channels": list(sheet.channels)})
    document = {
        "about": "Each part is a sheet: up to three channels of a layer of an atlas, in the order of red, green, blue.",
        "times": model.times.tolist(),
        "period": model.period,
        "sheets": sheets,
    }
    return Bundle("lightmap", model.name, "", document, parts=parts)


def _book(book: Any) -> Bundle:
    height, width = book.size
    document = {
        "about": "A flip book of six-way lightmaps of smoke. The shader says how its textures are read.",
        "layout": book.layout,
        "channels": {name: list(names) for name, names in book.channels.items()},
        "rows": book.rows,
        "columns": book.columns,
        "frames": book.count,
        "frame_size": [width, height],
        "padding": book.padding,
        "levels": book.levels,
        "gain": book.gain,
        "rate": book.rate,
        "extent": [book.extent * width / height, book.extent],
        "motion_scale": book.scale,
    }
    textures = {}
    if not any("alpha" in names for names in book.channels.values()):
        raise WlmError("the smoke has no opacity: expected an alpha channel, or a texture of it")
    if not all(np.isfinite(page).all() for page in book.pages.values()):
        raise WlmError("cannot export: expected finite light, found NaN or infinity")
    document["clipped"] = int(sum((page > 1.0).sum() for page in book.pages.values()))
    for name, page in book.pages.items():
        pixels = np.ones((*page.shape[:2], 4), np.float32)
        pixels[..., : page.shape[2]] = page
        codes = np.round(np.clip(pixels, 0.0, 1.0) * 255.0).astype(np.uint8)
        textures[name] = Texture.from_texels(codes, "R8G8B8A8_UNORM")
    from wlm.smoke.flipbook.shader import billboard_shader

    return Bundle("smoke", "smoke", billboard_shader(book), document, textures)
