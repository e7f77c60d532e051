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
