"""The grid for three.js, loaded and drawn by three.js itself: its KTX2 loader, its shader's spherical harmonics.

three.js is no part of this package: WLM_THREE names the folder of an unpacked `three` from npm, 0.187 or later.
"""

import json

import numpy as np
import pytest
from builders.probe_models import whole_model as random_model

from wlm.export import export
from wlm.probe.sphere import irradiance

_SIZE = 64
_PAGE = """<!doctype html>
<script type="importmap">{"imports": {"three": "/three/build/three.module.js", "three/addons/": "/three/examples/jsm/"}}
</script>
<script type="module">
import * as THREE from 'three';
import { KTX2Loader } from 'three/addons/loaders/KTX2Loader.js';
import { LightProbeGridWebGL } from 'three/addons/lighting/LightProbeGridWebGL.js';
import { loadLightProbeGrid } from './grid.js';

// A plane through the box's centre that faces along an axis, as light in linear floats.
window.draw = async (axis, sign, side) => {
    const renderer = new THREE.WebGLRenderer();
    const grid = await loadLightProbeGrid('grid.json', renderer, THREE, KTX2Loader, LightProbeGridWebGL);
    const scene = new THREE.Scene();
    scene.add(grid);
    const geometry = new THREE.PlaneGeometry(side, side);
    const plane = new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({ color: 0xffffff }));
    const normal = new THREE.Vector3().setComponent(axis, sign);
    plane.position.copy(grid.position);
    plane.lookAt(plane.position.clone().add(normal));
    scene.add(plane);
    const camera = new THREE.OrthographicCamera(-side / 2, side / 2, side / 2, -side / 2, 0.1, 100);
    camera.position.copy(plane.position).addScaledVector(normal, 10);
    camera.up.setComponent(1, 0).setComponent((axis + 1) % 3, 1);
    camera.lookAt(plane.position);
    const size = SIZE, target = new THREE.WebGLRenderTarget(size, size, { type: THREE.FloatType });
    renderer.setRenderTarget(target);
    renderer.render(scene, camera);
    const pixels = new Float32Array(4 * size * size);
    renderer.readRenderTargetPixels(target, 0, 0, size, size, pixels);
    const axes = [new THREE.Vector3(), new THREE.Vector3(), new THREE.Vector3()];
    camera.matrixWorld.extractBasis(...axes);
    return { pixels: Array.from(pixels), right: axes[0].toArray(), up: axes[1].toArray(),
             revision: THREE.REVISION, error: renderer.getContext().getError() };
};
window.ready = true;
</script>
"""


@pytest.fixture
def site(tmp_path, serve):
    """The grid of a model and three.js."""
    model = random_model(seed=3)
    model.content.net[-27:-24] = 4.0  # biases of L0: light that is nowhere below 0
    export(model, tmp_path, "three", cells=8)
    (tmp_path / "index.html").write_text(_PAGE.replace("SIZE", str(_SIZE)))
    return model, json.loads((tmp_path / "grid.json").read_text()), f"{serve(tmp_path)}/index.html"


def test_three_shows_what_decode_gives(site, browser):
    """At the pixels of six planes: trilinear between the cells' centres, half a cell ahead along the normal."""
    model, info, url = site
    page = browser.new_page()
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(url)
    page.wait_for_function("window.ready")
    low, high = np.array(info["box"])
    count = np.array(info["resolution"])
    cell, side = (high - low) / count, 0.9 * float((high - low).min())
    decoder = model.decoder()
    for axis in range(3):
        for sign in (1.0, -1.0):
            drawn = page.evaluate(f"draw({axis}, {sign}, {side})")
            assert drawn["error"] == 0 and int(drawn["revision"]) >= 187 and not errors
            pixels = np.array(drawn["pixels"]).reshape(_SIZE, _SIZE, 4)
            normal = sign * np.eye(3)[axis]
            along = ((np.arange(_SIZE) + 0.5) / _SIZE - 0.5) * side
            v, u = np.meshgrid(along, along, indexing="ij")  # row 0 is the lowest
            place = (low + high) / 2 + u[..., None] * drawn["right"] + v[..., None] * drawn["up"]
            at = np.clip((place + normal * cell / 2 - low) / cell - 0.5, 0.0, count - 1.0)
            first = np.minimum(np.floor(at), count - 2).astype(int)
            rest = at - first
            light = np.zeros((_SIZE, _SIZE, 27))
            for corner in np.ndindex(2, 2, 2):
                centre = low + (first + corner + 0.5) * cell
                weight = np.where(corner, rest, 1.0 - rest).prod(-1)
                light += weight[..., None] * decoder.decode(centre.reshape(-1, 3)).reshape(_SIZE, _SIZE, 27)
            want = irradiance(light.reshape(_SIZE, _SIZE, 9, 3), normal[None])[..., 0, :] / np.pi
            assert want.min() > 0.0 and np.ptp(want) > 0.01 * want.max()
            np.testing.assert_allclose(pixels[..., :3], want, atol=2e-3 * want.max())
    page.close()
