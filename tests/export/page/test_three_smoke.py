"""Smoke for three.js, loaded and drawn by three.js itself under its own lights."""

import numpy as np
import pytest
from builders.smoke_books import IRRADIANCE, SKY, TOWARD, random_book, random_frames, shown

from wlm.export import export
from wlm.smoke.bundle import bundle

_PAGE = """<!doctype html>
<script type="importmap">{"imports": {"three": "/three/build/three.module.js"}}</script>
<script type="module">
import * as THREE from 'three';
import { loadSmoke } from './smoke.js';
const renderer = new THREE.WebGLRenderer();
const smoke = await loadSmoke(new URL('bundle.json', import.meta.url), THREE);
const scene = new THREE.Scene(), sun = new THREE.DirectionalLight(), sky = new THREE.AmbientLight();
scene.add(smoke.mesh, sun, sun.target, sky);
smoke.mesh.position.set(3, 2, 1);
smoke.mesh.rotation.set(0.3, 0.2, 0.1);
smoke.mesh.scale.setScalar(2);
// From behind and above, so that the mesh has to turn; light as floats, before a background.
window.draw = ({time, loop, width, height, toward, irradiance, sky: [r, g, b], behind}) => {
  const [wide, high] = smoke.info.extent;
  const camera = new THREE.OrthographicCamera(-wide, wide, high, -high, 0.1, 100);
  camera.position.set(-4, 9, -8);
  camera.lookAt(smoke.mesh.position);
  camera.updateMatrixWorld();
  sun.target.position.set(0, 0, 0);
  sun.position.set(...toward).transformDirection(camera.matrixWorld);
  sun.color.setRGB(...irradiance, THREE.LinearSRGBColorSpace);
  sky.color.setRGB(r * Math.PI, g * Math.PI, b * Math.PI, THREE.LinearSRGBColorSpace);
  smoke.setTime(time, loop);
  const target = new THREE.WebGLRenderTarget(width, height, {type: THREE.FloatType});
  renderer.setRenderTarget(target);
  renderer.setClearColor(new THREE.Color().setRGB(behind, behind, behind, THREE.LinearSRGBColorSpace), 1);
  renderer.render(scene, camera);
  const pixels = new Float32Array(4 * width * height);
  renderer.readRenderTargetPixels(target, 0, 0, width, height, pixels);
  const error = renderer.getContext().getError();
  renderer.setRenderTarget(null);
  if (error || parseInt(THREE.REVISION) < 187) throw new Error(`GL ${error}, revision ${THREE.REVISION}`);
  return Array.from(pixels);
};
window.ready = true;
</script>
"""


@pytest.fixture
def opened(tmp_path, browser, serve):
    """Opens a flip book; at the end nothing has gone wrong in its page."""
    pages, errors = [], []

    def open_book(book):
        export(bundle(book), tmp_path, "three")
        (tmp_path / "index.html").write_text(_PAGE)
        page = browser.new_page()
        pages.append(page)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.goto(f"{serve(tmp_path)}/index.html")
        page.wait_for_function("window.ready", timeout=20000)

        def drawn(time, width=16, height=12, *, loop=True, behind=0.0):
            given = {"time": time, "width": width, "height": height, "loop": loop, "behind": behind}
            given |= {"toward": TOWARD, "irradiance": IRRADIANCE, "sky": SKY}
            return np.array(page.evaluate("draw", given)).reshape(height, width, 4)[::-1, :, :3]

        return drawn

    yield open_book
    for page in pages:
        page.close()
    assert not errors


@pytest.mark.parametrize("moving", [False, True])
def test_three_shows_what_shade_gives(moving, opened):
    """At frames, between them and, where it doesn't begin again, after the last; over black and over light."""
    frames = random_frames()
    book = random_book(frames, moving=moving)
    drawn = opened(book)
    for seconds, loop in ((0.0, True), (0.15, True), (0.825, True), (0.4, False), (0.9, False)):
        frame = seconds * book.rate
        frame = frame % 5 if loop else min(frame, 4.0)
        want = shown(frames, book, frame)
        for behind in (0.0, 0.75):
            expected = want[..., :3] + behind * (1.0 - want[..., 3:])
            np.testing.assert_allclose(drawn(seconds, loop=loop, behind=behind), expected, atol=1.6 / 255)


def test_smaller_pictures_read_mips(opened):
    """A pixel as large as four is their mean, where the padding allows the mip, and else one place between them."""
    frames = random_frames(seed=1)
    found = opened(random_book(frames, ramp=None))(0.0, 8, 6)
    want = shown(frames, random_book(frames, ramp=None), 0.0)[..., :3]
    fours = want.reshape(6, 2, 8, 2, 3).mean((1, 3))
    # Mips are rounded to 8 bits once more.
    np.testing.assert_allclose(found, fours, atol=2.4 / 255)
