"""What a picture holds: light, or data beside it, and whether its numbers can be light."""

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
from wlm.inspection.finding import Finding, quoted

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_FIRST = 80  # bytes, the sizes of all but EXR and Radiance among them
_FACES = 6  # of a cube
_GUIDE = {"light", "transparency", "depth"}
# Of lit texels: shares and levels that light seldom has.
_AT_ONE, _BRIGHT, _LEVELS, _NEAR_LEVEL = 0.02, 1000.0, 255.0, 0.08
_MANY = 1000  # texels, to say something of levels


@dataclass(frozen=True)
class Picture:
    """What the head of a picture says.

    Attributes:
        kind: "EXR", "Radiance", "KTX2", "DDS" or "PNG".
        width, height: Texels; 0: not told by the head.
        channels: Their names; empty: not told by it.
    """

    kind: str
    width: int = 0
    height: int = 0
    channels: tuple[str, ...] = ()

    @property
    def size(self) -> str:
        """As a message has it."""
        return f"{self.width}x{self.height}"

    @property
    def is_cube(self) -> bool:
        """Whether it is as long as the six faces of a cube in a row."""
        short, long = sorted((self.width, self.height))
        return short > 0 and long == _FACES * short

    @property
    def is_six_way(self) -> bool:
        """Whether it has a channel for the light from each direction."""
        if len(self.channels) < _FACES:
            return False
        # It brings torch, which takes seconds.
        from wlm.smoke.camera import DIRECTIONS

        return set(DIRECTIONS) <= set(self.channels)


def picture_of(path: Path) -> Picture | None:
    """Reads the head of a picture; None where it is none.

    Raises:
        WlmError: It can't be read, or it is damaged.
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


def inspect_picture(path: Path, picture: Picture) -> Finding:
    """Says what a picture by itself is.

    Raises:
        WlmError: It can't be read.
    """
    name = path.name.lower()
    if picture.is_six_way:
        what = f"six-way lightmaps of smoke, {picture.size}"
        return Finding(path, what, f"wlm smoke flipbook {quoted(path)} -o OUT.png")
    if _GUIDE <= set(picture.channels):
        return Finding(path, f"a guiding map of smoke, {picture.size}: predict makes its own, of the volume")
    if picture.is_cube:
        return Finding(path, f"a cube's six faces, {picture.size}: a reflection probe; nothing here takes it")
    if "_comp_dir" in name or "_comp_shadowmask" in name:
        layer = "directions" if "_comp_dir" in name else "a shadow mask"
        return Finding(path, f"{layer} of Unity, {picture.size}: read with the light beside it, by its folder")
    if picture.kind == "PNG":
        pixels = read_channels(path)[0]
        return Finding(path, f"a PNG of {picture.size}, {pixels.shape[2]} channels: a mask, or colours; no light")
    pixels, names = read_light(path)
    height, width = pixels.shape[:2]
    what = f"a picture of light, {picture.kind}, {width}x{height}, {''.join(names)}"
    return Finding(path, what, f"wlm atlas compress MESH.glb {quoted(path)} -o OUT.wlm", problems_of(pixels))


def problems_of(pixels: np.ndarray) -> tuple[str, ...]:
    """What the numbers of light [H, W, 3 or 4] have that light seldom has."""
    light = pixels[..., :3]
    problems = []
    finite = np.isfinite(light).all(-1)
    if broken := int(np.count_nonzero(~finite)):
        problems.append(f"{broken} texels NaN or infinite")
    used = light[finite] if pixels.shape[2] == 3 else light[finite & (pixels[..., 3] > 0)]
    if below := int(np.count_nonzero((used < 0).any(-1))):
        problems.append(f"{below} texels negative")
    used = used[(used > 0).any(-1)]
    if not len(used):
        return (*problems, "no light at all")
    brightest, middle = float(used.max()), float(np.median(used.max(-1)))
    if brightest > HALF_MAX:
        problems.append(f"up to {brightest:.3g}, beyond half floats: it is cut to 65,504")
    if middle > _BRIGHT:
        problems.append(f"half of it above {middle:.3g}: in lux, or multiplied for an encoding?")
    if brightest == 1.0 and np.count_nonzero(used == 1.0) > _AT_ONE * used.size:
        problems.append("cut at 1: colours for a screen, not light?")
    if len(used) >= _MANY and brightest <= 1.0 and _from_level(used) < _NEAR_LEVEL:
        problems.append("in 256 levels: made of a picture of 8 bits?")
    return tuple(problems)


def _from_level(light: np.ndarray) -> float:
    """How far light [N, 3] is from the nearest of 256 levels, on the mean, in levels."""
    codes = light[:: max(1, len(light) // 65536)] * _LEVELS
    return float(np.abs(codes - np.rint(codes)).mean())


def read_lit(path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """The texels of a lightmap that have light, or a chart where its alpha says so; and its problems.

    Raises:
        WlmError: It can't be read.
    """
    pixels, names = read_light(path)
    alpha = pixels[..., 3] > 0 if "A" in names else None
    if alpha is not None and alpha.any() and not alpha.all():
        return alpha, problems_of(pixels)
    with np.errstate(invalid="ignore"):
        return (pixels[..., :3] > 0).any(-1), problems_of(pixels)


def said(error: WlmError, path: Path) -> str:
    """An error without the path in front."""
    return str(error).removeprefix(f"{path}: ")
