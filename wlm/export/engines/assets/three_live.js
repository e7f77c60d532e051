// Smoke that the GPU lights from its voxels, for the WebGLRenderer of three.js: a coarse march and the network of this
// folder make six-way lightmaps for the camera of each picture, which a billboard shows under the scene's lights.
//
//     import * as THREE from 'three';
//     import { loadLiveSmoke } from './live.js';
//     const smoke = await loadLiveSmoke(new URL('bundle.json', import.meta.url), THREE, renderer);
//     smoke.setVolume({shape: [X, Y, Z], voxel: 0.02, density, extinction: 14});  // for new smoke, as often as you like
//     scene.add(smoke.mesh);
//     smoke.update(camera, {size: 256});  // each frame, before the scene is rendered
//
// `density` has X * Y * Z numbers, z fastest; `heat`, if given, as many, with the light that is emitted per unit of length
// at 1 as `emission`. `made` of `update` is 'network', as in wlm, or 'march', which is faster.

@CORE@

import { makeBillboard } from './smoke.js';

const READ = `
uniform sampler2D wlm_first, wlm_second;
uniform vec3 wlm_fire;
void wlm_smoke_texels(vec2 place, float time, float texels, out vec4 first, out vec4 second)
{
    first = texture(wlm_first, place);
    second = texture(wlm_second, place);
    first *= first;  // they are stored as square roots
    second *= second;
}
float wlm_smoke_alpha(vec4 first, vec4 second) { return second.b; }
vec3 wlm_smoke_glow(vec4 first, vec4 second) { return wlm_fire * second.a; }
vec3 wlm_smoke_sky(vec4 first, vec4 second, vec3 radiance)
{
    return radiance * (dot(first, vec4(1.0)) + second.r + second.g) / 6.0;
}
vec3 wlm_smoke_lit(vec4 first, vec4 second, vec3 toward, vec3 irradiance)
{
    vec3 sides = mix(vec3(first.ga, second.g), vec3(first.rb, second.r), greaterThan(toward, vec3(0.0)));
    return irradiance * dot(toward * toward, sides) * 0.0795774715;
}`;

const LEAST_STEP = 0.01;  // voxels

export async function loadLiveSmoke(url, THREE, renderer) {
  const base = new URL(url, document.baseURI), gl = renderer.getContext();
  const fetched = async (address) => {
    const answer = await fetch(address);
    if (!answer.ok) throw new Error(`${address}: ${answer.status}`);
    return answer;
  };
  const info = await (await fetched(base)).json(), {look} = info;
  const weights = new Uint16Array(await (await fetched(new URL(info.buffers.weights.file, base))).arrayBuffer());
  // The passes set all state that they need, from the default state.
  const alone = (work) => {
    renderer.resetState();
    gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, false);
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    const made = work();
    renderer.resetState();
    return made;
  };
  const live = alone(() => new LiveSmoke(new Graphics(renderer.domElement, gl), info, weights));
  const uniforms = THREE.UniformsUtils.clone(THREE.UniformsLib.lights);
  Object.assign(uniforms, {
    wlm_first: {value: null}, wlm_second: {value: null}, wlm_fire: {value: new THREE.Vector3(1, 1, 1)}, wlm_time: {value: 0}, wlm_size: {value: new THREE.Vector2(1, 1)},
  });
  const mesh = makeBillboard(THREE, uniforms, READ, [1, 1]), external = new Map();
  const wrapped = ({texture}) => {
    if (!external.has(texture)) external.set(texture, new THREE.ExternalTexture(texture));
    return external.get(texture);
  };
  let volume, extent;
  return {
    mesh,
    fire: uniforms.wlm_fire.value,  // colour of the emission
    setVolume({shape, voxel, density, extinction = 1, heat, emission = 1}) {
      const longest = Math.max(...shape), step = (share) => Math.max(share * longest, LEAST_STEP), arrays = {}, factors = {};
      const parts = [['density', density, extinction], ...heat ? [['heat', heat, emission]] : []];
      for (const [name, values, factor] of parts) {
        if (values.length !== shape[0] * shape[1] * shape[2]) throw new Error(`${name}: expected ${shape.join(' x ')} numbers, found ${values.length}`);
        const most = values.reduce((a, b) => Math.max(a, b), 1e-30);
        arrays[name] = Uint16Array.from(values, (x) => THREE.DataUtils.toHalfFloat(x / most));
        factors[name] = factor * voxel * most;
      }
      const march = {
        step: step(look.guide_step), spacing: look.guide_spacing === null ? null : step(look.guide_spacing), jitter: look.jitter,
        threshold: look.surface / longest, cutoff: 1e-4,
      };
      alone(() => {
        if (volume) live.discard(volume);
        volume = live.volume({shape, voxel, origin: shape.map((n) => -0.5 * n * voxel), march, ...factors}, arrays);
      });
      extent = voxel * Math.hypot(...shape);
      mesh.geometry.dispose();
      mesh.geometry = new THREE.PlaneGeometry(extent, extent);
    },
    update(camera, {size = 256, made = 'network'} = {}) {
      if (!volume) return;
      for (const each of [camera, mesh]) each.updateWorldMatrix(true, false);
      const turn = mesh.getWorldQuaternion(new THREE.Quaternion()).invert(), axes = [0, 1, 2].map((n) => (
        new THREE.Vector3().setFromMatrixColumn(camera.matrixWorld, n).normalize().applyQuaternion(turn).toArray()));
      const [right, up, toward] = axes, view = {right, up, toward, target: [0, 0, 0], extent, width: size, height: size};
      const {first, second} = alone(() => live.render(volume, view, made));
      uniforms.wlm_first.value = wrapped(first);
      uniforms.wlm_second.value = wrapped(second);
    },
    dispose() {
      for (const each of [mesh.material, mesh.geometry]) each.dispose();
      live.graphics.discard(live.weights, ...[...live.targets.values()].flatMap(({each}) => each));
      if (volume) live.discard(volume);
    },
  };
}
