// Decompresses Zstandard frames (RFC 8878), which browsers cannot. Checksums and dictionaries are not read: an artifact
// has digests of its own, and our frames use no dictionary.

const ZSTD_MAGIC = 0xFD2FB528, ZSTD_BLOCK = 1 << 17;  // bytes of a block at most
// Smallest value and further bits of each code of a literals length and of a match length.
const pairsOf = (text) => text.trim().split(/\s+/).map((pair) => pair.split(':').map(Number));
const LITERAL_CODES = [...Array.from({length: 16}, (_, i) => [i, 0]), ...pairsOf(`
  16:1 18:1 20:1 22:1 24:2 28:2 32:3 40:3 48:4 64:6 128:7 256:8 512:9 1024:10 2048:11 4096:12 8192:13 16384:14 32768:15
  65536:16`)];
const MATCH_CODES = [...Array.from({length: 32}, (_, i) => [i + 3, 0]), ...pairsOf(`
  35:1 37:1 39:1 41:1 43:2 47:2 51:3 59:3 67:4 83:4 99:5 131:7 259:8 515:9 1027:10 2051:11 4099:12 8195:13 16387:14
  32771:15 65539:16`)];
const repeated = (...runs) => runs.flatMap(([value, count]) => Array(count).fill(value));
// For literals lengths, offsets and match lengths: largest accuracy and symbol, and the accuracy and the probabilities of
// the table that is used by default.
const ZSTD_TABLES = [
  {most: 9, last: 35, usual: [6, [4, 3, ...repeated([2, 11], [1, 3], [2, 9]), 3, 2, ...repeated([1, 5], [-1, 4])]]},
  {most: 8, last: 31, usual: [5, repeated([1, 6], [2, 3], [1, 15], [-1, 5])]},
  {most: 9, last: 52, usual: [6, [1, 4, 3, ...repeated([2, 6], [1, 37], [-1, 7])]]},
];

function damagedFrame() { return new Error('expected a zstd frame, found damaged data'); }

// Bits from the end of some bytes, whose highest set bit marks the end; what is read before the begin is 0.
class BackwardBits {
  constructor(bytes) {
    if (!bytes.length || !bytes.at(-1)) throw damagedFrame();
    this.bytes = bytes;
    this.left = 8 * bytes.length - 1 - (Math.clz32(bytes.at(-1)) - 24);
  }

  // The next bits, at most 24, without taking them.
  peek(count) {
    const first = this.left - count, low = Math.max(first, 0), at = low >> 3, {bytes} = this;
    const word = bytes[at] | bytes[at + 1] << 8 | bytes[at + 2] << 16 | bytes[at + 3] << 24;
    return (word >>> (low & 7) & (1 << Math.max(count - (low - first), 0)) - 1) << (low - first);
  }

  // Up to 32 bits.
  read(count) {
    if (count > 16) return this.read(count - 16) * 65536 + this.read(16);
    const value = this.peek(count);
    this.left -= count;
    return value;
  }
}

// Reads the probabilities of an FSE table; returns them, the accuracy and the number of bytes.
function readProbabilities(bytes, most, last) {
  let at = 0;
  const take = (count) => {
    let value = 0;
    for (let i = 0; i < count; ++i, ++at) value |= (bytes[at >> 3] >> (at & 7) & 1) << i;
    return value;
  };
  const accuracy = take(4) + 5, shares = [];
  if (accuracy > most) throw damagedFrame();
  for (let left = 1 << accuracy; left > 0;) {
    const bits = 32 - Math.clz32(left + 1), half = (1 << bits - 1) - 1, spare = (1 << bits) - 2 - left;
    let value = take(bits);
    if ((value & half) < spare) {
      value &= half;
      --at;
    } else if (value > half) value -= spare;
    shares.push(value - 1);
    left -= Math.abs(value - 1);
    if (value === 1) {
      for (let again = 3; again === 3 && shares.length <= last;) {
        again = take(2);
        for (let i = 0; i < again; ++i) shares.push(0);
      }
    }
    if (left < 0 || shares.length > last + 1) throw damagedFrame();
  }
  if (at > 8 * bytes.length) throw damagedFrame();
  return {shares, accuracy, size: Math.ceil(at / 8)};
}

// Makes an FSE table: for each state a symbol, the number of bits to read, and the state that they are added to.
function fseTable(shares, accuracy) {
  const size = 1 << accuracy, symbols = new Uint8Array(size), bits = new Uint8Array(size), base = new Uint16Array(size);
  const next = shares.map((share) => Math.abs(share));
  let end = size, at = 0;
  shares.forEach((share, symbol) => { if (share < 0) symbols[--end] = symbol; });
  shares.forEach((share, symbol) => {
    for (let i = 0; i < share; ++i) {
      symbols[at] = symbol;
      do at = at + (size >> 1) + (size >> 3) + 3 & size - 1; while (at >= end);
    }
  });
  for (let state = 0; state < size; ++state) {
    const count = next[symbols[state]]++;
    bits[state] = accuracy - (31 - Math.clz32(count));
    base[state] = (count << bits[state]) - size;
  }
  return {symbols, bits, base, accuracy};
}

// Reads a Huffman table: for each code of the most bits its symbol and its length; and the number of bytes.
function readHuffman(bytes) {
  const head = bytes[0], weights = [];
  let size = 1 + head;
  if (head >= 128) {
    const count = head - 127;
    size = 1 + Math.ceil(count / 2);
    for (let i = 0; i < count; ++i) weights.push(i & 1 ? bytes[1 + (i >> 1)] & 15 : bytes[1 + (i >> 1)] >> 4);
  } else {
    const {shares, accuracy, size: used} = readProbabilities(bytes.subarray(1, size), 6, 255);
    const table = fseTable(shares, accuracy), stream = new BackwardBits(bytes.subarray(1 + used, size));
    const states = [stream.read(accuracy), stream.read(accuracy)];
    // Two states take turns; the bits end while one of them is read, and the other has a symbol left.
    for (let turn = 0; weights.length < 255; turn ^= 1) {
      const state = states[turn];
      weights.push(table.symbols[state]);
      states[turn] = table.base[state] + stream.read(table.bits[state]);
      if (stream.left < 0) {
        weights.push(table.symbols[states[turn ^ 1]]);
        break;
      }
    }
  }
  const sum = weights.reduce((total, weight) => total + (weight ? 2 ** (weight - 1) : 0), 0);
  const most = 32 - Math.clz32(sum), rest = 2 ** most - sum;
  if (size > bytes.length || !sum || most > 11 || rest & rest - 1) throw damagedFrame();
  weights.push(32 - Math.clz32(rest));
  const symbols = new Uint8Array(1 << most), lengths = new Uint8Array(1 << most);
  let at = 0;
  for (let weight = 1; weight <= most; ++weight) {
    weights.forEach((each, symbol) => {
      if (each !== weight) return;
      symbols.fill(symbol, at, at + (1 << weight - 1));
      lengths.fill(most + 1 - weight, at, at += 1 << weight - 1);
    });
  }
  return {symbols, lengths, most, size};
}

function readHuffmanStream({symbols, lengths, most}, bytes, out) {
  const stream = new BackwardBits(bytes);
  for (let i = 0; i < out.length; ++i) {
    const code = stream.peek(most);
    out[i] = symbols[code];
    stream.left -= lengths[code];
  }
  if (stream.left !== 0) throw damagedFrame();
}

// Reads the literals of a block; returns them and the number of bytes that they take.
function readLiterals(block, state) {
  const kind = block[0] & 3, form = block[0] >> 2 & 3;
  const word = (block[0] | block[1] << 8 | block[2] << 16 | block[3] << 24) >>> 0;
  if (kind < 2) {
    const head = form === 3 ? 3 : form === 1 ? 2 : 1, count = form & 1 ? (word & (1 << 8 * head) - 1) >>> 4 : block[0] >> 3;
    const size = kind ? 1 : count;
    if (count > ZSTD_BLOCK || head + size > block.length) throw damagedFrame();
    const bytes = kind ? new Uint8Array(count).fill(block[head]) : block.subarray(head, head + size);
    return {literals: bytes, size: head + size};
  }
  const head = Math.max(form, 1) + 2, width = 4 * head - 2, all = word + (block[4] ?? 0) * 2 ** 32;
  const count = Math.floor(all / 16) % 2 ** width, packed = Math.floor(all / 2 ** (4 + width)) % 2 ** width;
  const literals = new Uint8Array(count), end = head + packed;
  if (count > ZSTD_BLOCK || end > block.length) throw damagedFrame();
  let at = head;
  if (kind === 2) {
    state.huffman = readHuffman(block.subarray(at, end));
    at += state.huffman.size;
  }
  if (!state.huffman) throw damagedFrame();
  if (form === 0) readHuffmanStream(state.huffman, block.subarray(at, end), literals);
  else {
    // Three lengths, then four streams, of which the last takes what is left.
    const quarter = count + 3 >> 2;
    let from = at + 6;
    for (let i = 0; i < 4; ++i) {
      const to = i < 3 ? from + (block[at + 2 * i] | block[at + 2 * i + 1] << 8) : end;
      if (to > end || 3 * quarter > count) throw damagedFrame();
      readHuffmanStream(state.huffman, block.subarray(from, to), literals.subarray(quarter * i, i < 3 ? quarter * (i + 1) : count));
      from = to;
    }
  }
  return {literals, size: end};
}

// Reads the tables of the sequences of a block: for each of the three the default one, a symbol alone, a new one, or that
// of the block before; returns where the bits begin.
function readTables(block, at, state) {
  const modes = block[at++];
  ZSTD_TABLES.forEach(({most, last, usual: [accuracy, shares]}, i) => {
    const mode = modes >> 6 - 2 * i & 3;
    if (mode === 0) state.tables[i] = fseTable(shares, accuracy);
    else if (mode === 1) {
      if (block[at] > last) throw damagedFrame();
      state.tables[i] = {symbols: [block[at++]], bits: [0], base: [0], accuracy: 0};
    } else if (mode === 2) {
      const read = readProbabilities(block.subarray(at), most, last);
      state.tables[i] = fseTable(read.shares, read.accuracy);
      at += read.size;
    }
    if (!state.tables[i]) throw damagedFrame();
  });
  return at;
}

// Decompresses a block of literals and sequences to `out` at `place`; returns the place behind it.
function readBlock(block, state, out, place) {
  const {literals, size} = readLiterals(block, state);
  let at = size, from = 0, count = block[at++];
  const copy = (amount) => {
    if (from + amount > literals.length || place + amount > out.length) throw damagedFrame();
    out.set(literals.subarray(from, from += amount), place);
    place += amount;
  };
  if (count === 255) count = block[at++] + (block[at++] << 8) + 0x7F00;
  else if (count > 127) count = (count - 128 << 8) + block[at++];
  if (!count) {
    copy(literals.length);
    return place;
  }
  at = readTables(block, at, state);
  const {tables: [lengths, offsets, matches], recent} = state, stream = new BackwardBits(block.subarray(at));
  let a = stream.read(lengths.accuracy), b = stream.read(offsets.accuracy), c = stream.read(matches.accuracy);
  for (let i = 0; i < count; ++i) {
    const code = offsets.symbols[b], value = 2 ** code + stream.read(code);
    const [least, wide] = MATCH_CODES[matches.symbols[c]], length = least + stream.read(wide);
    const [fewest, further] = LITERAL_CODES[lengths.symbols[a]], amount = fewest + stream.read(further);
    // Values up to 3 name one of the last three offsets; without literals they are shifted by one.
    const number = value - (amount ? 1 : 0), again = value <= 3;
    const offset = !again ? value - 3 : number < 3 ? recent[number] : recent[0] - 1;
    if (!again || number > 0) {
      if (!again || number > 1) recent[2] = recent[1];
      recent[1] = recent[0];
      recent[0] = offset;
    }
    copy(amount);
    if (offset < 1 || offset > place || place + length > out.length) throw damagedFrame();
    if (offset >= length) out.copyWithin(place, place - offset, place - offset + length);
    else for (let k = 0; k < length; ++k) out[place + k] = out[place + k - offset];
    place += length;
    if (i === count - 1) break;
    a = lengths.base[a] + stream.read(lengths.bits[a]);
    c = matches.base[c] + stream.read(matches.bits[c]);
    b = offsets.base[b] + stream.read(offsets.bits[b]);
  }
  if (stream.left !== 0) throw damagedFrame();
  copy(literals.length - from);
  return place;
}

// Decompresses exactly one frame to `size` bytes.
function unzstd(frame, size) {
  const word = (at, bytes) => Array.from({length: bytes}, (_, i) => frame[at + i] * 2 ** (8 * i)).reduce((a, b) => a + b, 0);
  if (frame.length < 6 || word(0, 4) !== ZSTD_MAGIC) throw new Error('expected a zstd frame, found other data');
  const head = frame[4], single = head >> 5 & 1, held = [single, 2, 4, 8][head >> 6];
  let at = 5 + (single ? 0 : 1), place = 0, last = false;
  if (head & 3 || head & 8) throw new Error('expected a zstd frame without a dictionary');
  const stated = held ? word(at, held) + (held === 2 ? 256 : 0) : size;
  if (stated !== size) throw new Error(`expected a zstd frame of ${size} decompressed bytes, found ${stated}`);
  at += held;
  const out = new Uint8Array(size), state = {tables: [], recent: [1, 4, 8], huffman: null};
  while (!last) {
    const block = word(at, 3), kind = block >> 1 & 3, many = block >> 3, taken = kind === 1 ? 1 : many;
    last = Boolean(block & 1);
    at += 3;
    if (!(at + taken <= frame.length) || kind === 3 || many > ZSTD_BLOCK) throw damagedFrame();
    if (kind < 2 && place + many > size) throw damagedFrame();
    const bytes = frame.subarray(at, at += taken);
    if (kind === 2) place = readBlock(bytes, state, out, place);
    else {
      if (kind === 1) out.fill(bytes[0], place, place + many);
      else out.set(bytes, place);
      place += many;
    }
  }
  if (at + (head & 4) !== frame.length || place !== size) throw damagedFrame();
  return out;
}
