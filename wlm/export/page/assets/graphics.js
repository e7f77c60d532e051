// A thin layer over WebGL2: programs with uniforms by name, textures, render targets.

const HEAD = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
precision highp sampler2DArray;
`;

// A triangle that covers the whole target.
const WHOLE = `${HEAD}
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

class Graphics {
  // `gl` is a context that already exists.
  constructor(canvas, gl = canvas.getContext('webgl2', {antialias: true, alpha: false})) {
    if (!gl) throw new Error('this browser has no WebGL2');
    this.gl = gl;
    this.canvas = canvas;
    // `#unpacked` at the end of the address acts as if the browser had no block compression.
    this.bptc = location.hash === '#unpacked' ? null : gl.getExtension('EXT_texture_compression_bptc');
    if (!gl.getExtension('EXT_color_buffer_float')) throw new Error('this browser can not draw into float textures');
    this.floatLinear = gl.getExtension('OES_texture_float_linear');
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  }

  // The colour of the page, which follows the browser's choice of light or dark.
  get paper() {
    const text = getComputedStyle(document.body).backgroundColor;
    return text.match(/[\d.]+/g).slice(0, 3).map((x) => x / 255);
  }

  program(vertex, fragment) {
    const {gl} = this, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    const places = new Map();
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); ++i) {
      const {name, type} = gl.getActiveUniform(program, i);
      places.set(name, {place: gl.getUniformLocation(program, name), type});
    }
    return {program, places, attribute: (name) => gl.getAttribLocation(program, name)};
  }

  // Activates a program and sets its uniforms: numbers, vectors, matrices; textures get units in order.
  use(program, values) {
    const {gl} = this;
    gl.useProgram(program.program);
    let unit = 0;
    for (const [name, value] of Object.entries(values)) {
      const found = program.places.get(name);
      if (!found) continue;
      const {place, type} = found;
      if (value?.texture) {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(value.target, value.texture);
        gl.uniform1i(place, unit++);
      } else if (type === gl.FLOAT_MAT4) gl.uniformMatrix4fv(place, false, value);
      else if (type === gl.FLOAT_VEC2) gl.uniform2fv(place, value);
      else if (type === gl.FLOAT_VEC3) gl.uniform3fv(place, value);
      else if (type === gl.FLOAT_VEC4) gl.uniform4fv(place, value);
      else if (type === gl.INT_VEC2) gl.uniform2iv(place, value);
      else if (type === gl.INT_VEC3) gl.uniform3iv(place, value);
      else if (type === gl.FLOAT) gl.uniform1f(place, value);
      else gl.uniform1i(place, value);
    }
  }

  #texture(target, filter, wraps = {}) {
    const {gl} = this, texture = gl.createTexture();
    gl.bindTexture(target, texture);
    gl.texParameteri(target, gl.TEXTURE_MIN_FILTER, filter);
    gl.texParameteri(target, gl.TEXTURE_MAG_FILTER, filter);
    for (const axis of ['S', 'T', 'R']) {
      gl.texParameteri(target, gl[`TEXTURE_WRAP_${axis}`], wraps[axis] ? gl.REPEAT : gl.CLAMP_TO_EDGE);
    }
    return {target, texture};
  }

  // Makes a texture of uncompressed texels; `form` is [internal format, format, type].
  plain(width, height, form, values, filter, wraps) {
    const {gl} = this, result = this.#texture(gl.TEXTURE_2D, filter, wraps);
    gl.texImage2D(gl.TEXTURE_2D, 0, form[0], width, height, 0, form[1], form[2], values);
    return {...result, width, height};
  }

  // Make textures of three half floats, of nine bits and a shared exponent, or of BC6H blocks; `read` gives the array.
  halves(width, height, read, filter) {
    const {gl} = this;
    return this.plain(width, height, [gl.RGB16F, gl.RGB, gl.HALF_FLOAT], read(Uint16Array), filter);
  }

  exponents(width, height, read, filter) { return this.plain(width, height, this.shared(), read(Uint32Array), filter); }

  hdrBlocks(width, height, read, filter) {
    const {gl} = this, form = this.bptc?.COMPRESSED_RGB_BPTC_UNSIGNED_FLOAT_EXT;
    if (!form) throw new Error('this browser can not show BC6H textures');
    // Blocks are uploaded whole, and copied: a size in texels that are no whole blocks is not allowed.
    const [across, down] = [width, height].map((side) => 4 * Math.ceil(side / 4)), blocks = this.#texture(gl.TEXTURE_2D, gl.NEAREST);
    gl.compressedTexImage2D(gl.TEXTURE_2D, 0, form, across, down, 0, read(Uint8Array));
    const copied = this.target(width, height, this.half(), filter);
    this.copier ??= this.program(WHOLE, `${HEAD}
uniform sampler2D u_blocks;
out vec4 texel;
void main() { texel = texelFetch(u_blocks, ivec2(gl_FragCoord.xy), 0); }`);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.DEPTH_TEST);
    this.use(this.copier, {u_blocks: blocks});
    this.draw(3);
    this.discard(blocks);
    return copied;
  }

  // Makes a texture of BC7 blocks, which are unpacked if the browser does not support them.
  blocks(width, height, bytes, filter) {
    const {gl} = this;
    if (!this.bptc) return this.plain(width, height, [gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE], unpackBlocks(bytes, width, height), filter);
    const result = this.#texture(gl.TEXTURE_2D, filter), form = this.bptc.COMPRESSED_RGBA_BPTC_UNORM_EXT;
    gl.compressedTexImage2D(gl.TEXTURE_2D, 0, form, width, height, 0, bytes);
    return {...result, width, height};
  }

  // Allocates a texture array of BC7 blocks, to be filled layer by layer.
  layers(width, height, count) {
    const {gl} = this, target = gl.TEXTURE_2D_ARRAY, result = this.#texture(target, gl.NEAREST);
    const form = this.bptc?.COMPRESSED_RGBA_BPTC_UNORM_EXT ?? gl.RGBA8;
    gl.texStorage3D(target, 1, form, width, height, count);
    return {...result, width, height};
  }

  // Makes a texture array of square sRGB pictures that repeat, with smaller levels.
  pictures(side, values) {
    const {gl} = this, target = gl.TEXTURE_2D_ARRAY, result = this.#texture(target, gl.LINEAR, {S: true, T: true});
    gl.texImage3D(target, 0, gl.SRGB8_ALPHA8, side, side, values.length / (4 * side * side), 0, gl.RGBA, gl.UNSIGNED_BYTE, values);
    gl.generateMipmap(target);
    gl.texParameteri(target, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    return result;
  }

  putLayer({target, texture, width, height}, layer, data) {
    const {gl} = this, place = [target, 0, 0, 0, layer, width, height, 1];
    gl.bindTexture(target, texture);
    if (this.bptc) gl.compressedTexSubImage3D(...place, this.bptc.COMPRESSED_RGBA_BPTC_UNORM_EXT, data);
    else gl.texSubImage3D(...place, gl.RGBA, gl.UNSIGNED_BYTE, unpackBlocks(data, width, height));
  }

  // Makes a texture of RGBA floats, 1,024 texels a row.
  fours(values) {
    const {gl} = this, padded = new Float32Array(4096 * Math.max(Math.ceil(values.length / 4096), 1));
    padded.set(values);
    return this.plain(1024, padded.length / 4096, [gl.RGBA32F, gl.RGBA, gl.FLOAT], padded, gl.NEAREST);
  }

  // Makes a texture of float32 or uint32 numbers, which `fetch` reads by index.
  numbers(values) {
    const {gl} = this, whole = values instanceof Uint32Array, rows = Math.max(Math.ceil(values.length / 1024), 1);
    const padded = new values.constructor(rows * 1024);
    padded.set(values);
    const form = whole ? [gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT] : [gl.R32F, gl.RED, gl.FLOAT];
    return this.plain(1024, rows, form, padded, gl.NEAREST);
  }

  // Makes a render target with its frame buffer; `depth` adds a depth buffer.
  target(width, height, form, filter, {depth = false} = {}) {
    const {gl} = this, result = this.plain(width, height, form, null, filter);
    result.buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, result.buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, result.texture, 0);
    if (depth) {
      gl.bindRenderbuffer(gl.RENDERBUFFER, gl.createRenderbuffer());
      gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, gl.getParameter(gl.RENDERBUFFER_BINDING));
    }
    return result;
  }

  // Frees textures and targets.
  discard(...items) {
    for (const {texture, buffer} of items) {
      this.gl.deleteTexture(texture);
      if (buffer) this.gl.deleteFramebuffer(buffer);
    }
  }

  half() { return [this.gl.RGBA16F, this.gl.RGBA, this.gl.HALF_FLOAT]; }
  single() { return [this.gl.RGBA32F, this.gl.RGBA, this.gl.FLOAT]; }
  shared() { return [this.gl.RGB9_E5, this.gl.RGB, this.gl.UNSIGNED_INT_5_9_9_9_REV]; }

  draw(vertices) { this.gl.drawArrays(this.gl.TRIANGLES, 0, vertices); }

  // Reads a target as RGBA floats, row 0 first. Waits until drawing is done.
  read(target, width = target.width, height = target.height, left = 0, top = 0) {
    const {gl} = this, values = new Float32Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.readPixels(left, top, width, height, gl.RGBA, gl.FLOAT, values);
    return values;
  }

  // Makes a mesh with named attributes {name: [numbers per vertex, array]} and optional indices.
  geometry(program, attributes, indices) {
    const {gl} = this, array = gl.createVertexArray();
    gl.bindVertexArray(array);
    for (const [name, [size, values]] of Object.entries(attributes)) {
      const place = program.attribute(name);
      if (place < 0) continue;
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, gl.FLOAT, false, 0, 0);
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return {array, count: indices.length};
  }

  // `oneSided` hides triangles that face away from the camera.
  drawGeometry(geometry, instances = 1, oneSided = false) {
    const {gl} = this;
    gl.bindVertexArray(geometry.array);
    if (oneSided) gl.enable(gl.CULL_FACE);
    gl.drawElementsInstanced(gl.TRIANGLES, geometry.count, gl.UNSIGNED_INT, 0, instances);
    gl.disable(gl.CULL_FACE);
    gl.bindVertexArray(null);
  }

  // Starts a picture on the canvas at the resolution of the screen.
  begin() {
    const {gl, canvas} = this, ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...this.paper, 1);
    gl.enable(gl.DEPTH_TEST);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    return {width, height, ratio};
  }
}
