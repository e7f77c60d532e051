"""The pictures of README and docs: what `wlm view` and `wlm web` show of what the demos leave.

    make pictures

It needs a Chromium and playwright, and for `wlm view` pyvista.
"""

from __future__ import annotations

import argparse
import io
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from PIL import Image, ImageColor, ImageDraw, ImageFont

from wlm.cli.console import quiet_warp
from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path
from wlm.view.opening import open_scene
from wlm.view.window import STRIP, Window

HERE = Path(__file__).resolve().parent
DATA = HERE / "data"
BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
SOFTWARE_GL = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
PANEL = 300  # pixels of a page's panel
PAPER, INK, SOFT, MARK = "#1b1b1f", "#e8e8e8", "#a0a0a8", "#ffb454"
COLUMN, UPPER, LOWER, GAP, HEAD = 690, 260, 280, 10, 58  # of the gallery: its pictures, between and above them
ROOMY = 420  # wide enough for a page to have its panel at the side
TITLE = 60  # of a panel of the window
FLAT = 1.08  # height of a page's picture over that of the lightmap in it

HOURS = (3.0, 7.0, 12.0, 18.5, 21.0)
LIGHTMAPS = ("right", "left", "top", "bottom", "front", "back")
# By file: what is opened, its options, the view, and the sliders.
VIEWS: dict[str, tuple[Sequence[str], dict[str, Any], str, dict[str, float]]] = {
    "lightmap.png": (["city.wlm"], {"original": DATA / "city"}, "light", {"hour": 12.0}),
    "atlas.png": (["room-standard.wlm"], {"original": DATA / "atlas" / "room.exr"}, "tiles", {}),
    "probe.png": (
        ["street.wlm"],
        {"original": DATA / "probes" / "street.npz", "key": "12.00"},
        "gaussians",
        {"sigma": 0.6},
    ),
    "smoke.png": ([f"smoke/plume_{angle:02}.exr" for angle in (0, 30, 60, 90)], {}, "light", {"turn": 60.0}),
}
# Those that demos make themselves.
DEMOS = {
    "fluid-control.png": "fluid_control.png",
    "ops-bc7.png": "ops_bc7.png",
    "ops-march.png": "ops_march.png",
    "ops-silhouette.png": "ops_silhouette.png",
    "smoke-light.png": "smoke/smoke_light.png",
}


class Browser:
    """Chromium that takes pictures of pages."""

    def __init__(self, chromium: Any, folder: Path) -> None:
        self._chromium, self._folder = chromium, folder

    def open(self, name: str, width: int, height: int, **options: Any) -> Any:
        """Opens a page of `gallery.py` or a report; a size in pixels."""
        page = self._chromium.new_page(viewport={"width": width, "height": height}, **options)
        page.goto((self._folder / f"{name}.html").as_uri())
        return page

    def stage(self, name: str, width: int, height: int) -> Any:
        """Opens a page whose picture, beside the panel, has a size."""
        page = self.open(name, PANEL + width, height)
        page.evaluate("wlm.then(() => 0)")
        return page


def take(page: Any, part: str = "body") -> Image.Image:
    """Takes a picture of a page, or of a part of it, after the next frame."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return Image.open(io.BytesIO(page.locator(part).screenshot())).convert("RGB")


def do(page: Any, script: str) -> None:
    """Runs a script that knows `kind`, and waits for it."""
    page.evaluate(f"wlm.then(async ({{kind}}) => {{ {script} }})")


@contextmanager
def browser(folder: Path) -> Iterator[Browser]:
    """Chromium with WebGL2 in software."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise WlmError("playwright is missing; needs the extra: pip install 'wlm[test]'") from error
    if program is None:
        raise WlmError(f"expected one of {', '.join(BROWSERS)}, found none")
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=program, args=list(SOFTWARE_GL))
        yield Browser(chromium, folder)
        chromium.close()


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


def middle(picture: Image.Image, width: int, height: int) -> Image.Image:
    """The middle of a picture."""
    left, top = (picture.width - width) // 2, (picture.height - height) // 2
    return picture.crop((left, top, left + width, top + height))


def cell(title: str, words: str, picture: Image.Image) -> Image.Image:
    """A picture of the gallery below what it shows."""
    result = Image.new("RGB", (COLUMN, HEAD + picture.height), PAPER)
    pen = ImageDraw.Draw(result)
    pen.text((0, 4), title, MARK, ImageFont.load_default(24))
    pen.text((0, 34), words, SOFT, ImageFont.load_default(16))
    result.paste(picture, (0, HEAD))
    return result


def gallery(pages: Browser, out: Path) -> Image.Image:
    """The four systems."""
    cells = [
        cell("Lightmaps over the day", "one file, read by a GPU at any hour", day(pages)),
        cell("The lightmap of a mesh", "a small colour texture, read through a small table", room(pages)),
        cell("Light probes", "decoded anywhere, from a few 3D Gaussians", street(pages, out)),
        cell("Smoke", "six lightmaps, baked or by a network: lit from anywhere", plume(pages)),
    ]
    both = row([(stack(cells[::2], 2 * GAP), ""), (stack(cells[1::2], 2 * GAP), "")], 3 * GAP)
    framed = Image.new("RGB", (both.width + 4 * GAP, both.height + 3 * GAP), PAPER)
    framed.paste(both, (2 * GAP, GAP))
    return framed


def day(pages: Browser) -> Image.Image:
    """Hours of the city's lightmap."""
    side = (COLUMN - (len(HOURS) - 1) * GAP) // len(HOURS)
    page, hours = pages.stage("city", ROOMY, round(UPPER * FLAT)), []
    for hour in HOURS:
        do(page, f"await kind.read({hour});")
        hours.append((middle(take(page, "#view"), side, UPPER), f"{int(hour)}:{round(hour % 1 * 60):02}"))
    return row(hours)


def room(pages: Browser) -> Image.Image:
    """The room's lightmap, and the room under it beside the original."""
    page = pages.stage("room", ROOMY, round(UPPER * FLAT))
    page.get_by_role("button", name="unwrapped").click()
    unwrapped = middle(take(page, "#view"), UPPER, UPPER)
    page = pages.stage("room", COLUMN - GAP - UPPER, UPPER)
    page.get_by_role("button", name="split").click()
    do(page, "const {mesh} = kind.surface; mesh.distance = 0.92; mesh.centre[1] -= 0.16 * mesh.radius; mesh.changed();")
    return row([(unwrapped, "the lightmap"), (take(page, "#view"), "")])


def street(pages: Browser, out: Path) -> Image.Image:
    """The street's probes as white balls, and its Gaussians from `wlm view` on the page's paper."""
    size = (COLUMN - GAP) // 2, LOWER
    page = pages.stage("street", ROOMY, LOWER)
    do(page, "await kind.read(); Object.assign(kind.camera, {yaw: 0.6, pitch: 0.42, distance: 0.84});")
    do(page, "const {camera} = kind; camera.centre[1] -= 0.07 * camera.radius; camera.changed();")
    page.keyboard.press("[")
    balls = middle(take(page, "#view"), *size)
    files, options, view, _ = VIEWS["probe.png"]
    # Twice as large, without the title and the sliders; the other two panels are left out.
    wide, high = 2 * size[0], 2 * size[1]
    shown = Window(open_scene([out / file for file in files], **options), size=(3 * wide, TITLE + high + STRIP))
    try:
        shown.choose(view)
        shown.set("sigma", 0.6)
        shown.set("exposure", 0.5)
        pixels = shown.picture()[TITLE : TITLE + high, :wide]
    finally:
        shown.close()
    pixels[(pixels == pixels[-1, 0]).all(-1)] = ImageColor.getrgb(PAPER)
    held = Image.fromarray(pixels).resize(size, Image.Resampling.LANCZOS)
    return row([(balls, "probes, as white balls"), (held, "the Gaussians that hold them")])


def plume(pages: Browser) -> Image.Image:
    """The plume's six lightmaps, and the plume under a light."""
    page = pages.stage("plume", ROOMY, LOWER)
    do(page, "kind.camera.distance = 0.926; kind.toward = unit([0.75, 0.6, 0.3]); kind.camera.changed();")
    small, maps = (LOWER - GAP) // 2, []
    wide = COLUMN - 3 * (small + GAP)
    lit = middle(take(page, "#view"), wide, LOWER)
    for name in LIGHTMAPS:
        page.get_by_role("button", name=name, exact=True).click()
        shown = middle(take(page, "#view"), LOWER, LOWER)
        maps.append((shown.resize((small, small), Image.Resampling.LANCZOS), name))
    return row([(stack([row(maps[:3]), row(maps[3:])]), ""), (lit, "any light")])


def page_and_phone(pages: Browser) -> Image.Image:
    """A page on a desk, with a texel under the pointer, and one on a phone."""
    desk = pages.open("room", 960, 640)
    desk.evaluate("wlm.then(() => 0)")
    desk.get_by_role("button", name="split").click()
    desk.mouse.move(700, 330)
    phone = pages.open("city", 330, 640, has_touch=True)
    do(phone, "await kind.read(18.5);")
    phone.touchscreen.tap(165, 150)
    return row([(take(desk), ""), (take(phone), "")])


def window(out: Path, name: str) -> Image.Image:
    """Takes a picture of the window of `wlm view`."""
    files, options, view, values = VIEWS[name]
    shown = Window(open_scene([out / file for file in files], **options), size=(1080, 480))
    try:
        shown.choose(view)
        shown.look()
        for slider, value in values.items():
            shown.set(slider, value)
        return Image.fromarray(shown.picture())
    finally:
        shown.close()


def save(path: Path, picture: Image.Image) -> None:
    """Writes a PNG, whole or not at all; levels in threes are a third smaller, and look the same."""
    rounded = picture.point(lambda level: (level + 1) // 3 * 3)
    with atomic_path(path) as temporary:
        rounded.save(temporary, "PNG", optimize=True)
    print(f"{path.name}: {picture.width} x {picture.height} pixels, {path.stat().st_size:,} bytes")


def main() -> None:
    """Reads the command line and writes the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--demos", type=Path, default=HERE / "out", help="the folder of the demos' files")
    parser.add_argument("--out", type=Path, default=HERE.parent / "docs" / "images", help="the folder to write to")
    args = parser.parse_args()
    quiet_warp()
    try:
        with browser(args.demos) as pages:
            save(args.out / "gallery.png", gallery(pages, args.demos))
            save(args.out / "web.png", page_and_phone(pages))
        for name in VIEWS:
            save(args.out / name, window(args.demos, name))
        for name, made in DEMOS.items():
            save(args.out / name, Image.open(args.demos / made).convert("RGB"))
    except (OSError, WlmError) as error:
        sys.exit(f"error: {error}; expected what the other demos leave")


if __name__ == "__main__":
    main()
