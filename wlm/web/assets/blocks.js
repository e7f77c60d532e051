// BC7 blocks of mode 6, the only mode that wlm writes, to RGBA of 8 bits, for browsers that can't take them.

const WEIGHTS = [0, 4, 9, 13, 17, 21, 26, 30, 34, 38, 43, 47, 51, 55, 60, 64];

function unpackBlocks(bytes, width, height) {
  const texels = new Uint8Array(width * height * 4), across = width / 4;
  const words = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  for (let block = 0; block < bytes.length / 16; ++block) {
    let low = words.getBigUint64(16 * block, true), high = words.getBigUint64(16 * block + 8, true);
    let bits = low | (high << 64n);
    if ((bits & 127n) !== 64n) throw new Error('the page is damaged: a block is not of BC7 mode 6');
    bits >>= 7n;
    const take = (count) => {
      const value = Number(bits & ((1n << BigInt(count)) - 1n));
      bits >>= BigInt(count);
      return value;
    };
    const ends = [];
    for (let channel = 0; channel < 4; ++channel) ends.push([take(7), take(7)]);
    const shared = [take(1), take(1)];
    for (const pair of ends) for (const end of [0, 1]) pair[end] = 2 * pair[end] + shared[end];
    const left = 4 * (block % across), top = 4 * Math.floor(block / across);
    for (let i = 0; i < 16; ++i) {
      const weight = WEIGHTS[take(i ? 4 : 3)], at = 4 * ((top + (i >> 2)) * width + left + (i & 3));
      for (let channel = 0; channel < 4; ++channel) {
        const [a, b] = ends[channel];
        texels[at + channel] = ((64 - weight) * a + weight * b + 32) >> 6;
      }
    }
  }
  return texels;
}
