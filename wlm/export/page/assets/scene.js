// The page of a scene: a mesh under lightmaps, moving objects and smoke lit by probes, and a sky, over a day.

const DAY = 24;  // hours
// Copies light into a texture whose mip levels leave out texels outside charts: premultiplied by their weights.
const MAIN_WEIGH = `
uniform sampler2D u_light, u_weight;
uniform vec2 u_size;
out vec4 weighed;
void main() {
    vec2 uv = gl_FragCoord.xy / u_size;
    float weight = texture(u_weight, uv).a;
    weighed = vec4(weight * min(texture(u_light, uv).rgb, vec3(16000.0)), weight);
}`;
const SOLID = `${HEAD}
in vec3 a_position, a_colour;
in vec2 a_uv;
uniform mat4 u_camera;
out vec3 v_colour;
out vec2 v_uv;
void main()
{
    v_colour = a_colour;
    v_uv = a_uv;
    gl_Position = u_camera * vec4(a_position, 1.0);
}`;
// Lightmaps hold irradiance; radiance is base colour / pi times irradiance. The level is that of the virtual texture.
const MAPPED = `${HEAD}
in vec3 v_colour;
in vec2 v_uv;
uniform sampler2D u_map;
out vec4 radiance;
void main()
{
    vec2 size = vec2(textureSize(u_map, 0));
    float texels = max(length(dFdx(v_uv) * size), length(dFdy(v_uv) * size));
    vec4 light = textureLod(u_map, v_uv, log2(max(texels, 1.0)));
    radiance = vec4(v_colour * light.rgb / (max(light.a, 1e-4) * ${Math.PI}), 1.0);
}`;
const MOVING = `${HEAD}
in vec3 a_position, a_normal, a_colour;
uniform mat4 u_camera, u_pose;
uniform vec3 u_sh[9];
out vec3 v_radiance;
${DIFFUSE}
void main()
{
    v_radiance = a_colour * wlm_diffuse(mat3(u_pose) * a_normal, u_sh);
    gl_Position = u_camera * (u_pose * vec4(a_position, 1.0));
}`;
const PROBED = `${HEAD}
in vec3 v_radiance;
out vec4 radiance;
void main() { radiance = vec4(v_radiance, 1.0); }`;
const PUFF = `${HEAD}
uniform mat4 u_camera;
uniform vec3 u_place, u_right, u_above;  // the middle of the lower edge, and the sides of the square
out vec2 v_uv;
void main()
{
    v_uv = vec2(gl_VertexID & 1, gl_VertexID >> 1);
    gl_Position = u_camera * vec4(u_place + (v_uv.x - 0.5) * u_right + (1.0 - v_uv.y) * u_above, 1.0);
}`;
// Six-way lightmaps under one light from each of the six sides; alpha is the transparency.
const SMOKE = `${HEAD}
in vec2 v_uv;
uniform sampler2D u_first, u_second;
uniform vec3 u_most, u_sides[6];
out vec4 radiance;
// Numbers are stored as square roots, and interpolated as they are.
vec4 wlm_planes(sampler2D page)
{
    ivec2 most = textureSize(page, 0) - 1;
    vec2 at = v_uv * vec2(most + 1) - 0.5;
    ivec2 low = ivec2(floor(at));
    vec4 texels[4];
    for (int i = 0; i < 4; ++i) {
        texels[i] = texelFetch(page, clamp(low + ivec2(i & 1, i >> 1), ivec2(0), most), 0);
        texels[i] *= texels[i];
    }
    vec2 share = at - vec2(low);
    return mix(mix(texels[0], texels[1], share.x), mix(texels[2], texels[3], share.x), share.y);
}
void main()
{
    vec4 a = wlm_planes(u_first) * u_most.x, b = wlm_planes(u_second) * vec4(u_most.xx, u_most.yz);
    vec3 light = a.x * u_sides[0] + a.y * u_sides[1] + a.z * u_sides[2] + a.w * u_sides[3];
    radiance = vec4(light + b.x * u_sides[4] + b.y * u_sides[5] + b.w, 1.0 - b.z);
}`;
const SHOWN = `${HEAD}
uniform sampler2D u_now, u_then;
out vec4 colour;
${DISPLAY}
void main()
{
    ivec2 at = ivec2(gl_FragCoord.xy);
    colour = vec4(wlm_shown(texelFetch(u_now, at, 0).rgb, texelFetch(u_then, at, 0).rgb), 1.0);
}`;

const wrapped = (x, length) => (x % length + length) % length;
const lerp = (a, b, t) => a.map((x, i) => mix(x, b[i], t));
// Places an hour between rows of rising hours, of which the last is followed by the first.
function betweenHours(hours, hour) {
  const count = hours.length, before = (hours.findLastIndex((h) => h <= wrapped(hour, DAY)) + count) % count;
  const after = (before + 1) % count, span = wrapped(hours[after] - hours[before], DAY);
  return [before, after, span ? wrapped(hour - hours[before], DAY) / span : 0];
}
// The light of one of the six lightmaps of smoke, whose weight is the square of the cosine to its direction: the radiance
// of nine coefficients times that weight, over all directions, by the irradiance of the stored light, 4 pi.
function sixLight([x, y, z], c) {
  const [zero, first, second] = [0.2820948 / 6, 0.4886025 / 8, 1.0925484 / 15];
  const weights = [
    zero, first * y, first * z, first * x, second * x * y, second * y * z,
    0.3153916 / 15 * (3 * z * z - 1), second * x * z, 0.5 * second * (x * x - y * y),
  ];
  return [0, 1, 2].map((k) => Math.max(weights.reduce((sum, w, i) => sum + w * c[3 * i + k], 0), 0));
}

// A camera that flies: drag to look around; keys, wheel and two fingers move it.
class Flight {
  constructor(canvas, {reach, began, changed}) {
    Object.assign(this, {canvas, reach, began, changed, pointers: new Map(), held: new Set(), active: true});
    canvas.addEventListener('pointerdown', (event) => this.pointers.set(event.pointerId, [event.clientX, event.clientY]));
    canvas.addEventListener('pointermove', (event) => this.#drag(event));
    for (const name of ['pointerup', 'pointercancel']) {
      canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener('wheel', (event) => { if (this.active) this.#fly(0, 0, -event.deltaY * 0.0002); });
    window.addEventListener('keydown', (event) => {
      const key = event.key.toLowerCase();
      if (event.ctrlKey || event.metaKey || event.altKey || !'wasdqe'.includes(key)) return;
      this.held.add(key);
      began();
    });
    window.addEventListener('keyup', (event) => this.held.delete(event.key.toLowerCase()));
    window.addEventListener('blur', () => this.held.clear());
  }

  look(eye, target, fov) {
    const ahead = unit(target.map((x, i) => x - eye[i]));
    Object.assign(this, {eye, fov, yaw: Math.atan2(ahead[0], ahead[2]), pitch: Math.asin(ahead[1])});
  }

  // Moves by shares of the scene's size.
  #fly(right, above, ahead) {
    this.began();
    const axes = this.#axes(), step = [right, above, ahead].map((x) => x * this.reach);
    this.eye = this.eye.map((x, i) => x + step[0] * axes.right[i] + step[1] * axes.above[i] + step[2] * axes.ahead[i]);
    this.changed();
  }

  #drag(event) {
    const before = this.pointers.get(event.pointerId), now = [event.clientX, event.clientY];
    if (!before || !this.active) return;
    const [dx, dy] = [now[0] - before[0], now[1] - before[1]];
    if (!dx && !dy) return;
    this.began();
    if (this.pointers.size === 2) {
      const other = [...this.pointers].find(([id]) => id !== event.pointerId)[1];
      const span = (point) => Math.hypot(point[0] - other[0], point[1] - other[1]);
      this.#fly(-dx * 0.0003, dy * 0.0003, (span(now) - span(before)) * 0.0006);
    } else {
      this.yaw += dx * 0.004;
      this.pitch = Math.min(Math.max(this.pitch + dy * 0.004, -1.5), 1.5);
    }
    this.pointers.set(event.pointerId, now);
    this.changed();
  }

  // Moves by the keys that are held down.
  advance(elapsed) {
    if (!this.held.size) return;
    const way = (plus, minus) => (this.held.has(plus) - this.held.has(minus)) * Math.min(elapsed, 100) * 0.00015;
    this.#fly(way('d', 'a'), way('e', 'q'), way('w', 's'));
  }

  #axes() {
    const {yaw, pitch} = this, level = Math.cos(pitch);
    const ahead = [Math.sin(yaw) * level, Math.sin(pitch), Math.cos(yaw) * level];
    const right = unit(cross(ahead, [0, 1, 0]));
    return {right, above: cross(right, ahead), ahead};
  }

  // The matrix from world to clip space, column-major.
  matrix() {
    const {right, above, ahead} = this.#axes(), aspect = this.canvas.clientWidth / this.canvas.clientHeight;
    // A picture that is higher than wide shows more above and below, and less at the sides, than a square one.
    const focal = Math.min(1, Math.sqrt(aspect)) / Math.tan(this.fov * Math.PI / 360);
    const near = 0.0005 * this.reach, far = 10 * this.reach;
    const row = (axis, scale) => [...axis.map((x) => x * scale), -scale * dot(axis, this.eye)];
    const depth = row(ahead, 1), rows = [
      row(right, focal / aspect), row(above, focal),
      depth.map((x, i) => (x * (far + near) - (i === 3 ? 2 * far * near : 0)) / (far - near)), depth,
    ];
    return new Float32Array([0, 1, 2, 3].flatMap((column) => rows.map((each) => each[column])));
  }
}

// A picture in linear half floats: drawn with some samples a pixel, shown as their mean.
class Frame {
  constructor(graphics, width, height, samples) {
    const {gl} = graphics, [form] = graphics.half();
    Object.assign(this, {gl, width, height, samples, shown: graphics.target(width, height, graphics.half(), gl.NEAREST)});
    this.buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.buffer);
    this.parts = [[gl.COLOR_ATTACHMENT0, form], [gl.DEPTH_ATTACHMENT, gl.DEPTH_COMPONENT24]].map(([place, format]) => {
      const part = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, part);
      gl.renderbufferStorageMultisample(gl.RENDERBUFFER, samples, format, width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, place, gl.RENDERBUFFER, part);
      return part;
    });
  }

  begin(colour) {
    const {gl, width, height} = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.buffer);
    gl.viewport(0, 0, width, height);
    gl.enable(gl.DEPTH_TEST);
    gl.clearBufferfv(gl.COLOR, 0, [...colour, 1]);
    gl.clear(gl.DEPTH_BUFFER_BIT);
  }

  end() {
    const {gl, width, height} = this;
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.buffer);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, this.shown.buffer);
    gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
  }

  discard(graphics) {
    graphics.discard(this.shown);
    this.gl.deleteFramebuffer(this.buffer);
    for (const part of this.parts) this.gl.deleteRenderbuffer(part);
  }
}

class ScenePage extends LightmapPage {
  // Everything but the light, which the base class decodes.
  makeSurface() {
    const {graphics, page, panel, changed, manifest} = this, {scene} = manifest, {gl, canvas} = graphics;
    Object.assign(this, {scene, frames: [], samples: 4, second: 0, moves: true, cameraPath: page.array('path', Float32Array)});
    this.speed = (scene.day.last - scene.day.first) / scene.day.seconds;
    this.programs = {
      weigh: graphics.program(WHOLE, HEAD + MAIN_WEIGH), mapped: graphics.program(SOLID, MAPPED),
      probed: graphics.program(MOVING, PROBED), smoke: graphics.program(PUFF, SMOKE), shown: graphics.program(WHOLE, SHOWN),
    };
    // Shown until the first hour is decoded.
    this.preview = graphics.plain(...scene.first, graphics.shared(), page.array('first', Uint32Array), gl.LINEAR);
    this.map = graphics.target(manifest.width, manifest.height, graphics.half(), gl.LINEAR);
    gl.bindTexture(gl.TEXTURE_2D, this.map.texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    const mesh = (name, program, parts) => graphics.geometry(
      program, Object.fromEntries(Object.entries(parts).map(([part, size]) =>
        [`a_${part}`, [size, page.array(`${name}_${part}`, Float32Array)]])), page.array(`${name}_triangles`, Uint32Array));
    this.mesh = mesh('mesh', this.programs.mapped, {position: 3, colour: 3, uv: 2});
    this.moving = scene.moving.map((given, i) => ({
      ...given, mesh: mesh(`moving_${i}`, this.programs.probed, {position: 3, colour: 3, normal: 3}),
      light: page.array(`moving_${i}_light`, Float32Array),
    }));
    const picture = (name, [width, height]) => graphics.plain(
      width, height, [gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE], page.array(name, Uint8Array), gl.LINEAR);
    this.smoke = scene.smoke.map((given, i) => ({
      ...given, light: page.array(`smoke_${i}_light`, Float32Array),
      frames: given.most.map((u_most, f) => ({
        u_most, u_first: picture(`smoke_${i}_first_${f}`, given.pixels), u_second: picture(`smoke_${i}_second_${f}`, given.pixels),
      })),
    }));
    this.addControls(panel, changed, canvas);
    const decoded = () => this.groups.every((group) => group.seen.length);
    return {draw: ({u_light}, original) => this.#show(decoded() ? u_light : this.preview, original)};
  }

  addControls(panel, changed, canvas) {
    const {low, high} = this.manifest, reach = Math.hypot(...low.map((x, i) => high[i] - x));
    this.flight = new Flight(canvas, {reach, changed, began: () => { if (this.view === 'path') this.choose('fly'); }});
    this.flight.look(...this.pathAt(0));
    this.orbit = new Camera(canvas, low, high, {changed});
    this.choose = panel.choices('camera', ['path', 'fly', 'orbit'], 'path', (name) => {
      this.view = name;
      [this.flight.active, this.orbit.active] = [name !== 'orbit', name === 'orbit'];
      changed();
    });
    this.choose('path');
    panel.key('c', 'C', 'follow the path of the camera', () => this.choose('path'));
    panel.key('o', 'O', 'orbit around the scene', () => this.choose('orbit'));
    panel.toggle('motion', 'm', true, (on) => { this.moves = on; });
    panel.explain('drag', 'look around; orbit: turn the camera');
    panel.explain('W A S D, Q E', 'fly; down, up');
    panel.explain('wheel, two fingers', 'forward and back; orbit: zoom, move');
  }

  advance(elapsed) {
    super.advance(elapsed);
    const {first, last, seconds} = this.scene.day;
    // A played day is a film, whose second follows from its hour.
    if (this.playing !== undefined) this.second = Math.min(wrapped(this.time - first, DAY) / (last - first), 1) * seconds;
    else if (this.moves && (this.moving.length || this.smoke.length || this.view === 'path')) {
      this.second += Math.min(elapsed, 100) / 1000;
      this.changed();
    }
    if (this.view !== 'orbit') this.flight.advance(elapsed);
  }

  // Decodes light, but not before the first picture, which needs none.
  work(elapsed) { return this.frames.length ? super.work(elapsed) : false; }

  // Eye, target and vertical field of view of the camera's path at a second.
  pathAt(second) {
    const {cameraPath: path, scene: {path_rate: rate, day}} = this, last = path.length / 7 - 1;
    const at = Math.min(second > day.seconds ? wrapped(second, day.seconds) : second, last / rate) * rate, i = Math.floor(at);
    const row = (k) => [...path.subarray(7 * k, 7 * k + 7)], now = lerp(row(i), row(Math.min(i + 1, last)), at - i);
    return [now.slice(0, 3), now.slice(3, 6), now[6]];
  }

  // Coefficients of probes at the hour; within a switch of a lamp, those before it. `light` has rows of them by hour, and of
  // `places` at even steps of a closed path.
  #probe(light, places = 1, at = 0) {
    const {probe_hours: hours, probe_switches: switches} = this.scene, [before, after, weight] = betweenHours(hours, this.hour);
    const share = switches.includes(before) ? 0 : weight, step = at * places;
    const row = (hour, place) => light.subarray(27 * (hour * places + place % places), 27 * (hour * places + place % places + 1));
    const along = (hour) => lerp(row(hour, Math.floor(step)), row(hour, Math.floor(step) + 1), step % 1);
    return lerp(along(before), along(after), share);
  }

  // The pose of an object on its path, column-major; +z points ahead, +y up.
  #pose(path, share) {
    const lengths = path.map((point, i) => Math.hypot(...point.map((x, k) => path[(i + 1) % path.length][k] - x)));
    let left = share * lengths.reduce((sum, length) => sum + length), i = 0;
    while (i < path.length - 1 && left >= lengths[i]) left -= lengths[i++];
    const step = path[(i + 1) % path.length].map((x, k) => x - path[i][k]), across = Math.hypot(step[0], step[2]);
    const place = path[i].map((x, k) => x + step[k] * left / lengths[i]);
    const [x, z] = across ? [step[0] / across, step[2] / across] : [0, 1];
    return new Float32Array([z, 0, -x, 0, 0, 1, 0, 0, x, 0, z, 0, ...place, 1]);
  }

  #draw(frame, light, matrix) {
    const {graphics, programs, map, scene, second} = this, {gl} = graphics;
    gl.bindFramebuffer(gl.FRAMEBUFFER, map.buffer);
    gl.viewport(0, 0, map.width, map.height);
    gl.disable(gl.DEPTH_TEST);
    const u_weight = light === this.preview ? light : this.light;
    graphics.use(programs.weigh, {u_light: light, u_weight, u_size: [map.width, map.height]});
    graphics.draw(3);
    gl.bindTexture(gl.TEXTURE_2D, map.texture);
    gl.generateMipmap(gl.TEXTURE_2D);
    frame.begin(this.sky.slice(0, 3));
    graphics.use(programs.mapped, {u_camera: matrix, u_map: map});
    graphics.drawGeometry(this.mesh);
    for (const {mesh, path, seconds, places, light: stored} of this.moving) {
      const share = wrapped(second / seconds, 1);
      const sh = new Float32Array(this.#probe(stored, places, share));
      graphics.use(programs.probed, {u_camera: matrix, u_pose: this.#pose(path, share), 'u_sh[0]': sh});
      graphics.drawGeometry(mesh);
    }
    const row = (i) => [0, 4, 8, 12].map((column) => matrix[column + i]);
    const [right, above, ahead] = [0, 1, 3].map((i) => unit(row(i).slice(0, 3))), depth = row(3);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.SRC_ALPHA);
    gl.depthMask(false);
    const distance = ({position, size}) => dot(depth, position.map((x, i) => x + 0.5 * size * above[i]));
    for (const puff of [...this.smoke].sort((a, b) => distance(b) - distance(a))) {
      const sh = this.#probe(puff.light), axes = [right, above, ahead.map((x) => -x)];
      // Right, left, above, below, in front, behind.
      const sides = axes.flatMap((axis) => [axis, axis.map((x) => -x)]).flatMap((axis) => sixLight(axis, sh));
      graphics.use(programs.smoke, {
        ...puff.frames[Math.floor(second * puff.rate) % puff.frames.length], u_camera: matrix, u_place: puff.position,
        u_right: right.map((x) => x * puff.size), u_above: above.map((x) => x * puff.size), 'u_sides[0]': new Float32Array(sides),
      });
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    }
    gl.depthMask(true);
    gl.disable(gl.BLEND);
    frame.end();
  }

  // Draws the picture, and with an original the same picture under it.
  #show(light, original) {
    const {graphics, display, samples, frames} = this, {gl} = graphics, {width, height} = graphics.begin();
    const fits = (frame) => frame.width === width && frame.height === height && frame.samples === samples;
    if (!frames.every(fits)) frames.splice(0).forEach((frame) => frame.discard(graphics));
    while (frames.length < (original ? 2 : 1)) frames.push(new Frame(graphics, width, height, samples));
    if (this.view === 'path') this.flight.look(...this.pathAt(this.second));
    // All light is of the hour that is decoded.
    this.hour = this.shown ?? this.time;
    const {hours, rows} = this.scene.sky, [before, after, share] = betweenHours(hours, this.hour);
    this.sky = lerp(rows[before], rows[after], share);
    const matrix = (this.view === 'orbit' ? this.orbit : this.flight).matrix();
    const [now, then = now] = [light, original].filter(Boolean).map((each, i) => {
      this.#draw(this.frames[i], each, matrix);
      return this.frames[i].shown;
    });
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.DEPTH_TEST);
    const uniforms = display.uniforms(width);
    uniforms.u_exposure *= 2 ** this.sky[3];
    graphics.use(this.programs.shown, {...uniforms, u_now: now, u_then: then});
    graphics.draw(3);
  }

  // For scripts: shows an hour, a second of the moving objects, and if given a view.
  async show(hour, second, eye, target, fov) {
    this.second = second;
    if (eye) {
      this.choose('fly');
      this.flight.look(eye, target, fov);
    }
    await this.read(hour);
    this.changed();
  }
}
