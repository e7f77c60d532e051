// Reads a .wlm file (wlm/formats/artifact.py): its settings, its parts, and the pieces of parts that are read one by one.

const ARTIFACT_VERSION = 3, COMPACT_VERSION = 6, COMPACT_SYSTEMS = ['probe'];
const PART_TYPES = {
  BOOL: Uint8Array, U8: Uint8Array, I8: Int8Array, U16: Uint16Array, I16: Int16Array, F16: Uint16Array,
  U32: Uint32Array, I32: Int32Array, F32: Float32Array, F64: Float64Array,
};

// Numbers of a type from little-endian bytes that may begin anywhere.
const numbersOf = (bytes, Type) => new Type(bytes.slice().buffer);

function parseObject(text, what) {
  let value;
  try {
    value = JSON.parse(text);
  } catch {
    throw new Error(`${what}: expected JSON, found other content`);
  }
  return value;
}

// Returns {system, settings, parts, pieces}: parts have a type, a shape and bytes; pieces are lists of bytes.
function readArtifact(bytes) {
  if (bytes.length > 8 && String.fromCharCode(...bytes.subarray(0, 3)) === 'wlm') return readCompact(bytes);
  const words = new DataView(bytes.buffer, bytes.byteOffset), length = bytes.length > 8 ? words.getUint32(0, true) : 0;
  const start = 8 + length;
  if (bytes[8] !== 0x7B || words.getUint32(4, true)) throw new Error('expected a .wlm file, found other content');
  if (start > bytes.length) throw new Error(`the file is cut short: expected a header of ${length} bytes, found fewer`);
  const header = parseObject(new TextDecoder().decode(bytes.subarray(8, start)), 'header');
  const {wlm = '', settings = ''} = header.__metadata__ ?? {}, [version, system, , digest] = wlm.split(' ');
  if (!digest) throw new Error('expected a .wlm file, found another safetensors file');
  if (Number(version) !== ARTIFACT_VERSION) {
    throw new Error(`expected version ${ARTIFACT_VERSION} of .wlm files, found ${version}: compress the input again`);
  }
  const parts = {}, pieces = {};
  let end = start;
  delete header.__metadata__;
  for (const [name, {dtype, shape, data_offsets: [first, last]}] of Object.entries(header)) {
    const count = shape.reduce((product, side) => product * side, 1), size = PART_TYPES[dtype]?.BYTES_PER_ELEMENT;
    const half = dtype === 'U64' || dtype === 'I64';
    if (half || !(last - first === count * size && first >= 0 && start + last <= bytes.length)) {
      throw new Error(`part ${name}: expected the bytes of its type and shape within the file`);
    }
    parts[name] = {dtype, shape, bytes: bytes.subarray(start + first, start + last)};
    if (!(`${name}.pieces` in header)) end = Math.max(end, start + last);
  }
  // The digest is that of the index with zeros in its own place.
  const index = bytes.slice(0, end), text = new TextDecoder('latin1').decode(index.subarray(0, start));
  index.fill(0x30, text.indexOf(` ${digest}"`) + 1, text.indexOf(` ${digest}"`) + 33);
  if (hexadecimals(blake2b([index], 16)) !== digest) {
    throw new Error('the file is damaged: its bytes do not match their digest');
  }
  for (const name of Object.keys(parts).filter((each) => `${each}.pieces` in parts)) {
    const table = numbersOf(parts[`${name}.pieces`].bytes, Uint32Array), whole = parts[name].bytes;
    let at = 0;
    pieces[name] = Array.from({length: table.length / 5}, (_, i) => {
      const piece = whole.subarray(at, at += table[5 * i]), own = blake2b([piece], 16);
      if (numbersOf(own, Uint32Array).some((word, k) => word !== table[5 * i + 1 + k])) {
        throw new Error(`part ${name}: piece ${i} is damaged: its bytes do not match their digest`);
      }
      return piece;
    });
    delete parts[name];
    delete parts[`${name}.pieces`];
  }
  const quotes = {'"': "'", "'": '"'};
  return {system, settings: parseObject(settings.replace(/["']/g, (mark) => quotes[mark]), 'settings'), parts, pieces};
}

function readCompact(bytes) {
  const version = bytes[3] & 15, system = COMPACT_SYSTEMS[bytes[3] >> 4];
  if (version !== COMPACT_VERSION || !system) {
    throw new Error(`expected version ${COMPACT_VERSION} of compact .wlm files, found ${version}: compress the input again`);
  }
  const body = bytes.subarray(8), digest = blake2b([bytes.subarray(0, 4), body], 4);
  if (digest.some((byte, i) => byte !== bytes[4 + i])) {
    throw new Error('the file is damaged: its bytes do not match their digest');
  }
  return {system, settings: {}, parts: {body: {dtype: 'U8', shape: [body.length], bytes: body}}, pieces: {}};
}

// The numbers of a part, of a type by its name in the file and of `count` numbers; a missing part that should have none
// is empty.
function partNumbers(parts, name, dtypes, count) {
  const Type = PART_TYPES[dtypes[0]];
  if (!(name in parts) && count === 0) return new Type(0);
  const {dtype, bytes} = parts[name] ?? {};
  if (!dtypes.includes(dtype) || bytes.length !== count * PART_TYPES[dtype].BYTES_PER_ELEMENT) {
    throw new Error(`part ${name}: expected ${count} numbers of ${dtypes.join(' or ')}, found others`);
  }
  return numbersOf(bytes, PART_TYPES[dtype]);
}

// Rounds to the nearest half float, ties to even; numbers are at most 65504.
function toHalf(value) {
  const size = Math.abs(value), exponent = Math.max(size ? Math.floor(Math.log2(size)) : -14, -14);
  let scaled = size / 2 ** (exponent - 10);
  scaled = Math.floor(scaled) + (scaled % 1 > 0.5 || (scaled % 1 === 0.5 && Math.floor(scaled) % 2) ? 1 : 0);
  // The leading bit of a normal number, and a carry, add to the exponent.
  return (value < 0 || Object.is(value, -0) ? 0x8000 : 0) + (exponent + 14) * 1024 + scaled;
}

// The numbers of half floats; files hold none that is NaN or infinite.
function halves(bits) {
  if (bits.some((each) => (each & 0x7C00) === 0x7C00)) throw new Error('expected finite numbers, found NaN or infinity');
  return Float64Array.from(bits, fromHalf);
}
