// Six-way smoke for the WebGLRenderer of three.js: a billboard that faces the viewer and is lit by the scene's lights.
//
//     import * as THREE from 'three';
//     import { loadSmoke } from './smoke.js';
//     const smoke = await loadSmoke(new URL('bundle.json', import.meta.url), THREE);
//     scene.add(smoke.mesh);
//     smoke.setTime(seconds);  // each frame
//
// It is lit by the scene's DirectionalLights and AmbientLights.

const VERTEX = `
varying vec2 wlm_place;
void main() {
  wlm_place = vec2(uv.x, 1.0 - uv.y);
  vec4 centre = modelViewMatrix * vec4(0.0, 0.0, 0.0, 1.0);
  vec2 scale = vec2(length(modelMatrix[0].xyz), length(modelMatrix[1].xyz));
  gl_Position = projectionMatrix * (centre + vec4(position.xy * scale, 0.0, 0.0));
}`;

// Directions to lights are in view space, whose axes are those of the billboard.
const FRAGMENT = `
varying vec2 wlm_place;
uniform float wlm_time;
uniform vec2 wlm_size;
#include <common>
#include <lights_pars_begin>
SHADER
void main() {
  vec4 first, second;
  float texels = max(length(dFdx(wlm_place) * wlm_size), length(dFdy(wlm_place) * wlm_size));
  wlm_smoke_texels(wlm_place, wlm_time, texels, first, second);
  float alpha = wlm_smoke_alpha(first, second);
  vec3 light = wlm_smoke_sky(first, second, ambientLightColor * RECIPROCAL_PI);
  #if NUM_DIR_LIGHTS > 0
    for (int i = 0; i < NUM_DIR_LIGHTS; ++i)
      light += wlm_smoke_lit(first, second, directionalLights[i].direction, directionalLights[i].color);
  #endif
  // If the screen is not linear, light is converted to its colours before blending: scattered light like that of a
  // surface with the same coverage, emission as light that is added.
  float cover = max(alpha, 1e-3);
  gl_FragColor = vec4(light / cover, 1.0);
  #include <tonemapping_fragment>
  #include <colorspace_fragment>
  vec3 shown = gl_FragColor.rgb * cover;
  gl_FragColor = vec4(wlm_smoke_glow(first, second), 1.0);
  #include <tonemapping_fragment>
  #include <colorspace_fragment>
  gl_FragColor = vec4(shown + gl_FragColor.rgb, alpha);
}`;

async function fetched(url) {
  const answer = await fetch(url);
  if (!answer.ok) throw new Error(`${url}: ${answer.status}`);
  return answer;
}

// Loads a picture without changing its numbers: no premultiplication by alpha, no colour space conversion.
async function readPng(url, THREE, mips) {
  const options = {premultiplyAlpha: 'none', colorSpaceConversion: 'none'};
  const texture = new THREE.Texture(await createImageBitmap(await (await fetched(url)).blob(), options));
  texture.magFilter = THREE.LinearFilter;
  texture.minFilter = mips ? THREE.LinearMipmapLinearFilter : THREE.LinearFilter;
  texture.generateMipmaps = mips;
  texture.colorSpace = THREE.NoColorSpace;
  texture.flipY = false;
  texture.needsUpdate = true;
  return texture;
}

// Makes the billboard; `shader` defines the functions that read its textures.
export function makeBillboard(THREE, uniforms, shader, extent) {
  const material = new THREE.ShaderMaterial({
    uniforms,
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT.replace('SHADER', () => shader),
    lights: true,
    transparent: true,
    depthWrite: false,
    side: THREE.DoubleSide,
    premultipliedAlpha: true,
    blending: THREE.CustomBlending,
    blendSrc: THREE.OneFactor,
    blendDst: THREE.OneMinusSrcAlphaFactor,
  });
  return new THREE.Mesh(new THREE.PlaneGeometry(...extent), material);
}

export async function loadSmoke(url, THREE) {
  const base = new URL(url, document.baseURI), beside = (name) => new URL(name, base).href;
  const info = await (await fetched(base)).json();
  const shader = await (await fetched(beside(info.shader))).text();
  const uniforms = THREE.UniformsUtils.clone(THREE.UniformsLib.lights), textures = [];
  uniforms.wlm_time = {value: 0};
  uniforms.wlm_size = {value: new THREE.Vector2(...info.frame_size)};
  await Promise.all(Object.entries(info.textures).map(async ([name, {file}]) => {
    const texture = await readPng(beside(file), THREE, info.levels > 0);
    uniforms[`wlm_smoke_${name}_map`] = {value: texture};
    textures.push(texture);
  }));
  const mesh = makeBillboard(THREE, uniforms, shader, info.extent);
  return {
    info,
    mesh,
    // Sets the time in seconds since the first frame. After the last frame the animation starts again if `loop` is true,
    // otherwise it stops.
    setTime(seconds, loop = true) {
      const time = Math.max(seconds, 0) * info.rate;
      uniforms.wlm_time.value = loop ? time % info.frames : Math.min(time, info.frames - 1);
    },
    dispose() {
      for (const each of [...textures, mesh.material, mesh.geometry]) each.dispose();
    },
  };
}
