"""A browser for the pages, where one is installed."""

import functools
import http.server
import os
import shutil
import threading
from pathlib import Path

import pytest

_PROGRAMS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
_OPTIONS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
_OPTIONS += ("--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader")


@pytest.fixture(scope="session")
def browser():
    """Headless Chromium with WebGL2 and WebGPU in software."""
    program = next(filter(None, map(shutil.which, _PROGRAMS)), None)
    if program is None:
        pytest.skip("no browser: install chromium-headless-shell, or chromium")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as started:
        opened = started.chromium.launch(executable_path=program, args=list(_OPTIONS))
        yield opened
        opened.close()


@pytest.fixture
def show(browser):
    """Opens a page, and at the end checks that nothing went wrong in it; `unpacked` goes without block compression."""
    errors, contexts = [], []

    def load(path, *, unpacked=False, width=900, height=600, touch=False):
        options = {"has_touch": touch, "color_scheme": "dark"}
        context = browser.new_context(viewport={"width": width, "height": height}, **options)
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.goto(path.as_uri() + ("#unpacked" if unpacked else ""))
        page.evaluate("wlm.then(() => 0, () => 1)")
        return page

    load.errors = errors
    yield load
    for context in contexts:
        context.close()
    assert not errors


THREE = os.environ.get("WLM_THREE")
"""The folder of an unpacked `three` from npm, 0.187 or later."""


@pytest.fixture
def serve():
    """Serves a folder, with three.js beside it, on this machine's loopback; gives its address."""
    if not THREE:
        pytest.skip("WLM_THREE names no three.js: npm install three, and name its folder")
    started = []

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *words: object) -> None:
            """Says nothing."""

        def do_GET(self) -> None:
            """Chromium with a window asks for a page's icon, and calls its lack an error."""
            if self.path == "/favicon.ico":
                self.send_response(204)
                self.end_headers()
                return
            super().do_GET()

    def start(folder: Path) -> str:
        (folder / "three").symlink_to(Path(THREE).resolve(), target_is_directory=True)
        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        started.append((server, thread))
        return f"http://127.0.0.1:{server.server_port}"

    yield start
    for server, thread in started:
        server.shutdown()
        thread.join()
