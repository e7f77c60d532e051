// The page of six-way lightmaps: a billboard under a light that follows the pointer, in front of a checkerboard. The
// lightmaps are stored, or computed from a volume whenever the view or the frame changes (`live.js`).

const BILLBOARD = `${HEAD}
uniform mat4 u_camera;
uniform float u_aspect;
out vec2 v_uv;
void main()
{
    v_uv = vec2(gl_VertexID & 1, gl_VertexID >> 1);
    gl_Position = u_camera * vec4(v_uv.x * u_aspect, -v_uv.y, 0.0, 1.0);
}`;

const SHADE = `${HEAD}
in vec2 v_uv;
uniform sampler2D u_first, u_second;    // right, left, top, bottom; front, back, opacity, emission
uniform vec3 u_most;                    // of the lightmaps, the opacity and the emission
uniform vec3 u_toward;                  // to the light, in the camera's axes: right, up, towards the viewer
uniform float u_light, u_glow, u_ground;
uniform int u_plane;
out vec4 colour;
${DISPLAY}
// Numbers are stored as square roots, whose steps are perceptually more even.
vec4 wlm_planes(sampler2D page) { vec4 x = texture(page, v_uv); return x * x; }

// The lightmaps' weights are the squares of the direction's parts, which add up to 1 (smoke-lightmaps, eq. 4 and 5).
void main()
{
    vec4 sides = wlm_planes(u_first) * u_most.x, rest = wlm_planes(u_second) * vec4(u_most.xx, u_most.yz);
    vec3 ahead = max(u_toward, 0.0), behind = max(-u_toward, 0.0);
    ahead *= ahead;
    behind *= behind;
    float lit = ahead.x * sides.x + behind.x * sides.y + ahead.y * sides.z + behind.y * sides.w;
    lit += ahead.z * rest.x + behind.z * rest.y;
    float planes[8] = float[8](sides.x, sides.y, sides.z, sides.w, rest.x, rest.y, rest.z, rest.w);
    if (u_plane > 0) {
        colour = vec4(wlm_screen(vec3(planes[u_plane - 1])), 1.0);
        return;
    }
    float square = mod(floor(v_uv.x * 8.0) + floor(v_uv.y * 8.0), 2.0);
    vec3 light = vec3(u_light * lit) + u_glow * rest.w * vec3(1.0, 0.45, 0.12);
    light += (1.0 - rest.z) * u_ground * mix(0.06, 0.12, square);
    colour = vec4(wlm_screen(light), 1.0);
}`;

const SIZES = ['128', '256', '512'];  // texels along the edge of computed lightmaps
const FAST = 8;  // milliseconds for lightmaps, below which the page goes on to larger ones

class SmokePage {
  constructor(graphics, page, panel, changed) {
    const {manifest} = page, {gl} = graphics, {frames} = manifest.smoke;
    Object.assign(this, {graphics, manifest, plane: 0, light: 1, glow: 1, toward: [0.6, 0.5, 0.62]});
    let amounts;
    if (manifest.live) amounts = this.#begin(page, panel, changed);
    const {smoke: {planes}, width, height} = manifest;
    if (!amounts) {
      const form = [gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE];
      const texture = (name) => graphics.plain(width, height, form, page.array(name, Uint8Array), gl.LINEAR);
      this.frames = Array.from({length: frames}, (_, i) => ({
        u_first: texture(`first_${i}`), u_second: texture(`second_${i}`), u_most: manifest.smoke.most[i],
      }));
      const opaque = (i) => page.array(`second_${i}`, Uint8Array).reduce((sum, code, k) => sum + (k % 4 === 2 ? code : 0), 0);
      amounts = Array.from({length: frames}, (_, i) => opaque(i));
    }
    // The page opens on the frame with most smoke.
    this.frame = amounts.indexOf(Math.max(...amounts));
    this.program = graphics.program(BILLBOARD, SHADE);
    if (frames > 1) {
      this.setFrame = panel.slider('frame', {
        min: 0, max: frames - 1, step: 1, value: this.frame, text: (value) => `${value + 1}/${frames}`,
        keys: ['arrowleft', 'arrowright'], next: (value, direction) => (value + direction + frames) % frames,
        changed: (value) => { this.frame = value; changed(); },
      });
      panel.player((playing) => {
        this.playing = playing ? this.frame : undefined;
        changed();
      });
    }
    this.display = new Display(page, panel, changed);
    this.aspect = width / height;
    this.camera = new Camera(graphics.canvas, [0, -1, 0], [this.aspect, 0, 0], {flat: true, changed});
    // The pointer moves the light or turns the view; two touches and the wheel still move the picture.
    const pan = this.camera;
    let last;
    graphics.canvas.addEventListener('pointermove', (event) => {
      const before = last;
      last = [event.clientX, event.clientY];
      if (!event.buttons || pan.pointers.size > 1 || event.shiftKey) return;
      if (this.turns && before) {
        const [dx, dy] = last.map((x, i) => x - before[i]);
        this.setTurn((this.turn - 0.35 * dx + 540) % 360 - 180);
        this.setTilt(this.tilt + 0.35 * dy);
        return;
      }
      const box = graphics.canvas.getBoundingClientRect(), half = 0.5 * Math.min(box.width, box.height);
      const x = (event.clientX - box.left - box.width / 2) / half, y = (box.top + box.height / 2 - event.clientY) / half;
      // Inside the circle the light is in front of the smoke, outside behind it.
      const far = Math.hypot(x, y), angle = Math.min(far, 2) * Math.PI / 2, scale = far > 1e-6 ? Math.sin(angle) / far : 0;
      this.lightFrom(unit([x * scale, y * scale, Math.cos(angle)]));
      changed();
    });
    pan.still = true;
    explainCamera(panel, manifest.live ? 'turn the view or the light' : 'turn the light', () => pan.reset());
    const level = (name, set) => panel.slider(name, {
      min: 0, max: 4, step: 0.05, value: 1, text: (value) => `${value.toFixed(2)}×`, changed: (value) => { set(value); changed(); },
    });
    level('light', (value) => { this.light = value; });
    if (planes.includes('emission')) level('glow', (value) => { this.glow = value; });
    panel.choices('show', ['shaded', ...planes], 'shaded', (name) => {
      this.plane = name === 'shaded' ? 0 : 1 + ['right', 'left', 'top', 'bottom', 'front', 'back', 'opacity', 'emission'].indexOf(name);
      changed();
    });
  }

  advance(elapsed) {
    if (this.playing === undefined) return;
    // The slider was moved in the meantime.
    if (Math.floor(this.playing) % this.manifest.smoke.frames !== this.frame) this.playing = this.frame;
    this.playing += elapsed / 1000 * this.manifest.smoke.rate;
    const frame = Math.floor(this.playing) % this.manifest.smoke.frames;
    if (frame !== this.frame) this.setFrame(frame);
  }

  // Prepares computed lightmaps: a view that turns, their size, and what makes them. Returns how much smoke a frame has.
  #begin(page, panel, changed) {
    const {manifest} = page, {network, frames} = manifest.live, names = ['density', 'heat'];
    this.arrays = (i) => Object.fromEntries(names.filter((name) => page.has(`${name}_${i}`)).map((name) => [name, page.array(`${name}_${i}`, Uint16Array)]));
    const boxes = frames.map(({shape}, i) => smokyBox(shape, this.arrays(i).density));
    // The image shows all smoke of all frames from any side.
    const some = boxes.some(({count}) => count), ends = frames.flatMap(({voxel, origin, shape}, i) => {
      const {low, high, count} = boxes[i], corners = count ? [low, high] : some ? [] : [[0, 0, 0], shape];
      return corners.map((corner) => corner.map((x, axis) => origin[axis] + voxel * x));
    });
    const [low, high] = [Math.min, Math.max].map((least) => ends.reduce((a, b) => a.map((x, axis) => least(x, b[axis]))));
    this.target = low.map((x, axis) => 0.5 * (x + high[axis]));
    this.extent = Math.hypot(...low.map((x, axis) => high[axis] - x));
    Object.assign(manifest, {exposure: 1, width: 1, height: 1});
    manifest.smoke.planes = [...PLANE_NAMES.slice(0, 7), ...frames.some(({heat}) => heat) ? ['emission'] : []];
    this.lamp = this.toward;  // towards the light, in the world
    Object.assign(this, {turns: true, turn: 30, tilt: 10, size: Number(SIZES[0]), grows: true, times: 0, changed, made: network ? 'network' : 'march'});
    this.live = new LiveSmoke(this.graphics, network, page.array('weights', Uint16Array));
    const angle = (name, most) => panel.slider(name, {
      min: -most, max: most, step: 1, value: this[name], text: (value) => `${value}°`, changed: (value) => { this[name] = value; this.stale = true; changed(); },
    });
    [this.setTurn, this.setTilt] = [angle('turn', 180), angle('tilt', 89)];
    panel.choices('drag', ['view', 'light'], 'view', (name) => { this.turns = name === 'view'; });
    this.choose = panel.choices('texels', SIZES, SIZES[0], (name) => { this.resize(Number(name)); changed(); });
    if (network) {
      panel.choices('made by', ['network', 'march'], 'network', (name) => { Object.assign(this, {made: name, stale: true}); changed(); });
    }
    this.panel = panel;
    this.stale = true;
    return boxes.map(({count}) => count);
  }

  resize(size) { Object.assign(this, {size, grows: false, stale: true}); }

  // Sets the direction to the light, given in the camera's axes.
  lightFrom(toward) {
    this.toward = toward;
    if (!this.live) return;
    const {right, up, toward: ahead} = this.view();
    this.lamp = right.map((x, i) => x * toward[0] + up[i] * toward[1] + ahead[i] * toward[2]);
  }

  // The camera of computed lightmaps.
  view() {
    const [turn, tilt] = [this.turn, this.tilt].map((degrees) => degrees * Math.PI / 180), {target, extent} = this;
    const toward = [Math.sin(turn) * Math.cos(tilt), Math.sin(tilt), Math.cos(turn) * Math.cos(tilt)];
    const right = [Math.cos(turn), 0, -Math.sin(turn)];
    return {right, up: cross(toward, right), toward, target, extent, width: this.size, height: this.size};
  }

  // Computes the lightmaps of the frame, seen by the camera.
  #compute(made = this.made) {
    if (this.shown !== this.frame) {
      if (this.smoke) this.live.discard(this.smoke);
      this.smoke = this.live.volume(this.manifest.live.frames[this.frame], this.arrays(this.frame));
      this.shown = this.frame;
    }
    const view = this.view(), begin = performance.now();
    const {first, second} = this.live.render(this.smoke, view, made);
    // Reading waits until the lightmaps are drawn.
    this.graphics.read(second, 1, 1);
    const time = performance.now() - begin;
    this.toward = [view.right, view.up, view.toward].map((axis) => dot(axis, this.lamp));
    this.frames = {[this.frame]: {u_first: first, u_second: second, u_most: [1, 1, 1]}};
    this.panel.figure('lightmaps', `${this.size} × ${this.size} texels`);
    this.panel.figure('time for them', `${time.toFixed(1)} ms`);
    this.stale = made !== this.made;
    // The first times have the compilation of the shaders in them.
    if (this.grows && ++this.times > 2 && time < FAST && this.size < Number(SIZES.at(-1))) {
      this.choose(String(2 * this.size));
      this.grows = true;
    }
  }

  // The lightmaps of a frame, as [2 x height x width x 4] numbers: right, left, top, bottom; front, back, opacity, emission.
  read(frame = this.frame) {
    if (this.live && (this.stale || this.shown !== frame)) {
      this.frame = frame;
      this.#compute();
    }
    const {u_first, u_second} = this.frames[frame], values = [u_first, u_second].map((map) => this.graphics.read(map));
    return Float32Array.from([...values[0], ...values[1]], (x) => x * x);
  }

  #uniforms(width) {
    return {
      ...this.frames[this.frame], ...this.display.uniforms(width), u_toward: this.toward, u_plane: this.plane,
      u_light: this.light, u_glow: this.glow, u_ground: 1, u_aspect: this.aspect,
    };
  }

  draw() {
    const {graphics} = this;
    if (this.live && (this.stale || this.shown !== this.frame)) {
      // The march is soon there.
      this.#compute(this.shown === undefined ? 'march' : this.made);
      if (this.stale) this.changed();
    }
    const {width} = graphics.begin();
    graphics.use(this.program, {...this.#uniforms(width), u_camera: this.camera.matrix()});
    graphics.gl.drawArrays(graphics.gl.TRIANGLE_STRIP, 0, 4);
  }
}
