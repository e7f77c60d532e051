// Lightmaps over time for the WebGLRenderer of three.js, decoded on the GPU.
//
//     import * as THREE from 'three';
//     import { loadLightmap } from './lightmap.js';
//     const light = await loadLightmap(new URL('bundle.json', import.meta.url), renderer, THREE);
//     scene.traverse((mesh) => mesh.material && light.apply(mesh.material));
//     light.setTime(12.5);  // call it when the time changes; maps are decoded only when a stored hour is passed
//
// `light.texture` is linear radiance with row 0 at v = 0, as in glTF. three.js divides the value of a lightMap by pi.

@DDS@

@TABLE@

const HEAD = `precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler2DArray;
`;
const WHOLE = 'void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }';
const DECODE = 'out vec4 light; void main() { light = vec4(wlm_radiance(ivec2(gl_FragCoord.xy)), 1.0); }';
const FILL = `uniform sampler2D u_map; out vec4 light;
void main() { light = texelFetch(u_map, wlm_source(ivec2(gl_FragCoord.xy)), 0); }`;
const MIX = `${HEAD}uniform sampler2D u_early, u_late; uniform float u_share; out vec4 light;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  light = mix(texelFetch(u_early, at, 0), texelFetch(u_late, at, 0), u_share);
}`;

export async function loadLightmap(url, renderer, THREE) {
  const base = new URL(url, document.baseURI), beside = (name) => new URL(name, base).href;
  const read = async (name, kind) => (await fetched(beside(name)))[kind]();
  const lightmap = await (await fetched(base)).json(), shader = await read(lightmap.shader, 'text');
  if (!renderer.extensions.has('EXT_texture_compression_bptc')) throw new Error('lightmap: this GPU has no BC7');
  const names = Object.keys(lightmap.textures), {networks: stored} = lightmap.buffers;
  const [networks, ...made] = await Promise.all([
    stored ? read(stored.file, 'arrayBuffer') : new ArrayBuffer(16),
    ...names.map((name) => readDds(lightmap.textures[name], base, THREE))]);
  const floats = new Float32Array(networks), {width, height} = lightmap, uniforms = {};
  const fours = (values) => {
    const padded = new Float32Array(4096 * Math.ceil(values.length / 4096));
    padded.set(values);
    const texture = new THREE.DataTexture(padded, 1024, padded.length / 4096, THREE.RGBAFormat, THREE.FloatType);
    texture.needsUpdate = true;
    return texture;
  };
  names.forEach((name, i) => { uniforms[`wlm_lightmap_${name}`] = {value: made[i]}; });
  uniforms.wlm_lightmap_networks = {value: fours(floats)};
  uniforms.wlm_lightmap_hour = {value: null};
  const pass = (fragmentShader, own) => new THREE.RawShaderMaterial({
    glslVersion: THREE.GLSL3, vertexShader: WHOLE, fragmentShader, uniforms: own, depthTest: false, depthWrite: false});
  const decode = pass(HEAD + shader + DECODE, uniforms);
  const fill = pass(HEAD + shader + FILL, {...uniforms, u_map: {value: null}});
  const mixing = pass(MIX, {u_early: {value: null}, u_late: {value: null}, u_share: {value: 0}});
  const geometry = new THREE.BufferGeometry(), camera = new THREE.Camera();
  geometry.setDrawRange(0, 3);
  const triangle = new THREE.Mesh(geometry, decode);
  triangle.frustumCulled = false;
  const target = () => new THREE.WebGLRenderTarget(width, height, {
    type: THREE.HalfFloatType, colorSpace: THREE.NoColorSpace, depthBuffer: false, generateMipmaps: false,
    minFilter: THREE.LinearFilter, magFilter: THREE.LinearFilter});
  const raw = target(), shown = target(), maps = [{target: target()}, {target: target()}];

  const draw = (material, to) => {
    const before = renderer.getRenderTarget();
    triangle.material = material;
    renderer.setRenderTarget(to);
    renderer.render(triangle, camera);
    renderer.setRenderTarget(before);
  };

  // The map of a stored hour. If it is not in memory, it replaces the map that is not needed now.
  const mapOf = (wanted, all) => {
    let map = maps.find(({key}) => key === wanted.key);
    if (map) return map.target;
    map = maps.find(({key}) => !all.some((other) => other.key === key));
    const table = fours(wlmTable(lightmap, floats, wanted));
    uniforms.wlm_lightmap_hour.value = table;
    draw(decode, raw);
    table.dispose();
    fill.uniforms.u_map.value = raw.texture;
    draw(fill, map.target);
    map.key = wanted.key;
    return map.target;
  };

  const light = {
    texture: shown.texture,
    lightmap,
    setTime(time) {
      const reads = wlmReads(lightmap, time), [early, late = early] = reads.map((each) => mapOf(each, reads).texture);
      Object.assign(mixing.uniforms.u_early, {value: early});
      Object.assign(mixing.uniforms.u_late, {value: late});
      mixing.uniforms.u_share.value = reads.length > 1 ? reads[1].weight : 0;
      draw(mixing, shown);
    },
    // Lights a material; `channel` is n of its mesh's TEXCOORD_n, the same for all materials.
    apply(material, channel = 1) {
      material.lightMap = shown.texture;
      material.lightMap.channel = channel;
      material.lightMapIntensity = Math.PI;
      material.needsUpdate = true;
    },
    dispose() {
      for (const each of [raw, shown, ...maps.map((map) => map.target)]) each.dispose();
      for (const each of [...made, uniforms.wlm_lightmap_networks.value, decode, fill, mixing, geometry]) each.dispose();
    },
  };
  light.setTime(lightmap.times[0]);
  return light;
}
