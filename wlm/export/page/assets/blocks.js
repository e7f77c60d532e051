// Decodes BC7 blocks of all modes to RGBA8, for browsers without block compression.

// For each mode: subsets; bits of the partition's number, the rotation and the index selection; of a colour and an alpha
// of an endpoint; P bits of each endpoint and of each subset; bits of an index, and of the second index.
const MODES = [
  [3, 4, 0, 0, 4, 0, 1, 0, 3, 0], [2, 6, 0, 0, 6, 0, 0, 1, 3, 0], [3, 6, 0, 0, 5, 0, 0, 0, 2, 0],
  [2, 6, 0, 0, 7, 0, 1, 0, 2, 0], [1, 0, 2, 1, 5, 6, 0, 0, 2, 3], [1, 0, 2, 0, 7, 8, 0, 0, 2, 2],
  [1, 0, 0, 0, 7, 7, 1, 0, 4, 0], [2, 6, 0, 0, 5, 5, 1, 0, 2, 0],
];
const hexadecimal = (text) => text.trim().split(/\s+/).map((word) => parseInt(word, 16));
// For two and three subsets: the subset of each texel, in one bit or two; and the subsets' anchors, a digit for
// each partition, whose indices have one bit less.
const PARTITIONS = [[0], hexadecimal(`
  CCCC 8888 EEEE ECC8 C880 FEEC FEC8 EC80 C800 FFEC FE80 E800 FFE8 FF00 FFF0 F000
  F710 008E 7100 08CE 008C 7310 3100 8CCE 088C 3110 6666 366C 17E8 0FF0 718E 399C
  AAAA F0F0 5A5A 33CC 3C3C 55AA 9696 A55A 73CE 13C8 324C 3BDC 6996 C33C 9966 0660
  0272 04E4 4E40 2720 C936 936C 39C6 639C 9336 9CC6 817E E718 CCF0 0FCC 7744 EE22`), hexadecimal(`
  AA685050 6A5A5040 5A5A4200 5450A0A8 A5A50000 A0A05050 5555A0A0 5A5A5050
  AA550000 AA555500 AAAA5500 90909090 94949494 A4A4A4A4 A9A59450 2A0A4250
  A5945040 0A425054 A5A5A500 55A0A0A0 A8A85454 6A6A4040 A4A45000 1A1A0500
  0050A4A4 AAA59090 14696914 69691400 A08585A0 AA821414 50A4A450 6A5A0200
  A9A58000 5090A0A8 A8A09050 24242424 00AA5500 24924924 24499224 50A50A50
  500AA550 AAAA4444 66660000 A5A0A5A0 50A050A0 69286928 44AAAA44 66666600
  AA444444 54A854A8 95809580 96969600 A85454A8 80959580 AA141414 96960000
  AAAA1414 A05050A0 A0A5A5A0 96000000 40804080 A9A8A9A8 AAAAAA44 2A4A5254`)];
const ANCHORS = [[], ['FFFFFFFFFFFFFFFFF282288F28228822FF6828FF28222FF66268FF22FFFFF22F'], [
  '33FF83FF88666533338F336A588685FF8F356A8FF3F5FFFF3F55585A5A8DFC33',
  'F883FF38FFFFFFF8F8F3F8F83F6AFFA8F3FAA89A6F8F3668F3FFFFFFFFFF3FF8']];
const SHARES = {
  2: [0, 21, 43, 64], 3: [0, 9, 18, 27, 37, 46, 55, 64],
  4: [0, 4, 9, 13, 17, 21, 26, 30, 34, 38, 43, 47, 51, 55, 60, 64],
};

function unpackBlocks(bytes, width, height) {
  const texels = new Uint8Array(width * height * 4), across = width / 4;
  const words = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const block = new Uint32Array(4), ends = new Uint8Array(24), shares = new Uint8Array(32);
  for (let number = 0; number < bytes.length / 16; ++number) {
    for (let i = 0; i < 4; ++i) block[i] = words.getUint32(16 * number + 4 * i, true);
    unpackBlock(block, ends, shares, texels, 4 * (4 * Math.floor(number / across) * width + 4 * (number % across)), width);
  }
  return texels;
}

// Decodes a block of four words into `texels` at an offset; `ends` and `shares` are scratch.
function unpackBlock(block, ends, shares, texels, place, width) {
  if (block.every((word) => word === 0)) return;  // padding, of which a GPU makes zeros
  const mode = 31 - Math.clz32(block[0] & -block[0]);
  if (!(mode in MODES)) throw new Error('the page is damaged: a block is of no BC7 mode');
  const [subsets, wide, turns, selects, colour, alpha, own, shared, count, second] = MODES[mode];
  let at = mode + 1;
  const take = (bits) => {  // at most 8
    const word = at >> 5, shift = at & 31;
    let value = block[word] >>> shift;
    if (shift > 24 && word < 3) value |= block[word + 1] << (32 - shift);
    at += bits;
    return value & ((1 << bits) - 1);
  };
  const partition = take(wide), rotation = take(turns), selection = take(selects);
  for (let channel = 0; channel < 4; ++channel)
    for (let end = 0; end < 2 * subsets; ++end) ends[4 * end + channel] = take(channel < 3 ? colour : alpha);
  const lowest = [];
  for (let i = 0; i < subsets * (2 * own + shared); ++i) lowest.push(take(1));
  for (let i = 0; i < 8 * subsets; ++i) {
    let size = (i & 3) < 3 ? colour : alpha, value = ends[i];
    if (size && lowest.length) {
      value = 2 * value + lowest[shared ? i >> 3 : i >> 2];
      ++size;
    }
    value <<= 8 - size;
    ends[i] = size ? value | (value >> size) : 255;
  }
  const anchors = ANCHORS[subsets - 1].map((digits) => parseInt(digits[partition], 16));
  for (let i = 0; i < 16; ++i) shares[i] = SHARES[count][take(i && !anchors.includes(i) ? count : count - 1)];
  for (let i = 0; i < 16; ++i) shares[16 + i] = second ? SHARES[second][take(i ? second : second - 1)] : shares[i];
  const digits = subsets - 1, words = PARTITIONS[digits][partition];
  for (let i = 0; i < 16; ++i) {
    const subset = words >>> (digits * i) & ((1 << digits) - 1), to = place + 4 * ((i >> 2) * width + (i & 3));
    for (let channel = 0; channel < 4; ++channel) {
      const share = shares[(channel < 3) === !selection ? i : 16 + i];
      const a = ends[8 * subset + channel], b = ends[8 * subset + 4 + channel];
      texels[to + channel] = ((64 - share) * a + share * b + 32) >> 6;
    }
    if (rotation) {
      const turned = to + rotation - 1, value = texels[turned];
      texels[turned] = texels[to + 3];
      texels[to + 3] = value;
    }
  }
}
