"""The bundle of a flip book of six-way lightmaps: its textures, and the shader of a billboard that plays it."""

import numpy as np

from wlm.bundle import Bundle, Texture
from wlm.errors import WlmError
from wlm.smoke.camera import ALPHA
from wlm.smoke.flipbook.book import Book
from wlm.smoke.flipbook.shader import billboard_shader

_ABOUT = (
    "A flip book of six-way lightmaps of smoke: frames in rows of cells from the top left, each of frame_size pixels"
    " with padding around it, linear and premultiplied by opacity; light is multiplied by gain. channels: content of"
    " each texture's channels; a direction is where the light comes from, as seen from the camera. motion: to the right"
    " and up to the next frame, in shares of a frame, 127/255 + motion / (2 motion_scale). depth: distance of the smoke"
    " in front of the billboard in heights of a frame, 127/255 + depth / (2 depth_scale). rate: frames per second."
    " extent: width and height of the view in the world's unit. levels: smallest mip level at which frames do not show"
    " their neighbours. clipped: texels above the range of 8 bits. The shader reads the textures."
)


def bundle(book: Book, *, device: str = "cpu", name: str = "smoke") -> Bundle:
    """Makes the bundle of a flip book.

    Args:
        book: The flip book, from `wlm.smoke.flipbook.book.pack_book`.
        device: Not used: a flip book is an image already.
        name: Name of the smoke.

    Returns:
        Textures `first`, `second` and, if the book has them, `motion` and `depth`, all R8G8B8A8_UNORM, linear; the
        shader of the billboard; and a document that describes them.

    Raises:
        WlmError: The flip book has no opacity, or light that is not finite.
    """
    if not any(ALPHA in names for names in book.channels.values()):
        raise WlmError(f"{name}: has no opacity: expected an alpha channel, or a texture of it")
    textures, clipped = {}, 0
    for key, page in book.pages.items():
        if not np.isfinite(page).all():
            raise WlmError(f"{name}: {key}: expected finite light, found NaN or infinity")
        clipped += int((page > 1.0).sum())
        pixels = np.ones((*page.shape[:2], 4), np.float32)
        pixels[..., : page.shape[2]] = page
        codes = np.round(np.clip(pixels, 0.0, 1.0) * 255.0).astype(np.uint8)
        textures[key] = Texture(codes, "R8G8B8A8_UNORM", page.shape[1], page.shape[0])
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
        "motion_scale": book.scale,
        "depth_scale": book.reach,
        "rate": book.rate,
        "extent": [book.extent * width / height, book.extent],
        "clipped": clipped,
    }
    return Bundle("smoke", name, billboard_shader(book), document, textures)
