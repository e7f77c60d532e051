// The compressed lightmaps of a scene for the WebGLRenderer of three.js, read in the materials' shaders.
//
//     import * as THREE from 'three';
//     import { loadScene } from './scene.js';
//     const light = await loadScene(new URL('bundle.json', import.meta.url), THREE);
//     light.apply(gltf.scene);  // of mesh.glb, by GLTFLoader
//     light.setState(1.5);      // half-way from the second of `light.info.states` to the third
//
// three.js divides the value of a lightMap by pi.

@DDS@

export async function loadScene(url, THREE) {
  const base = new URL(url, document.baseURI), beside = (name) => new URL(name, base).href;
  const info = await (await fetched(base)).json();
  const shader = await (await fetched(beside('scene.glsl'))).text();
  const state = {value: 0}, shared = {wlm_state: state};
  await Promise.all(Object.entries(info.textures).map(async ([name, entry]) => {
    shared[`wlm_scene_${name}`] = {value: await readDds(entry, base, THREE)};
  }));
  // Turns on the lightmap code of the materials; the shader reads the other textures instead.
  const shown = new THREE.DataTexture(new Uint8Array(4), 1, 1);
  shown.channel = info.uv_set;
  const made = new Map();

  // One material for each position in the lightmaps: objects may share materials, but not their part of the lightmaps.
  const lit = (material, object) => {
    const key = `${material.uuid} ${object.sheet} ${object.scale_offset}`;
    if (!made.has(key)) made.set(key, withLight(material.clone(), object));
    return made.get(key);
  };
  const withLight = (material, object) => {
    const own = {wlm_place: {value: new THREE.Vector4(...object.scale_offset)}, wlm_sheet: {value: object.sheet}};
    material.lightMap = shown;
    material.lightMapIntensity = Math.PI;
    material.onBeforeCompile = (program) => {
      Object.assign(program.uniforms, shared, own);
      const head = 'precision highp usampler2D;\nprecision highp sampler2DArray;\n'
        + 'uniform vec4 wlm_place;\nuniform int wlm_sheet;\nuniform float wlm_state;\n';
      const read = 'vec4( wlm_object( vLightMapUv, wlm_place, wlm_sheet, wlm_state ), 1.0 )';
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
    // Sets the state by its index; between two states they are mixed.
    setState(number) {
      state.value = number;
    },
    // The light on all that reads it, of mesh.glb as GLTFLoader gives it: it keeps what nodes have to say.
    apply(root) {
      const visit = (each, object) => {
        const own = each.userData.wlm ?? object;
        if (own && each.isMesh) {
          const all = each.material;
          each.material = Array.isArray(all) ? all.map((one) => lit(one, own)) : lit(all, own);
        }
        // The primitives of a node with several are its children; the loader names nodes, but not these.
        for (const child of each.children) visit(child, each.isMesh || child.userData.name ? undefined : own);
      };
      visit(root, undefined);
    },
    dispose() {
      for (const each of [shown, ...made.values()]) each.dispose();
      for (const {value} of Object.values(shared)) value.dispose?.();
    },
  };
  return light;
}
