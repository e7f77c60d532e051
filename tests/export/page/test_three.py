"""Kits for three.js, loaded and drawn by three.js itself: probe grids, lightmaps, atlases, scenes and smoke.

three.js is no part of this package: WLM_THREE names the folder of an unpacked `three` from npm, 0.187 or later.
"""

import json

import numpy as np
import pytest
from builders.atlas_meshes import charts
from builders.atlas_models import KINDS, MIXED
from builders.atlas_models import random_model as random_atlas
from builders.light_groups import random_groups
from builders.probe_models import whole_model as random_model
from builders.scene_folders import expected_picture, scene_folder
from builders.smoke_books import IRRADIANCE, SKY, TOWARD, random_book, random_frames, shown
from builders.synthetic import random_model as random_lightmap

from benchmarks.atlas_exact import decode64
from wlm.export import export
from wlm.probe.sphere import irradiance
from wlm.smoke.bundle import bundle

_SIZE = 64
_SHARED = """<!doctype html>
<script type="importmap">{"imports": {"three": "/node_modules/three/build/three.module.js",
 "three/addons/": "/node_modules/three/examples/jsm/"}}</script>
<script>
// The light of a scene, in floats.
window.read = (THREE, renderer, scene, camera, width, height = width) => {
  const target = new THREE.WebGLRenderTarget(width, height, {type: THREE.FloatType});
  renderer.setRenderTarget(target);
  renderer.render(scene, camera);
  const pixels = new Float32Array(4 * width * height), error = renderer.getContext().getError();
  renderer.readRenderTargetPixels(target, 0, 0, width, height, pixels);
  renderer.setRenderTarget(null);
  if (error || parseInt(THREE.REVISION) < 187) throw new Error(`GL ${error}, revision ${THREE.REVISION}`);
  return Array.from(pixels);
};
</script>
"""
_PAGE = (
    _SHARED
    + """<script type="module">
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
    const pixels = read(THREE, renderer, scene, camera, SIZE);
    const axes = [new THREE.Vector3(), new THREE.Vector3(), new THREE.Vector3()];
    camera.matrixWorld.extractBasis(...axes);
    return { pixels, right: axes[0].toArray(), up: axes[1].toArray() };
};
window.ready = true;
</script>
"""
)


def test_three_shows_what_decode_gives(tmp_path, visit):
    """At the pixels of six planes: trilinear between the cells' centres, half a cell ahead along the normal."""
    model = random_model(seed=3)
    model.content.net[-27:-24] = 4.0  # biases of L0: light that is nowhere below 0
    export(model, tmp_path, "three", cells=8)
    (tmp_path / "index.html").write_text(_PAGE.replace("SIZE", str(_SIZE)))
    info, page = json.loads((tmp_path / "grid.json").read_text()), visit(tmp_path)
    low, high = np.array(info["box"])
    count = np.array(info["resolution"])
    cell, side = (high - low) / count, 0.9 * float((high - low).min())
    decoder = model.decoder()
    for axis in range(3):
        for sign in (1.0, -1.0):
            drawn = page.evaluate(f"draw({axis}, {sign}, {side})")
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
            want = np.maximum(irradiance(light.reshape(_SIZE, _SIZE, 9, 3), normal[None])[..., 0, :] / np.pi, 0.0)
            assert np.ptp(want) > 0.01 * want.max() > 0.0
            np.testing.assert_allclose(pixels[..., :3], want, atol=2e-3 * want.max())


_KIT_SIZE = 96
_KIT_PAGE = (
    _SHARED
    + """<script type="module">
import * as THREE from 'three';
const renderer = new THREE.WebGLRenderer();
// A white plane whose second UVs fill the picture, v down, under the light alone.
window.plane = (apply, name) => {
  const geometry = new THREE.PlaneGeometry(2, 2), uv = geometry.attributes.uv.clone();
  for (let i = 0; i < uv.count; ++i) uv.setY(i, 1 - uv.getY(i));
  geometry.setAttribute('uv1', uv);
  const material = new THREE[`Mesh${name}Material`]({color: 0xffffff});
  apply(material, 1);
  const mesh = new THREE.Mesh(geometry, material);
  const camera = new THREE.OrthographicCamera(-1, 1, 1, -1, -1, 1), scene = new THREE.Scene();
  scene.add(mesh);
  return read(THREE, renderer, scene, camera, SIZE);
};
const {load} = await import('./load.js');
window.light = await load(renderer, THREE);
window.ready = true;
</script>
"""
)
_LIGHTMAP = """import { loadLightmap } from './lightmap.js';
export const load = (renderer, THREE) => loadLightmap(new URL('bundle.json', import.meta.url), renderer, THREE);
"""
_GROUPS = """import { loadGroups } from './groups.js';
export const load = (renderer, THREE) => loadGroups(new URL('bundle.json', import.meta.url), renderer, THREE);
"""
_ATLAS = """import { loadAtlas } from './atlas.js';
export const load = (renderer, THREE) => loadAtlas(new URL('bundle.json', import.meta.url), THREE);
"""


def opened(visit, folder, load):
    (folder / "load.js").write_text(load)
    (folder / "index.html").write_text(_KIT_PAGE.replace("SIZE", str(_KIT_SIZE)))
    return visit(folder)


def drawn(page, name):
    """The plane, row 0 at v = 0."""
    values = page.evaluate(f"plane(light.apply, '{name}')")
    return np.array(values).reshape(_KIT_SIZE, _KIT_SIZE, 4)[::-1, :, :3]


def filtered(frame):
    """A frame at the picture's pixels, as a linear filter reads it."""
    height, width = frame.shape[:2]
    out = frame.astype(np.float64)
    for axis, size in ((0, height), (1, width)):
        at = np.clip((np.arange(_KIT_SIZE) + 0.5) / _KIT_SIZE * size - 0.5, 0, size - 1)
        low = np.floor(at).astype(int)
        share = (at - low).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        out = (1 - share) * out.take(low, axis) + share * out.take(np.minimum(low + 1, size - 1), axis)
    return out


@pytest.mark.parametrize(("kinds", "interpolation"), [((4, 3, 3, 1), "radiance"), ((4, 3, 3, 1), "network")])
def test_three_shows_the_light_of_any_hour(kinds, interpolation, tmp_path, visit):
    model = random_lightmap(kinds, interpolation=interpolation)
    export(model, tmp_path, "three")
    page = opened(visit, tmp_path, _LIGHTMAP)
    decoder = model.decoder()
    for time, name in ((0.0, "Basic"), (7.5, "Lambert"), (9.1, "Phong"), (21.7, "Basic")):
        page.evaluate(f"light.setTime({time})")
        expected = filtered(decoder.frame(time))
        # Maps of half floats, between which SwiftShader's filter mixes in floats.
        np.testing.assert_allclose(drawn(page, name), expected, rtol=0, atol=expected.max() / 255)


def test_three_adds_light_groups(tmp_path, visit):
    model = random_groups()
    export(model, tmp_path, "three")
    page = opened(visit, tmp_path, _GROUPS)
    decoder = model.decoder()
    assert page.evaluate("light.groups") == list(model.groups)
    for time, weights in ((0.0, {}), (9.1, {"lamp": 0.0, "sun": [1.0, 0.5, 0.25]}), (21.7, {"lamp": 2.0})):
        page.evaluate(f"light.setTime({time})")
        for name, weight in weights.items():
            page.evaluate(f"light.setWeight('{name}', {weight})")
        decoder.set_weights(weights)
        expected = filtered(decoder.frame(time))
        np.testing.assert_allclose(drawn(page, "Basic"), expected, rtol=0, atol=expected.max() / 255)


@pytest.mark.parametrize("kind, colour", [*((kind, "rgb9e5") for kind in KINDS), ("plain", "bc6h"), (MIXED, "mixed")])
def test_three_shows_an_atlas(kind, colour, tmp_path, visit):
    model = random_atlas(charts(), kind, colour)
    export(model, tmp_path / "three_js", "three")
    page = opened(visit, tmp_path / "three_js", _ATLAS)
    v, u = np.mgrid[:_KIT_SIZE, :_KIT_SIZE] / _KIT_SIZE + 0.5 / _KIT_SIZE
    uv = np.stack([u, v], -1).reshape(-1, 2).astype(np.float32)
    expected = decode64(model, uv).reshape(_KIT_SIZE, _KIT_SIZE, 3)
    inside = np.ones((_KIT_SIZE, _KIT_SIZE), bool)
    if model.method == "tiles":
        # A point on a border of tiles may be read from either.
        place = (uv * model.sheets[0].size[::-1] - 0.5) / model.profile.tile
        inside = (np.abs(place - np.rint(place)).min(1) > 1e-3).reshape(_KIT_SIZE, _KIT_SIZE)
    # As of the shader alone: a filter's place between two texels has 8 bits, in a table too.
    allowed = 3.0 / 512 * 2 * (1 + 22 * (model.method == "cascade"))
    for name in ("Basic", "Lambert", "Phong"):
        np.testing.assert_allclose(drawn(page, name)[inside], expected[inside], rtol=0, atol=allowed)


_SCENE_PAGE = (
    _SHARED
    + """<script type="module">
import * as THREE from 'three';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
import { loadScene } from './scene.js';
const renderer = new THREE.WebGLRenderer();
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
  const camera = new THREE.OrthographicCamera(-1, 1, 1, -1, -1, 1), root = new THREE.Scene();
  root.add(scene);
  return read(THREE, renderer, root, camera, SIZE);
};
window.ready = true;
</script>
"""
)


@pytest.mark.parametrize(("uv_set", "colour"), [(0, "mixed"), (1, "rgb9e5")])
def test_three_shows_each_object_its_part(uv_set, colour, tmp_path, visit):
    model = scene_folder(tmp_path / "scene", uv_set, colour=colour)
    assert model.colour == colour
    export(model, tmp_path / "out", "three")
    (tmp_path / "out" / "index.html").write_text(_SCENE_PAGE.replace("SIZE", str(_KIT_SIZE)))
    page = visit(tmp_path / "out")
    for name, state in (("Basic", 0.0), ("Lambert", 1.0), ("Phong", 1.5), ("Basic", 2.0)):
        found = np.array(page.evaluate(f"draw('{name}', {state})")).reshape(_KIT_SIZE, _KIT_SIZE, 4)[::-1, :, :3]
        expected, inside = expected_picture(model, _KIT_SIZE, state)
        assert inside.mean() > 0.9
        np.testing.assert_allclose(found[inside], expected[inside], rtol=0, atol=expected.max() / 255)


_SMOKE_PAGE = (
    _SHARED
    + """<script type="module">
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
  renderer.setClearColor(new THREE.Color().setRGB(behind, behind, behind, THREE.LinearSRGBColorSpace), 1);
  return read(THREE, renderer, scene, camera, width, height);
};
window.ready = true;
</script>
"""
)


def opened_book(visit, folder, book):
    """Opens a flip book, and returns a function that draws it."""
    export(bundle(book), folder, "three")
    (folder / "index.html").write_text(_SMOKE_PAGE)
    page = visit(folder)

    def drawn(time, width=16, height=12, *, loop=True, behind=0.0):
        given = {"time": time, "width": width, "height": height, "loop": loop, "behind": behind}
        given |= {"toward": TOWARD, "irradiance": IRRADIANCE, "sky": SKY}
        return np.array(page.evaluate("draw", given)).reshape(height, width, 4)[::-1, :, :3]

    return drawn


def test_three_shows_what_shade_gives(visit, tmp_path):
    """At frames, between them and, where it doesn't begin again, after the last; over black and over light."""
    frames = random_frames()
    book = random_book(frames)
    drawn = opened_book(visit, tmp_path, book)
    for seconds, loop in ((0.0, True), (0.15, True), (0.825, True), (0.4, False), (0.9, False)):
        frame = seconds * book.rate
        frame = frame % 5 if loop else min(frame, 4.0)
        want = shown(frames, book, frame)
        for behind in (0.0, 0.75):
            expected = want[..., :3] + behind * (1.0 - want[..., 3:])
            np.testing.assert_allclose(drawn(seconds, loop=loop, behind=behind), expected, atol=1.6 / 255)


def test_smaller_pictures_read_mips(visit, tmp_path):
    """A pixel as large as four is their mean, where the padding allows the mip, and else one place between them."""
    frames = random_frames(seed=1)
    found = opened_book(visit, tmp_path, random_book(frames, ramp=None))(0.0, 8, 6)
    want = shown(frames, random_book(frames, ramp=None), 0.0)[..., :3]
    fours = want.reshape(6, 2, 8, 2, 3).mean((1, 3))
    # Mips are rounded to 8 bits once more.
    np.testing.assert_allclose(found, fours, atol=2.4 / 255)
