// The page of a mesh's lightmap, which the exported function reads in the fragment shader.

class AtlasPage {
  constructor(graphics, page, panel, changed) {
    const {manifest} = page, {gl} = graphics, [width, height] = manifest.atlas.colour;
    this.graphics = graphics;
    this.manifest = manifest;
    const {forms = {}} = manifest.atlas;
    const upload = (name, size) => graphics[forms[name] ?? 'halves'](...size, (Type) => page.array(name, Type), gl.LINEAR);
    this.textures = {wlm_atlas_colour: upload('colour', [width, height])};
    if (page.has('blocks')) this.textures.wlm_atlas_blocks = upload('blocks', manifest.atlas.blocks);
    if (page.has('lut')) {
      const [across, down] = manifest.atlas.lut, tiles = manifest.atlas.method === 'tiles';
      const lut = this.lut = page.array('lut', Uint16Array);
      // Normalised 16-bit textures are missing in browsers, so coordinates are uploaded as floats.
      this.textures.wlm_atlas_lut = tiles
        ? graphics.plain(across, down, [gl.RG16UI, gl.RG_INTEGER, gl.UNSIGNED_SHORT], lut, gl.NEAREST)
        : graphics.plain(across, down, [gl.RG32F, gl.RG, gl.FLOAT], Float32Array.from(lut, (x) => x / 65535),
          graphics.floatLinear ? gl.LINEAR : gl.NEAREST);
    }
    // Texels are mixed in floats: the eight bits of the texture filter are visible in large tiles.
    this.source = `#define WLM_ATLAS_EXACT\n${manifest.shader}\nvec3 wlm_light() { return wlm_atlas(v_coordinate); }`;
    this.display = new Display(page, panel, changed);
    const tell = (...texel) => this.#tell(...texel);
    this.surface = new Surface(graphics, page, this.source, this.display, panel, changed, tell);
    this.originals = new Originals(graphics, page);
    this.places = page.array(page.has('coordinate') ? 'coordinate' : 'uv', Float32Array);
  }

  draw() {
    this.surface.draw(this.textures, this.display.compares ? this.originals.get(0) : undefined);
  }

  // Describes a texel.
  #tell(column, row, coordinate) {
    const {originals} = this, [red, green, blue] = this.#light(coordinate);
    return {
      tile: this.manifest.atlas.method === 'tiles' ? this.#tile(column, row) : undefined,
      decoded: [red, green, blue],
      original: originals.times.length ? originals.texel(0, column, row) : undefined,
    };
  }

  #tile(column, row) {
    const {lut: [across, down], tile, size_bits: bits, block_side: side, first_block_code: code} = this.manifest.atlas;
    const x = Math.min(Math.floor(column / tile), across - 1), y = Math.min(Math.floor(row / tile), down - 1);
    const entry = [0, 1].map((i) => this.lut[2 * (y * across + x) + i]);
    const sizes = entry.map((number) => number & ((1 << bits) - 1)), places = entry.map((number) => number >> bits);
    const blocks = sizes[0] >= code;
    const [wide, high] = sizes.map((size) => (blocks ? side * (size - code + 1) : size + 1));
    const [left, top] = places.map((place) => (blocks ? side * place : place));
    return `tile ${x}, ${y}: ${wide} × ${high} texels${blocks ? ' of blocks' : ''} at ${left}, ${top}`;
  }

  // Light of up to 4,096 vertices, for the exposure.
  async brightness() {
    const count = this.places.length / 2, step = Math.ceil(count / 4096);
    const chosen = Array.from({length: Math.ceil(count / step)}, (_, i) => 2 * i * step).flatMap((at) => [this.places[at], this.places[at + 1]]);
    return this.#light(chosen).filter((_, i) => i % 4 < 3);
  }

  // For scripts: RGBA light at coordinates [N, 2].
  async read(coordinates) { return this.#light(coordinates); }

  #light(coordinates) {
    const {graphics} = this, {gl} = graphics, count = coordinates.length / 2;
    this.reader ??= graphics.program(WHOLE, `${HEAD}
uniform sampler2D u_places;
out vec4 light;
vec2 v_coordinate;
${this.source}
void main() { v_coordinate = texelFetch(u_places, ivec2(gl_FragCoord.xy), 0).xy; light = vec4(wlm_light(), 1.0); }`);
    const places = graphics.plain(count, 1, [gl.RG32F, gl.RG, gl.FLOAT], Float32Array.from(coordinates), gl.NEAREST);
    const target = graphics.target(count, 1, graphics.single(), gl.NEAREST);
    gl.viewport(0, 0, count, 1);
    gl.disable(gl.DEPTH_TEST);
    graphics.use(this.reader, {...this.textures, u_places: places});
    graphics.draw(3);
    const light = graphics.read(target);
    graphics.discard(places, target);
    return light;
  }
}
