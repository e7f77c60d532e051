// The page of six-way lightmaps: a billboard under a light that follows the pointer, in front of a checkerboard.

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

class SmokePage {
  constructor(graphics, page, panel, changed) {
    const {manifest} = page, {gl} = graphics, {frames, planes} = manifest.smoke;
    Object.assign(this, {graphics, manifest, plane: 0, light: 1, glow: 1, toward: [0.6, 0.5, 0.62]});
    const {width, height} = manifest, form = [gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE];
    const texture = (name) => graphics.plain(width, height, form, page.array(name, Uint8Array), gl.LINEAR);
    this.frames = Array.from({length: frames}, (_, i) => ({
      u_first: texture(`first_${i}`), u_second: texture(`second_${i}`), u_most: manifest.smoke.most[i],
    }));
    // The page opens on the frame with most smoke.
    const opaque = (i) => page.array(`second_${i}`, Uint8Array).reduce((sum, code, k) => sum + (k % 4 === 2 ? code : 0), 0);
    const amounts = Array.from({length: frames}, (_, i) => opaque(i));
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
    // The pointer moves the light; two touches and the wheel still move the picture.
    const pan = this.camera;
    graphics.canvas.addEventListener('pointermove', (event) => {
      if (!event.buttons || pan.pointers.size > 1 || event.shiftKey) return;
      const box = graphics.canvas.getBoundingClientRect(), half = 0.5 * Math.min(box.width, box.height);
      const x = (event.clientX - box.left - box.width / 2) / half, y = (box.top + box.height / 2 - event.clientY) / half;
      // Inside the circle the light is in front of the smoke, outside behind it.
      const far = Math.hypot(x, y), angle = Math.min(far, 2) * Math.PI / 2, scale = far > 1e-6 ? Math.sin(angle) / far : 0;
      this.toward = unit([x * scale, y * scale, Math.cos(angle)]);
      changed();
    });
    pan.still = true;
    explainCamera(panel, 'turn the light', () => pan.reset());
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
    if (Math.floor(this.playing) % this.frames.length !== this.frame) this.playing = this.frame;
    this.playing += elapsed / 1000 * this.manifest.smoke.rate;
    const frame = Math.floor(this.playing) % this.frames.length;
    if (frame !== this.frame) this.setFrame(frame);
  }

  #uniforms(width) {
    return {
      ...this.frames[this.frame], ...this.display.uniforms(width), u_toward: this.toward, u_plane: this.plane,
      u_light: this.light, u_glow: this.glow, u_ground: 1, u_aspect: this.aspect,
    };
  }

  draw() {
    const {graphics} = this, {width} = graphics.begin();
    graphics.use(this.program, {...this.#uniforms(width), u_camera: this.camera.matrix()});
    graphics.gl.drawArrays(graphics.gl.TRIANGLE_STRIP, 0, 4);
  }
}
