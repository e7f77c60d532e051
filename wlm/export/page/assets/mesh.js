// Reads the triangles of a .glb file (glTF 2.0), as wlm/formats/gltf.py does; and what is drawn of them.

const GLB_TYPES = {5120: Int8Array, 5121: Uint8Array, 5122: Int16Array, 5123: Uint16Array, 5125: Uint32Array, 5126: Float32Array};
const GLB_WIDTHS = {SCALAR: 1, VEC2: 2, VEC3: 3, VEC4: 4};

// For each primitive under each node of the scene: the node's number, positions in the scene's space, UV sets by number,
// and the corners of triangles.
function readGlb(bytes) {
  const words = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (bytes.length < 20 || words.getUint32(0, true) !== 0x46546C67) throw new Error('mesh: expected a .glb file');
  const length = words.getUint32(12, true), binary = bytes.subarray(28 + length);
  const tree = parseObject(new TextDecoder().decode(bytes.subarray(20, 20 + length)), 'mesh');
  const needed = (tree.extensionsRequired ?? []).filter((name) => !/^KHR_(materials_|texture_|mesh_quant)/.test(name));
  if (needed.length) throw new Error(`mesh: expected no extension ${needed.join(', ')}`);

  // Elements of a view, each of `width` components, as floats; integers of a normalised accessor are at most 1.
  const view = ({bufferView, byteOffset = 0}, count, Type, width, scale = 1) => {
    const {byteOffset: first = 0, byteStride, byteLength} = tree.bufferViews[bufferView];
    const size = Type.BYTES_PER_ELEMENT, stride = byteStride ?? size * width, values = new Float64Array(count * width);
    if (byteOffset + (count - 1) * stride + size * width > byteLength || first + byteLength > binary.length) {
      throw new Error('mesh: the file is damaged: an accessor lies outside of its data');
    }
    const read = {
      Int8Array: 'getInt8', Uint8Array: 'getUint8', Int16Array: 'getInt16', Uint16Array: 'getUint16',
      Uint32Array: 'getUint32', Float32Array: 'getFloat32',
    }[Type.name];
    const from = new DataView(binary.buffer, binary.byteOffset + first + byteOffset);
    for (let i = 0; i < count; ++i) {
      for (let k = 0; k < width; ++k) values[width * i + k] = Math.max(from[read](i * stride + k * size, true) / scale, scale > 1 ? -1 : -Infinity);
    }
    return values;
  };
  const accessor = (number) => {
    const item = tree.accessors[number], width = GLB_WIDTHS[item.type], Type = GLB_TYPES[item.componentType];
    if (!width || !Type) throw new Error(`mesh: accessors[${number}]: expected numbers or vectors`);
    const scale = item.normalized ? {Int8Array: 127, Uint8Array: 255, Int16Array: 32767, Uint16Array: 65535}[Type.name] : 1;
    const values = 'bufferView' in item ? view(item, item.count, Type, width, scale) : new Float64Array(item.count * width);
    if (item.sparse) {
      const {count, indices, values: held} = item.sparse, places = view(indices, count, GLB_TYPES[indices.componentType], 1);
      const changed = view(held, count, Type, width, scale);
      places.forEach((place, i) => values.set(changed.subarray(width * i, width * (i + 1)), width * place));
    }
    return values;
  };

  const found = [], scene = tree.scenes?.[tree.scene ?? 0];
  const below = new Set(tree.nodes.flatMap(({children = []}) => children));
  const roots = scene?.nodes ?? tree.nodes.map((_, i) => i).filter((i) => !below.has(i));
  const visit = (number, above, depth) => {
    const node = tree.nodes[number], matrix = multiply(above, localMatrix(node));
    if (depth > tree.nodes.length) throw new Error('mesh: a node is its own ancestor');
    for (const {attributes, indices, mode = 4} of tree.meshes?.[node.mesh]?.primitives ?? []) {
      if (mode < 4 || mode > 6 || !('POSITION' in attributes)) continue;
      const position = accessor(attributes.POSITION), count = position.length / 3;
      for (let i = 0; i < position.length; i += 3) {
        const [x, y, z] = position.subarray(i, i + 3);
        for (const k of [0, 1, 2]) position[i + k] = matrix[k] * x + matrix[4 + k] * y + matrix[8 + k] * z + matrix[12 + k];
      }
      const corners = indices === undefined ? Float64Array.from({length: count}, (_, i) => i) : accessor(indices);
      if (corners.some((corner) => corner >= count)) throw new Error('mesh: expected indices of vertices that exist');
      const at = mode === 4 ? (i, k) => 3 * i + k : mode === 5 ? (i, k) => i + (i % 2 ? [0, 2, 1][k] : k) : (i, k) => k && i + k;
      const triangles = new Uint32Array(3 * Math.max(mode === 4 ? Math.floor(corners.length / 3) : corners.length - 2, 0));
      // A node that mirrors turns the winding round.
      const [a, b, c] = [0, 4, 8].map((column) => matrix.slice(column, column + 3)), mirrored = dot(a, cross(b, c)) < 0;
      for (let i = 0; i < triangles.length / 3; ++i) {
        for (const k of [0, 1, 2]) triangles[3 * i + (mirrored ? [0, 2, 1][k] : k)] = corners[at(i, k)];
      }
      const uv = {};
      for (const [name, own] of Object.entries(attributes)) {
        const set = /^TEXCOORD_(\d+)$/.exec(name)?.[1];
        if (set !== undefined) uv[set] = accessor(own);
      }
      found.push({node: number, position, uv, triangles});
    }
    for (const child of node.children ?? []) visit(child, matrix, depth + 1);
  };
  for (const root of roots) visit(root, [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], 0);
  return found;
}

function multiply(a, b) {
  return Array.from({length: 16}, (_, i) => {
    const row = i % 4, column = i - row;
    return [0, 1, 2, 3].reduce((sum, k) => sum + a[4 * k + row] * b[column + k], 0);
  });
}

function localMatrix({matrix, translation = [0, 0, 0], rotation: [x, y, z, w] = [0, 0, 0, 1], scale = [1, 1, 1]}) {
  if (matrix) return matrix;
  const columns = [
    [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)],
    [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)],
    [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)],
  ];
  return [...columns.flatMap((column, k) => [...column.map((v) => v * scale[k]), 0]), ...translation, 1];
}

// The arrays that a page draws, and the entries of its manifest, of primitives with the lightmap's UVs: of set 1 if any
// has it, else 0; `uv` false: without.
function packTriangles(primitives, uv = true) {
  const set = primitives.some((each) => 1 in each.uv) ? 1 : 0, used = primitives.filter((each) => !uv || set in each.uv);
  const join = (lists, Type) => {
    const joined = new Type(lists.reduce((total, list) => total + list.length, 0));
    lists.reduce((at, list) => { joined.set(list, at); return at + list.length; }, 0);
    return joined;
  };
  let first = 0;
  const triangles = join(used.map((each) => {
    const moved = each.triangles.map((corner) => corner + first);
    first += each.position.length / 3;
    return moved;
  }), Uint32Array);
  if (!triangles.length) throw new Error(`mesh: expected triangles${uv ? ' with lightmap UVs' : ''}, found none`);
  const position = join(used.map((each) => each.position), Float32Array);
  const arrays = {position, triangles, ...uv && {uv: join(used.map((each) => each.uv[set]), Float32Array)}};
  return {arrays, box: boxOf(position, triangles)};
}

// Corners of the bounding box of triangles, and whether most of them face its middle, as the walls of a room do: the
// volume that they enclose, a sum of signed tetrahedra, is then negative.
function boxOf(position, triangles) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (const corner of triangles) {
    for (const k of [0, 1, 2]) {
      low[k] = Math.min(low[k], position[3 * corner + k]);
      high[k] = Math.max(high[k], position[3 * corner + k]);
    }
  }
  let volume = 0;
  const place = (corner) => [0, 1, 2].map((k) => (position[3 * corner + k] - low[k]) / (high[k] - low[k]) - 0.5);
  for (let i = 0; i < triangles.length; i += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => place(triangles[i + k]));
    volume += dot(a, cross(b, c)) / 6;
  }
  return {low, high, up: 1, inward: volume < -0.25};
}
