"""The module for three.js that fills a volume of light probes with WebGPU, run by three.js itself."""

import numpy as np

from wlm import probe
from wlm.export import export
from wlm.export.engines.volume import volume_module
from wlm.probe.sphere import irradiance
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.shader import volume_glsl
from wlm.probe.volume.update import update_bundle

_SIZE = 16
_PAGE = """<!doctype html>
<script type="importmap">{"imports": {"three": "/node_modules/three/build/three.webgpu.js", "three/webgpu":
"/node_modules/three/build/three.webgpu.js", "three/tsl": "/node_modules/three/build/three.tsl.js"}}
</script>
<script type="module">
import * as THREE from 'three/webgpu';
import * as TSL from 'three/tsl';
import { WlmVolume } from './volume.js';

// A plane that faces up, lit after a walk, as light in linear floats.
window.draw = async (path, centre, side) => {
    const renderer = new THREE.WebGPURenderer();
    const volume = await WlmVolume.load('./', renderer, THREE);
    for (const viewpoint of path)
        volume.update(new THREE.Vector3(...viewpoint));
    const material = new THREE.MeshBasicNodeMaterial();
    material.colorNode = volume.diffuse(TSL, TSL.positionWorld, TSL.normalWorld);
    const plane = new THREE.Mesh(new THREE.PlaneGeometry(side, side), material);
    plane.position.set(...centre);
    plane.rotation.x = -Math.PI / 2;
    const scene = new THREE.Scene();
    scene.add(plane);
    const camera = new THREE.OrthographicCamera(-side / 2, side / 2, side / 2, -side / 2, 0.1, 100);
    camera.position.set(centre[0], centre[1] + 10, centre[2]);
    camera.up.set(0, 0, -1);
    camera.lookAt(plane.position);
    const size = SIZE, target = new THREE.RenderTarget(size, size, { type: THREE.FloatType });
    renderer.setRenderTarget(target);
    await renderer.renderAsync(scene, camera);
    const pixels = await renderer.readRenderTargetPixelsAsync(target, 0, 0, size, size);
    return { pixels: Array.from(pixels), webgpu: !!renderer.backend.isWebGPUBackend };
};
window.ready = true;
</script>
"""


def test_three_lights_a_plane_from_the_volume(visit, tmp_path):
    """After a walk the pixels are what the volume of the same walk gives in Python."""
    random = np.random.default_rng(4)
    place = random.uniform(0.0, 6.0, (300, 3)) * [1.0, 0.3, 1.0]
    light = np.sin(place @ random.normal(size=(3, 27)) + random.uniform(0.0, 6.0, 27))
    light[:, :3] += 2.0
    model = probe.compress(probe.from_arrays(place, light), "pca")
    volume = Volume(place, model.decoder(position=place).light(place), live=model.live, budget=64, side=8)
    made = update_bundle(volume, model, frames=5)
    export(made, tmp_path, shader="wgsl")
    files = volume_module(volume_glsl(27)) | {"index.html": _PAGE.replace("SIZE", str(_SIZE)).encode()}
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    page = visit(tmp_path)
    side, centre = 4.0, np.array([3.0, 0.9, 3.0])
    drawn = page.evaluate(f"draw({made.reference['viewpoint'].tolist()}, {centre.tolist()}, {side})")
    assert drawn["webgpu"]
    pixels = np.array(drawn["pixels"], np.float32).reshape(_SIZE, _SIZE, 4)[..., :3]
    along = ((np.arange(_SIZE) + 0.5) / _SIZE - 0.5) * side
    z, x = np.meshgrid(along, along, indexing="ij")
    points = centre + np.stack([x, 0 * x, z], -1).reshape(-1, 3)
    up = np.tile([0.0, 1.0, 0.0], (len(points), 1))
    reading = volume.read(points, up)
    light = irradiance(reading.values.reshape(-1, 9, 3), up[:1])[:, 0] / np.pi
    expected = np.maximum(light, 0.0).reshape(_SIZE, _SIZE, 3)
    assert (reading.weight > 0).mean() > 0.9 and np.ptp(expected, (0, 1)).min() > 0.2 * expected.max()
    np.testing.assert_allclose(pixels, expected, atol=3e-3 * expected.max())
