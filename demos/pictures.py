"""The pictures of README and docs: drawings from data in the repository (`drawings.py`), what `wlm view` and `wlm web`
show of the demos' files, and what the tutorials leave, with their pages of three.js.

    make pictures                           # all, after the demos and the tutorials
    python -m demos.pictures web.png        # some, of what the demos have left

`sources.json` beside the pictures gets a digest of the inputs and scripts of each (`SOURCES`), which a test compares.
It needs a Chromium and playwright, for `wlm view` pyvista, and for pages of tutorials three.js: WLM_THREE names the
folder of an unpacked `three` from npm, 0.187 or later.
"""

from __future__ import annotations

import argparse
import functools
import http.server
import inspect
import io
import os
import shutil
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from PIL import Image

import wlm
from benchmarks.plots import digest, stamp
from demos.drawings import DRAWINGS, SCENES, row, stack
from demos.tutorials import steps
from wlm.cli.console import quiet_warp
from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path
from wlm.scene import Renderer
from wlm.view.opening import open_scene
from wlm.view.window import Window

HERE = Path(__file__).resolve().parent
DATA = HERE / "data"
BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
SOFTWARE_GL = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
SOFTWARE_GPU = ("--no-sandbox", "--use-angle=vulkan", "--use-vulkan=swiftshader", "--enable-features=Vulkan")
SOFTWARE_GPU += ("--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader")
STREET = (7.0, 12.0, 18.75, 22.0)  # hours of the street
SECOND, VIEW = 2.0, (360, 640)  # of the street: the camera's place by the second of its film, height and width

# By file: what is opened, its options, the view, and the sliders.
VIEWS: dict[str, tuple[str, dict[str, Any], str, dict[str, float]]] = {
    "atlas.png": ("room-standard.wlm", {"original": DATA / "atlas" / "room.exr"}, "tiles", {}),
    "probe.png": (
        "street.wlm",
        {"original": DATA / "probes" / "street.npz", "key": "12.00"},
        "gaussians",
        {"sigma": 0.6},
    ),
}
# Of the tutorials, by file: pictures side by side, with labels and the lines to keep.
TUTORIALS = {
    "tutorial-optimise.png": ({f"optimise/{name}.png": name for name in ("front", "between", "side")}, (40, 224)),
    "tutorial-scene.png": ({f"scene/room/view_{hour:02}_00h.png": f"{hour}:00" for hour in (8, 12, 20)}, (0, 300)),
}
# Of the tutorials' pages of three.js, by file: the folder, the size, what is done in turn, and the label.
PAGES = {
    "tutorial-bake.png": ("bake", (360, 260), {f"hour.value = {h}; hour.hidden = 1": f"{h}:00" for h in (8, 12, 20)}),
    "tutorial-smoke.png": ("smoke", (260, 300), {"0": "", "1": "", "2": ""}),
}
WEBGPU_PAGES = {"tutorial-probes.png": ("probes", (640, 360), {"0": ""})}
# Those that demos make themselves.
DEMOS = {
    "fluid-control.png": "fluid_control.png",
    "ops-bc7.png": "ops_bc7.png",
    "ops-march.png": "ops_march.png",
    "ops-silhouette.png": "ops_silhouette.png",
    "smoke-light.png": "smoke/smoke_light.png",
}

# By file: the scripts and data that it is made from, below `demos`.
SOURCES = {
    "street.png": ("data/street/**/*",),
    "web.png": ("lightmap.py", "atlas.py", "data/city/*", "data/atlas/*", "../wlm/export/page/assets/page.css"),
    "lightmap.png": ("data/street/**/*",),
    "bake.png": ("data/cornell/*",),
    "atlas-mips.png": ("data/city/*",),
    "smoke.png": ("plume.py",),
    "fire.png": ("../configs/smoke-candle.yaml", "../configs/smoke-explosion.yaml"),
    "smoke-rabbit.png": ("../configs/smoke-rabbit.yaml", "../configs/meshes/rabbit.ply"),
    "smoke-fan.png": ("../configs/smoke-fan.yaml", "../configs/meshes/fan.ply"),
    "atlas.png": ("atlas.py", "data/atlas/*"),
    "probe.png": ("probe.py", "data/probes/*"),
    "fluid-control.png": ("fluid_control.py",),
    "ops-bc7.png": ("ops_bc7.py", "data/atlas/*"),
    "ops-march.png": ("ops_march.py", "data/smoke/*"),
    "ops-silhouette.png": ("ops_silhouette.py",),
    "smoke-light.png": ("smoke_light.py", "plume.py"),
    "tutorial-bake.png": ("data/cornell/*",),
    "tutorial-optimise.png": (),
    "tutorial-probes.png": ("data/cornell/*",),
    "tutorial-scene.png": ("data/cornell/*", "data/street/car.glb"),
    "tutorial-smoke.png": (),
}


def digests() -> dict[str, str]:
    """Returns the digest of each picture's sources, among them the function of a drawing, and the commands and code of
    a tutorial."""
    found = {}
    for name, patterns in SOURCES.items():
        paths = sorted({path for pattern in patterns for path in HERE.glob(pattern) if path.suffix not in ("", ".md")})
        tutorial = HERE.parent / "docs" / "tutorials" / f"{Path(name).stem.removeprefix('tutorial-')}.md"
        code = repr(list(steps(tutorial))) if name.startswith("tutorial-") else ""
        if name in DRAWINGS:
            code = inspect.getsource(DRAWINGS[name])
            code += repr([SCENES[scene] for scene in SCENES if f'("{scene}")' in code])
        found[name] = digest(code.encode() + b"".join(path.read_bytes() for path in paths))
    return found


class Browser:
    """Chromium that takes pictures of pages."""

    def __init__(self, chromium: Any, folder: Path) -> None:
        self.chromium, self.folder = chromium, folder

    def open(self, name: str, width: int, height: int, **options: Any) -> Any:
        """Opens a page of `gallery.py` or a report; a size in pixels."""
        page = self.chromium.new_page(viewport={"width": width, "height": height}, color_scheme="dark", **options)
        page.goto((self.folder / f"{name}.html").as_uri())
        return page


def take(page: Any, part: str = "body") -> Image.Image:
    """Takes a picture of a page, or of a part of it, after the next frame."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return Image.open(io.BytesIO(page.locator(part).screenshot())).convert("RGB")


def do(page: Any, script: str) -> None:
    """Runs a script that knows `kind`, and waits for it."""
    page.evaluate(f"wlm.then(async ({{kind}}) => {{ {script} }})")


@contextmanager
def browser(folder: Path, options: Sequence[str] = SOFTWARE_GL) -> Iterator[Browser]:
    """Chromium with WebGL2, or WebGPU, in software."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise WlmError("playwright is missing; needs the extra: pip install 'wlm[test]'") from error
    if program is None:
        raise WlmError(f"expected one of {', '.join(BROWSERS)}, found none")
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=program, args=list(options))
        yield Browser(chromium, folder)
        chromium.close()


def street() -> Image.Image:
    """The street at four hours."""
    views = []
    with wlm.scene.load(DATA / "street" / "street.yaml") as scene, Renderer(scene, *VIEW, samples=3) as renderer:
        for hour in STREET:
            drawn = Image.fromarray(renderer.draw(SECOND, hour=hour, complete=True).picture())
            views.append((drawn, f"{int(hour)}:{round(hour % 1 * 60):02}"))
    return stack([row(views[:2]), row(views[2:])])


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


@contextmanager
def serve(folder: Path) -> Iterator[str]:
    """Serves a tutorial's folder, with three.js in it, on this machine's loopback; gives its address."""
    three = os.environ.get("WLM_THREE")
    if not three:
        raise WlmError("WLM_THREE names no three.js: npm install three, and name its folder")
    (folder / "node_modules").mkdir(exist_ok=True)
    link = folder / "node_modules" / "three"
    link.unlink(missing_ok=True)
    link.symlink_to(Path(three).resolve())

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *words: object) -> None:
            """Says nothing."""

        def do_GET(self) -> None:
            """Chromium with a window asks for a page's icon, and calls its lack an error."""
            if self.path != "/favicon.ico":
                return super().do_GET()
            self.send_response(204)
            return self.end_headers()

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()


def tutorial_page(pages: Browser, name: str) -> Image.Image:
    """A tutorial's page of three.js, in each of its states."""
    folder, (width, height), states = (PAGES | WEBGPU_PAGES)[name]
    with serve(pages.folder / "tutorials" / folder) as address:
        page, taken = pages.chromium.new_page(viewport={"width": width, "height": height}), []
        page.goto(f"{address}/index.html", wait_until="networkidle")
        for script, label in states.items():
            page.evaluate(script)
            page.wait_for_timeout(4000)
            taken.append((Image.open(io.BytesIO(page.screenshot(timeout=200_000))).convert("RGB"), label))
        page.close()
    return row(taken)


def tutorial_row(out: Path, name: str) -> Image.Image:
    """Pictures that the commands of a tutorial write, side by side."""
    files, (top, bottom) = TUTORIALS[name]
    pictures = [(Image.open(out / "tutorials" / file).convert("RGB"), label) for file, label in files.items()]
    return row([(picture.crop((0, top, picture.width, bottom)), label) for picture, label in pictures])


def window(out: Path, name: str) -> Image.Image:
    """Takes a picture of the window of `wlm view`."""
    file, options, view, values = VIEWS[name]
    shown = Window(open_scene(out / file, **options), size=(1080, 480))
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


def pictures(demos: Path, wanted: Sequence[str]) -> Iterator[tuple[str, Image.Image]]:
    """Yields the wanted pictures by the names of their files."""
    if "street.png" in wanted:
        yield "street.png", street()
    for kind, options in ((["web.png", *PAGES], SOFTWARE_GL), (WEBGPU_PAGES, SOFTWARE_GPU)):
        if names := [name for name in kind if name in wanted]:
            with browser(demos, options) as pages:
                for name in names:
                    yield name, page_and_phone(pages) if name == "web.png" else tutorial_page(pages, name)
    for name in wanted:
        if name in DRAWINGS:
            yield name, DRAWINGS[name]()
        elif name in TUTORIALS:
            yield name, tutorial_row(demos, name)
        elif name in VIEWS:
            yield name, window(demos, name)
        elif name in DEMOS:
            yield name, Image.open(demos / DEMOS[name]).convert("RGB")


def main() -> None:
    """Reads the command line and writes the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME.png", help="pictures to make; default: all")
    parser.add_argument("--demos", type=Path, default=HERE / "out", help="the folder of the demos' files")
    parser.add_argument("--out", type=Path, default=HERE.parent / "docs" / "images", help="the folder to write to")
    args = parser.parse_args()
    quiet_warp()
    if unknown := sorted(set(args.names) - SOURCES.keys()):
        sys.exit(f"error: {unknown[0]}: expected some of {', '.join(SOURCES)}")
    try:
        for name, picture in pictures(args.demos, args.names or list(SOURCES)):
            save(args.out / name, picture)
            stamp(args.out, {name: digests()[name]})
    except (OSError, WlmError) as error:
        sys.exit(f"error: {error}; expected what the other demos leave")


if __name__ == "__main__":
    main()
