// Makes the content of a page from EXR files of six-way lightmaps, which wlm smoke bake and predict write: scan lines of
// half floats or floats, packed with ZIP.

const SIX_WAY = ['right', 'left', 'top', 'bottom', 'front', 'back'], EXR_SIZES = [4, 2, 4], EXR_LINES = {0: 1, 2: 1, 3: 16};
const WHITE = 0.8;  // screen value of the brightest lightmap

async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate'));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Reads an EXR file of one part; returns its size and its planes by name, float32.
async function readExr(bytes) {
  const words = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength), attributes = {};
  if (words.getUint32(0, true) !== 20000630) throw new Error('expected an EXR file, found other content');
  if (words.getUint32(4, true) >> 8 & ~4) throw new Error('expected an EXR file of one part with scan lines');
  let at = 8;
  const text = () => {
    const end = bytes.indexOf(0, at), found = new TextDecoder().decode(bytes.subarray(at, end));
    at = end + 1;
    return found;
  };
  for (let name = text(); name; name = text()) {
    text();
    const size = words.getUint32(at, true);
    attributes[name] = at + 4;
    at += 4 + size;
  }
  const [left, top, right, bottom] = [0, 4, 8, 12].map((i) => words.getInt32(attributes.dataWindow + i, true));
  const width = right - left + 1, height = bottom - top + 1, packing = bytes[attributes.compression];
  if (!(packing in EXR_LINES)) throw new Error('expected an EXR file that is packed with ZIP, or not packed');
  const channels = [], first = at;
  at = attributes.channels;
  for (let name = text(); name; name = text()) {
    channels.push({name, type: words.getUint32(at, true)});
    at += 16;
  }
  if (channels.some(({type}) => !type)) throw new Error('expected channels of floats');
  const planes = Object.fromEntries(channels.map(({name}) => [name, new Float32Array(width * height)]));
  const line = width * channels.reduce((sum, {type}) => sum + EXR_SIZES[type], 0), lines = EXR_LINES[packing];
  for (let chunk = 0; chunk * lines < height; ++chunk) {
    const place = Number(words.getBigUint64(first + 8 * chunk, true)), row = words.getInt32(place, true) - top;
    const size = words.getUint32(place + 4, true), many = Math.min(lines, height - row), data = new Uint8Array(line * many);
    const held = bytes.subarray(place + 8, place + 8 + size);
    if (size === data.length) data.set(held);
    else {
      // Differences of bytes; the even ones come first.
      const packed = await inflate(held), half = data.length + 1 >> 1;
      for (let i = 1; i < packed.length; ++i) packed[i] = packed[i - 1] + packed[i] - 128;
      for (let i = 0; i < data.length; ++i) data[i] = packed[(i >> 1) + (i & 1 ? half : 0)];
    }
    const numbers = new DataView(data.buffer);
    let from = 0;
    for (let y = row; y < row + many; ++y) {
      for (const {name, type} of channels) {
        for (let x = 0; x < width; ++x, from += EXR_SIZES[type]) {
          planes[name][y * width + x] = type === 1 ? fromHalf(numbers.getUint16(from, true)) : numbers.getFloat32(from, true);
        }
      }
    }
  }
  return {width, height, planes};
}

async function readSixWay(file) {
  try {
    const exr = await readExr(new Uint8Array(await file.arrayBuffer())), {planes} = exr;
    const missing = [...SIX_WAY, 'transparency'].find((name) => !(name in planes));
    if (missing) throw new Error(`expected six-way lightmaps, found no channel ${missing}`);
    if (Object.values(planes).some((plane) => !plane.every(Number.isFinite))) throw new Error('expected finite numbers, found NaN or infinity');
    return exr;
  } catch (error) {
    throw named(file, error);
  }
}

// Frames in the order of the numbers in their names.
async function openSmoke(files) {
  const order = new Intl.Collator('en', {numeric: true}), sorted = [...files].sort((a, b) => order.compare(a.name, b.name));
  const arrays = {}, most = [];
  let size, hot = false;
  for (const [number, file] of sorted.entries()) {
    const {width, height, planes} = await readSixWay(file);
    size ??= [width, height];
    if (size.join() !== [width, height].join()) {
      throw new Error(`${file.name}: expected ${size.join('x')} pixels as the first frame, found ${width}x${height}`);
    }
    const largest = (names) => names.reduce((top, name) => planes[name].reduce((a, b) => Math.max(a, b), top), 1e-12);
    const scales = [largest(SIX_WAY), 1, planes.emission ? largest(['emission']) : 1e-12];
    hot ||= 'emission' in planes;
    const codes = [new Uint8Array(4 * width * height), new Uint8Array(4 * width * height)];
    const put = (channel, value) => {
      const code = codes[channel >> 2];
      for (let i = 0; i < width * height; ++i) code[4 * i + (channel & 3)] = Math.round(255 * Math.sqrt(Math.min(Math.max(value(i), 0), 1)));
    };
    SIX_WAY.forEach((name, channel) => put(channel, (i) => planes[name][i] / scales[0]));
    put(6, (i) => 1 - planes.transparency[i]);
    put(7, (i) => planes.emission ? planes.emission[i] / scales[2] : 0);
    [arrays[`first_${number}`], arrays[`second_${number}`]] = codes;
    most.push(scales);
  }
  const bytes = sorted.reduce((sum, file) => sum + file.size, 0), brightest = Math.max(...most.map(([light]) => light));
  return {
    arrays,
    manifest: {
      kind: 'smoke', title: sorted[0].name.replace(/\.exr$/i, ''), width: size[0], height: size[1], exposure: WHITE / brightest,
      note: 'Six-way lightmaps of smoke. Drag over the picture: the light follows the pointer.',
      smoke: {frames: sorted.length, planes: [...SIX_WAY, 'opacity', ...hot ? ['emission'] : []], most, rate: 30},
      figures: [
        ['files', `${bytes.toLocaleString('en')} bytes`], ['frames', String(sorted.length)],
        ['lightmaps', `${size.join(' × ')} texels`], ['brightest texel', brightest.toPrecision(3)],
      ],
    },
  };
}
