// The light groups of lightmaps over time for the WebGLRenderer of three.js, decoded on the GPU and added by weights.
//
//     import * as THREE from 'three';
//     import { loadGroups } from './groups.js';
//     const light = await loadGroups(new URL('bundle.json', import.meta.url), renderer, THREE);
//     scene.traverse((mesh) => mesh.material && light.apply(mesh.material));
//     light.setTime(18.5);            // maps are decoded only when a stored hour of their group is passed
//     light.setWeight('lamp', 0.5);   // or [red, green, blue]; nothing is decoded
//
// `light.texture` is linear radiance with row 0 at v = 0, as in glTF. three.js divides the value of a lightMap by pi.

import { loadLightmap } from './@PART@/lightmap.js';

const WHOLE = 'void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }';
const ADD = `precision highp float;
precision highp sampler2D;
uniform sampler2D u_light; uniform vec3 u_weight; out vec4 light;
void main() { light = vec4(u_weight * texelFetch(u_light, ivec2(gl_FragCoord.xy), 0).rgb, 1.0); }`;

// `atlas` is the name of an atlas; without it the first one with light is loaded.
export async function loadGroups(url, renderer, THREE, atlas) {
  const base = new URL(url, document.baseURI), response = await fetch(base);
  if (!response.ok) throw new Error(`${base}: ${response.status} ${response.statusText}`);
  const lit = (await response.json()).sheets.filter((sheet) => sheet.encoding === 'radiance');
  const first = lit.find((sheet) => sheet.atlas === (atlas ?? lit[0].atlas));
  if (!first) throw new Error(`groups: expected an atlas with light, found no ${atlas}`);
  const same = (sheet) => ['atlas', 'layer', 'channels'].every((key) => String(sheet[key]) === String(first[key]));
  const groups = await Promise.all(lit.filter(same).map(async ({part, group}) => ({
    name: group, weight: new THREE.Vector3(1, 1, 1),
    light: await loadLightmap(new URL(`${part}/bundle.json`, base), renderer, THREE),
  })));
  const sum = new THREE.WebGLRenderTarget(first.width, first.height, {
    type: THREE.HalfFloatType, colorSpace: THREE.NoColorSpace, depthBuffer: false, generateMipmaps: false,
    minFilter: THREE.LinearFilter, magFilter: THREE.LinearFilter});
  const material = new THREE.RawShaderMaterial({
    glslVersion: THREE.GLSL3, vertexShader: WHOLE, fragmentShader: ADD, depthTest: false, depthWrite: false,
    uniforms: {u_light: {value: null}, u_weight: {value: null}},
    blendSrc: THREE.OneFactor, blendDst: THREE.OneFactor, blendEquation: THREE.AddEquation});
  const geometry = new THREE.BufferGeometry(), camera = new THREE.Camera(), triangle = new THREE.Mesh(geometry, material);
  geometry.setDrawRange(0, 3);
  triangle.frustumCulled = false;

  // The first group replaces what was there, and the others are added.
  const add = () => {
    const before = renderer.getRenderTarget(), clears = renderer.autoClear;
    renderer.autoClear = false;
    renderer.setRenderTarget(sum);
    groups.forEach(({light, weight}, i) => {
      material.uniforms.u_light.value = light.texture;
      material.uniforms.u_weight.value = weight;
      material.uniformsNeedUpdate = true;
      material.blending = i ? THREE.CustomBlending : THREE.NoBlending;
      renderer.render(triangle, camera);
    });
    renderer.setRenderTarget(before);
    renderer.autoClear = clears;
  };

  const light = {
    texture: sum.texture,
    groups: groups.map(({name}) => name),
    setTime(time) {
      for (const group of groups) group.light.setTime(time);
      add();
    },
    // Sets the factor of a group, or three of red, green and blue.
    setWeight(name, weight) {
      const group = groups.find((each) => each.name === name);
      if (!group) throw new Error(`groups: expected one of ${light.groups.join(', ')}, got ${name}`);
      group.weight.set(...[weight, weight, weight].map((value, i) => value[i] ?? value));
      add();
    },
    // Lights a material; `channel` is n of its mesh's TEXCOORD_n, the same for all materials.
    apply(material, channel = 1) {
      material.lightMap = sum.texture;
      material.lightMap.channel = channel;
      material.lightMapIntensity = Math.PI;
      material.needsUpdate = true;
    },
    dispose() {
      for (const each of [sum, material, geometry, ...groups.map((group) => group.light)]) each.dispose();
    },
  };
  add();
  return light;
}
