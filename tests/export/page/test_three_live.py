"""The kit of a smoke network, loaded and drawn by three.js itself."""

import numpy as np
import pytest
import torch
from builders.smoke_plumes import plume
from typer.testing import CliRunner

from wlm.cli.app import app
from wlm.errors import WlmError
from wlm.export import export
from wlm.smoke.camera import Camera
from wlm.smoke.codec import open_network
from wlm.smoke.network.prediction import predict
from wlm.smoke.shading import Light

SIZE = 48
_PAGE = """<!doctype html>
<script type="importmap">{"imports": {"three": "/three/build/three.module.js"}}</script>
<script type="module">
import * as THREE from 'three';
import { loadLiveSmoke } from './live.js';
const renderer = new THREE.WebGLRenderer(), scene = new THREE.Scene(), sun = new THREE.DirectionalLight(0xffffff, 9);
const smoke = await loadLiveSmoke(new URL('bundle.json', import.meta.url), THREE, renderer);
scene.add(smoke.mesh, sun, sun.target);
smoke.mesh.position.set(3, 2, 1);
smoke.mesh.rotation.set(0, 0.5, 0);
window.draw = (volume, size, toward) => {
  smoke.setVolume(volume);
  const half = 0.5 * volume.voxel * Math.hypot(...volume.shape);
  const camera = new THREE.OrthographicCamera(-half, half, half, -half, 0.1, 50);
  camera.position.set(3, 3, 6);
  camera.lookAt(smoke.mesh.position);
  sun.position.set(...toward);
  const target = new THREE.WebGLRenderTarget(size, size, {type: THREE.FloatType});
  const pixels = new Float32Array(4 * size * size);
  for (let n = 0; n < 2; ++n) {  // three.js draws between two runs of the network
    smoke.update(camera, {size});
    renderer.setRenderTarget(target);
    renderer.render(scene, camera);
  }
  renderer.readRenderTargetPixels(target, 0, 0, size, size, pixels);
  const error = renderer.getContext().getError(), turn = smoke.mesh.quaternion.clone().invert();
  if (error) throw new Error(`GL ${error}`);
  const local = (vector) => vector.normalize().applyQuaternion(turn).toArray();
  const axes = [0, 1, 2].map((n) => local(new THREE.Vector3().setFromMatrixColumn(camera.matrixWorld, n)));
  return [Array.from(pixels), axes, half, local(new THREE.Vector3(...toward))];
};
window.ready = true;
</script>
"""


def test_three_lights_smoke_as_python_does(tmp_path, browser, serve):
    result = CliRunner().invoke(app, ["smoke", "export-three", "-o", str(tmp_path / "kit")])
    assert result.exit_code == 0, result.output
    (tmp_path / "kit" / "index.html").write_text(_PAGE)
    page, errors = browser.new_page(), []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.goto(f"{serve(tmp_path / 'kit')}/index.html")
    page.wait_for_function("window.ready", timeout=20000)
    smoke = plume()
    given = {name: getattr(smoke, name) for name in ("shape", "voxel", "extinction")}
    given["density"] = smoke.density.flatten().tolist()
    pixels, axes, half, toward = page.evaluate("(given) => draw(...given)", [given, SIZE, (1.0, 2.0, 1.5)])
    camera = Camera(*map(tuple, (smoke.centre + 9.0 * np.array(axes[2]), *axes)), 2.0 * half, SIZE, SIZE)
    six = predict(smoke, camera, "fast")
    expected = six.shade([Light(tuple(toward), (9.0,) * 3)])[..., 0]
    found = torch.tensor(pixels).reshape(SIZE, SIZE, 4).flip(0)
    apart = (found[..., 0] - expected).abs()
    assert expected.max() > 0.3 and apart.max() < 2 / 255, apart.max()
    assert not errors
    page.close()


def test_only_three_has_a_kit(tmp_path):
    with pytest.raises(WlmError, match="expected the engine three and .*, got unity"):
        export(open_network("fast"), tmp_path / "kit", "unity")
    raw = export(open_network("fast"), tmp_path / "raw")
    assert {path.name for path in raw} == {"bundle.json", "weights.bin"}
