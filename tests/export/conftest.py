"""A browser for the pages, where one is installed."""

import os
from contextlib import ExitStack
from pathlib import Path

import pytest

from demos import pictures
from demos.pictures import SOFTWARE_GL
from wlm.errors import WlmError

_OPTIONS = (*SOFTWARE_GL, "--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader")


@pytest.fixture(scope="session")
def browser():
    """Headless Chromium with WebGL2 and WebGPU in software."""
    try:
        with pictures.browser(Path(), _OPTIONS) as opened:
            yield opened.chromium
    except WlmError as error:
        pytest.skip(str(error))


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
    """Serves a folder, with three.js in its node_modules, on this machine's loopback; gives its address."""
    if not THREE:
        pytest.skip("WLM_THREE names no three.js: npm install three, and name its folder")
    with ExitStack() as started:
        yield lambda folder: started.enter_context(pictures.serve(folder))


@pytest.fixture
def visit(browser, serve):
    """Opens the page of a folder, served with three.js; at the end nothing has gone wrong in it."""
    pages, errors = [], []

    def opened(folder, ready="window.ready", **options):
        page = browser.new_page(**options)
        pages.append(page)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.goto(f"{serve(folder)}/index.html", wait_until="networkidle")
        page.wait_for_function(ready, timeout=20000)
        return page

    yield opened
    for page in pages:
        page.close()
    assert not errors
