"""Pictures of the documents that are drawn from data in the repository alone, without what other demos leave.

`DRAWINGS` has a function for each; `python -m demos.pictures NAME.png` makes them.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

import wlm
from demos.plume import make_plume
from wlm.formats.exr import write_exr
from wlm.ops import texture
from wlm.ops.views import View, visible_points
from wlm.scene import Renderer
from wlm.smoke.camera import DIRECTIONS
from wlm.smoke.scene import load_scene, make_camera
from wlm.smoke.simulation import advance, make_solver, volume_of
from wlm.smoke.transport.orders import scatter
from wlm.texels import filmic, to_srgb
from wlm.view.pictures import to_bytes
from wlm.view.smoke import Drawing

HERE = Path(__file__).resolve().parent
DATA = HERE / "data"
PAPER, INK = "#1b1b1f", "#e8e8e8"
GAP = 10  # between pictures
NIGHT = (0.02, 0.025, 0.035)  # radiance behind a plume

# By scene of smoke: the share of its cells along each axis, pixels of the height, frames, and the part to keep:
# left, top, right and bottom as shares. Those at full size take a minute on a GPU, and hours on a CPU.
SCENES = {
    "candle": (1.0, 256, (60,), (0.0, 0.0, 1.0, 1.0)),
    "explosion": (1.0, 256, (6, 12, 20, 45), (0.0, 0.0, 1.0, 1.0)),
    "rabbit": (0.3, 300, (22, 44, 66), (0.0, 0.1, 1.0, 0.96)),
    "fan": (1.0, 256, (25, 50, 100), (0.0, 0.0, 1.0, 1.0)),
}


def row(pictures: Sequence[tuple[Image.Image, str]], gap: int = GAP) -> Image.Image:
    """Pictures of one height side by side, each with its label in a corner."""
    font = ImageFont.load_default(15)
    width = sum(picture.width for picture, _ in pictures) + gap * (len(pictures) - 1)
    result, left = Image.new("RGB", (width, pictures[0][0].height), PAPER), 0
    for picture, label in pictures:
        result.paste(picture, (left, 0))
        if label:
            pen, place = ImageDraw.Draw(result), (left + 6, 4)
            box = pen.textbbox(place, label, font)
            pen.rectangle((box[0] - 4, box[1] - 3, box[2] + 4, box[3] + 3), "#000000")
            pen.text(place, label, INK, font)
        left += picture.width + gap
    return result


def stack(pictures: Sequence[Image.Image], gap: int = GAP) -> Image.Image:
    """Pictures of one width below each other."""
    height = sum(picture.height for picture in pictures) + gap * (len(pictures) - 1)
    result, top = Image.new("RGB", (pictures[0].width, height), PAPER), 0
    for picture in pictures:
        result.paste(picture, (0, top))
        top += picture.height + gap
    return result


def street_beside_original() -> Image.Image:
    """The street at two hours: under decoded lightmaps, under the original ones, and 8 times the error."""
    rows = []
    with wlm.scene.load(DATA / "street" / "street.yaml") as scene, Renderer(scene, 240, 340, samples=3) as renderer:
        for hour, name in ((7.0, "7:00"), (22.0, "22:00")):
            decoded = renderer.draw(5.0, hour=hour, complete=True)
            original = renderer.draw(5.0, hour=hour, original=renderer.original(hour))
            error = np.abs(8.0 * (decoded.screen - original.screen).cpu().numpy()).clip(0, 1)
            pictures = decoded.picture(), original.picture(), (255 * error).astype(np.uint8)
            labels = f"{name}, decoded", "original", "8 times the error"
            rows.append(row([(Image.fromarray(each), label) for each, label in zip(pictures, labels, strict=True)]))
    return stack(rows)


def room_by_day_and_lamp() -> Image.Image:
    """The room of `wlm bake` from outside a corner, at two hours, under lightmaps that were compressed and decoded."""
    folder, pixels = DATA / "cornell", 440
    day = wlm.lightmap.load(folder)
    decoder = wlm.lightmap.compress(day, "M", steps=1500, samples=2048).decoder("cpu")
    mesh = wlm.atlas.load(folder / "scene.glb", folder / "light_8h.exr").triangles
    toward = np.array([0.8, 0.75, 1.0])
    a, b, c = (mesh.position[mesh.triangle[:, k]] for k in range(3))
    front = np.cross(b - a, c - a) @ toward > 0  # the walls between the viewer and the room face away
    facing, view = mesh.triangle[front], View.of(toward)
    pictures = []
    for hour, exposure in ((8.0, 1.6), (20.0, 5.0)):
        light = torch.from_numpy(decoder.frame(hour))
        shown, _, uv = next(visible_points(mesh.position, facing, mesh.uv, [view], 2 * pixels, "cpu"))
        picture = np.full((*shown.shape, 3), 0.035, np.float32)
        hit = (shown >= 0).numpy()
        picture[hit] = filmic(exposure * texture(light, uv[shown >= 0]).numpy().clip(0))
        fine = to_srgb(picture).reshape(pixels, 2, pixels, 2, 3).mean((1, 3))
        drawn = Image.fromarray((255 * fine + 0.5).astype(np.uint8))
        pictures.append((drawn, f"{hour:g}:00, " + ("the sun" if hour < 12 else "the lamp")))
    return row(pictures)


def plane_to_the_horizon() -> Image.Image:
    """A plane that repeats a lightmap up to the horizon, by 64 samples a pixel, by an atlas without mips and with."""
    day = wlm.lightmap.load(DATA / "city").light
    noon = int(np.argmin(np.abs(day.times - 12.0)))
    height, width, many = 150, 640, 8
    with tempfile.TemporaryDirectory() as folder:
        plane, light = Path(folder) / "plane.obj", Path(folder) / "noon.exr"
        corners = "v 0 0 0\nv 1 0 0\nv 1 0 2\nv 0 0 2\nvt 0 1\nvt 1 1\nvt 1 0\nvt 0 0\n"
        plane.write_text(corners + "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
        write_exr(light, day.frames[noon])
        decoder = wlm.atlas.compress(wlm.atlas.load(plane, light), "standard", mips=True).decoder("cpu")
    original = torch.from_numpy(day.frames[noon])

    def places(count: int) -> torch.Tensor:
        """UVs [height, width, count, count, 2] of samples within each pixel, not wrapped."""
        fine = (torch.arange(count) + 0.5) / count
        down, right = torch.arange(height)[:, None] + fine, torch.arange(width)[:, None] + fine
        depth = 0.09 * height / (down + 4.0)  # distance along the ground, the horizon 4 pixels above the picture
        across = (right - width / 2)[None, :, None] * depth[:, None, :, None] / 340.0
        along = depth[:, None, :, None].expand(height, width, count, 1)
        across = across.expand(height, width, count, count)
        return torch.stack([across + 0.5, -0.5 * along.expand_as(across)], -1) * 3.0

    sampled = texture(original, places(many), boundary="wrap").mean((2, 3))
    middle = places(1)[:, :, 0, 0]
    texels = torch.tensor([original.shape[1], original.shape[0]])
    slope = torch.stack(torch.gradient(middle, dim=(0, 1)), -1) * texels[:, None]
    lod = slope.norm(dim=-2).amax(-1).log2().clamp(min=0).flatten()
    wrapped = (middle % 1.0).reshape(-1, 2).float().contiguous()
    plain, smaller = decoder.read(wrapped), decoder.read(wrapped, lod=lod.float())
    white = float(torch.quantile(sampled, 0.99))
    shown = [(sampled, "original, 64 samples a pixel"), (plain, "atlas, one sample"), (smaller, "atlas with mips")]
    return stack([row([(_bytes(each.reshape(height, width, 3), white), name)]) for each, name in shown])


def _bytes(light: torch.Tensor, white: float = 1.0) -> Image.Image:
    return Image.fromarray(to_bytes(light.clamp(min=0.0), white))


def plume_in_turning_light() -> Image.Image:
    """A plume with embers under a light from four sides, and smaller the six lightmaps that it is mixed of."""
    volume = make_plume(extinction=14.0)
    camera = wlm.smoke.Camera.around(volume, toward=(0.3, 0.15, 1.0), pixels=240)
    six = wlm.smoke.bake(volume, camera)
    lit = []
    sides = {"right": (1, 0.3, 0.2), "front": (0.3, 0.3, 1), "left": (-1, 0.3, 0.2), "back": (0, 0.4, -1)}
    for name, toward in sides.items():
        lights = [wlm.smoke.Light(toward, (10.0, 9.0, 7.5)), wlm.smoke.Light((0, 1, 0), (0.4, 0.55, 0.8))]
        lit.append((_bytes(filmic(six.shade(lights, background=NIGHT).cpu())), f"light from the {name}"))
    width = sum(picture.width for picture, _ in lit) + 3 * GAP
    side = (width - 5 * GAP) // 6
    ways = [(_bytes(six[name]).resize((side, side), Image.Resampling.LANCZOS), name) for name in DIRECTIONS]
    below = Image.new("RGB", (width, side), PAPER)
    below.paste(row(ways), (0, 0))
    return stack([row(lit), below])


def scene_of_smoke(name: str) -> Image.Image:
    """Frames of a scene that is shipped, mostly with fewer cells, in light of all orders; on a GPU if there is one."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    scale, pixels, frames, (left, top, right, bottom) = SCENES[name]
    scene = load_scene(name).scaled(scale)
    camera = scene.camera.model_copy(update={"resolution": pixels})
    scene = scene.model_copy(update={"camera": camera, "frames": max(frames)})
    solver, pictures = make_solver(scene, device=device), []
    view, looks = make_camera(camera, scene.grid.origin, scene.grid.size), scene.looks(1)
    lights = [light.light() for light in looks.lights]
    parts = {"background": looks.background, "ramp": looks.ramp, "obstacles": looks.obstacles}
    drawing = Drawing(view, lights, albedo=looks.albedo, **parts, device=device)
    for number in range(1, max(frames) + 1):
        advance(scene, solver, number)
        if number in frames:
            drawing.move(scene.time(number))
            drawing(scatter(volume_of(scene, solver), view, lights, scene.smoke.albedo))
            drawn = _bytes(drawing.image)
            box = (left * drawn.width, top * drawn.height, right * drawn.width, bottom * drawn.height)
            pictures.append((drawn.crop(tuple(map(round, box))), f"{scene.time(number):.2f} s"))
    return row(pictures)


DRAWINGS: dict[str, Callable[[], Image.Image]] = {
    "lightmap.png": street_beside_original,
    "bake.png": room_by_day_and_lamp,
    "atlas-mips.png": plane_to_the_horizon,
    "smoke.png": plume_in_turning_light,
    "fire.png": lambda: row([(scene_of_smoke("candle"), ""), (scene_of_smoke("explosion"), "")]),
    "smoke-rabbit.png": lambda: scene_of_smoke("rabbit"),
    "smoke-fan.png": lambda: scene_of_smoke("fan"),
}
