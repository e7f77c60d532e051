"""Pictures of smoke: shaded frames with a scene's obstacles, guiding maps, sequences and contact sheets."""

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from wlm.errors import WlmError
from wlm.interop import device_name
from wlm.smoke.camera import DIRECTIONS, Camera
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.coarse import Guide
from wlm.smoke.scene import ObstacleSettings
from wlm.smoke.shading import Light, Ramp
from wlm.smoke.transport.lighting import LitSmoke
from wlm.smoke.transport.orders import ScatteredSmoke
from wlm.view.atlas import encode, save_png
from wlm.view.smoke_drawing import Drawing

MOST_COLUMNS = 8
"""Pictures in a row of a contact sheet."""

_GREY = 96  # of a sheet: neither smoke nor shadow
_MARGIN, _FONT = 4, 14  # pixels


def to_bytes(light: torch.Tensor | np.ndarray, white: float = 1.0) -> np.ndarray:
    """Linear light to sRGB bytes.

    Args:
        light: [H, W, 3], or [H, W]: grey.
        white: The light that becomes white; brighter light clips.

    Returns:
        uint8 [H, W, 3].

    Raises:
        ValueError: White isn't above 0.
    """
    if not 0 < white < math.inf:
        raise ValueError(f"white: expected a number above 0, got {white}")
    pixels = np.asarray(light.cpu() if isinstance(light, torch.Tensor) else light, np.float32)
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=2)
    return encode(pixels, np.ones(pixels.shape[:2], bool), white)


def draw_obstacles(
    obstacles: Sequence[ObstacleSettings], time: float, camera: Camera, lights: Sequence[Light], device: str = "cpu"
) -> tuple[torch.Tensor, torch.Tensor]:
    """Draws diffuse obstacles under directional lights. They cast no shadows on each other, nor does the smoke on them.

    Args:
        obstacles: Any number.
        time: Seconds.
        camera: The view.
        lights: Any number.
        device: "cpu" or "cuda:N".

    Returns:
        Light float32 [H, W, 3], and the distance along the ray float32 [H, W], infinite where there is no obstacle.
    """
    drawing = Drawing(camera, lights, obstacles=obstacles, device=device)
    drawing.move(time)
    drawing.draw_obstacles()
    return drawing.solid_light, drawing.solid_depth


def picture(
    six: SixWay,
    lights: Sequence[Light],
    *,
    albedo: Sequence[float] = (1.0, 1.0, 1.0),
    background: Sequence[float] = (0.0, 0.0, 0.0),
    ramp: Ramp | None = None,
    obstacles: Sequence[ObstacleSettings] = (),
    time: float = 0.0,
    rule: str = "squared",
) -> torch.Tensor:
    """Puts shaded smoke and a scene's obstacles into one picture.

    A billboard is flat: at a pixel an obstacle is before all of the smoke or behind all of it, by the depth of the
    smoke's surface.

    Args:
        six: Lightmaps with their camera and transparency; with obstacles, with their depth too.
        lights: Any number.
        albedo: R, G, B, the share of light that a scattering leaves.
        background: A linear colour.
        ramp: Colour of the emission.
        obstacles: They are drawn, and cast shadows on the smoke's surface.
        time: Of the obstacles, seconds.
        rule: How a light's direction weighs the lightmaps.

    Returns:
        float32 [H, W, 3], linear.

    Raises:
        ValueError: The lightmaps lack their camera, transparency or, with obstacles, depth.
    """
    if six.camera is None:
        raise ValueError("six: expected lightmaps with their camera")
    options = {"albedo": albedo, "background": background, "ramp": ramp, "obstacles": obstacles, "rule": rule}
    drawing = Drawing(six.camera, lights, **options, device=device_name(six.lightmaps.device))
    drawing.move(time)
    return drawing(six)


def light_picture(
    smoke: LitSmoke | ScatteredSmoke,
    *,
    albedo: Sequence[float] = (1.0, 1.0, 1.0),
    background: Sequence[float] = (0.0, 0.0, 0.0),
    ramp: Ramp | None = None,
    obstacles: Sequence[ObstacleSettings] = (),
    time: float = 0.0,
) -> torch.Tensor:
    """Puts smoke that its own lights light and a scene's obstacles into one picture, as `picture` does.

    Args:
        smoke: Light scattered once, or of all orders, which has its albedo already.
        albedo: R, G, B of light scattered once.
        background: A linear colour.
        ramp: Colour of the emission.
        obstacles: They are drawn, and keep directional lights off the smoke's surface.
        time: Of the obstacles, seconds.

    Returns:
        float32 [H, W, 3], linear.
    """
    lit = smoke.lit if isinstance(smoke, ScatteredSmoke) else smoke
    options = {"albedo": albedo, "background": background, "ramp": ramp, "obstacles": obstacles}
    drawing = Drawing(lit.camera, lit.lights, **options, device=device_name(lit.transparency.device))
    drawing.move(time)
    return drawing(smoke)


def six_pictures(six: SixWay, white: float = 1.0) -> dict[str, np.ndarray]:
    """The lightmaps, the opacity and, of hot smoke, the emission, uint8 [H, W, 3] each, by name."""
    planes = {name: six[name] for name in DIRECTIONS}
    if six.transparency is not None:
        planes["alpha"] = 1.0 - six.transparency
    if six.emission is not None:
        planes["emission"] = six.emission
    return {name: to_bytes(plane, 1.0 if name == "alpha" else white) for name, plane in planes.items()}


def guide_pictures(guide: Guide, white: float = 2.0) -> dict[str, np.ndarray]:
    """Light, transparency and depth, uint8 [H, W, 3] each, by name; the nearest depth is white, no smoke is black."""
    depth = guide.depth.cpu()
    smoke = depth > 0
    near, far = (float(depth[smoke].min()), float(depth[smoke].max())) if smoke.any() else (0.0, 0.0)
    grey = torch.where(smoke, 1.0 - 0.8 * (depth - near) / max(far - near, 1e-12), 0.0)
    return {
        "light": to_bytes(guide.light, white),
        "transparency": to_bytes(guide.transparency),
        "depth": np.repeat((grey.numpy() * 255.0 + 0.5).astype(np.uint8)[..., None], 3, axis=2),
    }


def write_sequence(folder: str | os.PathLike[str], pictures: Iterable[np.ndarray], stem: str = "frame") -> list[Path]:
    """Writes pictures as `STEM_0001.png` and so on, each whole or not at all.

    Args:
        folder: Made if its parent is there.
        pictures: uint8 [H, W, 3].
        stem: First part of the names.

    Returns:
        The files.

    Raises:
        WlmError: A file can't be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise WlmError(f"{folder}: cannot write there: {error.strerror or error}") from error
    paths = []
    for number, pixels in enumerate(pictures, 1):
        paths.append(folder / f"{stem}_{number:04d}.png")
        save_png(paths[-1], pixels)
    return paths


def contact_sheet(
    path: str | os.PathLike[str],
    rows: Mapping[str, Sequence[np.ndarray]],
    titles: Sequence[str] = (),
    *,
    columns: int = MOST_COLUMNS,
) -> tuple[int, ...]:
    """Writes a PNG of pictures in labelled rows; of more than fit in a row, evenly spread ones are chosen.

    Args:
        path: The PNG to write; its folder must exist.
        rows: uint8 [H, W, 3] pictures by label, all of one size, as many in each row.
        titles: Of the columns, as many as there are pictures in a row, or none.
        columns: Pictures in a row at most.

    Returns:
        The numbers, from 0, of the chosen pictures.

    Raises:
        ValueError: No picture, or they differ in size or number.
        WlmError: The file can't be written.
    """
    counts = {len(row) for row in rows.values()}
    shapes = {np.shape(cell) for row in rows.values() for cell in row}
    if len(counts) != 1 or len(shapes) != 1 or columns < 1:
        raise ValueError(f"expected rows of as many pictures of one size, got {sorted(counts)} of {sorted(shapes)}")
    (count,), (height, width, _) = counts, next(iter(shapes))
    if titles and len(titles) != count:
        raise ValueError(f"titles: expected {count}, got {len(titles)}")
    chosen = [int(i) for i in np.unique(np.linspace(0, count - 1, min(columns, count)).round())]
    font = ImageFont.load_default(_FONT)
    label = max(math.ceil(font.getlength(text)) for text in rows) + 2 * _MARGIN
    head = 2 * _FONT if titles else _MARGIN
    size = (label + len(chosen) * (width + _MARGIN), head + len(rows) * (height + _MARGIN))
    sheet = Image.new("RGB", size, (_GREY,) * 3)
    pen = ImageDraw.Draw(sheet)
    for column, i in enumerate(chosen):
        x = label + column * (width + _MARGIN)
        if titles:
            pen.text((x + width // 2, _FONT), titles[i], "white", font, anchor="mm")
        for row, cells in enumerate(rows.values()):
            sheet.paste(Image.fromarray(cells[i]), (x, head + row * (height + _MARGIN)))
    for row, text in enumerate(rows):
        pen.text((_MARGIN, head + row * (height + _MARGIN) + height // 2), text, "white", font, anchor="lm")
    save_png(path, np.asarray(sheet))
    return tuple(chosen)
