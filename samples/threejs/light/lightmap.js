// Lightmaps over time for the WebGLRenderer of three.js, decoded on the GPU.
//
//     import * as THREE from 'three';
//     import { loadLightmap } from './lightmap.js';
//     const light = await loadLightmap(new URL('bundle.json', import.meta.url), renderer, THREE);
//     scene.traverse((mesh) => mesh.material && light.apply(mesh.material));
//     light.setTime(12.5);  // call it when the time changes; maps are decoded only when a stored hour is passed
//
// `light.texture` is linear radiance with row 0 at v = 0, as in glTF. three.js divides the value of a lightMap by pi.

async function fetched(url) {
  const answer = await fetch(url);
  if (!answer.ok) throw new Error(`${url}: ${answer.status}`);
  return answer;
}

// Reads a texture or texture array, described by its entry of bundle.json, from a DDS file with the DX10 header.
async function readDds({file, layers: count}, base, THREE) {
  const url = new URL(file, base).href, array = count > 0;
  const bytes = await (await fetched(url)).arrayBuffer(), head = new DataView(bytes, 0, 148);
  const height = head.getUint32(12, true), width = head.getUint32(16, true);
  const format = head.getUint32(128, true), layers = head.getUint32(140, true);
  const levels = (Kind) => new Kind(bytes, 148);
  const plain = (data, kind, type) => array
    ? Object.assign(new THREE.DataArrayTexture(data, width, height, layers), {format: kind, type})
    : new THREE.DataTexture(data, width, height, kind, type);
  let texture, filter = THREE.LinearFilter;
  if (format === 98 || format === 95) {
    const kind = format === 98 ? THREE.RGBA_BPTC_Format : THREE.RGB_BPTC_UNSIGNED_Format;
    const mipmaps = [{data: levels(Uint8Array), width, height}];
    texture = array ? new THREE.CompressedArrayTexture(mipmaps, width, height, layers, kind)
      : new THREE.CompressedTexture(mipmaps, width, height, kind);
  } else if (format === 61) texture = plain(levels(Uint8Array), THREE.RedFormat, THREE.UnsignedByteType);
  else if (format === 49) texture = plain(levels(Uint8Array), THREE.RGFormat, THREE.UnsignedByteType);
  else if (format === 10) texture = plain(levels(Uint16Array), THREE.RGBAFormat, THREE.HalfFloatType);
  else if (format === 67) texture = plain(levels(Uint32Array), THREE.RGBFormat, THREE.UnsignedInt5999Type);
  else if (format === 36) {
    texture = plain(levels(Uint16Array), THREE.RGIntegerFormat, THREE.UnsignedShortType);
    filter = THREE.NearestFilter;
  } else if (format === 12) {
    texture = plain(levels(Uint16Array), THREE.RGBAIntegerFormat, THREE.UnsignedShortType);
    filter = THREE.NearestFilter;
  } else if (format === 2) {
    texture = plain(levels(Float32Array), THREE.RGBAFormat, THREE.FloatType);
    filter = THREE.NearestFilter;
  } else if (format === 35) {
    texture = plain(Float32Array.from(levels(Uint16Array), (v) => v / 65535), THREE.RGFormat, THREE.FloatType);
  } else throw new Error(`${url}: DXGI format ${format}`);
  texture.minFilter = texture.magFilter = filter;
  texture.generateMipmaps = false;
  texture.colorSpace = THREE.NoColorSpace;
  texture.flipY = false;
  texture.unpackAlignment = 1;
  texture.needsUpdate = true;
  return texture;
}

// Computes the table of an hour that the shader of a lightmap reads, from bundle.json and networks.bin (see "about" there).

// The stored times before and after a time (their indices), the weight of the later one, and tau.
function wlmPlace(lightmap, time) {
  const {times, period, tau, time_axis: axis} = lightmap, count = times.length;
  if (period) time = ((time % period) + period) % period;
  else time = Math.min(Math.max(time, times[0]), times[count - 1]);
  let before = times.findLastIndex((t) => t <= time), after = before + 1, span, since;
  if (period) {
    [before, after] = [(before + count) % count, after % count];
    span = (times[after] - times[before] + period) % period || period;
    since = (time - times[before] + period) % period;
  } else {
    after = Math.min(after, count - 1);
    [span, since] = [times[after] - times[before] || 1, time - times[before]];
  }
  const share = count > 1 ? since / span : 0;
  let place = axis.rule === 'paper' && period ? time / period
    : tau[before] + share * (axis.repeats ? 1 / count : tau[after] - tau[before]);
  if (axis.repeats) place -= Math.floor(place);
  return {before, after, share, tau: place};
}

// The times to decode for a given time, each with its weight in linear light: one or two stored times; if the networks
// interpolate, the time itself. The light of a single stored time is the same at all times.
function wlmReads(lightmap, time) {
  const now = wlmPlace(lightmap, time);
  if (lightmap.interpolation === 'network' && lightmap.times.length > 1) return [{...now, key: time, weight: 1}];
  const stored = (k, weight) => ({before: k, after: k, share: 0, tau: lightmap.tau[k], key: k, weight});
  return [stored(now.before, 1 - now.share), stored(now.after, now.share)].filter((read) => read.weight > 0);
}

// The two texels of an axis that a linear filter reads at tau, and the weight of the second.
function wlmBetween(tau, count, repeats) {
  const position = tau * count - 0.5, low = Math.floor(position);
  const texel = (i) => repeats ? (i + count) % count : Math.min(Math.max(i, 0), count - 1);
  return [texel(low), texel(low + 1), position - low, 0];
}

// The table of one entry of `wlmReads`: RGBA floats in rows of 1,024 texels.
function wlmTable(lightmap, networks, now) {
  const {time_axis: axis, record, tile_columns: columns, tile_size: side, images} = lightmap;
  const count = columns * Math.ceil(lightmap.height / side), fours = 2 + record * count;
  const table = new Float32Array(4096 * Math.ceil(fours / 1024)), wide = Math.ceil(lightmap.hidden / 4);
  const put = (four, ...values) => table.set(values.flat(), 4 * four);
  const mixed = (rows) => rows[now.before].map((v, c) => v + now.share * (rows[now.after][c] - v));
  put(0, wlmBetween(now.tau, lightmap.slices, axis.repeats).slice(0, 3), columns);
  if (images.planes) put(1, wlmBetween(now.tau, images.planes.size[1], axis.repeats));
  for (const tile of lightmap.tiles) {
    const at = 2 + record * tile.number, codes = {constant: 1, dynamic: 3, frames: 4};
    put(at, codes[tile.kind], tile.image ?? 0, tile.network_four ?? 0, 0);
    if (tile.kind === 'constant') {
      put(at + 1, mixed(tile.radiance).map((v) => v ** (1 / lightmap.gamma)));
    } else if (tile.kind === 'frames') {
      table[4 * at + 3] = now.share;
      for (const [first, image] of [[1, now.before], [3, now.after]]) {
        put(at + first, tile.least[image], image, tile.greatest[image]);
      }
    } else {
      const scale = mixed(tile.scale), turn = axis.turn * now.tau;
      put(at + 1, tile.shift.map((v, c) => v * scale[c]));
      put(at + 2, tile.spread.map((v, c) => v * scale[c]));
      const time = [turn, 2 * turn].flatMap((a) => [Math.sin(a), Math.cos(a)]);
      const first = 4 * (tile.network_four + 12 * wide), row = 4 * wide;
      for (let j = 0; j < row; ++j) {
        let bias = networks[first + time.length * row + j];
        time.forEach((v, c) => { bias += v * networks[first + c * row + j]; });
        table[4 * (at + 3) + j] = bias;
      }
    }
  }
  return table;
}

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
