// The compressed lightmaps of a scene for three.js' WebGLRenderer, read in the materials' own shaders.
//
//     import * as THREE from 'three';
//     import { loadScene } from './scene.js';
//     const light = await loadScene(new URL('scene.json', import.meta.url), THREE);
//     light.apply(gltf.scene);  // of scene.glb, by GLTFLoader
//     light.setState(1.5);      // half-way from the second of `light.info.states` to the third
//
// three.js divides what a lightMap gives by pi.

@DDS@

export async function loadScene(url, THREE) {
  const base = new URL(url, document.baseURI), beside = (name) => new URL(name, base).href;
  const info = await (await fetched(base)).json();
  const shader = await (await fetched(beside('scene.glsl'))).text();
  const [lut, colour] = await Promise.all([readDds(beside('lut.dds'), THREE), readDds(beside('colour.dds'), THREE, true)]);
  const factor = info.factors[0].map(() => new THREE.Vector3());
  // What switches the materials' lightmap on; the shader reads the others in its place.
  const shown = new THREE.DataTexture(new Uint8Array(4), 1, 1);
  shown.channel = info.uv_set;
  const made = new Map();

  // A material of its own for each place: objects share materials, and not their part of the lightmaps.
  const lit = (material, object) => {
    const key = `${material.uuid} ${object.sheet} ${object.scale_offset}`;
    if (!made.has(key)) made.set(key, withLight(material.clone(), object));
    return made.get(key);
  };
  const withLight = (material, object) => {
    const {width, height, column, row, columns, rows, page} = info.sheets[object.sheet];
    const own = {
      wlm_scene_lut: {value: lut},
      wlm_scene_colour: {value: colour},
      wlm_scene_factor: {value: factor},
      wlm_place: {value: new THREE.Vector4(...object.scale_offset)},
      wlm_sheet: {value: new THREE.Vector4(width, height, column, row)},
      wlm_tiles: {value: new THREE.Vector3(columns, rows, page)},
    };
    material.lightMap = shown;
    material.lightMapIntensity = Math.PI;
    material.onBeforeCompile = (program) => {
      Object.assign(program.uniforms, own);
      const head = 'precision highp usampler2D;\nprecision highp sampler2DArray;\n'
        + 'uniform vec4 wlm_place, wlm_sheet;\nuniform vec3 wlm_tiles;\n';
      const read = 'vec4( wlm_object( vLightMapUv, wlm_place, wlm_sheet, wlm_tiles ), 1.0 )';
      program.fragmentShader = head + program.fragmentShader
        .replace('#include <lights_fragment_maps>', THREE.ShaderChunk.lights_fragment_maps)
        .replaceAll('texture2D( lightMap, vLightMapUv )', read)
        .replace('void main() {', `${shader}\nvoid main() {`);
    };
    material.customProgramCacheKey = () => shader;
    return material;
  };

  const light = {
    info,
    // A state's number; between two they are mixed.
    setState(state) {
      const last = info.states.length - 1, at = Math.min(Math.max(state, 0), last), low = Math.floor(at);
      const late = info.factors[Math.min(low + 1, last)];
      info.factors[low].forEach((early, i) => factor[i].set(...early).lerp(new THREE.Vector3(...late[i]), at - low));
    },
    // The light on all that reads it, of scene.glb as GLTFLoader gives it: it keeps what nodes have to say.
    apply(root) {
      const visit = (each, object) => {
        const own = each.userData.wlm ?? object;
        if (own && each.isMesh) {
          const all = each.material;
          each.material = Array.isArray(all) ? all.map((one) => lit(one, own)) : lit(all, own);
        }
        // A node's primitives, where it has several, are below it; the loader gives names to nodes, and none to those.
        for (const child of each.children) visit(child, each.isMesh || child.userData.name ? undefined : own);
      };
      visit(root, undefined);
    },
    dispose() {
      for (const each of [lut, colour, shown, ...made.values()]) each.dispose();
    },
  };
  light.setState(0);
  return light;
}
