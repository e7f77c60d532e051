"""Describes pictures: radiance or other data, and whether the values are plausible radiance."""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wlm.errors import WlmError
from wlm.formats import dds, ktx2, radiance
from wlm.formats.channels import read_channels
from wlm.formats.exr import HALF_MAX, read_header
from wlm.formats.exr import MAGIC as EXR_MAGIC
from wlm.formats.light import read_light
from wlm.formats.limits import check_sides
from wlm.formats.reading import open_file
from wlm.inspection.finding import Finding, command

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_FIRST = 80  # bytes that include the size, except in EXR and Radiance files
_FACES = 6  # faces of a cube
# Share of values at 1, median radiance, and mean distance from 8-bit levels that suggest other data than radiance.
_AT_ONE, _BRIGHT, _LEVELS, _NEAR_LEVEL = 0.02, 1000.0, 255.0, 0.08
_MANY = 1000  # fewest texels for the test of levels


@dataclass(frozen=True)
class Picture:
    """Facts from the header of a picture.

    Attributes:
        kind: "EXR", "Radiance", "KTX2", "DDS" or "PNG".
        width, height: Size in texels; 0 if the beginning of the file does not state it.
        channels: Names of the channels; empty if the beginning of the file does not state them.
    """

    kind: str
    width: int = 0
    height: int = 0
    channels: tuple[str, ...] = ()

    @property
    def size(self) -> str:
        """Width and height in pixels as text, such as "512x256"."""
        return f"{self.width}x{self.height}"

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
        from wlm.smoke.camera import DIRECTIONS

        return set(DIRECTIONS) <= set(self.channels)


def picture_of(path: Path) -> Picture | None:
    """Reads the header of a picture; returns None for other files.

    Raises:
        WlmError: The file cannot be read or is damaged.
    """
    with open_file(path, "the file") as file:
        head = file.read(_FIRST)
    if head.startswith(EXR_MAGIC):
        width, height, channels = read_header(path)
        return Picture("EXR", width, height, channels)
    if head.startswith(radiance.MAGIC):
        return Picture("Radiance")
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
    return None


def inspect_picture(path: Path) -> Finding:
    """Describes a single picture.

    Raises:
        WlmError: The file cannot be read.
    """
    picture, name = picture_of(path), path.name.lower()
    if picture is None:
        raise WlmError(f"{path}: expected an EXR, Radiance, KTX2, DDS or PNG picture")
    if picture.is_six_way:
        what = f"six-way lightmaps of smoke, {picture.size}"
        return Finding(path, what, command("smoke", "flipbook", path, "-o", "OUT.png"))
    if picture.is_cube:
        return Finding(path, f"six faces of a cube, {picture.size}: a reflection probe, which no command reads")
    if "_comp_dir" in name or "_comp_shadowmask" in name:
        layer = "light directions" if "_comp_dir" in name else "a shadow mask"
        return Finding(path, f"{layer} of Unity, {picture.size}; read together with the light in its folder")
    if picture.kind == "PNG":
        pixels = read_channels(path)[0]
        return Finding(path, f"a PNG of {picture.size}, {pixels.shape[2]} channels: a mask or colours, no radiance")
    pixels, names = read_light(path)
    height, width = pixels.shape[:2]
    what = f"a lightmap, {picture.kind}, {width}x{height}, {''.join(names)}; compress it together with its mesh"
    return Finding(path, what, problems=problems_of(pixels))


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
    used = used[(used > 0).any(-1)]
    if not len(used):
        return (*problems, "no texel is above 0")
    brightest, middle = float(used.max()), float(np.median(used.max(-1)))
    if brightest > HALF_MAX:
        problems.append(f"values up to {brightest:.3g} exceed half floats and are clamped to 65,504")
    if middle > _BRIGHT:
        problems.append(f"half of the texels exceed {middle:.3g}: are they in lux, or scaled for an encoding?")
    if brightest == 1.0 and np.count_nonzero(used == 1.0) > _AT_ONE * used.size:
        problems.append("values are clamped at 1: are they screen colours instead of radiance?")
    if len(used) >= _MANY and brightest <= 1.0 and _from_level(used) < _NEAR_LEVEL:
        problems.append("values have 256 levels: were they converted from an 8-bit picture?")
    return tuple(problems)


def _from_level(light: np.ndarray) -> float:
    """Returns the mean distance of values [N, 3] from the nearest of 256 8-bit levels, in units of a level."""
    codes = light[:: max(1, len(light) // 65536)] * _LEVELS
    return float(np.abs(codes - np.rint(codes)).mean())


def read_lit(path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """Finds the texels of a lightmap that are inside charts or not black, bool [H, W], and lists unusual values.

    Raises:
        WlmError: The file cannot be read.
    """
    pixels, names = read_light(path)
    alpha = pixels[..., 3] > 0 if "A" in names else None
    if alpha is not None and alpha.any() and not alpha.all():
        return alpha, problems_of(pixels)
    with np.errstate(invalid="ignore"):
        return (pixels[..., :3] > 0).any(-1), problems_of(pixels)


def said(error: WlmError, path: Path) -> str:
    """Returns an error message without the path at its beginning."""
    return str(error).removeprefix(f"{path}: ")
