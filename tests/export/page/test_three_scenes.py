"""The lightmaps of a scene for three.js, with its own loader of glTF: objects that share a material, states."""

import numpy as np
import pytest
from builders.scene_folders import expected_picture, scene_folder

from wlm.export import export

_SIZE = 96
_PAGE = """<!doctype html>
<script type="importmap">{"imports": {"three": "/three/build/three.module.js", "three/addons/": "/three/examples/jsm/"}}
</script>
<script type="module">
import * as THREE from 'three';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
import { loadScene } from './scene.js';
const renderer = new THREE.WebGLRenderer(), size = SIZE;
const light = await loadScene(new URL('bundle.json', import.meta.url), THREE);
window.draw = async (name, state) => {
  const { scene } = await new GLTFLoader().loadAsync('mesh.glb');
  const shared = new THREE[`Mesh${name}Material`]({color: 0xffffff});
  scene.traverse((each) => { if (each.isMesh) each.material = shared; });
  // A node below one that has light, and its own has none.
  const below = new THREE.Mesh(new THREE.BufferGeometry(), shared);
  below.userData.name = 'below';
  scene.getObjectByName('left').add(below);
  light.apply(scene);
  if (below.material !== shared) throw new Error('light of another node');
  light.setState(state);
  const target = new THREE.WebGLRenderTarget(size, size, {type: THREE.FloatType});
  const camera = new THREE.OrthographicCamera(-1, 1, 1, -1, -1, 1), root = new THREE.Scene();
  root.add(scene);
  renderer.setRenderTarget(target);
  renderer.render(root, camera);
  const pixels = new Float32Array(4 * size * size);
  renderer.readRenderTargetPixels(target, 0, 0, size, size, pixels);
  const error = renderer.getContext().getError();
  if (error || parseInt(THREE.REVISION) < 187) throw new Error(`GL ${error}, revision ${THREE.REVISION}`);
  return Array.from(pixels);
};
window.ready = true;
</script>
"""


@pytest.mark.parametrize(("uv_set", "colour"), [(0, "mixed"), (1, "rgb9e5")])
def test_three_shows_each_object_its_part(uv_set, colour, tmp_path, browser, serve):
    model = scene_folder(tmp_path / "scene", uv_set, colour=colour)
    assert model.colour == colour
    export(model, tmp_path / "out", "three")
    (tmp_path / "out" / "index.html").write_text(_PAGE.replace("SIZE", str(_SIZE)))
    page, errors = browser.new_page(), []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.goto(f"{serve(tmp_path / 'out')}/index.html")
    page.wait_for_function("window.ready", timeout=20000)
    for name, state in (("Basic", 0.0), ("Lambert", 1.0), ("Phong", 1.5), ("Basic", 2.0)):
        found = np.array(page.evaluate(f"draw('{name}', {state})")).reshape(_SIZE, _SIZE, 4)[::-1, :, :3]
        expected, inside = expected_picture(model, _SIZE, state)
        assert inside.mean() > 0.9
        np.testing.assert_allclose(found[inside], expected[inside], rtol=0, atol=expected.max() / 255)
    assert not errors
    page.close()
