// Describes the texel under the pointer in the panel.

const PLACES = `${HEAD}
centroid in vec2 v_uv;
centroid in vec2 v_coordinate;
out vec4 place;
void main() { place = vec4(v_uv, v_coordinate); }`;
const NOWHERE = -1e9;  // beyond any UV

// Draws the surface again into the single pixel under the pointer, with coordinates as colours.
class Reading {
  // `tell` returns {tile, decoded, original} for a texel's column, row and coordinate; unknown entries are undefined.
  constructor(graphics, surface, manifest, panel, tell) {
    const {gl, canvas} = graphics;
    Object.assign(this, {graphics, surface, manifest, panel, tell});
    this.program = graphics.program(SURFACE, PLACES);
    this.target = graphics.target(1, 1, graphics.single(), gl.NEAREST, {depth: true});
    const at = (event) => {
      const box = canvas.getBoundingClientRect();
      this.point = [event.clientX - box.left, event.clientY - box.top];
      this.next ??= requestAnimationFrame(() => { this.next = undefined; this.show(); });
    };
    canvas.addEventListener('pointerdown', at);
    canvas.addEventListener('pointermove', (event) => { if (!event.buttons) at(event); });
    panel.tell([]);
  }

  // Updates the description; the surface also calls it after each picture.
  show() {
    if (!this.point) return;
    const {width, height} = this.manifest, found = this.#place();
    if (!found) {
      this.panel.tell([]);
      return;
    }
    const [u, v] = found.uv, texel = (x, count) => Math.min(Math.max(Math.floor(x * count), 0), count - 1);
    const column = texel(u, width), row = texel(v, height);
    const coordinate = this.surface.apart ? found.coordinate : [(column + 0.5) / width, (row + 0.5) / height];
    const {tile, decoded, original} = this.tell(column, row, coordinate);
    const light = (name, rgb) => rgb && `${name} ${rgb.map((x) => Number(x.toPrecision(4))).join(' ')}`;
    this.panel.tell([
      `texel ${column}, ${row}`, `UV ${u.toFixed(4)} ${v.toFixed(4)}`, tile,
      light('decoded', decoded), light('original', original),
    ]);
  }

  #place() {
    const {graphics, surface, target, point: [x, y]} = this, {gl, canvas} = graphics;
    const {clientWidth: width, clientHeight: height} = canvas, matrix = surface.camera.matrix();
    // The pixel under the pointer fills clip space.
    for (let column = 0; column < 16; column += 4) {
      matrix[column] = width * matrix[column] - (2 * x - width) * matrix[column + 3];
      matrix[column + 1] = height * matrix[column + 1] + (2 * y - height) * matrix[column + 3];
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, 0, 1, 1);
    gl.enable(gl.DEPTH_TEST);
    gl.clearBufferfv(gl.COLOR, 0, [NOWHERE, 0, 0, 0]);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    graphics.use(this.program, {...surface.shape(), u_camera: matrix});
    graphics.drawGeometry(surface.geometry, 1, surface.culled);
    const [u, v, ...coordinate] = graphics.read(target);
    return u === NOWHERE ? null : {uv: [u, v], coordinate};
  }
}
