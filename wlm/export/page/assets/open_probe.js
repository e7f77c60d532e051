// Makes the content of a page from a file of light probes, as wlm/probe/codec.py and the bundles of both methods do.

const CUT = 3;  // radius of a Gaussian's support in standard deviations
const LATTICE = 8;  // balls along the longest side of the box of a file without positions
const SHARE = 0.45, NEIGHBOURS = 2000;  // radius of a ball by the distance to the next; probes of which it is the median

// Arrays of a body, whose bytes are split into planes: first the lowest byte of every number.
function unpackPlanes(data, table) {
  const arrays = {};
  let at = 0;
  for (const [name, [Type, count]] of Object.entries(table)) {
    const width = Type.BYTES_PER_ELEMENT, bytes = new Uint8Array(count * width);
    for (let k = 0; k < width; ++k) for (let i = 0; i < count; ++i) bytes[width * i + k] = data[at + k * count + i];
    at += count * width;
    arrays[name] = new Type(bytes.buffer);
    // Small magnitudes of either sign have empty high planes.
    if (Type === Int32Array) arrays[name] = Int32Array.from(new Uint32Array(bytes.buffer), (x) => (x >>> 1) ^ -(x & 1));
  }
  return arrays;
}

function openProbe({parts, pieces}, {templates, defaults, group}, bytes, name) {
  if (pieces.regions) throw new Error(`expected a model of one region, found ${pieces.regions.length}`);
  const body = parts.body.bytes, length = body[0] | body[1] << 8;
  const header = parseObject(new TextDecoder().decode(body.subarray(2, 2 + length)), 'header');
  const {probes, outputs = 27, count = 0, clusters = 1, hours = 1, live = probes, positions: placed} = header;
  const profile = {...defaults.probe, ...header.profile}, gaussian = profile.method === 'gaussians', {latent, hidden} = profile;
  const coefficients = Math.sqrt(outputs / 3);
  if (!Number.isInteger(coefficients)) throw new Error(`expected probes of RGB spherical harmonics, found ${outputs} numbers a probe`);
  const numbers = hours * outputs, relative = profile.error === 'relative', columns = hours * (outputs + relative);
  const shapes = [[latent + 4, hidden], [hidden + 1, hidden], [hidden + 1, columns]], channels = 9 + latent, codes = 1 + (count || numbers);
  const table = {
    box: [Float64Array, 7], ...live < probes && {dead: [Uint8Array, Math.ceil(probes / 8)]},
    ...placed && {positions: [Uint16Array, 3 * probes]},
    ...hours > 1 && {times: [Float64Array, hours], scales: [Float64Array, hours]},
    ...gaussian ? {
      gain: [Float64Array, 1], lowest: [Int32Array, channels], gaussians: [Uint16Array, channels * count],
      steps: [Uint16Array, channels + latent + 6], network: [Int32Array, shapes.reduce((sum, [a, b]) => sum + a * b, 0)],
    } : {
      cluster: [Uint8Array, clusters > 1 ? live : 0], code: [Uint16Array, codes * live], width: [Uint8Array, clusters * codes],
      bounds: [Uint16Array, 2 * clusters * codes],
      basis: [hours === 1 ? Int8Array : Uint16Array, (count ? clusters : 0) * (codes - 1) * numbers],
    },
  };
  const size = Object.values(table).reduce((sum, [Type, many]) => sum + Type.BYTES_PER_ELEMENT * many, 0);
  const stored = unpackPlanes(unzstd(body.subarray(2 + length), size), table);
  const {times, scales = [1]} = stored, noon = hours > 1 ? times.reduce((best, t, i) => Math.abs(t - 12) < Math.abs(times[best] - 12) ? i : best, 0) : 0;
  const shape = {probes, outputs, count, clusters, hours, live, latent, hidden, relative, channels, codes, shapes, hour: noon, scale: scales[noon], group};
  const arrays = gaussian ? packGaussians(stored, shape) : packComponents(stored, shape);
  const shader = gaussian ? gaussianShader(templates.gaussian, {latent, hidden, outputs, relative, support: profile.support})
    : componentShader(templates.pca, {outputs, kind: !stored.basis.length && hours === 1 ? '' : hours === 1 ? 'int8' : 'float16', group})
      + filled(templates.page['between.glsl'], {COUNT: coefficients ** 2});
  if (!placed && !gaussian) throw new Error('the file stores no positions, between which its light is read; make a page with wlm web --original');
  const places = placed ? placesOf(stored, probes) : lattice(stored.box);
  arrays.places = places;
  if (!gaussian) arrays.own = new Uint32Array(places.buffer);
  const radius = ballRadius(places), [low, high] = [Math.min, Math.max].map((best) => [0, 1, 2].map((k) => {
    let bound = places[k];
    for (let i = k; i < places.length; i += 3) bound = best(bound, places[i]);
    return bound + (best === Math.min ? -radius : radius);
  }));
  const full = 4 * outputs * probes * hours, shown = hours > 1 ? `, at ${times[noon]} h of ${hours} hours` : '';
  return {
    arrays,
    manifest: {
      kind: 'probe', title: name, shader, low, high, up: 1, probe: {count: places.length / 3, radius, coefficients: coefficients ** 2},
      note: `Light probes, decoded on this GPU${shown}.${placed ? '' : ' The file stores no positions: the balls are on a lattice.'}`,
      figures: [
        ...compareSizes(bytes, full, 'float32'), ['bits per probe', (bytes * 8 / probes).toFixed(1)],
        ['live probes', `${live.toLocaleString('en')} of ${probes.toLocaleString('en')}`],
        [gaussian ? 'gaussians' : 'components', String(count || numbers)], ['profile', profile.name],
      ],
    },
  };
}

// Positions of live probes: differences of 16-bit codes, modulo 2^16, in the box of origin, extent and relative sides.
function placesOf({box: [...box], positions, dead}, probes) {
  const places = [];
  const code = [0, 0, 0];
  for (let i = 0; i < probes; ++i) {
    for (const k of [0, 1, 2]) code[k] = code[k] + positions[k * probes + i] & 65535;
    if (dead && dead[i >> 3] >> 7 - (i & 7) & 1) continue;
    for (const k of [0, 1, 2]) places.push(box[k] + box[3] * box[4 + k] * code[k] / 65535);
  }
  return Float32Array.from(places);
}

function lattice([...box]) {
  const counts = [0, 1, 2].map((k) => Math.max(Math.round(LATTICE * box[4 + k]), 1)), places = [];
  for (let i = 0; i < counts[0] * counts[1] * counts[2]; ++i) {
    const at = [i % counts[0], Math.floor(i / counts[0]) % counts[1], Math.floor(i / counts[0] / counts[1])];
    for (const k of [0, 1, 2]) places.push(box[k] + box[3] * box[4 + k] * (at[k] + 0.5) / counts[k]);
  }
  return Float32Array.from(places);
}

function ballRadius(places) {
  const count = places.length / 3, step = Math.ceil(count / NEIGHBOURS), apart = [];
  for (let i = 0; i < count; i += step) {
    let nearest = Infinity;
    for (let j = 0; j < count; ++j) {
      if (j === i) continue;
      const [x, y, z] = [0, 1, 2].map((k) => places[3 * j + k] - places[3 * i + k]), square = x * x + y * y + z * z;
      if (square < nearest) nearest = square;
    }
    if (nearest > 0 && nearest < Infinity) apart.push(Math.sqrt(nearest));
  }
  apart.sort((a, b) => a - b);
  return apart.length ? SHARE * 0.5 * (apart[apart.length - 1 >> 1] + apart[apart.length >> 1]) : 1;
}

// The buffers of Gaussians and their network, see wlm/probe/gaussian/bundle.py; of several hours those of one.
function packGaussians({box, gain, lowest, gaussians, steps, network}, {outputs, count, hours, latent, hidden, relative, channels, shapes, hour, scale}) {
  const step = new Float32Array(Uint32Array.from(steps, (x) => x << 16).buffer), row = (c) => gaussians.subarray(c * count, (c + 1) * count);
  if (step.some((x) => !(x > 0 && x < Infinity))) throw new Error('part steps: expected finite quantisation steps above 0');
  const low = [], codeSteps = [], codes = [];
  for (let c = 0; c < channels; ++c) {
    const values = row(c), least = values.reduce((a, b) => Math.min(a, b)), most = values.reduce((a, b) => Math.max(a, b));
    const [first, last] = [least, most].map((code) => Math.fround((lowest[c] + code) * step[c]));
    low.push(first);
    codeSteps.push(Math.fround(Math.fround(last - first) / Math.max(most - least, 1)));
    codes.push(values.map((code) => code - least));
  }
  const quaternion = Array.from({length: 4}, () => new Uint16Array(count));
  for (let i = 0; i < count; ++i) {
    const turn = [6, 7, 8].map((c) => (gaussians[c * count + i] + lowest[c]) * step[c]), square = dot(turn, turn);
    [1 - square, ...turn.map((x) => 2 * x)].forEach((x, k) => { quaternion[k][i] = Math.round((x / (1 + square) + 1) * 32767.5); });
  }
  const four = (list, value) => [...list.slice(0, 6), ...value, ...list.slice(9)], width = 10 + latent, words = width + 1 >> 1;
  const all = four(codes, quaternion), numbers = new Uint16Array(2 * words * count);
  all.forEach((values, c) => values.forEach((code, i) => { numbers[2 * words * i + c] = code; }));
  const [origin, extent, sides] = [box.slice(0, 3), box[3], box.slice(4)];
  const head = Float32Array.from([...origin, extent, ...sides, gain[0], CUT]);
  const bounds = Float32Array.from([...four(low, [-1, -1, -1, -1]), ...four(codeSteps, Array(4).fill(Math.fround(2 / 65535)))]);
  const bits = (floats) => new Uint32Array(floats.buffer);
  const buffer = Uint32Array.from([...bits(head), count, ...bits(bounds), ...new Uint32Array(numbers.buffer)]);

  const netSteps = step.subarray(channels), packed = [];
  let at = 0;
  shapes.forEach(([rows, columns], layer) => {
    const stepOf = (i) => layer === 0 ? netSteps[i] : netSteps[latent + 3 + layer];
    const value = (i, j) => fromHalf(toHalf(Math.max(-65504, Math.min(65504, network[at + i * columns + j] * stepOf(i)))));
    // The last layer has columns for each hour.
    const last = layer === 2, own = last ? columns / hours : columns, factor = last && hours > 1 && !relative ? scale : 1;
    const number = (i, j) => factor * value(i, last ? hour * own + j : j);
    const inputs = rows - 1, high = 1 + 4 * Math.ceil(inputs / 4);
    for (let group = 0; group < own; group += 4) {
      for (let i = 0; i < high; ++i) {
        for (let j = group; j < group + 4; ++j) packed.push(j >= own || i > inputs ? 0 : toHalf(number(i ? i - 1 : inputs, j)));
      }
    }
    at += rows * columns;
  });
  return {gaussians: buffer, network: new Uint32Array(Uint16Array.from(packed).buffer)};
}

// Numbers of few bits, one after another from the lowest bit of a word.
class BitWords {
  constructor() { Object.assign(this, {words: [], held: 0}); }

  put(value, width) {
    for (let i = 0; i < width; ++i, ++this.held) {
      if (!(this.held & 31)) this.words.push(0);
      if (value >> i & 1) this.words[this.words.length - 1] |= 1 << (this.held & 31);
    }
  }
}

// The buffer of principal components, see wlm/probe/pca/bundle.py; of several hours that of one.
function packComponents({cluster, code, width, bounds, basis}, {outputs, clusters, hours, live, codes, hour, scale, group}) {
  const own = cluster.length ? cluster : new Uint8Array(live), plain = !basis.length, components = codes - 1;
  const used = (c, k) => k === 0 || width[c * codes + k] > 0 || bounds[c * codes + k] & 0x7FFF || (plain && hours === 1);
  if (own.some((c) => c >= clusters)) throw new Error('part cluster: expected clusters that exist');
  const directions = (c, k) => Array.from({length: outputs}, (_, d) => {
    const at = hour * outputs + d;
    if (hours === 1) return basis[(c * components + k) * outputs + d];
    return toHalf(scale * (plain ? Number(k === at) : fromHalf(basis[(c * components + k) * hours * outputs + at])));
  });
  const list = [], bits = [], first = [], pairs = [], widths = [], rows = [], wide = hours === 1 ? 4 : 2;
  for (let c = 0; c < clusters; ++c) {
    first.push(pairs.length / 2);
    bits.push(width.subarray(c * codes, (c + 1) * codes).reduce((a, b) => a + b, 0));
    for (let k = 0; k < codes; ++k) {
      if (!used(c, k)) continue;
      pairs.push(bounds[c * codes + k], bounds[(clusters + c) * codes + k]);
      widths.push(width[c * codes + k]);
      if (k && !(plain && hours === 1)) rows.push(...directions(c, k - 1), ...Array((wide - outputs % wide) % wide).fill(0));
    }
  }
  while (widths.length % 4) widths.push(0);
  const index = 32 - Math.clz32(clusters - 1), places = [], numbers = new BitWords(), data = new BitWords();
  list.push(live, clusters, index, pairs.length / 2, ...first.map((at, c) => at | bits[c] << 16));
  let at = 0;
  for (let i = 0; i < Math.ceil(live / group) * group; ++i) {
    if (i % group === 0) places.push(at);
    const c = own[i] ?? 0;
    at += bits[c];
    numbers.put(c, index);
    for (let k = 0; k < codes && i < live; ++k) data.put(code[k * live + i], width[c * codes + k]);
  }
  const words = (values, Type) => new Uint32Array(Type.from(values).buffer);
  const stored = [
    list, words(pairs, Uint16Array), words(widths, Uint8Array), words(rows, hours === 1 ? Int8Array : Uint16Array),
    [...places, at], numbers.words, data.words,
  ];
  const whole = new Uint32Array(stored.reduce((sum, part) => sum + part.length, 0));
  stored.reduce((end, part) => { whole.set(part, end); return end + part.length; }, 0);
  return {probes: whole};
}
