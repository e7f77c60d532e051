"""Sizes of engines' folders of a lightmap of 1024 x 1024 texels and 24 hours, and how long three.js takes to load it.

    WLM_THREE=node_modules/three python benchmarks/engine_loads.py benchmarks/engine-loads.json

It needs `playwright`, `chromium-headless-shell` or `chromium`, and three.js from npm, whose folder WLM_THREE names. All
tiles are dynamic. A load is from the call of `loadLightmap` to its return, with all files on the GPU and the first hour
asked for; drawn is when that hour is there; an hour is `setTime` to a stored one that isn't, until it is drawn, which
without a GPU the CPU does. All are medians over pages, each with a context of its own.
"""

import functools
import http.server
import json
import os
import shutil
import statistics
import sys
import tempfile
import threading
from pathlib import Path

import numpy as np
from playwright.sync_api import sync_playwright

import wlm
from benchmarks import describe_environment
from wlm.export import ENGINES, export
from wlm.formats.atomic import atomic_write
from wlm.lightmap.data import from_arrays

SIDE, HOURS, PAGES = 1024, 24, 5
PROGRAMS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
OPTIONS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
PAGE = """<!doctype html>
<script type="importmap">{"imports": {"three": "/three/build/three.module.js"}}</script>
<script type="module">
import * as THREE from 'three';
import { loadLightmap } from './lightmap.js';
const renderer = new THREE.WebGLRenderer(), gl = renderer.getContext(), pixel = new Uint8Array(4);
const done = () => gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
let start = performance.now();
const light = await loadLightmap(new URL('bundle.json', import.meta.url), renderer, THREE);
const load = performance.now() - start;
done();
const drawn = performance.now() - start;
start = performance.now();
light.setTime(light.lightmap.times[3]);
done();
window.times = [load, drawn, performance.now() - start, parseInt(THREE.REVISION)];
</script>
"""


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *words: object) -> None:
        """Says nothing."""


def lightmap() -> wlm.lightmap.LightmapModel:
    """A light that goes round over a pattern, fitted by so few steps that it is right in its bytes alone."""
    v, u = np.mgrid[:SIDE, :SIDE] / SIDE
    pattern = 0.5 + 0.5 * np.sin(40.0 * u) * np.cos(30.0 * v)
    turns = 2.0 * np.pi * (np.arange(HOURS)[:, None, None] / HOURS + u + v)
    light = (pattern * (1.1 + np.sin(turns)))[..., None] * np.array([1.0, 0.9, 0.8])
    light = from_arrays(light.astype(np.float32), np.arange(float(HOURS)), period=24.0, name="1024")
    return wlm.lightmap.compress(light, "M", steps=10)


def measured(browser, address: str) -> dict[str, float]:
    """Seconds that three.js takes in pages of their own, and its revision."""
    rows = []
    for _ in range(PAGES):
        context = browser.new_context()
        page = context.new_page()
        page.goto(f"{address}/index.html")
        page.wait_for_function("window.times", timeout=120_000)
        rows.append(page.evaluate("times"))
        context.close()
    load, drawn, hour, revision = (statistics.median(column) for column in zip(*rows, strict=True))
    seconds = {"load_seconds": load / 1e3, "drawn_seconds": drawn / 1e3, "hour_seconds": hour / 1e3}
    return seconds | {"revision": revision}


def main(target: Path) -> None:
    """Writes the figures as JSON."""
    model, methods = lightmap(), {}
    kinds = [int(count) for count in np.bincount(model.light.kind)]
    environment = describe_environment("cpu", "python benchmarks/engine_loads.py benchmarks/engine-loads.json")
    with tempfile.TemporaryDirectory() as name:
        for engine in ENGINES:
            paths = export(model, Path(name) / engine, engine)
            methods[engine] = {"files": len(paths), "megabytes": sum(path.stat().st_size for path in paths) / 1e6}
        folder = Path(name) / "three"
        (folder / "index.html").write_text(PAGE)
        (folder / "three").symlink_to(Path(os.environ["WLM_THREE"]).resolve(), target_is_directory=True)
        handler = functools.partial(_Quiet, directory=str(folder))
        with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, sync_playwright() as started:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            program = next(filter(None, map(shutil.which, PROGRAMS)))
            browser = started.chromium.launch(executable_path=program, args=list(OPTIONS))
            methods["three"] |= measured(browser, f"http://127.0.0.1:{server.server_port}")
            environment |= {"browser": browser.version}
            browser.close()
            server.shutdown()
    content = {"environment": environment, "sets": [{"name": "1024", "tiles_by_kind": kinds, "methods": methods}]}
    atomic_write(target, (json.dumps(content, indent=1) + "\n").encode())


if __name__ == "__main__":
    main(Path(sys.argv[1]))
