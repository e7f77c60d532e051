// A lightmap on a mesh, or unwrapped as a picture. Coordinates are read inside triangles (`centroid`): at a pixel's middle
// outside of one they may be those of a gap, far from the chart, which shows as a dark rim.

const SURFACE = `${HEAD}
in vec3 a_position;
in vec2 a_uv;
in vec2 a_coordinate;
in vec3 a_tint;
in vec3 a_picture;
uniform mat4 u_camera;
uniform bool u_unwrapped;
uniform float u_aspect;
centroid out vec2 v_uv;
centroid out vec2 v_coordinate;
centroid out vec3 v_tint;
centroid out vec3 v_picture;
void main()
{
    v_uv = a_uv;
    v_coordinate = a_coordinate;
    v_tint = a_tint;
    v_picture = a_picture;
    gl_Position = u_camera * vec4(u_unwrapped ? vec3(a_uv.x * u_aspect, -a_uv.y, 0.0) : a_position, 1.0);
}`;

// A page passes `source`, GLSL with vec3 wlm_light(), and `tell`, as for `Reading`; `mask` is a texture of the texels in
// charts, if the page has no array of that name.
class Surface {
  constructor(graphics, page, source, display, panel, changed, tell, mask) {
    const {manifest} = page, coloured = page.has('pictures');
    Object.assign(this, {graphics, display, changed, aspect: manifest.width / manifest.height});
    this.program = graphics.program(SURFACE, `${HEAD}
centroid in vec2 v_uv;
centroid in vec2 v_coordinate;
uniform sampler2D u_original, u_mask;
centroid in vec3 v_tint;
centroid in vec3 v_picture;
uniform sampler2DArray u_pictures;
uniform bool u_coloured;
uniform bool u_unwrapped;
uniform vec3 u_paper;
out vec4 colour;
${source}
${DISPLAY}
void main()
{
    vec3 base = ${coloured ? 'v_tint * texture(u_pictures, v_picture).rgb' : 'vec3(1.0)'};
    if (!u_coloured) base = vec3(1.0);
    colour = vec4(wlm_shown(base * wlm_light(), base * texture(u_original, v_uv).rgb), 1.0);
    // Texels outside charts are not visible on the mesh, and are in no score: there the page is seen.
    if (u_unwrapped && texture(u_mask, v_uv).r == 0.0) colour.rgb = u_view == ${VIEWS.indexOf('error')} ? vec3(0.3) : u_paper;
}`);
    const {gl} = graphics, bytes = [gl.R8, gl.RED, gl.UNSIGNED_BYTE], {width, height} = manifest;
    this.mask = page.has('mask') ? graphics.plain(width, height, bytes, page.array('mask', Uint8Array), gl.NEAREST)
      : mask ?? graphics.plain(1, 1, bytes, new Uint8Array([255]), gl.NEAREST);
    const uv = page.has('uv') ? page.array('uv', Float32Array) : new Float32Array([0, 0, 1, 0, 1, 1, 0, 1]);
    const indices = page.has('triangles') ? page.array('triangles', Uint32Array) : new Uint32Array([0, 1, 2, 0, 2, 3]);
    const position = page.has('position') ? page.array('position', Float32Array) : new Float32Array(uv.length * 1.5);
    // Whether light is read at other coordinates than the lightmap's UV.
    this.apart = page.has('coordinate');
    const coordinate = this.apart ? page.array('coordinate', Float32Array) : uv;
    const attributes = {a_position: [3, position], a_uv: [2, uv], a_coordinate: [2, coordinate]};
    if (coloured) {
      for (const name of ['tint', 'picture']) attributes[`a_${name}`] = [3, page.array(name, Float32Array)];
      this.pictures = graphics.pictures(manifest.picture, page.array('pictures', Uint8Array));
      this.coloured = true;
      const {exposure, bare} = manifest;
      panel.toggle('materials', 'm', true, (on) => { this.coloured = on; display.expose(on ? exposure : bare); });
    }
    this.geometry = graphics.geometry(this.program, attributes, indices);
    const canvas = graphics.canvas;
    this.picture = new Camera(canvas, [0, -1, 0], [this.aspect, 0, 0], {flat: true, changed});
    this.mesh = page.has('position') ? new Camera(canvas, manifest.low, manifest.high, {up: manifest.up, changed}) : null;
    this.unwrapped = !this.mesh;
    this.#choose();
    if (this.mesh) {
      panel.choices('show', ['mesh', 'unwrapped'], 'mesh', (name) => {
        this.unwrapped = name === 'unwrapped';
        this.#choose();
        changed();
      });
      if (page.manifest.inward) {
        this.oneSided = true;
        panel.toggle('walls from outside', 'b', false, (seen) => { this.oneSided = !seen; changed(); });
      }
    }
    this.reading = new Reading(graphics, this, manifest, panel, tell);
    explainCamera(panel, this.mesh ? 'turn the camera; unwrapped: move' : 'move', () => {
      this.picture.reset();
      this.mesh?.reset();
    });
  }

  #choose() {
    this.picture.active = this.unwrapped;
    if (this.mesh) this.mesh.active = !this.unwrapped;
  }

  get camera() { return this.unwrapped ? this.picture : this.mesh; }

  // Whether triangles that face away are hidden.
  get culled() { return Boolean(this.oneSided && !this.unwrapped); }

  shape() { return {u_camera: this.camera.matrix(), u_unwrapped: this.unwrapped, u_aspect: this.aspect}; }

  draw(uniforms, original) {
    const {graphics} = this, {width} = graphics.begin();
    graphics.use(this.program, {
      ...uniforms, ...this.display.uniforms(width), ...this.shape(), u_mask: this.mask, u_paper: graphics.paper,
      u_pictures: this.pictures, u_coloured: Boolean(this.coloured && !this.unwrapped), u_original: original ?? graphics.black,
    });
    graphics.drawGeometry(this.geometry, 1, this.culled);
    this.reading.show();
  }
}

// Original frames, each uploaded when it is first needed.
class Originals {
  constructor(graphics, page) {
    const {manifest: {width, height, reference}} = page;
    const frame = (index) => page.array(`original_${index}`, Uint32Array);
    this.times = reference?.times ?? [];
    this.get = (index) => {
      this.frames ??= [];
      return this.frames[index] ??= graphics.plain(width, height, graphics.shared(), frame(index), graphics.gl.LINEAR);
    };
    // Nine bits per channel and a shared exponent.
    this.texel = (index, column, row) => {
      const code = frame(index)[row * width + column];
      return [0, 9, 18].map((shift) => (code >> shift & 511) * 2 ** ((code >>> 27) - 24));
    };
  }

  // Index of the stored frame nearest to a time.
  nearest(time, period) {
    const apart = (t) => period ? Math.min(Math.abs(t - time) % period, period - Math.abs(t - time) % period) : Math.abs(t - time);
    return this.times.reduce((best, t, i) => apart(t) < apart(this.times[best]) ? i : best, 0);
  }
}
