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
    if kind == "Book":
        return _book(model)
    raise TypeError(f"expected a model with a bundle, got {kind}")


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
