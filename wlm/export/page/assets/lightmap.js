// Lightmaps over time: the exported shader decodes stored hours of each light group into textures, which are mixed
// between two hours and added by the weights of the groups.

const MAIN_TILE = `
out vec4 radiance;
void main() { radiance = vec4(wlm_radiance(ivec2(gl_FragCoord.xy)), 1.0); }`;
const MAIN_FILL = `
uniform sampler2D u_map;
out vec4 radiance;
void main() {
    ivec2 at = ivec2(gl_FragCoord.xy), source = wlm_source(at);
    // Alpha is the weight of a texel in smaller mip levels: one that fills a gap counts where no valid one does.
    float weight = texelFetch(WLM_LIGHTMAP_VALID, at, 0).x > 0.5 ? 1.0 : source != at ? 1.0 / 256.0 : 0.0;
    radiance = vec4(texelFetch(u_map, source, 0).rgb, weight);
}`;
const MAIN_ADD = `
uniform sampler2D u_early, u_late;
uniform float u_share;
uniform vec3 u_weight;
out vec4 radiance;
void main() {
    ivec2 at = ivec2(gl_FragCoord.xy);
    vec4 light = mix(texelFetch(u_early, at, 0), texelFetch(u_late, at, 0), u_share);
    radiance = vec4(u_weight, 1.0) * light;
}`;
const LIGHT = `
uniform sampler2D u_light;
vec3 wlm_light() { return texture(u_light, v_uv).rgb; }`;
const LONG_FRAME = 40, SHORT_FRAME = 25;  // milliseconds between two pictures

// A light group: decodes stored hours into `next`, which the groups share, and keeps one or two of them in `maps`.
class LightGroup {
  constructor(graphics, page, number, next, valid) {
    const {gl} = graphics, {width, height, groups} = page.manifest, {name, lightmap} = groups[number];
    Object.assign(this, {graphics, page, number, next, name, lightmap, valid, tiles: lightmap.tiles, weight: [1, 1, 1]});
    this.layers = new Set();
    this.maps = Array.from(
      {length: Math.min(lightmap.times.length, 2)}, () => graphics.target(width, height, graphics.half(), gl.LINEAR));
    this.seen = [];
    this.waiting = [];
  }

  // Compiles the shaders and uploads the textures, before the first decoding.
  #prepare() {
    const {graphics, page, number, valid} = this, {shader} = page.manifest.groups[number];
    const program = (main) => graphics.program(WHOLE, HEAD + shader + main);
    this.programs = {tile: program(MAIN_TILE), fill: program(MAIN_FILL)};
    this.networks = this.#array('networks', Float32Array);
    this.textures = {wlm_lightmap_networks: graphics.fours(this.networks), wlm_lightmap_valid: valid, ...this.#upload()};
  }

  #array(name, kind) { return this.page.array(`${this.number}_${name}`, kind); }

  #upload() {
    const {graphics, lightmap: {textures}} = this, {gl} = graphics, made = {};
    for (const [name, {size, layers}] of Object.entries(textures)) {
      const bytes = () => this.#array(name, Uint8Array), key = `wlm_lightmap_${name}`;
      if (name === 'uv' || name === 'uvt') made[key] = graphics.blocks(...size, bytes(), gl.LINEAR);
      else if (name === 'planes') made[key] = graphics.plain(...size, [gl.RG8, gl.RG, gl.UNSIGNED_BYTE], bytes(), gl.LINEAR);
      else made[key] = graphics.layers(...size, layers);
    }
    return made;
  }

  // Uploads the images of an hour when they are first needed.
  #show(hour) {
    const {graphics, layers} = this;
    if (layers.has(hour)) return;
    layers.add(hour);
    const texture = this.textures.wlm_lightmap_frames;
    if (!texture) return;
    const size = texture.width * texture.height;
    graphics.putLayer(texture, hour, this.#array('frames', Uint8Array).subarray(size * hour, size * (hour + 1)));
  }

  #decode(tile) {
    const {graphics, next} = this, {gl} = graphics;
    gl.bindFramebuffer(gl.FRAMEBUFFER, next.buffer);
    gl.disable(gl.DEPTH_TEST);
    gl.viewport(128 * tile.column, 128 * tile.row, 128, 128);
    graphics.use(this.programs.tile, {...this.textures, wlm_lightmap_hour: this.table});
    graphics.draw(3);
  }

  // Prepares a time of `wlmReads`: its table, the images that it reads, and an empty map.
  #ask(read) {
    if (!this.programs) this.#prepare();
    const {graphics, lightmap, next} = this, {gl} = graphics, old = this.table;
    this.asked = read;
    this.table = graphics.fours(wlmTable(lightmap, this.networks, read));
    if (old) graphics.discard(old);
    this.#show(read.before);
    this.#show(read.after);
    gl.bindFramebuffer(gl.FRAMEBUFFER, next.buffer);
    gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
    next.owner = this;
  }

  // The time whose light is shown: within a switch of a lamp, from `start` to `end`, the light before it.
  #held(time) {
    const {switches = [], period} = this.lightmap;
    const since = (start) => period ? ((time - start) % period + period) % period : time - start;
    return switches.find(([start, end]) => since(start) > 0 && since(start) < end - start)?.[0] ?? time;
  }

  #map(read) { return this.maps.find((map) => map.key === read.key); }

  // Decodes up to `count` tiles that a time still needs; returns whether it needed any.
  work(time, count) {
    const reads = wlmReads(this.lightmap, this.#held(time));
    if (!this.waiting.length) {
      const missing = reads.find((read) => !this.#map(read));
      if (!missing) {
        this.seen = reads;
        return false;
      }
      this.#ask(missing);
      this.waiting = [...this.tiles];
    }
    for (const tile of this.waiting.splice(0, count)) this.#decode(tile);
    if (!this.waiting.length) this.#keep(this.asked, reads);
    return true;
  }

  // Fills the gaps of a complete hour, and replaces the map that is not needed now.
  #keep(read, wanted) {
    const {graphics, maps, next} = this, {gl} = graphics;
    const map = maps.find(({key}) => !wanted.some((other) => other.key === key)) ?? maps[0];
    gl.bindFramebuffer(gl.FRAMEBUFFER, map.buffer);
    gl.disable(gl.DEPTH_TEST);
    gl.viewport(0, 0, map.width, map.height);
    graphics.use(this.programs.fill, {u_map: next, ...this.textures});
    graphics.draw(3);
    graphics.read(map, 1, 1);
    map.key = read.key;
    next.owner = undefined;
    // Shown alone until the other one is complete.
    if (!this.seen.length || !this.seen.every((other) => this.#map(other))) this.seen = [{...read, weight: 1}];
  }

  // The maps to show and the share of the later one: one, two between two stored hours, or the tiles decoded so far.
  get shown() {
    const {seen, next} = this;
    if (!seen.length) return next.owner === this ? {u_early: next, u_late: next, u_share: 0} : null;
    const [early, late = early] = seen.map((read) => this.#map(read));
    return {u_early: early, u_late: late, u_share: seen[1]?.weight ?? 0};
  }
}

class LightmapPage {
  constructor(graphics, page, panel, changed) {
    const {manifest} = page, {gl} = graphics, {times, period} = manifest;
    Object.assign(this, {graphics, page, manifest, panel, changed, times, period});
    const texture = () => graphics.target(manifest.width, manifest.height, graphics.half(), gl.LINEAR);
    const next = texture(), valid = this.valid = this.#mask(page.array('valid', Uint8Array));
    this.groups = manifest.groups.map((_, number) => new LightGroup(graphics, page, number, next, valid));
    this.program = graphics.program(WHOLE, HEAD + MAIN_ADD);
    // The sum of the groups.
    this.light = texture();
    this.batch = 1;
    this.time = manifest.time;
    this.first = period ? 0 : times[0];
    this.length = period ?? times.at(-1) - this.first;
    this.speed = this.length / 12;  // hours a second while playing
    this.originals = new Originals(graphics, page);
    if (this.length > 0 && times.length > 1) {
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
    if (this.groups.length > 1) for (const group of this.groups) this.#dial(group);
    this.display = new Display(page, panel, changed);
    this.surface = this.makeSurface();
  }

  makeSurface() {
    const {graphics, page, display, panel, changed, valid} = this;
    return new Surface(graphics, page, LIGHT, display, panel, changed, (column, row) => this.#tell(column, row), valid);
  }

  // The controls of a group: its weight, and its colour as a screen shows it.
  #dial(group) {
    let gain = 1, tint = [1, 1, 1];
    const set = () => this.setWeight(group.name, tint.map((x) => gain * x));
    this.panel.slider(group.name, {
      min: 0, max: 2, step: 0.01, value: 1, text: (value) => value ? `${Math.round(100 * value)} %` : 'off',
      changed: (value) => { gain = value; set(); },
      tint: (colour) => { tint = colour.map((x) => x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4); set(); },
    });
  }

  // Sets the factors of red, green and blue of a group; nothing is decoded again.
  setWeight(name, weight) {
    this.groups.find((group) => group.name === name).weight = weight;
    this.changed();
  }

  // The hour after an arrow key: a quarter of an hour further, or the next one with an original.
  #beside(time, direction) {
    const {times} = this.originals, {period} = this;
    if (this.display.compares) {
      const at = this.originals.nearest(time, period) + direction;
      return times[period ? (at + times.length) % times.length : Math.min(Math.max(at, 0), times.length - 1)];
    }
    const next = time + direction * this.length / 96, since = next - this.first;
    return period ? this.first + (since + period) % period : next;
  }

  // The nearest hour that the view can show; views with the original only show hours that have one.
  #shown(time) {
    return this.display.compares ? this.originals.times[this.originals.nearest(time, this.period)] : time;
  }

  #clock(value) {
    if (this.period !== 24) return value.toFixed(2);
    const minutes = Math.round(value * 60) % 1440;
    return `${Math.floor(minutes / 60)}:${String(minutes % 60).padStart(2, '0')}`;
  }

  // The mask of valid texels, from one bit each, the first in the highest bit of its byte.
  #mask(bits) {
    const {graphics, manifest: {width, height}} = this, {gl} = graphics, texels = new Uint8Array(width * height);
    for (let i = 0; i < texels.length; ++i) texels[i] = bits[i >> 3] >> (7 - (i & 7)) & 1 ? 255 : 0;
    return graphics.plain(width, height, [gl.R8, gl.RED, gl.UNSIGNED_BYTE], texels, gl.NEAREST);
  }

  get waiting() { return this.groups.find((group) => group.waiting.length)?.waiting ?? []; }

  // Decodes some tiles of a waiting hour; returns whether the picture changed.
  work(elapsed) {
    const busy = this.groups.find((group) => group.waiting.length);
    // The number of tiles between two pictures adapts, so that the page stays responsive.
    const most = Math.max(...this.groups.map((group) => group.tiles.length), 1);
    if (busy && elapsed > LONG_FRAME) this.batch = Math.max(Math.floor(this.batch / 2), 1);
    else if (busy && elapsed < SHORT_FRAME) this.batch = Math.min(2 * this.batch, most);
    // The groups decode in one texture, one after another.
    const worked = (busy ? [busy] : this.groups).find((group) => group.work(this.time, this.batch));
    if (worked) {
      this.began ??= performance.now();
      const {name, tiles, waiting} = worked, group = this.groups.length > 1 ? `${name}, ` : '';
      this.panel.figure('decoded in', `${group}${tiles.length - waiting.length} of ${tiles.length} tiles so far`);
      return true;
    }
    if (this.began) this.panel.figure('decoded in', `${(performance.now() - this.began).toFixed(0)} ms`);
    this.began = undefined;
    const moved = this.shown !== this.time;
    this.shown = this.time;
    if (moved) this.#score();
    return moved;
  }

  // Adds the groups by their weights.
  #add() {
    const {graphics, light, groups} = this, {gl} = graphics;
    gl.bindFramebuffer(gl.FRAMEBUFFER, light.buffer);
    gl.disable(gl.DEPTH_TEST);
    gl.viewport(0, 0, light.width, light.height);
    gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    for (const {shown, weight} of groups) {
      if (!shown) continue;
      graphics.use(this.program, {...shown, u_weight: weight});
      graphics.draw(3);
    }
    gl.disable(gl.BLEND);
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
    this.playing = (this.playing + Math.min(elapsed, 250) / 1000 * this.speed) % this.length;
    this.setTime(this.#shown(this.first + this.playing));
    this.played = this.time;
  }

  draw() {
    this.#add();
    if (!this.display.compares) {
      this.surface.draw({u_light: this.light});
      return;
    }
    if (this.#shown(this.time) !== this.time) this.setTime(this.#shown(this.time));
    // The last picture stays until both have the same hour.
    const index = this.originals.times.indexOf(this.shown);
    if (index >= 0) this.surface.draw({u_light: this.light}, this.originals.get(index));
  }

  // Describes a texel.
  #tell(column, row) {
    const {graphics, manifest, originals, groups} = this, index = originals.nearest(this.time, this.period);
    const number = Math.floor(row / 128) * Math.ceil(manifest.width / 128) + Math.floor(column / 128);
    const kind = ({tiles}) => tiles.find((tile) => tile.number === number)?.kind ?? 'empty';
    const [red, green, blue] = graphics.read(this.light, 1, 1, column, row);
    return {
      tile: `tile ${number} (${[...new Set(groups.map(kind))].join(', ')})`,
      decoded: [red, green, blue],
      original: originals.times[index] === this.shown ? originals.texel(index, column, row) : undefined,
    };
  }

  // Light of the valid texels at the first hour, for the exposure.
  async brightness() {
    const texels = await this.read(this.time), step = 4 * Math.ceil(texels.length / (1 << 20));
    return texels.filter((_, i) => i % step < 3);
  }

  // For scripts: RGBA radiance of the whole map at an hour, row by row.
  async read(time) {
    this.setTime?.(time);
    while (this.shown !== this.time || this.waiting.length) await new Promise(requestAnimationFrame);
    this.#add();
    return this.graphics.read(this.light);
  }
}
