// BLAKE2b (RFC 7693) without a key, of a digest of 4 to 64 bytes. A number of 64 bits is two words, the low one first.

const BLAKE_START = new Uint32Array([
  0xF3BCC908, 0x6A09E667, 0x84CAA73B, 0xBB67AE85, 0xFE94F82B, 0x3C6EF372, 0x5F1D36F1, 0xA54FF53A,
  0xADE682D1, 0x510E527F, 0x2B3E6C1F, 0x9B05688C, 0xFB41BD6B, 0x1F83D9AB, 0x137E2179, 0x5BE0CD19]);
const BLAKE_ORDER = `0123456789ABCDEF EA489FD61C02B753 B8C052FDAE367194 7931DCBE265A40F8 905724AFE1BC683D
  2C6A0B834D75FE19 C51FED4A0763928B DB7EC13950F4862A 6FE9B308C2D714A5 A2847615FB9E3CD0 0123456789ABCDEF
  EA489FD61C02B753`.split(/\s+/).map((line) => [...line].map((digit) => 2 * parseInt(digit, 16)));
// Places of the four numbers that are mixed together: columns, then diagonals.
const BLAKE_PLACES = ['048C', '159D', '26AE', '37BF', '05AF', '16BC', '278D', '349E'].map(
  (line) => [...line].map((digit) => 2 * parseInt(digit, 16)));

// Hashes consecutive pieces of bytes; returns the digest's bytes.
function blake2b(pieces, size) {
  const h = BLAKE_START.slice(), v = new Uint32Array(32), m = new Uint32Array(32), block = new Uint8Array(m.buffer);
  h[0] ^= 0x01010000 ^ size;
  let held = 0, total = 0;
  // v[a] += v[b] + the number of words x and y of the block; v[d] = (v[d] ^ v[a]) rotated to the right by 32 or 16 bits.
  const step = (a, b, d, x, swapped) => {
    const sum = v[a] + v[b] + m[x];
    v[a + 1] += v[b + 1] + m[x + 1] + (sum / 0x100000000 | 0);
    v[a] = sum;
    const low = v[d] ^ v[a], high = v[d + 1] ^ v[a + 1];
    v[d] = swapped ? high : low >>> 16 | high << 16;
    v[d + 1] = swapped ? low : high >>> 16 | low << 16;
  };
  // v[c] += v[d]; v[b] = (v[b] ^ v[c]) rotated to the right by 24 or 63 bits.
  const turn = (b, c, d, most) => {
    const sum = v[c] + v[d];
    v[c + 1] += v[d + 1] + (sum / 0x100000000 | 0);
    v[c] = sum;
    const low = v[b] ^ v[c], high = v[b + 1] ^ v[c + 1];
    v[b] = most ? high >>> 31 | low << 1 : low >>> 24 | high << 8;
    v[b + 1] = most ? low >>> 31 | high << 1 : high >>> 24 | low << 8;
  };
  const compress = (last) => {
    v.set(h);
    v.set(BLAKE_START, 16);
    v[24] ^= total;
    v[25] ^= Math.floor(total / 2 ** 32);
    if (last) {
      v[28] ^= -1;
      v[29] ^= -1;
    }
    for (const order of BLAKE_ORDER) {
      for (let i = 0; i < 8; ++i) {
        const places = BLAKE_PLACES[i], a = places[0], b = places[1], c = places[2], d = places[3];
        step(a, b, d, order[2 * i], true);
        turn(b, c, d, false);
        step(a, b, d, order[2 * i + 1], false);
        turn(b, c, d, true);
      }
    }
    for (let i = 0; i < 16; ++i) h[i] ^= v[i] ^ v[16 + i];
  };
  for (const piece of pieces) {
    for (let at = 0; at < piece.length;) {
      // The last block is compressed at the end, even if it is full.
      if (held === 128) {
        total += 128;
        compress(false);
        held = 0;
      }
      const many = Math.min(128 - held, piece.length - at);
      block.set(piece.subarray(at, at + many), held);
      held += many;
      at += many;
    }
  }
  block.fill(0, held);
  total += held;
  compress(true);
  return new Uint8Array(h.buffer, 0, size);
}

const hexadecimals = (bytes) => Array.from(bytes, (byte) => byte.toString(16).padStart(2, '0')).join('');
