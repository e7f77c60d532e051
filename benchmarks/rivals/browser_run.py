"""Times the page of a lightmap in Chromium, where WebGL2 runs the exported GLSL in software."""

import shutil
import tempfile
from pathlib import Path

import numpy as np

from wlm.errors import WlmError
from wlm.export import write_page
from wlm.lightmap.model import LightmapModel

_PROGRAMS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
_OPTIONS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
_DRAWS = 4  # for each of the samples
# Draws all tiles of the first stored hour, and waits by reading a texel.
_SCRIPT = """async ([draws, samples]) => {
    const {kind} = await wlm, group = kind.groups[0], {graphics, next} = group, {gl} = graphics, times = [];
    await kind.read(kind.times[0]);
    for (let i = 0; i <= samples; ++i) {
        const start = performance.now();
        gl.bindFramebuffer(gl.FRAMEBUFFER, next.buffer);
        gl.disable(gl.DEPTH_TEST);
        gl.viewport(0, 0, next.width, next.height);
        graphics.use(group.programs.tile, {...group.textures, wlm_lightmap_hour: group.table});
        for (let j = 0; j < draws; ++j) graphics.draw(3);
        graphics.read(next, 1, 1);
        times.push((performance.now() - start) / draws);
    }
    return times.slice(1);
}"""


def page_time(model: LightmapModel, samples: int) -> float:
    """Returns the median time in ms in which the page of a model decodes its map at a stored hour.

    Raises:
        WlmError: There is no Chromium, or no `playwright`.
    """
    program = next(filter(None, map(shutil.which, _PROGRAMS)), None)
    if program is None:
        raise WlmError("shaders: no browser: install chromium-headless-shell, or chromium")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise WlmError("shaders: playwright is missing; needs the extra: pip install 'wlm[test]'") from error
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as started:
        file, page = Path(folder, "map.wlm"), Path(folder, "map.html")
        model.save(file)
        write_page(page, [file])
        browser = started.chromium.launch(executable_path=program, args=list(_OPTIONS))
        opened = browser.new_page()
        opened.goto(page.as_uri())
        times = opened.evaluate(_SCRIPT, [_DRAWS, samples])
        browser.close()
    return float(np.median(times))
