// Lightmaps over time: the exported shader decodes stored hours into textures, which are mixed between two hours.

const MAIN_TILE = `
out vec4 radiance;
void main() { radiance = vec4(wlm_radiance(ivec2(gl_FragCoord.xy)), 1.0); }`;
const MAIN_FILL = `
uniform sampler2D u_map;
out vec4 radiance;
void main() { radiance = texelFetch(u_map, wlm_source(ivec2(gl_FragCoord.xy)), 0); }`;
const MIXED = `
uniform sampler2D u_early, u_late;
uniform float u_share;
vec3 wlm_light() { return mix(texture(u_early, v_uv).rgb, texture(u_late, v_uv).rgb, u_share); }`;
const LONG_FRAME = 40, SHORT_FRAME = 25;  // milliseconds between two pictures

class LightmapPage {
  constructor(graphics, page, panel, changed) {
    const {manifest} = page, {gl} = graphics;
    Object.assign(this, {graphics, page, manifest, lightmap: manifest.lightmap, panel});
    const {lightmap} = this;
    const shader = (main) => graphics.program(WHOLE, HEAD + manifest.shader + main);
    this.programs = {tile: shader(MAIN_TILE), fill: shader(MAIN_FILL)};
    this.networks = page.array('networks', Float32Array);
    this.tiles = lightmap.tiles;
    this.textures = this.#upload();
    this.layers = new Set();
    const texture = () => graphics.target(manifest.width, manifest.height, graphics.half(), gl.LINEAR);
    // An hour is decoded into `next` and moved to one of two maps when it is complete; the tiles of the first hour
    // appear one by one. One of the maps is shown, or a mix of both.
    this.next = texture();
    this.maps = [texture(), texture()];
    this.seen = [];
    this.batch = 1;
    this.waiting = [];
    this.time = manifest.time;
    this.first = lightmap.period ? 0 : lightmap.times[0];
    this.length = lightmap.period ?? lightmap.times.at(-1) - this.first;
    this.originals = new Originals(graphics, page);
    if (this.length > 0) {
      this.setTime = panel.slider('hour', {
        min: this.first, max: this.first + this.length, step: 'any', value: this.time,
        text: (value) => this.#clock(value), keys: ['arrowleft', 'arrowright'], told: 'the hour',
        next: (value, direction) => this.#beside(value, direction),
        changed: (value) => { this.time = value; changed(); },
      });
      panel.player((playing) => {
        this.playing = playing ? this.time - this.first : undefined;
        changed();
      });
    }
    this.display = new Display(page, panel, changed);
    this.surface = new Surface(
      graphics, page, MIXED, this.display, panel, changed, (column, row) => this.#tell(column, row));
  }

  // The hour after an arrow key: a quarter of an hour further, or the next one with an original.
  #beside(time, direction) {
    const {times} = this.originals, {period} = this.lightmap;
    if (this.display.compares) {
      const at = this.originals.nearest(time, period) + direction;
      return times[period ? (at + times.length) % times.length : Math.min(Math.max(at, 0), times.length - 1)];
    }
    const next = time + direction * this.length / 96, since = next - this.first;
    return period ? this.first + (since + period) % period : next;
  }

  // The nearest hour that the view can show; views with the original only show hours that have one.
  #shown(time) {
    return this.display.compares ? this.originals.times[this.originals.nearest(time, this.lightmap.period)] : time;
  }

  #clock(value) {
    if (this.lightmap.period !== 24) return value.toFixed(2);
    const minutes = Math.round(value * 60) % 1440;
    return `${Math.floor(minutes / 60)}:${String(minutes % 60).padStart(2, '0')}`;
  }

  #upload() {
    const {graphics, page, lightmap} = this, {gl} = graphics, {textures} = lightmap;
    const made = {
      wlm_lightmap_networks: graphics.fours(this.networks),
      wlm_lightmap_valid: this.#mask(page.array('valid', Uint8Array)),
    };
    for (const [name, {size, layers}] of Object.entries(textures)) {
      const bytes = () => page.array(`tiles_${name}`, Uint8Array), key = `wlm_lightmap_${name}`;
      if (name === 'uv' || name === 'uvt') made[key] = graphics.blocks(...size, bytes(), gl.LINEAR);
      else if (name === 'planes') made[key] = graphics.plain(...size, [gl.RG8, gl.RG, gl.UNSIGNED_BYTE], bytes(), gl.LINEAR);
      else made[key] = graphics.layers(...size, layers);
    }
    return made;
  }

  // Uploads the images of an hour when they are first needed.
  #show(hour) {
    const {graphics, page, layers} = this;
    if (layers.has(hour)) return;
    layers.add(hour);
    const texture = this.textures.wlm_lightmap_frames;
    if (!texture) return;
    const size = texture.width * texture.height;
    graphics.putLayer(texture, hour, page.array('tiles_frames', Uint8Array).subarray(size * hour, size * (hour + 1)));
  }

  // The mask of valid texels, from one bit each, the first in the highest bit of its byte.
  #mask(bits) {
    const {graphics, manifest: {width, height}} = this, {gl} = graphics, texels = new Uint8Array(width * height);
    for (let i = 0; i < texels.length; ++i) texels[i] = bits[i >> 3] >> (7 - (i & 7)) & 1 ? 255 : 0;
    return graphics.plain(width, height, [gl.R8, gl.RED, gl.UNSIGNED_BYTE], texels, gl.NEAREST);
  }

  #decode(tile) {
    const {graphics, next} = this, {gl} = graphics;
    gl.bindFramebuffer(gl.FRAMEBUFFER, next.buffer);
    gl.disable(gl.DEPTH_TEST);
    gl.viewport(128 * tile.column, 128 * tile.row, 128, 128);
    graphics.use(this.programs.tile, {...this.textures, wlm_lightmap_hour: this.table});
    graphics.draw(3);
  }

  // Prepares a time of `wlmReads`: its table, and the images that it reads.
  #ask(read) {
    const {graphics, lightmap} = this, old = this.table;
    this.asked = read;
    this.table = graphics.fours(wlmTable(lightmap, this.networks, read));
    if (old) graphics.discard(old);
    this.#show(read.before);
    this.#show(read.after);
  }

  #map(read) { return this.maps.find((map) => map.key === read.key); }

  // Decodes some tiles of a waiting hour; returns whether there was one.
  work(elapsed) {
    const reads = wlmReads(this.lightmap, this.time), missing = reads.find((read) => !this.#map(read));
    if (!this.waiting.length) {
      if (!missing) {
        const changed = this.shown !== this.time;
        [this.seen, this.shown] = [reads, this.time];
        if (changed) this.#score();
        return changed;
      }
      this.#ask(missing);
      this.waiting = [...this.tiles];
      this.began = performance.now();
    }
    // The number of tiles between two pictures adapts, so that the page stays responsive.
    if (elapsed > LONG_FRAME) this.batch = Math.max(Math.floor(this.batch / 2), 1);
    else if (elapsed < SHORT_FRAME) this.batch = Math.min(2 * this.batch, this.tiles.length);
    for (const tile of this.waiting.splice(0, this.batch)) this.#decode(tile);
    if (this.waiting.length) {
      this.panel.figure('decoded in', `${this.tiles.length - this.waiting.length} of ${this.tiles.length} tiles so far`);
      return true;
    }
    this.#keep(this.asked, reads);
    this.panel.figure('decoded in', `${(performance.now() - this.began).toFixed(0)} ms`);
    return true;
  }

  // Fills the gaps of a complete hour, and replaces the map that is not needed now.
  #keep(read, wanted) {
    const {graphics, maps, manifest} = this, {gl} = graphics;
    const map = maps.find(({key}) => !wanted.some((other) => other.key === key)) ?? maps[0];
    gl.bindFramebuffer(gl.FRAMEBUFFER, map.buffer);
    gl.disable(gl.DEPTH_TEST);
    gl.viewport(0, 0, manifest.width, manifest.height);
    graphics.use(this.programs.fill, {u_map: this.next, ...this.textures});
    graphics.draw(3);
    graphics.read(map, 1, 1);
    map.key = read.key;
    // Shown alone until the other one is complete.
    if (!this.seen.length || !this.seen.every((other) => this.#map(other))) this.seen = [{...read, weight: 1}];
  }

  // Shows the score of the current hour, if the page has its original.
  #score() {
    const {times} = this.originals;
    if (!times.length) return;
    const score = this.manifest.reference.psnr[times.indexOf(this.shown)];
    this.panel.figure('PSNR at this hour', score == null ? '–' : `${score.toFixed(2)} dB`);
    this.panel.figure('originals at', times.map((time) => this.#clock(time)).join(', '));
  }

  advance(elapsed) {
    if (this.playing === undefined || this.waiting.length) return;
    // The slider was moved in the meantime.
    if (this.time !== this.played) this.playing = this.time - this.first;
    // One day lasts twelve seconds.
    this.playing = (this.playing + Math.min(elapsed, 250) / 12000 * this.length) % this.length;
    this.setTime(this.#shown(this.first + this.playing));
    this.played = this.time;
  }

  draw() {
    if (!this.display.compares) {
      this.surface.draw(this.#light());
      return;
    }
    if (this.#shown(this.time) !== this.time) this.setTime(this.#shown(this.time));
    // The last picture stays until both have the same hour.
    const index = this.originals.times.indexOf(this.shown);
    if (index >= 0) this.surface.draw(this.#light(), this.originals.get(index));
  }

  // Uniforms of the visible maps.
  #light() {
    const [early, late] = this.#pictures();
    return {u_early: early, u_late: late ?? early, u_share: late ? this.seen[1].weight : 0};
  }

  // Describes a texel.
  #tell(column, row) {
    const {graphics, manifest, lightmap, originals} = this, index = originals.nearest(this.time, lightmap.period);
    const number = Math.floor(row / 128) * Math.ceil(manifest.width / 128) + Math.floor(column / 128);
    const kind = lightmap.tiles.find((tile) => tile.number === number)?.kind ?? 'empty';
    const [early, late] = this.#pictures().map((map) => graphics.read(map, 1, 1, column, row));
    const [red, green, blue] = late ? early.map((value, i) => mix(value, late[i], this.seen[1].weight)) : early;
    return {
      tile: `tile ${number} (${kind})`,
      decoded: [red, green, blue],
      original: originals.times[index] === this.shown ? originals.texel(index, column, row) : undefined,
    };
  }

  // The visible maps: one, or two between two stored hours.
  #pictures() { return this.seen.length ? this.seen.map((read) => this.#map(read)) : [this.next]; }

  // For scripts: RGBA radiance of the whole map at an hour, row by row.
  async read(time) {
    this.setTime?.(time);
    while (this.shown !== this.time || this.waiting.length) await new Promise(requestAnimationFrame);
    const maps = this.seen.map((read) => this.graphics.read(this.#map(read)));
    if (maps.length === 1) return maps[0];
    const share = this.seen[1].weight;
    return maps[0].map((value, i) => mix(value, maps[1][i], share));
  }
}
