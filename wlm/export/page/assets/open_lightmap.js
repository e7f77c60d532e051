// Makes the content of a page from a file of lightmaps, as wlm/lightmap/codec.py, encodings and bundle.py do together: the
// light groups of its first sheet of light.

const TILE = 128, LIGHTMAP_KINDS = {empty: 0, constant: 1, dynamic: 3, frames: 4};
const INPUTS = 16, MAP_INPUTS = 12;  // of a network, and those of them that come from the maps
const SCALE_SPAN = [-21, 16];  // of codes, as log2 of radiance
const VALUE_RANGES = {unit: [0, 1], signed: [-1, 1]};
const recordFours = (profile) => 3 + Math.max(Math.ceil(profile.hidden / 4), 2);

// Settings of the fit of a sheet: sizes along time follow the number of times, and values that are no light have no gamma.
function sheetProfile(profile, times, encoding) {
  const made = {...profile};
  if (profile.follow_times || times === 1) {
    const even = (x) => Math.round(x) - (x % 1 === 0.5 && Math.round(x) % 2 ? 1 : 0);
    for (const name of ['uvt_slices', 'plane_rows']) {
      made[name] = Math.min(times, 64, Math.max(profile[name], even(profile[name] * times / 26)));
    }
  }
  if (encoding !== 'radiance') made.gamma = 1;
  return made;
}

// Arranges images of `rows` rows of bytes side by side in several rows of one texture.
function sideBySide(images, rows, height, width) {
  const across = acrossOf(images.length, height, width), down = Math.ceil(images.length / across);
  const bytes = images[0].length / rows, data = new Uint8Array(down * across * rows * bytes);
  images.forEach((image, i) => {
    for (let row = 0; row < rows; ++row) {
      const to = ((Math.floor(i / across) * rows + row) * across + i % across) * bytes;
      data.set(image.subarray(row * bytes, (row + 1) * bytes), to);
    }
  });
  return {data, size: [across * width, down * height], across};
}

// The numbers of a network of a tile: half floats, or weights of 8 bits with a largest magnitude for each unit.
function unpackNetwork(bytes, hidden, bits) {
  if (bits === 16) return halves(numbersOf(bytes, Uint16Array));
  const shapes = [[INPUTS, hidden], [hidden, hidden], [hidden, 3]], count = shapes.reduce((sum, [a, b]) => sum + a * b, 0);
  const whole = numbersOf(bytes.subarray(0, count), Int8Array), rest = halves(numbersOf(bytes.subarray(count), Uint16Array));
  const numbers = [];
  let at = 0, place = 0;
  for (const [rows, units] of shapes) {
    for (let i = 0; i < rows * units; ++i) {
      numbers.push(fromHalf(toHalf(Math.fround(whole[at + i] * Math.fround(rest[place + i % units] / 127)))));
    }
    for (let i = 0; i < units; ++i) numbers.push(rest[place + units + i]);
    at += rows * units;
    place += 2 * units;
  }
  return numbers;
}

// A network as the shader reads it: rows of fours, with the centring of the maps in the first layer.
function shaderNetwork(net, hidden) {
  const wide = 4 * Math.ceil(hidden / 4), root = Math.sqrt(12), rows = [];
  for (let i = 0; i < INPUTS + hidden + 2; ++i) rows.push(Array.from(net.slice(i * hidden, (i + 1) * hidden)));
  for (let k = 0; k < hidden; ++k) {
    let sum = 0;
    for (let i = 0; i < MAP_INPUTS; ++i) sum += rows[i][k] *= root;
    rows[INPUTS][k] -= 0.5 * sum;
  }
  const output = Array.from({length: hidden + 1}, (_, i) => Array.from(net.slice((INPUTS + hidden + 2) * hidden + 3 * i).slice(0, 3)));
  for (let i = hidden; i < wide; ++i) {
    rows.splice(-1, 0, Array(hidden).fill(0));
    output.splice(-1, 0, [0, 0, 0]);
  }
  const filledUp = (row, width) => [...row, ...Array(width - row.length).fill(0)];
  return [...rows.flatMap((row) => filledUp(row, wide)), ...output.flatMap((row) => filledUp(row, 4))];
}

// Positions of stored times on the time axis, as `TimeAxis` in wlm/lightmap/profile.py.
function timeAxis(times, period, {time_axis: rule}) {
  const repeats = period !== null && rule === 'frames' && times.length > 1, count = times.length;
  const first = period === null ? times[0] : 0, span = period ?? Math.max(times.at(-1) - times[0], 1e-12);
  const place = (time, i) => rule === 'paper' ? ((period === null ? time : time % period) - first) / span : (i + 0.5) / count;
  return {axis: {rule, repeats, turn: (repeats ? 2 : 1) * Math.PI}, tau: Array.from(times, (time, i) => Math.fround(place(time, i)))};
}

// The description and the arrays of one light group, sheet `number` of the file.
function openGroup(artifact, number, times, profile, templates) {
  const {settings: {sheets, period}, parts, pieces} = artifact, {size: [width, height], encoding, group = 'base'} = sheets[number];
  const columns = Math.ceil(width / TILE), count = columns * Math.ceil(height / TILE), T = times.length;
  const part = (name, type, many) => partNumbers(parts, `${number}.${name}`, [type].flat(), many);
  const kind = part('kind', 'U8', count), of = (...kinds) => Array.from(kind.keys()).filter((i) => kinds.includes(kind[i]));
  if (kind.some((each) => each === 2 || each > 4)) throw new Error(`part ${number}.kind: expected the kinds of tiles 0, 1, 3 and 4`);
  const dynamic = of(3), framed = of(4), constant = of(1), packed = of(3, 4);
  const own = pieces[`${number}.tiles`] ?? [];
  if (own.length !== packed.length) throw new Error(`part ${number}.tiles: expected ${packed.length} pieces, found ${own.length}`);
  const {hidden, uvt_resolution: side, uvt_slices: slices, plane_rows: rows, plane_columns: across, net_bits: bits, gamma} = profile;
  const parameters = bits === 16 ? 2 * ((INPUTS + hidden + 2) * hidden + 3 * (hidden + 1))
    : (INPUTS + hidden + 3) * hidden + 4 * (2 * hidden + 3);
  const plane = 2 * rows * across, volume = slices * side * side;
  const tiles = new Map(packed.map((tile, i) => {
    const data = unzstd(own[i], kind[tile] === 4 ? TILE * TILE * T : TILE * TILE + volume + 2 * plane + parameters);
    if (kind[tile] === 4) return [tile, {frames: data}];
    let at = 0;
    const take = (size) => data.subarray(at, at += size);
    const maps = {uv: take(TILE * TILE), uvt: take(volume), ut: take(plane), vt: take(plane)};
    return [tile, {...maps, net: shaderNetwork(unpackNetwork(data.subarray(at), hidden, bits), hidden)}];
  }));
  const textures = {}, arrays = {}, images = {};
  const put = (name, made, sizes, layers = 0) => {
    arrays[`${number}_${name}`] = made.data;
    textures[name] = {size: made.size, layers};
    images[name] = {size: sizes, across: made.across};
  };
  const each = (name) => dynamic.map((tile) => tiles.get(tile)[name]);
  if (dynamic.length) {
    put('uv', sideBySide(each('uv'), TILE / 4, TILE, TILE), [TILE, TILE]);
    const sheet = each('uvt').flatMap((map) => Array.from({length: slices}, (_, i) => map.subarray(side * side * i, side * side * (i + 1))));
    put('uvt', sideBySide(sheet, side / 4, side, side), [side, side]);
    const pairs = dynamic.flatMap((tile) => [tiles.get(tile).ut, tiles.get(tile).vt]);
    put('planes', sideBySide(pairs, rows, rows, across), [across, rows]);
  }
  if (framed.length) {
    const layer = (time) => sideBySide(framed.map((tile) => tiles.get(tile).frames.subarray(TILE * TILE * time, TILE * TILE * (time + 1))), TILE / 4, TILE, TILE);
    const layers = Array.from({length: T}, (_, time) => layer(time)), all = new Uint8Array(T * layers[0].data.length);
    layers.forEach(({data}, time) => all.set(data, time * data.length));
    put('frames', {...layers[0], data: all}, [TILE, TILE], T);
  }
  const networks = each('net');
  arrays[`${number}_networks`] = Float32Array.from(networks.flat());

  // What the table of an hour needs of each tile.
  const threes = (values, row, amount = T) => Array.from({length: amount}, (_, i) => Array.from(values.slice(3 * (row * amount + i), 3 * (row * amount + i) + 3)));
  const [low, high] = SCALE_SPAN.map((bound) => bound / gamma);
  const scale = part('scale', 'U8', dynamic.length * T * 3), decoded = Array.from(scale, (code) => code ? Math.fround(2 ** (low + (code - 1) * (high - low) / 254)) : 0);
  const affine = halves(part('affine', 'F16', dynamic.length * 6));
  const ranges = halves(part('ranges', 'F16', framed.length * T * 6));
  const colours = part('constant', ['F16', 'F32'], constant.length * T * 3), steady = colours instanceof Uint16Array ? halves(colours) : colours;
  const described = packed.concat(constant).map((tile) => {
    const name = Object.keys(LIGHTMAP_KINDS).find((each) => LIGHTMAP_KINDS[each] === kind[tile]);
    const at = {number: tile, kind: name, column: tile % columns, row: Math.floor(tile / columns)};
    if (kind[tile] === 1) return {...at, radiance: threes(steady, constant.indexOf(tile))};
    if (kind[tile] === 4) {
      const pairs = threes(ranges, framed.indexOf(tile), 2 * T);
      return {...at, image: framed.indexOf(tile), least: pairs.filter((_, i) => i % 2 === 0), greatest: pairs.filter((_, i) => i % 2)};
    }
    const image = dynamic.indexOf(tile), [shift, spread] = threes(affine, image, 2);
    return {...at, image, shift, spread, scale: threes(decoded, image), network_four: image * networks[0].length / 4};
  });
  const values = VALUE_RANGES[encoding], {axis, tau} = timeAxis(times, period, profile);
  const shape = {width, height, columns, dynamic: dynamic.length, framed: framed.length, values};
  const lightmap = {
    times: Array.from(times), period, interpolation: profile.interpolation, time_axis: axis, tau, tiles: described, images,
    slices, record: recordFours(profile), tile_columns: columns, tile_size: TILE, hidden, gamma, height, textures,
  };
  return {group: {name: group, shader: lightmapShader(templates, profile, shape), lightmap}, arrays, kind};
}

function openLightmap(artifact, {templates, defaults}, bytes) {
  const {settings, parts} = artifact, {sheets, period} = settings, profile = {...defaults.lightmap, ...settings.profile};
  const first = Math.max(sheets.findIndex(({encoding}) => encoding === 'radiance'), 0), chosen = sheets[first];
  const same = (a, b) => a.atlas === b.atlas && a.layer === b.layer && a.encoding === b.encoding && a.channels.join() === b.channels.join();
  const numbers = sheets.keys().filter((i) => same(sheets[i], chosen)).toArray(), [width, height] = chosen.size;
  const stamps = (number) => {
    // Times are stored with the first sheet of a group.
    const owner = sheets.findIndex(({group}) => group === sheets[number].group), name = owner ? `${owner}.times` : 'times';
    return partNumbers(parts, name, ['F64'], parts[name]?.shape[0] ?? 1);
  };
  const opened = numbers.map((number) => openGroup(artifact, number, stamps(number), sheetProfile(profile, stamps(number).length, chosen.encoding), templates.lightmap));
  const groups = opened.map(({group}) => group), arrays = {};
  opened.forEach((each, i) => {
    for (const [name, values] of Object.entries(each.arrays)) arrays[name.replace(/^\d+/, i)] = values;
  });
  const masked = sheets.findIndex((each) => each.atlas === chosen.atlas && each.size.join() === chosen.size.join());
  const mask = parts[`${masked}.mask`], size = Math.ceil(width * height / 8);
  arrays.valid = mask ? unzstd(mask.bytes, size) : new Uint8Array(size).fill(255);
  arrays.valid[size - 1] &= 255 << 8 * size - width * height;
  const changing = groups.map(({lightmap}) => lightmap.times).filter((list) => list.length > 1);
  const times = changing.length ? [...new Set(changing.flat())].sort((a, b) => a - b) : groups[0].lightmap.times;
  const tiles = Object.entries(LIGHTMAP_KINDS).map(([name, i]) => [name, opened.reduce((sum, {kind}) => sum + kind.filter((each) => each === i).length, 0)]);
  const figures = [
    ...compareSizes(bytes, sheets.reduce((sum, each, i) => sum + 6 * each.size[0] * each.size[1] * stamps(i).length, 0)),
    ['bits per texel and hour', (bytes * 8 / (width * height * times.length)).toFixed(3)],
    ['lightmaps', `${width} × ${height}, ${times.length} ${times.length === 1 ? 'hour' : 'hours'}`],
    ['tiles', tiles.filter(([, many]) => many).map(([name, many]) => `${many} ${name}`).join(', ')],
    ['profile', profile.name],
  ];
  if (groups.length > 1) figures.push(['light groups', String(groups.length)]);
  const rest = sheets.length - numbers.length, others = rest ? `, without the file's ${rest} other sheet${rest === 1 ? '' : 's'}` : '';
  const note = `Lightmaps over time, decoded on this GPU${others}.`;
  return {
    manifest: {kind: 'lightmap', title: settings.name, note, figures, width, height, period, times, time: times[times.length >> 1], groups},
    arrays,
  };
}
