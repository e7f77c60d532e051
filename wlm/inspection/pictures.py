"""Describes pictures: radiance or other data, and whether the values are plausible radiance."""

import re
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wlm.errors import WlmError, one_line
from wlm.formats import dds, ktx2, pfm, radiance
from wlm.formats.channels import read_channels
from wlm.formats.exr import HALF_MAX, read_header
from wlm.formats.exr_header import MAGIC as EXR_MAGIC
from wlm.formats.levels import level_kind
from wlm.formats.light import read_light
from wlm.formats.limits import check_sides
from wlm.formats.reading import open_file
from wlm.inspection.finding import Finding, command
from wlm.texels import doubts

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_FIRST = 80  # bytes that include the size, except in EXR, Radiance, TIFF, JPEG, WebP and TGA files
_FACES = 6  # faces of a cube
_TEXTURE = re.compile(r"(^|[_. -])(rlt|bbf|tlr|rtbk?|lbt?f|tlrb)(?=[_. -]|$)", re.IGNORECASE)
"""Directions in the name of a texture of a flip book, `PAIRS` of `wlm.smoke.flipbook.naming` without short ones."""
_HALF = "by its name half of a flip book of six-way lightmaps of smoke, without the other texture"


@dataclass(frozen=True)
class Picture:
    """Facts from the header of a picture: its kind, "EXR", "Radiance", "PFM", "TIFF", "KTX2" or "DDS", or one that is
    no light without an encoding, "PNG", "JPEG", "WebP" or "TGA"; and its size in texels and the names of its channels,
    0 and empty if the beginning of the file does not state them."""

    kind: str
    width: int = 0
    height: int = 0
    channels: tuple[str, ...] = ()

    @property
    def size(self) -> str:
        """Width and height in pixels as text, such as "512x256"."""
        return f"{self.width}x{self.height}"

    @property
    def is_light(self) -> bool:
        """Whether the format can store linear light: EXR, Radiance, PFM, TIFF, KTX2 or DDS."""
        return self.kind not in ("PNG", "JPEG", "WebP", "TGA")

    @property
    def is_cube(self) -> bool:
        """Whether the picture has the shape of a cube map: six square faces in a row or a column."""
        short, long = sorted((self.width, self.height))
        return short > 0 and long == _FACES * short

    @property
    def is_six_way(self) -> bool:
        """Whether the channels are those of a six-way lightmap of smoke: light from each of six directions."""
        if len(self.channels) < _FACES:
            return False
        # This imports torch, which takes seconds.
        from wlm.smoke.flipbook.naming import six_way_channels

        return bool(six_way_channels(self.channels))


def picture_of(path: Path) -> Picture | None:
    """Reads the header of a picture; returns None for other files."""
    with open_file(path, "the file") as file:
        head = file.read(_FIRST)
    if head.startswith(EXR_MAGIC):
        width, height, channels = read_header(path)
        return Picture("EXR", width, height, channels)
    if head.startswith(radiance.MAGIC):
        return Picture("Radiance")
    if head.startswith(pfm.MAGIC):
        return Picture("PFM", *pfm.header_of(path, head)[:2])
    for kind, magic, form, at in (
        ("KTX2", ktx2.MAGIC, "<2I", 20),
        ("DDS", dds.MAGIC, "<2I", 12),
        ("PNG", PNG_MAGIC, ">2I", 16),
    ):
        if head.startswith(magic) and len(head) >= at + 8:
            first, second = struct.unpack_from(form, head, at)
            width, height = (second, first) if kind == "DDS" else (first, second)
            check_sides(str(path), width, height)
            return Picture(kind, width, height)
    other = level_kind(path, head)
    return None if other is None else Picture(other)


def size_of(path: Path, slices: int = 1) -> str:
    """Returns the size in pixels, such as "512x256", of each of the slices of a picture, which is read if its beginning
    does not state it; "" if it cannot be read."""
    try:
        head = picture_of(path)
        if head is None or head.width:
            return "" if head is None else f"{head.width}x{head.height // slices}"
        height, width = read_channels(path)[0].shape[:2]
    except WlmError:
        return ""
    return f"{width}x{height // slices}"


def inspect_picture(path: Path) -> Finding:
    """Describes a single picture."""
    picture, name = picture_of(path), path.name.lower()
    if picture is None:
        read_light(path)  # raises an error that names what it is
        return Finding(path, "unknown kind of file")
    if picture.is_six_way:
        what, assumed = f"six-way lightmaps of smoke, {picture.size}", list[str]()
        # This imports torch, too.
        from wlm.smoke.data import read_shaded

        try:
            read_shaded(path, notes=assumed)
        except WlmError as error:
            return Finding(path, what, problems=(said(error, path),))
        return Finding(path, what, command("smoke", "flipbook", path, "-o", "OUT.png"), tuple(assumed))
    if picture.is_cube:
        return Finding(path, f"six faces of a cube, {picture.size}: a reflection probe, which no command reads")
    if "_comp_dir" in name or "_comp_shadowmask" in name:
        layer = "light directions" if "_comp_dir" in name else "a shadow mask"
        return Finding(path, f"{layer} of Unity, {picture.size}; read together with the light in its folder")
    notes: list[str] = []
    if not picture.is_light:
        pixels, names, _ = read_channels(path, notes)
        height, width = pixels.shape[:2]
        use = _HALF if is_half(path) else "a mask, colours, or light with an --encoding"
        what = f"a {picture.kind} of {width}x{height}, {''.join(names)}: {use}"
        return Finding(path, what, problems=tuple(notes))
    pixels, names = read_light(path, notes)
    height, width = pixels.shape[:2]
    what = f"{picture.kind}, {width}x{height}, {''.join(names)}"
    if is_half(path):
        return Finding(path, f"{what}: {_HALF}", problems=tuple(notes))
    what = f"a lightmap, {what}; compress it together with its mesh"
    return Finding(path, what, problems=(*notes, *problems_of(pixels)))


def is_half(path: Path) -> bool:
    """Whether the name is that of one texture of a flip book, such as `smoke_RLT.png`."""
    return _TEXTURE.search(path.stem) is not None


def problems_of(pixels: np.ndarray) -> tuple[str, ...]:
    """Returns one line for each kind of value in a picture [H, W, 3 or 4] that is unusual for radiance."""
    light = pixels[..., :3]
    problems = []
    finite = np.isfinite(light).all(-1)
    if broken := int(np.count_nonzero(~finite)):
        problems.append(f"{broken} texels are NaN or infinite")
    used = light[finite] if pixels.shape[2] == 3 else light[finite & (pixels[..., 3] > 0)]
    if below := int(np.count_nonzero((used < 0).any(-1))):
        problems.append(f"{below} texels are negative")
    if not (used > 0).any():
        return (*problems, "no texel is above 0")
    if (brightest := float(used.max())) > HALF_MAX:
        problems.append(f"values up to {brightest:.3g} exceed half floats and are clamped to 65,504")
    return (*problems, *doubts(light))


def read_lit(path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """Finds the texels of a lightmap that are inside charts or not black, bool [H, W], and lists unusual values."""
    notes: list[str] = []
    pixels, names = read_light(path, notes)
    problems = (*notes, *problems_of(pixels))
    alpha = pixels[..., 3] > 0 if "A" in names else None
    if alpha is not None and alpha.any() and not alpha.all():
        return alpha, problems
    with np.errstate(invalid="ignore"):
        return (pixels[..., :3] > 0).any(-1), problems


def said(error: WlmError, path: Path) -> str:
    """Returns an error message without the path at its beginning."""
    return str(error).removeprefix(f"{one_line(path)}: ")
