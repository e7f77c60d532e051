// Makes the content of a page from a file of one lightmap of a mesh, as wlm/atlas/codec.py and stored.py do.

const SIDE_BITS = 4, FIRST_BLOCK_CODE = 12, NO_BLOCKS = 16;  // of an entry of the lookup texture, wlm/atlas/model.py
const ATLAS_TYPES = {colour: {half: Uint16Array, rgb9e5: Uint32Array, mixed: Uint32Array, bc6h: Uint8Array, astc: Uint8Array}};

function openAtlas({settings, parts}, {templates, defaults}, bytes) {
  const {method, colour, texels, block_texels: second = [0, 0], objects, uv_set: set} = settings;
  const profile = {...defaults.atlas, ...settings.profile}, [height, width] = settings.sizes[0];
  if (method === 'shared') {
    throw new Error(`expected a model of one lightmap, found ${settings.sheets.length * settings.states.length}`);
  }
  if (colour === 'astc') throw new Error('expected a colour texture of half, rgb9e5, bc6h or mixed, found astc');
  const read = (name, Type) => {
    if (!(name in parts)) return new Type(0);
    const shape = settings.parts[name], {bytes: stored} = parts[name];
    const count = shape?.reduce((product, side) => product * side, Type.BYTES_PER_ELEMENT);
    return numbersOf(shape ? unzstd(stored, count) : stored, Type);
  };
  const forms = {half: 'halves', rgb9e5: 'exponents', mixed: 'exponents', bc6h: 'hdrBlocks'}, [down, across] = texels;
  const arrays = {colour: read('colour', ATLAS_TYPES.colour[colour])};
  const blocksOf = ([rows, columns]) => 16 * Math.ceil(rows / 4) * Math.ceil(columns / 4);
  const expected = colour === 'half' ? 3 * down * across : colour === 'bc6h' ? blocksOf(texels) : down * across;
  if (arrays.colour.length !== expected) throw new Error('part colour: expected the texels of its size, found others');
  if (colour === 'mixed') {
    arrays.blocks = read('blocks', Uint8Array);
    if (arrays.blocks.length !== blocksOf(second)) throw new Error('part blocks: expected the blocks of its size, found others');
  }
  const lut = method === 'plain' ? [0, 0] : settings.parts.lut ?? parts.lut?.shape ?? [0, 0];
  if (method !== 'plain') arrays.lut = read('lut', Uint16Array);
  const code = {mixed: FIRST_BLOCK_CODE, bc6h: 0}[colour] ?? NO_BLOCKS;

  const primitives = readGlb(read('mesh', Uint8Array)), position = [], uv = [];
  for (const {node, scale_offset: [sx, sy, ox, oy] = [1, 1, 0, 0]} of objects) {
    for (const each of primitives.filter((one) => one.node === node && set in one.uv)) {
      for (const corner of each.triangles) {
        position.push(...each.position.subarray(3 * corner, 3 * corner + 3));
        uv.push(...[sx * each.uv[set][2 * corner] + ox, sy * each.uv[set][2 * corner + 1] + oy].map((x) => Math.min(Math.max(x, 0), 1)));
      }
    }
  }
  if (!position.length) throw new Error('part mesh: no triangle is lit by the lightmap');
  arrays.position = Float32Array.from(position);
  arrays.triangles = Uint32Array.from({length: position.length / 3}, (_, i) => i);
  arrays.uv = Float32Array.from(uv);
  const moved = read('uv', Uint16Array);
  if (moved.length) {
    if (moved.length !== uv.length) throw new Error('part uv: expected new UVs of each triangle of the mesh, found others');
    arrays.coordinate = Float32Array.from(moved, (x) => x / 65535);
  }
  const geometry = (parts.mesh.bytes.length + parts.mask.bytes.length), held = bytes - geometry;
  return {
    arrays,
    manifest: {
      kind: 'atlas', title: settings.name, note: 'A lightmap read through a table, on this GPU.', width, height,
      shader: atlasShader(templates.atlas, {method, colour, width, height, tile: profile.tile, code}),
      figures: [
        ...compareSizes(held, 6 * width * height, 'half floats', 'file without the mesh'),
        ['lightmap', `${width} × ${height} texels`], ['colour texture', `${across} × ${down}, ${colour}`], ['method', method],
        ['triangles', (position.length / 9).toLocaleString('en')], ['profile', profile.name],
      ],
      atlas: {
        method, colour: [across, down], blocks: [second[1], second[0]], lut: [lut[1], lut[0]], tile: profile.tile,
        size_bits: SIDE_BITS, block_side: 4, first_block_code: code, forms: {colour: forms[colour], blocks: 'hdrBlocks'},
      },
      ...boxOf(arrays.position, arrays.triangles),
    },
  };
}
