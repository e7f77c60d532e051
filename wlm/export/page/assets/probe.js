// Light probes as spheres, and a mesh lit by the light at its vertices. All light is decoded by the exported shader.

const WIDTH = 256;  // places a row of the table of coefficients
const ROW = 32;     // places that are decoded before the browser is asked whether it has time

// Arrays that the exported shaders read: two for Gaussians, two for principal components.
const BUFFERS = ['gaussians', 'network', 'probes', 'own'];
const declare = (name) => `
uniform highp usampler2D u_${name};
#define WLM_PROBE_${name.toUpperCase()}(i) texelFetch(u_${name}, ivec2((i) & 1023, (i) >> 10), 0).r
`;
// The 27 numbers of a place are stored as half floats, two in a word: WebGL 2 promises only four targets.
const STORE = `
uniform sampler2D u_places;
layout(location = 0) out uvec4 out_0;
layout(location = 1) out uvec4 out_1;
layout(location = 2) out uvec4 out_2;
layout(location = 3) out uvec4 out_3;
void main()
{
    vec3 sh[COUNT];
    wlm_probe_sh(texelFetch(u_places, ivec2(gl_FragCoord.xy), 0).xyz, sh);
    float numbers[32];
    for (int i = 0; i < 32; ++i)
        numbers[i] = i < min(3 * COUNT, 27) ? clamp(sh[min(i / 3, COUNT - 1)][i % 3], -65504.0, 65504.0) : 0.0;
    uint words[16];
    for (int i = 0; i < 16; ++i)
        words[i] = packHalf2x16(vec2(numbers[2 * i], numbers[2 * i + 1]));
    out_0 = uvec4(words[0], words[1], words[2], words[3]);
    out_1 = uvec4(words[4], words[5], words[6], words[7]);
    out_2 = uvec4(words[8], words[9], words[10], words[11]);
    out_3 = uvec4(words[12], words[13], words[14], words[15]);
}`;
const TABLES = 4;

const LIT = `${HEAD}
in vec3 a_position;
in vec3 a_normal;
uniform mat4 u_camera;
uniform sampler2D u_centres, u_original;
uniform highp usampler2D u_table_0, u_table_1, u_table_2, u_table_3;
uniform int u_view;      // 0: the original is not seen
uniform float u_radius;  // of spheres; 0: the vertices are a mesh's own
out vec3 v_decoded;
out vec3 v_original;
int wlm_row;
${DIFFUSE}
void main()
{
    int row = u_radius > 0.0 ? gl_InstanceID : gl_VertexID;
    ivec2 at = ivec2(row % ${WIDTH}, row / ${WIDTH});
    uvec4 tables[4] = uvec4[4](texelFetch(u_table_0, at, 0), texelFetch(u_table_1, at, 0),
                               texelFetch(u_table_2, at, 0), texelFetch(u_table_3, at, 0));
    vec3 c[9];
    for (int i = 0; i < 27; ++i)
        c[i / 3][i % 3] = unpackHalf2x16(tables[i / 8][(i / 2) % 4])[i % 2];
    v_decoded = wlm_diffuse(a_normal, c);
    for (int i = 0; i < 9 && u_view > 0; ++i)
        c[i] = texelFetch(u_original, ivec2((9 * row + i) & 1023, (9 * row + i) >> 10), 0).rgb;
    v_original = wlm_diffuse(a_normal, c);
    vec3 centre = u_radius > 0.0 ? texelFetch(u_centres, at, 0).xyz : vec3(0.0);
    gl_Position = u_camera * vec4(centre + (u_radius > 0.0 ? u_radius : 1.0) * a_position, 1.0);
}`;

// Makes a unit sphere of rows of triangles.
function sphere(rows) {
  const points = [], indices = [], columns = 2 * rows;
  for (let r = 0; r <= rows; ++r) {
    for (let c = 0; c <= columns; ++c) {
      const [a, b] = [Math.PI * r / rows, Math.PI * c / rows];
      points.push(Math.sin(a) * Math.cos(b), Math.cos(a), Math.sin(a) * Math.sin(b));
      if (r === rows || c === columns) continue;
      const at = r * (columns + 1) + c;
      indices.push(at, at + columns + 1, at + 1, at + 1, at + columns + 1, at + columns + 2);
    }
  }
  return [new Float32Array(points), new Uint32Array(indices)];
}

// Area-weighted vertex normals of a mesh.
function normals(position, triangles) {
  const sums = new Float32Array(position.length);
  const at = (i) => [position[3 * i], position[3 * i + 1], position[3 * i + 2]];
  for (let i = 0; i < triangles.length; i += 3) {
    const corners = [triangles[i], triangles[i + 1], triangles[i + 2]], [a, b, c] = corners.map(at);
    const normal = cross([0, 1, 2].map((k) => b[k] - a[k]), [0, 1, 2].map((k) => c[k] - a[k]));
    for (const corner of corners) for (const k of [0, 1, 2]) sums[3 * corner + k] += normal[k];
  }
  for (let i = 0; i < sums.length; i += 3) {
    const length = Math.hypot(sums[i], sums[i + 1], sums[i + 2]) || 1;
    for (const k of [0, 1, 2]) sums[i + k] /= length;
  }
  return sums;
}

function fromHalf(bits) {
  const sign = bits & 0x8000 ? -1 : 1, exponent = bits >> 10 & 31, fraction = bits & 1023;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : fraction * 2 ** -24);
}

class ProbePage {
  constructor(graphics, page, panel, changed) {
    const {manifest} = page, {gl} = graphics;
    Object.assign(this, {graphics, manifest, panel});
    const held = BUFFERS.filter(page.has), store = STORE.replaceAll('COUNT', String(manifest.probe.coefficients));
    this.buffers = Object.fromEntries(held.map((name) =>
      [`u_${name}`, graphics.numbers(page.array(name, Uint32Array))]));
    this.decoder = graphics.program(WHOLE, HEAD + held.map(declare).join('') + manifest.shader + store);
    this.drawer = graphics.program(LIT, `${HEAD}
in vec3 v_decoded;
in vec3 v_original;
out vec4 colour;
${DISPLAY}
void main() { colour = vec4(wlm_shown(v_decoded, v_original), 1.0); }`);
    this.ball = 1;
    panel.slider('ball size', {
      min: 0.1, max: 2, step: 0.05, value: 1, text: (value) => `${value.toFixed(2)}×`,
      changed: (value) => { this.ball = value; changed(); },
    });
    this.display = new Display(page, panel, changed);
    this.camera = new Camera(graphics.canvas, manifest.low, manifest.high, {up: manifest.up, changed});
    explainCamera(panel, 'turn the camera', () => this.camera.reset());
    const [points, indices] = sphere(manifest.probe.count > 512 ? 8 : 16);
    this.groups = [{
      places: this.#places(page.array('places', Float32Array)),
      geometry: graphics.geometry(this.drawer, {a_position: [3, points], a_normal: [3, points]}, indices),
      radius: manifest.probe.radius,
      instances: manifest.probe.count,
      original: page.has('original') ? this.#originals(page.array('original', Uint16Array)) : graphics.black,
    }];
    if (page.has('position')) {
      const position = page.array('position', Float32Array), triangles = page.array('triangles', Uint32Array);
      const attributes = {a_position: [3, position], a_normal: [3, normals(position, triangles)]};
      this.groups.push({
        places: this.#places(position), geometry: graphics.geometry(this.drawer, attributes, triangles), radius: 0,
        instances: 1, original: graphics.black,
      });
      this.hidden = 0;
      if (manifest.inward) {
        this.oneSided = true;
        panel.toggle('walls from outside', 'b', false, (seen) => { this.oneSided = !seen; changed(); });
      }
      panel.choices('show', ['spheres', 'mesh', 'both'], 'both', (name) => {
        this.hidden = {both: 0, spheres: 2, mesh: 1}[name];
        changed();
      });
    }
  }

  // A texture of the positions to decode at, and the table of the coefficients there.
  #places(values) {
    const {graphics} = this, {gl} = graphics, count = values.length / 3, rows = Math.max(Math.ceil(count / WIDTH), 1);
    const texels = new Float32Array(WIDTH * rows * 4);
    for (let i = 0; i < count; ++i) texels.set(values.subarray(3 * i, 3 * i + 3), 4 * i);
    const words = [gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT];
    const tables = Array.from({length: TABLES}, () => graphics.plain(WIDTH, rows, words, null, gl.NEAREST));
    const buffer = gl.createFramebuffer(), targets = tables.map((_, i) => gl.COLOR_ATTACHMENT0 + i);
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    tables.forEach(({texture}, i) => gl.framebufferTexture2D(gl.FRAMEBUFFER, targets[i], gl.TEXTURE_2D, texture, 0));
    gl.drawBuffers(targets);
    return {texture: graphics.plain(WIDTH, rows, graphics.single(), texels, gl.NEAREST), count, tables, buffer, done: 0};
  }

  #originals(values) {
    const {graphics} = this, {gl} = graphics, rows = Math.ceil(values.length / 3072);
    const padded = new Uint16Array(3072 * rows);
    padded.set(values);
    return graphics.plain(1024, rows, [gl.RGB16F, gl.RGB, gl.HALF_FLOAT], padded, gl.NEAREST);
  }

  // Decodes some positions; returns whether there were any.
  work(elapsed) {
    const {graphics} = this, {gl} = graphics;
    const places = this.groups.map((group) => group.places).find((each) => each.done < each.count);
    if (!places) return false;
    // At least half of the time, regardless of the drawing time; the first picture comes soon.
    const until = performance.now() + (this.began ? Math.max(30, elapsed) : 30);
    this.began ??= performance.now();
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.SCISSOR_TEST);
    while (places.done < places.count && performance.now() < until) {
      const column = places.done % WIDTH, row = Math.floor(places.done / WIDTH);
      const many = Math.min(ROW, WIDTH - column, places.count - places.done);
      gl.bindFramebuffer(gl.FRAMEBUFFER, places.buffer);
      gl.viewport(0, 0, places.texture.width, places.texture.height);
      gl.scissor(column, row, many, 1);
      graphics.use(this.decoder, {...this.buffers, u_places: places.texture});
      graphics.draw(3);
      places.done += many;
      // Waits, so that the clock measures finished work.
      gl.readBuffer(gl.COLOR_ATTACHMENT0);
      gl.readPixels(column, row, 1, 1, gl.RGBA_INTEGER, gl.UNSIGNED_INT, new Uint32Array(4));
    }
    gl.disable(gl.SCISSOR_TEST);
    const left = this.groups.some((group) => group.places.done < group.places.count);
    const [done, all] = ['done', 'count'].map((key) => this.groups.reduce((sum, {places}) => sum + places[key], 0));
    const share = `${Math.floor(100 * done / all)}%`, spent = `${(performance.now() - this.began).toFixed(0)} ms`;
    this.panel.figure('decoded in', left ? `${share} so far` : spent);
    return true;
  }

  draw() {
    const {graphics} = this, {width} = graphics.begin();
    for (const [i, group] of this.groups.entries()) {
      if (this.hidden === i + 1) continue;
      const tables = Object.fromEntries(group.places.tables.map((table, c) => [`u_table_${c}`, table]));
      graphics.use(this.drawer, {
        ...tables, ...this.display.uniforms(width), u_camera: this.camera.matrix(), u_radius: this.ball * group.radius,
        u_centres: group.places.texture, u_original: group.original,
      });
      graphics.drawGeometry(group.geometry, group.instances, this.oneSided && group.radius === 0);
    }
  }

  // Light of the balls from 32 sides, for the exposure.
  async brightness() {
    const numbers = await this.read(), count = this.groups[0].places.count, light = new Float32Array(96 * count);
    for (let side = 0; side < 32; ++side) {
      const z = 1 - (2 * side + 1) / 32, turn = side * Math.PI * (3 - Math.sqrt(5)), r = Math.sqrt(1 - z * z);
      const [x, y] = [r * Math.cos(turn), r * Math.sin(turn)];
      const weights = [
        0.2820948, 0.325735 * y, 0.325735 * z, 0.325735 * x, 0.2731371 * x * y, 0.2731371 * y * z,
        0.0788479 * (3 * z * z - 1), 0.2731371 * x * z, 0.1365686 * (x * x - y * y),
      ];
      for (let i = 0; i < count; ++i) {
        for (const k of [0, 1, 2]) light[96 * i + 3 * side + k] = weights.reduce((sum, w, c) => sum + w * numbers[27 * i + 3 * c + k], 0);
      }
    }
    return light;
  }

  // For scripts: the 27 numbers of each probe; for group 1 those of the mesh's vertices.
  async read(group = 0) {
    const {places} = this.groups[group], {gl} = this.graphics, {width, height} = places.texture;
    while (places.done < places.count) await new Promise(requestAnimationFrame);
    const numbers = new Float32Array(27 * places.count), words = new Uint32Array(4 * width * height);
    const halves = new Uint16Array(words.buffer);
    gl.bindFramebuffer(gl.FRAMEBUFFER, places.buffer);
    for (let table = 0; table < TABLES; ++table) {
      gl.readBuffer(gl.COLOR_ATTACHMENT0 + table);
      gl.readPixels(0, 0, width, height, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words);
      for (let i = 0; i < places.count; ++i) {
        for (let k = 8 * table; k < Math.min(8 * table + 8, 27); ++k) {
          numbers[27 * i + k] = fromHalf(halves[8 * i + k - 8 * table]);
        }
      }
    }
    return numbers;
  }
}
