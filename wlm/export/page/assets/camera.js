// Camera: an orbit around a scene, or a flat picture that can be moved and zoomed; by mouse, wheel and touch.

const mix = (a, b, t) => a + (b - a) * t;
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((x) => x / Math.hypot(...a));

// Lines of the help on mouse and touch; `drag` is the effect of dragging, `reset` resets the view.
function explainCamera(panel, drag, reset) {
  panel.explain('drag', drag);
  if (drag !== 'move') panel.explain('shift + drag', 'move');
  panel.explain('wheel, two fingers', 'zoom, move');
  panel.explain('shift + arrows, page up, page down', 'the same by keys, once the picture has the focus');
  panel.key('r', 'R, double-click', 'begin again', reset);
}

const STEP = 30;  // pixels that an arrow key moves the pointer, as it were
const FOCAL = 2.4;  // of the perspective, in halves of the picture's height
const FILLED = 0.93;  // of the picture, at first

class Camera {
  // `low`, `high`: corners of the visible box; `up`: 1 for y, 2 for z.
  constructor(canvas, low, high, {flat = false, up = 1, changed}) {
    Object.assign(this, {canvas, low, high, flat, up, changed, pointers: new Map(), active: true});
    this.reset();
    canvas.addEventListener('pointerdown', (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener('pointermove', (event) => this.#move(event));
    for (const name of ['pointerup', 'pointercancel']) {
      canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener('wheel', (event) => {
      event.preventDefault();
      if (this.active) this.#zoom(Math.exp(event.deltaY * 0.001));
    }, {passive: false});
    canvas.addEventListener('dblclick', () => this.reset());
    canvas.addEventListener('keydown', (event) => this.#key(event));
    // The right button moves the view, too.
    canvas.addEventListener('contextmenu', (event) => event.preventDefault());
    this.started = true;
  }

  reset() {
    this.centre = this.low.map((x, i) => 0.5 * (x + this.high[i]));
    this.radius = Math.max(0.5 * Math.hypot(...this.low.map((x, i) => this.high[i] - x)), 1e-9);
    this.distance = 1;
    [this.yaw, this.pitch] = [0.7, 0.5];
    const {right, above, toward} = this.#axes(), half = this.low.map((x, i) => 0.5 * (this.high[i] - x));
    const corners = Array.from({length: 8}, (_, n) => half.map((x, i) => n >> i & 1 ? x : -x));
    this.corners = corners.map((corner) => [dot(right, corner), dot(above, corner), dot(toward, corner)]);
    if (this.started) this.changed();
  }

  #zoom(factor) {
    this.distance = Math.min(Math.max(this.distance * factor, 0.01), 10);
    this.changed();
  }

  #move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before || !this.active) return;
    const now = [event.clientX, event.clientY];
    const [dx, dy] = [now[0] - before[0], now[1] - before[1]];
    if (this.pointers.size === 2) {
      const other = [...this.pointers].find(([id]) => id !== event.pointerId)[1];
      const span = (point) => Math.max(Math.hypot(point[0] - other[0], point[1] - other[1]), 1);
      this.#pan(0.5 * dx, 0.5 * dy);
      this.#zoom(span(before) / span(now));
    } else if (this.still && !event.shiftKey) {
      // A single touch has another use.
    } else this.#drag(dx, dy, event.shiftKey || event.buttons & 6);
    this.pointers.set(event.pointerId, now);
    this.changed();
  }

  // Moves or turns the view by pixels.
  #drag(dx, dy, moves) {
    if (this.flat || moves) this.#pan(dx, dy);
    else {
      this.yaw -= dx * 0.006;
      this.pitch = Math.min(Math.max(this.pitch + dy * 0.006, -1.55), 1.55);
    }
  }

  #key(event) {
    const turn = {ArrowLeft: [STEP, 0], ArrowRight: [-STEP, 0], ArrowUp: [0, STEP], ArrowDown: [0, -STEP]}[event.key];
    const zoom = {PageUp: 1 / 1.1, PageDown: 1.1}[event.key];
    if (!this.active || !(turn && event.shiftKey || zoom)) return;
    event.preventDefault();
    if (zoom) this.#zoom(zoom);
    else this.#drag(...turn, false);
    this.changed();
  }

  #pan(dx, dy) {
    const {right, above} = this.#axes(), step = 2 * this.#reach() / this.canvas.clientHeight;
    this.centre = this.centre.map((x, i) => x - step * (dx * right[i] - dy * above[i]));
  }

  // Half the height of the visible region, in scene units.
  #reach() {
    const aspect = this.canvas.clientWidth / this.canvas.clientHeight;
    if (!this.flat) {
      // Initially each corner of the box is inside the picture; near corners are further from its middle.
      const each = this.corners.map(([x, y, z]) => Math.max(Math.abs(y), Math.abs(x) / aspect) / FILLED + z / FOCAL);
      return this.distance * Math.max(...each, 1e-9);
    }
    const [width, height] = [0, 1].map((i) => this.high[i] - this.low[i]);
    return this.distance * 0.54 * Math.max(height, width / aspect);
  }

  #axes() {
    if (this.flat) return {right: [1, 0, 0], above: [0, 1, 0], toward: [0, 0, 1]};
    const {yaw, pitch, up} = this, level = Math.cos(pitch);
    const toward = up === 1
      ? [Math.sin(yaw) * level, Math.sin(pitch), Math.cos(yaw) * level]
      : [Math.sin(yaw) * level, -Math.cos(yaw) * level, Math.sin(pitch)];
    const right = unit(cross(up === 1 ? [0, 1, 0] : [0, 0, 1], toward));
    return {right, above: cross(toward, right), toward};
  }

  // The matrix from world to clip space, column-major: orthographic for pictures, perspective for scenes.
  matrix() {
    const {right, above, toward} = this.#axes(), reach = this.#reach();
    const aspect = this.canvas.clientWidth / this.canvas.clientHeight;
    const row = (axis, scale, from) => [...axis.map((x) => x * scale), -dot(axis, from) * scale];
    const rows = this.flat ? [
      row(right, 1 / (reach * aspect), this.centre),
      row(above, 1 / reach, this.centre),
      [0, 0, 0, 0],
      [0, 0, 0, 1],
    ] : this.#perspective(right, above, toward, reach, aspect, row);
    return new Float32Array([0, 1, 2, 3].flatMap((column) => rows.map((row) => row[column])));
  }

  #perspective(right, above, toward, reach, aspect, row) {
    const away = reach * FOCAL, eye = this.centre.map((x, i) => x + away * toward[i]);
    const near = Math.max(away - 3 * this.radius, 0.01 * reach), far = away + 3 * this.radius;
    const depth = row(toward, -1, eye);
    return [
      row(right, FOCAL / aspect, eye),
      row(above, FOCAL, eye),
      depth.map((x, i) => (x * (far + near) - (i === 3 ? 2 * far * near : 0)) / (far - near)),
      depth,
    ];
  }
}
