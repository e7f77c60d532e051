// Makes the shaders of files as Python does (wlm/lightmap/shader.py, wlm/atlas/shader.py, wlm/probe/*/shader.py), from the
// same templates, whose marks @name@ are replaced.

const filled = (template, words) => template.replace(/@(\w+)@/g, (_, name) => {
  if (!(name in words)) throw new Error(`the viewer lacks the word ${name} of a shader`);
  return words[name];
});
// A number as GLSL needs it, with a point or an exponent.
const decimal = (value) => Number.isInteger(value) ? value.toFixed(1) : String(value);
const declared = (name, kind) => `uniform ${kind} ${name};\n#define ${name.toUpperCase()} ${name}\n`;
// How many images to put in a row so that a texture of `count` images is about as wide as high.
const acrossOf = (count, height, width) => Math.max(Math.ceil(Math.sqrt(count * height / width)), 1);

const LIGHTMAP_UNITS = {
  biases: (j) => `    b[${j}] = wlm_lightmap_four(third - WLM_LIGHTMAP_FOURS + ${j});\n`,
  products: (j) => `        b[${j}] = wlm_lightmap_add(b[${j}], a, w + ${j}, WLM_LIGHTMAP_FOURS);\n`,
  outputs: (j) => `    y = wlm_lightmap_add(y, wlm_gelu(b[${j}]), third + ${4 * j}, 1);\n`,
};

// The shader of a sheet with the given settings and numbers of tiles, `dynamic` and `framed`; `values` are what the levels
// 0 and 1 stand for if the sheet is no light.
function lightmapShader(templates, profile, {width, height, columns, dynamic, framed, values}) {
  const side = profile.uvt_resolution, slices = profile.uvt_slices, {plane_columns, plane_rows} = profile;
  const across = {
    uv: acrossOf(dynamic, TILE, TILE), uvt: acrossOf(dynamic * slices, side, side),
    planes: acrossOf(2 * dynamic, plane_rows, plane_columns), frames: acrossOf(framed, TILE, TILE),
  };
  const fours = Math.ceil(profile.hidden / 4), reach = 2, kind = values ? 'value' : 'radiance', [least, most] = values ?? [0, 1];
  const vector = (value) => `vec3(${Array(3).fill(decimal(value)).join(', ')})`;
  const words = {
    TILE, width, height, columns, record: recordFours(profile), head: 2, fours, hidden: profile.hidden, side, slices,
    plane_columns, plane_rows, uv_columns: across.uv, uvt_columns: across.uvt, plane_across: across.planes,
    frames_columns: across.frames, uvt_width: across.uvt * side, uvt_height: Math.ceil(dynamic * slices / across.uvt) * side,
    planes_width: across.planes * plane_columns, planes_height: Math.ceil(2 * dynamic / across.planes) * plane_rows,
    reach, beyond: 2 * reach * reach + 1, gamma: vector(profile.gamma), inverse: vector(1 / profile.gamma), kind,
    least: decimal(least), span: decimal(most - least),
  };
  const part = (name, more = {}) => filled(templates[`${name}.glsl`], {...words, ...more});
  const maps = dynamic ? part('maps') : '';
  const textures = {hour: true, networks: dynamic, uv: dynamic, uvt: dynamic, planes: dynamic, frames: framed, valid: true};
  const held = Object.keys(textures).filter((name) => textures[name]);
  const reads = [['WLM_LIGHTMAP_HOUR_AT', 'wlm_lightmap_entry', 'hour'], ['WLM_LIGHTMAP_NET', 'wlm_lightmap_four', 'networks']];
  const entries = reads.filter(([, , name]) => held.includes(name)).map(([macro, function_, name]) =>
    part('entry', {macro, function: function_, texture: `WLM_LIGHTMAP_${name.toUpperCase()}`}));
  const samplers = held.map((name) => declared(`wlm_lightmap_${name}`, name === 'frames' ? 'sampler2DArray' : 'sampler2D'));
  let text = part('head', {use: '', textures: '', samplers: samplers.join(''), reads: entries.join('')}) + maps;
  if (dynamic) {
    const units = Object.fromEntries(Object.entries(LIGHTMAP_UNITS).map(([name, line]) =>
      [name, Array.from({length: fours}, (_, j) => line(j)).join('')]));
    text += part('network', {...units, gelu: templates[`gelu_${profile.gelu}.glsl`]});
  }
  text += (framed ? part('frames') : '') + part('unmapped', {frames: framed ? part('frames_kind') : ''});
  text += part('colour', {kinds: dynamic ? part('mapped_kind') : ''}) + part('source');
  return text + part(`linear_${kind}`) + part('last');
}

// The shader of one lightmap: `model` has its method, its format, its size, the texels along a tile and the smallest size
// code that names blocks.
function atlasShader(templates, {method, colour, width, height, tile, code}) {
  const mixed = colour === 'mixed', tiles = method === 'tiles', cascade = method === 'cascade';
  const words = {width, height, tile, bits: SIDE_BITS, mask: (1 << SIDE_BITS) - 1, code, side: 4, last: 3};
  const part = (name, more = {}) => filled(templates[`${name}.glsl`], {...words, ...more});
  const samplers = {colour: 'sampler2D', ...mixed && {blocks: 'sampler2D'}};
  if (method !== 'plain') samplers.lut = tiles ? 'usampler2D' : 'sampler2D';
  let text = Object.entries(samplers).map(([name, kind]) => declared(`wlm_atlas_${name}`, kind)).join('');
  for (const [name, kind] of Object.entries(samplers)) {
    if (kind !== 'sampler2D') continue;
    const [type, channels] = name === 'lut' ? ['vec2', 'xy'] : ['vec3', 'rgb'];
    text += part('read', {type, name, image: `WLM_ATLAS_${name.toUpperCase()}`, channels});
  }
  if (!tiles) return text + part(cascade ? 'cascade' : 'plain');
  return text + part('tiles', {blocks: mixed ? part('blocks') : code ? '' : part('whole_blocks')});
}

const probeHarmonics = (argument, call, coefficients) => `
void wlm_probe_sh(${argument}, out vec3 sh[${coefficients}])
{
    float values[WLM_PROBE_OUTPUTS];
    ${call};
    for (int c = 0; c < ${coefficients}; ++c)
        sh[c] = vec3(values[3 * c], values[3 * c + 1], values[3 * c + 2]);
}
`;
const AMBIENT = '\n    for (int i = 0; i < 3; ++i)\n        values[i] = max(values[i], 0.0);';

function gaussianShader(templates, {latent, hidden, outputs, relative, support}) {
  const channels = 10 + latent, inputs = Math.ceil((latent + 3) / 4), sphere = support === 'sphere';
  const reached = sphere ? 'dot(d, d) < cut * cut * longest * longest' : 'dot(u, u) < cut * cut';
  const text = filled(templates['gaussians.glsl'], {
    buffers: '', latent, hidden, outputs, columns: outputs + relative, form: '', reach: '', clamp: AMBIENT, channels,
    magnitude: relative ? filled(templates['magnitude.glsl'], {place: outputs % 4}) : '', head: 10, first: 10 + 2 * channels,
    words: channels + 1 >> 1, input_fours: inputs, hidden_fours: hidden / 4, most_fours: Math.max(inputs, hidden / 4),
    longest: sphere ? '\n    float longest = max(s.x, max(s.y, s.z));' : '', reached,
  });
  return text + probeHarmonics('vec3 position', 'wlm_probe_values(wlm_probe_place(position), values)', outputs / 3);
}

// `kind` is the type of the directions, int8 or float16; '' for unit vectors.
function componentShader(templates, {outputs, kind, group}) {
  const perWord = {int8: 4, float16: 2}[kind] ?? 1, words = kind ? Math.ceil(outputs / perWord) : 0;
  const number = kind === 'int8' ? 'float(int(word << uint(24 - d % 4 * 8)) >> 24)'
    : '(d % 2 == 0 ? unpackHalf2x16(word).x : unpackHalf2x16(word).y)';
  const basis = () => filled(templates['basis.glsl'], {words, per_word: perWord, unit: kind === 'int8' ? ' / 127.0' : '', number});
  const text = filled(templates['components.glsl'], {
    buffers: '', outputs, words, group, group_words: group / 32, directions: '', clamp: AMBIENT,
    body: kind ? basis() : templates['unit.glsl'],
  });
  return text + probeHarmonics('int probe', 'wlm_probe_values(probe, values)', outputs / 3);
}
