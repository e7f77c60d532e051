"""Lightmaps and atlases for three.js, loaded and drawn by three.js itself on materials that are matt.

Standard and Physical ones take what their specular part reflects off their diffuse part, 1.5% here.
"""

import numpy as np
import pytest
from builders.atlas_meshes import charts
from builders.atlas_models import KINDS, MIXED
from builders.atlas_models import random_model as random_atlas
from builders.synthetic import random_model as random_lightmap

from wlm.atlas.exact import decode64
from wlm.export import export

_SIZE = 96
_PAGE = """<!doctype html>
<script type="importmap">{"imports": {"three": "/three/build/three.module.js"}}</script>
<script type="module">
import * as THREE from 'three';
const renderer = new THREE.WebGLRenderer(), size = SIZE;
const floats = (target) => {
  const pixels = new Float32Array(4 * target.width * target.height);
  renderer.readRenderTargetPixels(target, 0, 0, target.width, target.height, pixels);
  return Array.from(pixels);
};
// A white plane whose second UVs fill the picture, v down, under the light alone.
window.plane = (apply, name) => {
  const geometry = new THREE.PlaneGeometry(2, 2), uv = geometry.attributes.uv.clone();
  for (let i = 0; i < uv.count; ++i) uv.setY(i, 1 - uv.getY(i));
  geometry.setAttribute('uv1', uv);
  const material = new THREE[`Mesh${name}Material`]({color: 0xffffff});
  apply(material, 1);
  const mesh = new THREE.Mesh(geometry, material);
  const target = new THREE.WebGLRenderTarget(size, size, {type: THREE.FloatType});
  const camera = new THREE.OrthographicCamera(-1, 1, 1, -1, -1, 1), scene = new THREE.Scene();
  scene.add(mesh);
  renderer.setRenderTarget(target);
  renderer.render(scene, camera);
  const error = renderer.getContext().getError();
  renderer.setRenderTarget(null);
  if (error || parseInt(THREE.REVISION) < 187) throw new Error(`GL ${error}, revision ${THREE.REVISION}`);
  return floats(target);
};
const {load} = await import('./load.js');
window.light = await load(renderer, THREE);
window.ready = true;
</script>
"""
_LIGHTMAP = """import { loadLightmap } from './lightmap.js';
export const load = (renderer, THREE) => loadLightmap(new URL('bundle.json', import.meta.url), renderer, THREE);
"""
_ATLAS = """import { loadAtlas } from './atlas.js';
export const load = (renderer, THREE) => loadAtlas(new URL('bundle.json', import.meta.url), THREE);
"""


def opened(browser, folder, serve, load):
    (folder / "load.js").write_text(load)
    (folder / "index.html").write_text(_PAGE.replace("SIZE", str(_SIZE)))
    page, errors = browser.new_page(), []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.goto(f"{serve(folder)}/index.html")
    page.wait_for_function("window.ready", timeout=20000) if not errors else None
    assert not errors
    return page, errors


def drawn(page, name):
    """The plane, row 0 at v = 0."""
    values = page.evaluate(f"plane(light.apply, '{name}')")
    return np.array(values).reshape(_SIZE, _SIZE, 4)[::-1, :, :3]


def filtered(frame):
    """A frame at the picture's pixels, as a linear filter reads it."""
    height, width = frame.shape[:2]
    out = frame.astype(np.float64)
    for axis, size in ((0, height), (1, width)):
        at = np.clip((np.arange(_SIZE) + 0.5) / _SIZE * size - 0.5, 0, size - 1)
        low = np.floor(at).astype(int)
        share = (at - low).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        out = (1 - share) * out.take(low, axis) + share * out.take(np.minimum(low + 1, size - 1), axis)
    return out


@pytest.mark.parametrize(("kinds", "interpolation"), [((4, 3, 2, 1), "radiance"), ((4, 3, 2, 1), "network")])
def test_three_shows_the_light_of_any_hour(kinds, interpolation, tmp_path, browser, serve):
    model = random_lightmap(kinds, interpolation=interpolation)
    export(model, tmp_path, "three")
    page, errors = opened(browser, tmp_path, serve, _LIGHTMAP)
    decoder = model.decoder()
    for time, name in ((0.0, "Basic"), (7.5, "Lambert"), (9.1, "Phong"), (21.7, "Basic")):
        page.evaluate(f"light.setTime({time})")
        expected = filtered(decoder.frame(time))
        # Maps of half floats, between which SwiftShader's filter mixes in floats.
        np.testing.assert_allclose(drawn(page, name), expected, rtol=0, atol=expected.max() / 255)
    assert not errors
    page.close()


@pytest.mark.parametrize(
    ("kind", "colour"), [*((kind, "rgb9e5") for kind in KINDS), ("plain", "bc6h"), (MIXED, "mixed")]
)
def test_three_shows_an_atlas(kind, colour, tmp_path, browser, serve):
    model = random_atlas(charts(), kind, colour)
    export(model, tmp_path / "three_js", "three")
    page, errors = opened(browser, tmp_path / "three_js", serve, _ATLAS)
    v, u = np.mgrid[:_SIZE, :_SIZE] / _SIZE + 0.5 / _SIZE
    uv = np.stack([u, v], -1).reshape(-1, 2).astype(np.float32)
    expected = decode64(model, uv).reshape(_SIZE, _SIZE, 3)
    inside = np.ones((_SIZE, _SIZE), bool)
    if model.method == "tiles":
        # A point on a border of tiles may be read from either.
        place = (uv * model.sheets[0].size[::-1] - 0.5) / model.profile.tile
        inside = (np.abs(place - np.rint(place)).min(1) > 1e-3).reshape(_SIZE, _SIZE)
    # As of the shader alone: a filter's place between two texels has 8 bits, in a table too.
    allowed = 3.0 / 512 * 2 * (1 + 22 * (model.method == "cascade"))
    for name in ("Basic", "Lambert", "Phong"):
        np.testing.assert_allclose(drawn(page, name)[inside], expected[inside], rtol=0, atol=allowed)
    assert not errors
    page.close()
