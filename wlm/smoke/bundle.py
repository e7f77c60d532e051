"""Exports a flip book of smoke as a bundle: 8-bit textures, and a shader that shows them on a billboard."""

import numpy as np

from wlm.bundle import Bundle, Texture
from wlm.errors import WlmError
from wlm.smoke.camera import ALPHA
from wlm.smoke.flipbook.book import Book
from wlm.smoke.flipbook.shader import billboard_shader

_MOST = 255  # largest level of 8 bits

_ABOUT = {
    "textures": "Frames of six-way lightmaps are in rows of cells from the top left, each of frame_size pixels with "
    "padding around it. They are linear and premultiplied by the opacity; light is multiplied by gain. channels names "
    "the direction from which the light of each channel comes, as seen from the camera.",
    "rate": "Frames per second.",
    "extent": "Width and height of the region that a frame shows, in world units.",
    "levels": "Number of mip levels; beyond them frames bleed into their neighbours.",
    "clipped": "Number of values above the range of 8 bits, which are clipped.",
}


def bundle(book: Book, *, name: str = "smoke", device: str = "cpu") -> Bundle:
    """Makes the bundle of a flip book, one of whose textures stores the opacity: its textures with 8 bits per channel,
    their description, and a shader. `device` is ignored, since a flip book is always in the memory of the CPU."""
    if not any(ALPHA in names for names in book.channels.values()):
        raise WlmError(f"{name}: the flip book has no opacity: expected an alpha channel in one of its textures")
    textures, clipped = {}, 0
    for key, page in book.pages.items():
        if not np.isfinite(page).all():
            raise WlmError(f"{name}: texture {key}: cannot export: expected finite light, found NaN or infinity")
        clipped += int((page > 1.0).sum())
        pixels = np.ones((*page.shape[:2], 4), np.float32)
        pixels[..., : page.shape[2]] = page
        levels = np.round(np.clip(pixels, 0.0, 1.0) * _MOST).astype(np.uint8)
        textures[key] = Texture.from_texels(levels, "R8G8B8A8_UNORM")
    height, width = book.size
    document = {
        "about": _ABOUT,
        "layout": book.layout,
        "channels": {key: list(names) for key, names in book.channels.items()},
        "rows": book.rows,
        "columns": book.columns,
        "frames": book.count,
        "frame_size": [width, height],
        "padding": book.padding,
        "levels": book.levels,
        "gain": book.gain,
        "rate": book.rate,
        "extent": [book.extent * width / height, book.extent],
        "clipped": clipped,
    }
    return Bundle("smoke", name, billboard_shader(book), document, textures)
