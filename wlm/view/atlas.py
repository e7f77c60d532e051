"""Pictures of a scene under its lightmaps: the original, the decoded ones, and their errors."""

import os
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from wlm.atlas.data import LightmappedScene
from wlm.atlas.evaluation import Sampler
from wlm.atlas.views import Points, points_at, visible_uv
from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path
from wlm.interop import check_device
from wlm.ops import raster
from wlm.ops.views import View
from wlm.view.display import Display, white_of

_BACKGROUND = 128  # light and dark surfaces stand out from it
_MARGIN, _TITLE, _FONT = 6, 26, 16  # pixels


def original(scene: LightmappedScene, device: str = "cpu") -> Sampler:
    """The lightmaps themselves as a decoder: read bilinearly, their gaps filled."""
    device = check_device(device)

    def sample(points: Points, state: int = 0) -> torch.Tensor:
        light = torch.empty((len(points), 3), dtype=torch.float32, device=points.uv.device)
        for number in torch.unique(points.sheet).tolist():
            at = points.sheet == number
            image = torch.from_numpy(scene.sheets[number].lightmaps[state]).to(device)
            light[at] = raster.texture(image, points.uv[at].contiguous())
        return light

    return sample


def draw(
    scene: LightmappedScene,
    samplers: Mapping[str, Sampler],
    view: View,
    resolution: int = 512,
    device: str = "cpu",
    state: int = 0,
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Draws a scene from one camera, as `wlm.atlas.evaluation` does.

    Args:
        scene: The scene.
        samplers: Decoders by name.
        view: The camera.
        resolution: Pixels along a side.
        device: "cpu" or "cuda:N", the decoders'.
        state: The number of the state.

    Returns:
        For each decoder float32 [resolution, resolution, 3], linear light, 0 where no sheet is visible; and bool
        [resolution, resolution], true where one is.
    """
    hit, points = points_at(scene, *next(iter(visible_uv(scene, [view], resolution, device))))
    pictures = {}
    for name, sampler in samplers.items():
        picture = torch.zeros((*hit.shape, 3), dtype=torch.float32, device=hit.device)
        picture[hit] = sampler(points, state).float()
        pictures[name] = picture.cpu().numpy()
    return pictures, hit.cpu().numpy()


def encode(light: np.ndarray, hit: np.ndarray, white: float) -> np.ndarray:
    """Encodes linear light [H, W, 3] as sRGB bytes, grey beside the mesh."""
    return np.where(hit[..., None], Display(1.0 / white).picture(light), np.uint8(_BACKGROUND))


def save_png(path: str | os.PathLike[str], pixels: np.ndarray) -> None:
    """Writes uint8 [H, W, 3] as a PNG, whole or not at all.

    Raises:
        WlmError: The file can't be written.
    """
    with atomic_path(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG")


def comparison(
    path: str | os.PathLike[str],
    scene: LightmappedScene,
    samplers: Mapping[str, Sampler],
    views: Sequence[View],
    *,
    resolution: int = 512,
    gain: float = 8.0,
    device: str = "cpu",
) -> None:
    """Writes a PNG: one row per view, with the original, each decoder, and each decoder's absolute error times a gain.

    All share one exposure: the original's 99.5th percentile over all views is white, and light is encoded as sRGB.
    Errors are linear. Each view is cropped to the mesh.

    Args:
        path: The PNG to write; its folder must exist.
        scene: The scene with its original lightmaps.
        samplers: Decoders by name, at least one; none is called "original".
        views: The cameras, at least one.
        resolution: Pixels along a side of a view before it is cropped.
        gain: Factor on errors.
        device: "cpu" or "cuda:N", the decoders'.

    Raises:
        ValueError: No decoder, or no view.
        WlmError: No view sees the mesh, or the file can't be written.
    """
    if not samplers or not views:
        raise ValueError("expected at least one decoder and one view")
    drawn = []
    for view in views:
        pictures, hit = draw(scene, {"original": original(scene, device), **samplers}, view, resolution, device)
        if hit.any():
            lines = hit.any(axis=1), hit.any(axis=0)
            window = tuple(slice(int(line.argmax()), len(line) - int(line[::-1].argmax())) for line in lines)
            drawn.append(({name: picture[window] for name, picture in pictures.items()}, hit[window]))
    if not drawn:
        raise WlmError(f"{scene.name}: cannot draw it: no view shows it")
    white = white_of(np.concatenate([pictures["original"][hit] for pictures, hit in drawn]))
    rows = []
    for pictures, hit in drawn:
        light = [encode(picture, hit, white) for picture in pictures.values()]
        errors = (np.abs(pictures[name] - pictures["original"]) * gain for name in samplers)
        rows.append(light + [encode(error, hit, white) for error in errors])
    titles = [f"error x {gain:g}, {name}" for name in samplers]
    save_png(path, _sheet(rows, ["original", *samplers, *titles]))


def _sheet(rows: list[list[np.ndarray]], titles: list[str]) -> np.ndarray:
    """Arranges pictures in rows under titles, each in the middle of its cell."""
    cell = max(row[0].shape[1] for row in rows)
    heights = [row[0].shape[0] for row in rows]
    width = len(titles) * (cell + _MARGIN) + _MARGIN
    sheet = Image.new("RGB", (width, sum(heights) + _TITLE + _MARGIN * (len(rows) + 1)), (_BACKGROUND,) * 3)
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(_FONT)
    for column, title in enumerate(titles):
        middle = _MARGIN + column * (cell + _MARGIN) + cell // 2
        pen.text((middle, _MARGIN), title, fill="white", font=font, anchor="ma")
    y = _TITLE + _MARGIN
    for row, height in zip(rows, heights, strict=True):
        for column, picture in enumerate(row):
            x = _MARGIN + column * (cell + _MARGIN) + (cell - picture.shape[1]) // 2
            sheet.paste(Image.fromarray(picture), (x, y))
        y += height + _MARGIN
    return np.asarray(sheet)
