// The content of the page: a JSON manifest, and arrays in one block, compressed by zlib and encoded in base64.

async function readContent() {
  const manifest = JSON.parse(document.getElementById('manifest').textContent);
  const text = document.getElementById('content').textContent.trim();
  const packed = Uint8Array.fromBase64?.(text) ?? Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  if (typeof DecompressionStream === 'undefined') throw new Error('this browser is too old to unpack the page');
  let bytes;
  try {
    // The stream verifies zlib's checksum.
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream('deflate'));
    bytes = await new Response(stream).arrayBuffer();
  } catch {
    throw new Error('the page is damaged: its content can not be unpacked');
  }
  if (bytes.byteLength !== manifest.bytes) throw new Error('the page is damaged: its content has another size');
  const array = (name, Type) => {
    const [offset, length] = manifest.arrays[name] ?? [0, 0];
    return new Type(bytes, offset, length / Type.BYTES_PER_ELEMENT);
  };
  return {manifest, array, has: (name) => name in manifest.arrays};
}
