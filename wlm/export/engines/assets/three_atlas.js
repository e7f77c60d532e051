// A compressed lightmap for the WebGLRenderer of three.js, read in the materials' shaders.
//
//     import * as THREE from 'three';
//     import { loadAtlas } from './atlas.js';
//     const atlas = await loadAtlas(new URL('bundle.json', import.meta.url), THREE);
//     model.traverse((mesh) => mesh.material && atlas.apply(mesh.material));
//
// `model` is mesh.glb, or a mesh with its UVs. three.js divides the value of a lightMap by pi.

@DDS@

export async function loadAtlas(url, THREE) {
  const base = new URL(url, document.baseURI), beside = (name) => new URL(name, base).href;
  const info = await (await fetched(base)).json();
  const shader = await (await fetched(beside(info.shader))).text();
  const textures = {};
  for (const [name, entry] of Object.entries(info.textures)) textures[`wlm_atlas_${name}`] = await readDds(entry, base, THREE);
  const {wlm_atlas_colour: colour} = textures;
  return {
    info,
    textures,
    // Lights a material; `channel` is n of its mesh's TEXCOORD_n.
    apply(material, channel = info.uv_set) {
      colour.channel = channel;
      material.lightMap = colour;
      material.lightMapIntensity = Math.PI;
      material.onBeforeCompile = (program) => {
        for (const [name, value] of Object.entries(textures)) program.uniforms[name] = {value};
        const precisions = 'precision highp usampler2D;\n';
        program.fragmentShader = precisions + program.fragmentShader
          .replace('#include <lights_fragment_maps>', THREE.ShaderChunk.lights_fragment_maps)
          .replaceAll('texture2D( lightMap, vLightMapUv )', 'vec4( wlm_atlas( vLightMapUv ), 1.0 )')
          .replace('void main() {', `${shader}\nvoid main() {`);
      };
      // Kits of one lightmap can differ in method, so the shader is the key of the program.
      material.customProgramCacheKey = () => shader;
      material.needsUpdate = true;
    },
    dispose() {
      for (const texture of Object.values(textures)) texture.dispose();
    },
  };
}
