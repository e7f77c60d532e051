// Lightmaps over the day: the exported shader decodes stored hours into textures, which are mixed between two hours.

const MAIN_DYNAMIC = `
uniform sampler2D u_uv, u_ut, u_vt;
uniform sampler3D u_uvt;
uniform ivec2 u_origin;
uniform float u_tau;
uniform int u_offset;
uniform vec3 u_scale, u_shift, u_spread;
out vec4 radiance;
void main()
{
    ivec2 texel = ivec2(gl_FragCoord.xy) - u_origin;
    vec3 colour = wlm_decode_dynamic(u_uv, u_uvt, u_ut, u_vt, texel, u_tau, u_offset, u_scale, u_shift, u_spread);
    radiance = vec4(wlm_radiance(colour), 1.0);
}`;
const MAIN_STATIC = `
uniform sampler2D u_uv;
uniform ivec2 u_origin;
uniform int u_offset;
uniform vec3 u_scale, u_shift, u_spread;
out vec4 radiance;
void main()
{
    ivec2 texel = ivec2(gl_FragCoord.xy) - u_origin;
    radiance = vec4(wlm_radiance(wlm_decode_static(u_uv, texel, u_offset, u_scale, u_shift, u_spread)), 1.0);
}`;
// Of the two stored times around the one that is decoded: their light is mixed, whatever networks do.
const MAIN_FRAMES = `
uniform sampler2D u_early, u_late;
uniform ivec2 u_origin;
uniform vec3 u_early_least, u_early_greatest, u_late_least, u_late_greatest;
uniform float u_share;
out vec4 radiance;
void main()
{
    ivec2 texel = ivec2(gl_FragCoord.xy) - u_origin;
    vec3 early = wlm_radiance(wlm_decode_frame(u_early, texel, u_early_least, u_early_greatest));
    vec3 late = wlm_radiance(wlm_decode_frame(u_late, texel, u_late_least, u_late_greatest));
    radiance = vec4(mix(early, late, u_share), 1.0);
}`;
const MAIN_FILL = `
uniform sampler2D u_map, u_valid;
out vec4 radiance;
void main() { radiance = texelFetch(u_map, wlm_source(u_valid, ivec2(gl_FragCoord.xy)), 0); }`;
const READ_NETWORK = `
uniform sampler2D u_network;
#define WLM_NET(i) texelFetch(u_network, ivec2((i) & 1023, (i) >> 10), 0).r
`;
const MIXED = `
uniform sampler2D u_early, u_late;
uniform float u_share;
vec3 wlm_light() { return mix(texture(u_early, v_uv).rgb, texture(u_late, v_uv).rgb, u_share); }`;
const LONG_FRAME = 40, SHORT_FRAME = 25;  // milliseconds between two pictures

// Where a time lies between the stored ones: their numbers, the share of the later one, and tau.
function place(lightmap, time) {
  const {times, period, tau, time_axis: axis} = lightmap, count = times.length;
  if (period) time = ((time % period) + period) % period;
  else time = Math.min(Math.max(time, times[0]), times[count - 1]);
  let before = times.findLastIndex((t) => t <= time), after = before + 1, span, since;
  if (period) {
    [before, after] = [(before + count) % count, after % count];
    span = (times[after] - times[before] + period) % period || period;
    since = (time - times[before] + period) % period;
  } else {
    after = Math.min(after, count - 1);
    [span, since] = [times[after] - times[before] || 1, time - times[before]];
  }
  const share = since / span;
  let place = axis.rule === 'paper' && period ? time / period
    : tau[before] + share * (axis.repeats ? 1 / count : tau[after] - tau[before]);
  if (axis.repeats) place -= Math.floor(place);
  return {before, after, share, tau: place};
}

class LightmapPage {
  constructor(graphics, page, panel, changed) {
    const {manifest} = page, {gl} = graphics;
    Object.assign(this, {graphics, page, manifest, lightmap: manifest.lightmap, panel});
    const {lightmap} = this;
    this.networks = graphics.numbers(page.array('networks', Float32Array));
    const shader = (main) => graphics.program(WHOLE, HEAD + READ_NETWORK + manifest.shader + main);
    const kinds = new Set(lightmap.tiles.map((tile) => tile.kind));
    this.programs = {
      dynamic: kinds.has('dynamic') && shader(MAIN_DYNAMIC),
      static: kinds.has('static') && shader(MAIN_STATIC),
      images: (kinds.has('frames') || kinds.has('video')) && shader(MAIN_FRAMES),
      fill: shader(MAIN_FILL),
    };
    this.valid = this.#mask(page.array('valid', Uint8Array));
    this.tiles = lightmap.tiles.map((tile) => this.#upload(tile));
    const texture = () => graphics.target(manifest.width, manifest.height, graphics.half(), gl.LINEAR);
    // An hour is decoded into `next`, and kept in one of two maps when it is whole; until the first is, its tiles
    // appear one by one. What is seen are one or two of the maps, the later one by its share.
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

  // The hour that an arrow key goes to: a quarter of an hour on, or the next that has an original.
  #beside(time, direction) {
    const {times} = this.originals, {period} = this.lightmap;
    if (this.display.compares) {
      const at = this.originals.nearest(time, period) + direction;
      return times[period ? (at + times.length) % times.length : Math.min(Math.max(at, 0), times.length - 1)];
    }
    const next = time + direction * this.length / 96, since = next - this.first;
    return period ? this.first + (since + period) % period : next;
  }

  // The nearest hour that the view can show: those that need the original have it at some hours alone.
  #shown(time) {
    return this.display.compares ? this.originals.times[this.originals.nearest(time, this.lightmap.period)] : time;
  }

  #clock(value) {
    if (this.lightmap.period !== 24) return value.toFixed(2);
    const minutes = Math.round(value * 60) % 1440;
    return `${Math.floor(minutes / 60)}:${String(minutes % 60).padStart(2, '0')}`;
  }

  #upload(tile) {
    const {graphics, page, lightmap} = this, {gl} = graphics, {resolution, slices, columns, rows} = lightmap.maps;
    const bytes = (map) => page.array(`${tile.number}_${map}`, Uint8Array), repeats = lightmap.time_axis.repeats;
    const textures = {};
    if (tile.kind === 'dynamic' || tile.kind === 'static') textures.u_uv = graphics.blocks(128, 128, 1, bytes('uv'), gl.NEAREST);
    if (tile.kind === 'dynamic') {
      const two = [gl.RG8, gl.RG, gl.UNSIGNED_BYTE], wrap = {T: repeats};
      textures.u_uvt = graphics.blocks(resolution, resolution, slices, bytes('uvt'), gl.LINEAR, {R: repeats});
      textures.u_ut = graphics.plain(columns, rows, two, bytes('ut'), gl.LINEAR, wrap);
      textures.u_vt = graphics.plain(columns, rows, two, bytes('vt'), gl.LINEAR, wrap);
    }
    // Images by their hour, uploaded when they are first seen.
    return {...tile, textures, frames: []};
  }

  #frame(tile, hour) {
    const {graphics, page} = this, {gl} = graphics, size = 128 * 128;
    if (tile.kind === 'video') {
      const words = () => page.array(`${tile.number}_video`, Uint32Array).subarray(size * hour, size * (hour + 1));
      const form = [gl.RGB10_A2, gl.RGBA, gl.UNSIGNED_INT_2_10_10_10_REV];
      return tile.frames[hour] ??= graphics.plain(128, 128, form, words(), gl.NEAREST);
    }
    const bytes = () => page.array(`${tile.number}_frames`, Uint8Array).subarray(size * hour, size * (hour + 1));
    return tile.frames[hour] ??= graphics.blocks(128, 128, 1, bytes(), gl.NEAREST);
  }

  // Valid texels from one bit each, the first the highest of its byte.
  #mask(bits) {
    const {graphics, manifest: {width, height}} = this, {gl} = graphics, texels = new Uint8Array(width * height);
    for (let i = 0; i < texels.length; ++i) texels[i] = bits[i >> 3] >> (7 - (i & 7)) & 1 ? 255 : 0;
    return graphics.plain(width, height, [gl.R8, gl.RED, gl.UNSIGNED_BYTE], texels, gl.NEAREST);
  }

  #decode(tile, now) {
    const {graphics, next} = this, {gl} = graphics, origin = [128 * tile.column, 128 * tile.row];
    gl.bindFramebuffer(gl.FRAMEBUFFER, next.buffer);
    gl.disable(gl.DEPTH_TEST);
    gl.viewport(...origin, 128, 128);
    const between = (rows) => rows[now.before].map((value, c) => mix(value, rows[now.after][c], now.share));
    if (tile.kind === 'constant') {
      gl.enable(gl.SCISSOR_TEST);
      gl.scissor(...origin, 128, 128);
      gl.clearColor(...between(tile.radiance), 1);
      gl.clear(gl.COLOR_BUFFER_BIT);
      gl.disable(gl.SCISSOR_TEST);
      return;
    }
    if (tile.kind === 'frames' || tile.kind === 'video') {
      const {before, after, share} = now;
      graphics.use(this.programs.images, {
        u_origin: origin, u_share: share, u_early: this.#frame(tile, before), u_late: this.#frame(tile, after),
        u_early_least: tile.least[before], u_early_greatest: tile.greatest[before],
        u_late_least: tile.least[after], u_late_greatest: tile.greatest[after],
      });
      graphics.draw(3);
      return;
    }
    graphics.use(this.programs[tile.kind], {
      ...tile.textures, u_network: this.networks, u_origin: origin, u_tau: now.tau, u_offset: tile.network_offset,
      u_scale: between(tile.scale), u_shift: tile.shift, u_spread: tile.spread,
    });
    graphics.draw(3);
  }

  // What is decoded for a time: one or two stored times, or, where the network interpolates, the time itself.
  #reads(time) {
    const {lightmap} = this, now = place(lightmap, time);
    if (lightmap.interpolation === 'network') return [{...now, key: time, weight: 1}];
    const stored = (k, weight) => ({before: k, after: k, share: 0, tau: lightmap.tau[k], key: k, weight});
    return [stored(now.before, 1 - now.share), stored(now.after, now.share)].filter((read) => read.weight > 0);
  }

  #map(read) { return this.maps.find((map) => map.key === read.key); }

  // Decodes some tiles of a wanted hour; returns whether it did.
  work(elapsed) {
    const reads = this.#reads(this.time), missing = reads.find((read) => !this.#map(read));
    if (!this.waiting.length) {
      if (!missing) {
        const changed = this.shown !== this.time;
        [this.seen, this.shown] = [reads, this.time];
        if (changed) this.#score();
        return changed;
      }
      this.asked = missing;
      this.waiting = [...this.tiles];
      this.began = performance.now();
    }
    // As many tiles between two pictures as leave the page responsive.
    if (elapsed > LONG_FRAME) this.batch = Math.max(Math.floor(this.batch / 2), 1);
    else if (elapsed < SHORT_FRAME) this.batch = Math.min(2 * this.batch, this.tiles.length);
    for (const tile of this.waiting.splice(0, this.batch)) this.#decode(tile, this.asked);
    if (this.waiting.length) {
      this.panel.figure('decoded in', `${this.tiles.length - this.waiting.length} of ${this.tiles.length} tiles so far`);
      return true;
    }
    this.#keep(this.asked, reads);
    this.panel.figure('decoded in', `${(performance.now() - this.began).toFixed(0)} ms`);
    return true;
  }

  // Fills the gaps of the hour that is whole, in the map that is wanted least.
  #keep(read, wanted) {
    const {graphics, maps, manifest} = this, {gl} = graphics;
    const map = maps.find(({key}) => !wanted.some((other) => other.key === key)) ?? maps[0];
    gl.bindFramebuffer(gl.FRAMEBUFFER, map.buffer);
    gl.disable(gl.DEPTH_TEST);
    gl.viewport(0, 0, manifest.width, manifest.height);
    graphics.use(this.programs.fill, {u_map: this.next, u_valid: this.valid});
    graphics.draw(3);
    graphics.read(map, 1, 1);
    map.key = read.key;
    // Alone until the other one is there.
    if (!this.seen.length || !this.seen.every((other) => this.#map(other))) this.seen = [{...read, weight: 1}];
  }

  // Tells the score of the hour that is seen, if it has an original here.
  #score() {
    const {times} = this.originals;
    if (!times.length) return;
    const score = this.manifest.reference.psnr[times.indexOf(this.shown)];
    this.panel.figure('PSNR at this hour', score == null ? '–' : `${score.toFixed(2)} dB`);
    this.panel.figure('originals at', times.map((time) => this.#clock(time)).join(', '));
  }

  advance(elapsed) {
    if (this.playing === undefined || this.waiting.length) return;
    // The slider was moved meanwhile.
    if (this.time !== this.played) this.playing = this.time - this.first;
    // A day in twelve seconds.
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
    // Until both are of one hour, the last picture stays.
    const index = this.originals.times.indexOf(this.shown);
    if (index >= 0) this.surface.draw(this.#light(), this.originals.get(index));
  }

  // The uniforms of what is seen.
  #light() {
    const [early, late] = this.#pictures();
    return {u_early: early, u_late: late ?? early, u_share: late ? this.seen[1].weight : 0};
  }

  // What is known of a texel.
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

  // What is seen: one map or, between two stored hours, two.
  #pictures() { return this.seen.length ? this.seen.map((read) => this.#map(read)) : [this.next]; }

  // For scripts: radiance of the whole map at an hour, RGBA by rows.
  async read(time) {
    this.setTime?.(time);
    while (this.shown !== this.time || this.waiting.length) await new Promise(requestAnimationFrame);
    const maps = this.seen.map((read) => this.graphics.read(this.#map(read)));
    if (maps.length === 1) return maps[0];
    const share = this.seen[1].weight;
    return maps[0].map((value, i) => mix(value, maps[1][i], share));
  }
}
