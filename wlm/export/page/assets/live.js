// Six-way lightmaps of smoke computed in the browser: a coarse march through a 3D texture of density, as
// `wlm_kernels/smoke/marches.py` has it, and the network of `wlm/smoke/network/unet.py`, which removes the march's noise.
//
// Lengths are in voxels. Images of many channels are stored in one texture, four channels a texel, group below group.

const MOST_NODES = 2 ** 23;  // of the lattice of optical depths, 8 bytes each, twice
const LEAST_SPACING = 0.25;  // between nodes
const FEW = 8;  // nodes that are added at a time
const PLANE_NAMES = ['right', 'left', 'top', 'bottom', 'front', 'back', 'opacity', 'emission'];
const ADAPTERS = [['front', 'back'], ['right', 'left'], ['top', 'bottom'], ['opacity', 'emission']];
const REACH = 8;  // pixels from smoke within which lightmaps may differ from 0

const FIELD = `${HEAD}
precision highp sampler3D;
uniform sampler3D u_density;
uniform vec3 u_shape, u_origin;           // of the grid; the middle of the image
uniform vec3 u_right, u_up, u_forward;
uniform vec3 u_low, u_gap;                // of the lattice, along these axes
uniform ivec3 u_nodes;
uniform int u_across;                     // layers of the lattice beside each other
uniform float u_extinction;

// Trilinear between the centres of voxels, and 0 outside the grid.
float wlm_field(sampler3D field, vec3 p)
{
    vec3 inside = clamp(p + 0.5, 0.0, 1.0) * clamp(u_shape + 0.5 - p, 0.0, 1.0);
    return texture(field, (p / u_shape).zyx).r * inside.x * inside.y * inside.z;
}`;

// The optical depth from a node to the next one on the right and above.
const GAPS = `${FIELD}
uniform vec3 u_begin, u_end;              // of the voxels with smoke
out vec2 gaps;
void main()
{
    ivec2 q = ivec2(gl_FragCoord.xy), tile = q / u_nodes.xy;
    ivec3 node = ivec3(q - tile * u_nodes.xy, tile.y * u_across + tile.x);
    vec3 at = u_low + vec3(node) * u_gap, p = u_origin + at.x * u_right + at.y * u_up + at.z * u_forward;
    gaps = vec2(0.0);
    vec3 reach = vec3(0.5 + 0.5 * max(u_gap.x, u_gap.y));
    if (any(lessThan(p, u_begin - reach)) || any(greaterThan(p, u_end + reach)) || node.z >= u_nodes.z) return;
    gaps = u_extinction * u_gap.xy * vec2(wlm_field(u_density, p + 0.5 * u_gap.x * u_right), wlm_field(u_density, p + 0.5 * u_gap.y * u_up));
}`;

// Sums of u_few gaps at most along x (u_axis 0) or y, and then of all such sums from one on.
const GROUPED = `${HEAD}
uniform sampler2D u_gaps;
uniform ivec2 u_counts, u_made;           // of a layer, in u_gaps and in the result
uniform int u_axis, u_few;
out vec2 sum;
void main()
{
    ivec2 q = ivec2(gl_FragCoord.xy), tile = q / u_made, p = q - tile * u_made;
    int begin = p[u_axis] * (u_made == u_counts ? 1 : u_few), end = min(begin + u_few, u_counts[u_axis]);
    ivec2 from = tile * u_counts + p, step = u_axis == 0 ? ivec2(1, 0) : ivec2(0, 1);
    from += (begin - p[u_axis]) * step;
    sum = vec2(0.0);
    for (int n = begin; n < end; ++n, from += step) sum += texelFetch(u_gaps, from, 0).rg;
}`;

// Optical depths from a node to the right, the left, the top and the bottom, as half floats.
const SUM = `${HEAD}
uniform sampler2D u_gaps, u_across_sums, u_up_sums;
uniform ivec2 u_counts;
uniform int u_few;
out vec4 sums;
void main()
{
    ivec2 q = ivec2(gl_FragCoord.xy), tile = q / u_counts, p = q - tile * u_counts, groups = (u_counts + u_few - 1) / u_few, group = p / u_few;
    ivec2 row = ivec2(tile.x * groups.x, q.y), column = ivec2(q.x, tile.y * groups.y), last = min((group + 1) * u_few, u_counts) - p;
    vec2 ahead = vec2(0.0);
    if (group.x + 1 < groups.x) ahead.x = texelFetch(u_across_sums, row + ivec2(group.x + 1, 0), 0).r;
    if (group.y + 1 < groups.y) ahead.y = texelFetch(u_up_sums, column + ivec2(0, group.y + 1), 0).g;
    for (int n = 0; n < last.x; ++n) ahead.x += texelFetch(u_gaps, q + ivec2(n, 0), 0).r;
    for (int n = 0; n < last.y; ++n) ahead.y += texelFetch(u_gaps, q + ivec2(0, n), 0).g;
    vec2 all = vec2(texelFetch(u_across_sums, row, 0).r, texelFetch(u_up_sums, column, 0).g);
    sums = min(vec4(ahead, max(all - ahead, vec2(0.0))).xzyw, vec4(6e4));
}`;

const CURVE = `
vec4 wlm_code(vec4 x)
{
    x = max(x, vec4(0.0));
    return mix(1.055 * pow(max(x, vec4(1e-6)), vec4(1.0 / 2.4)) - 0.055, 12.92 * x, lessThanEqual(x, vec4(0.0031308)));
}
vec4 wlm_linear(vec4 x)
{
    x = max(x, vec4(0.0));
    return mix(pow((x + 0.055) / 1.055, vec4(2.4)), x / 12.92, lessThanEqual(x, vec4(0.04045)));
}`;

// The guide: right, left, top, bottom; front, back, emission, opacity; depth. All encoded as the network reads them.
const MARCH = `${FIELD}
uniform sampler3D u_heat;
uniform sampler2D u_sums;
uniform ivec2 u_size;
uniform vec3 u_step;                      // its length, its jitter, the transparency at which a ray ends
uniform vec3 u_depth;                     // threshold of the surface; distance and length of the bounding sphere
uniform float u_pitch, u_emission;
uniform int u_seed;
layout(location = 0) out vec4 sides;
layout(location = 1) out vec4 rest;
layout(location = 2) out vec4 surface;
${CURVE}
float wlm_absorbed(float x) { return x < 0.05 ? x * (1.0 - x * (0.5 - x * (1.0 / 6.0 - x * (1.0 / 24.0 - x / 120.0)))) : 1.0 - exp(-x); }

// Interleaved gradient noise (Jimenez 2014).
float wlm_noise(vec2 place)
{
    place += 5.588238 * float(u_seed);
    float f = 0.06711056 * place.x + 0.00583715 * place.y;
    return fract(52.9829189 * fract(f));
}

vec4 wlm_depths(vec2 place, int layer)
{
    ivec2 tile = ivec2(layer % u_across, layer / u_across);
    return textureLod(u_sums, (vec2(tile * u_nodes.xy) + place + 0.5) / vec2(textureSize(u_sums, 0)), 0.0);
}

void main()
{
    vec2 pixel = floor(gl_FragCoord.xy), at = (pixel + 0.5 - 0.5 * vec2(u_size)) * vec2(u_pitch, -u_pitch);
    vec3 origin = u_origin + at.x * u_right + at.y * u_up, low = -0.5 - origin, high = u_shape + 0.5 - origin;
    float first = -1e30, last = 1e30;
    for (int axis = 0; axis < 3; ++axis) {
        float d = u_forward[axis];
        if (abs(d) > 1e-9) {
            first = max(first, min(low[axis] / d, high[axis] / d));
            last = min(last, max(low[axis] / d, high[axis] / d));
        } else if (low[axis] > 0.0 || high[axis] < 0.0) last = -1e30;
    }
    int count = last > first ? int(ceil((last - first) / u_step.x)) : 0;
    float size = (last - first) / float(max(count, 1)), offset = 0.5 + u_step.y * (wlm_noise(pixel) - 0.5);
    vec2 node = clamp((at - u_low.xy) / u_gap.xy, vec2(0.0), vec2(u_nodes.xy - 1));
    float tau = 0.0, t = 1.0, glow = 0.0, depth = 0.0;
    sides = vec4(0.0);
    for (int n = 0; n < count && t >= u_step.z; ++n) {
        float s = first + (float(n) + offset) * size, sigma = u_extinction * wlm_field(u_density, origin + s * u_forward), x = sigma * size;
        if (u_emission > 0.0) glow += t * (x > 0.0 ? wlm_absorbed(x) / x : 1.0) * u_emission * size * wlm_field(u_heat, origin + s * u_forward);
        if (x > 0.0) {
            if (depth == 0.0 && sigma > u_depth.x) depth = clamp((u_depth.y + u_depth.z - s) / u_depth.z, 0.0, 1.0);
            float z = (s - u_low.z) / u_gap.z;
            int layer = clamp(int(z), 0, u_nodes.z - 2);
            vec4 ways = mix(wlm_depths(node, layer), wlm_depths(node, layer + 1), clamp(z - float(layer), 0.0, 1.0));
            sides += t * wlm_absorbed(x) * exp(-ways);
            tau += x;
            t = exp(-tau);
        }
    }
    sides = wlm_code(sides);
    rest = vec4(wlm_code(vec4(0.5 * wlm_absorbed(2.0 * tau), t * tau, glow / (1.0 + glow), 0.0)).rgb, 1.0 - t);
    surface = vec4(depth, 0.0, 0.0, 0.0);
}`;

// Stacks the guide's planes, each as `stem` x `stem` channels of an image that is smaller by `stem`.
const STACK = `${HEAD}
uniform sampler2D u_sides, u_rest, u_surface;
uniform ivec2 u_size;                     // of the result
uniform int u_stem;
out vec4 four;
void main()
{
    ivec2 q = ivec2(gl_FragCoord.xy);
    int group = q.y / u_size.y, area = u_stem * u_stem;
    q.y -= group * u_size.y;
    vec4 made = vec4(0.0);
    for (int c = 0; c < 4; ++c) {
        int n = 4 * group + c, plane = n / area, part = n % area;
        ivec2 p = q * u_stem + ivec2(part % u_stem, part / u_stem);
        if (plane > 8 || any(greaterThanEqual(p, textureSize(u_sides, 0)))) continue;
        made[c] = plane < 4 ? texelFetch(u_sides, p, 0)[plane] : plane < 8 ? texelFetch(u_rest, p, 0)[plane - 4] : texelFetch(u_surface, p, 0).r;
    }
    four = made;
}`;

// Weights are half floats, four for each number n, two times four in a texel.
const WEIGHT = `
uniform usampler2D u_weights;
mat2x4 wlm_pair(int n)
{
    uvec4 bits = texelFetch(u_weights, ivec2(n >> 1 & 511, n >> 10), 0);
    return mat2x4(unpackHalf2x16(bits.x), unpackHalf2x16(bits.y), unpackHalf2x16(bits.z), unpackHalf2x16(bits.w));
}
vec4 wlm_weight(int n) { return wlm_pair(n)[n & 1]; }`;

// A convolution of u_groups groups of four channels. The weights of each group of the result, group of the input and tap
// are four texels, one for each channel of the input.
const CONVOLUTION = `
uniform sampler2D u_image, u_skip, u_rest, u_scale;
uniform ivec2 u_size;
uniform int u_groups, u_above, u_begin, u_bias, u_norm, u_beta, u_at;
out vec4 four;
${WEIGHT}
vec4 wlm_fetch(sampler2D image, ivec2 p, int group) { return texelFetch(image, ivec2(p.x, p.y + group * u_size.y), 0); }
float wlm_mean, wlm_inverse;

vec4 wlm_input(ivec2 p, int group)
{
#if defined JOIN  // an image of half the size, then another
    if (group < u_above) return texelFetch(u_image, ivec2(p.x / 2, p.y / 2 + group * (u_size.y / 2)), 0);
    return wlm_fetch(u_skip, p, group - u_above);
#elif defined PRODUCT  // of the halves of the channels
    return wlm_fetch(u_image, p, group) * wlm_fetch(u_image, p, group + u_groups);
#elif defined SCALE  // of each channel
    return wlm_fetch(u_image, p, group) * texelFetch(u_scale, ivec2(0, group), 0);
#elif defined NORM  // over the channels of each pixel
    return (wlm_fetch(u_image, p, group) - wlm_mean) * wlm_inverse * wlm_weight(u_norm + group) + wlm_weight(u_norm + u_groups + group);
#else
    return wlm_fetch(u_image, p, group);
#endif
}

void main()
{
    ivec2 q = ivec2(gl_FragCoord.xy);
    int group = q.y / u_size.y - u_at;
    q.y %= u_size.y;
#ifdef NORM
    float sum = 0.0, squares = 0.0;
    for (int i = 0; i < u_groups; ++i) sum += dot(wlm_fetch(u_image, q, i), vec4(1.0));
    wlm_mean = sum / float(4 * u_groups);
    for (int i = 0; i < u_groups; ++i) {
        vec4 apart = wlm_fetch(u_image, q, i) - wlm_mean;
        squares += dot(apart, apart);
    }
    wlm_inverse = inversesqrt(squares / float(4 * u_groups) + 1e-6);
#endif
    four = u_bias < 0 ? vec4(0.0) : wlm_weight(u_bias + group);
    int n = u_begin + group * u_groups * EDGE * EDGE * 4;
    for (int i = 0; i < u_groups; ++i)
        for (int y = -EDGE / 2; y <= EDGE / 2; ++y)
            for (int x = -EDGE / 2; x <= EDGE / 2; ++x, n += 4) {
                ivec2 p = q + ivec2(x, y);
                if (any(lessThan(p, ivec2(0))) || any(greaterThanEqual(p, u_size))) continue;
                vec4 x4 = wlm_input(p, i);
                four += wlm_pair(n) * x4.xy + wlm_pair(n + 2) * x4.zw;
            }
#ifdef RELU
    four = max(four, vec4(0.0));
#endif
#ifdef REST
    four = wlm_fetch(u_rest, q, group) + wlm_weight(u_beta + group) * four;
#endif
}`;

// The product of the two halves of the channels, each after a 3 x 3 convolution of single channels.
const GATE = `${HEAD}
uniform sampler2D u_image;
uniform ivec2 u_size;
uniform int u_groups, u_begin, u_bias;
out vec4 four;
${WEIGHT}
vec4 wlm_half(ivec2 q, int group)
{
    vec4 sum = wlm_weight(u_bias + group);
    for (int y = -1; y <= 1; ++y)
        for (int x = -1; x <= 1; ++x) {
            ivec2 p = q + ivec2(x, y);
            if (any(lessThan(p, ivec2(0))) || any(greaterThanEqual(p, u_size))) continue;
            sum += wlm_weight(u_begin + group * 9 + (y + 1) * 3 + x + 1) * texelFetch(u_image, ivec2(p.x, p.y + group * u_size.y), 0);
        }
    return sum;
}
void main()
{
    ivec2 q = ivec2(gl_FragCoord.xy);
    int group = q.y / u_size.y;
    q.y %= u_size.y;
    four = wlm_half(q, group) * wlm_half(q, group + u_groups);
}`;

const POOLED = `${HEAD}
uniform sampler2D u_image;
out vec4 four;
void main()
{
    ivec2 p = 2 * ivec2(gl_FragCoord.xy);
    vec4 above = max(texelFetch(u_image, p, 0), texelFetch(u_image, p + ivec2(1, 0), 0));
    four = max(above, max(texelFetch(u_image, p + ivec2(0, 1), 0), texelFetch(u_image, p + ivec2(1, 1), 0)));
}`;

// The mean of u_count texels from u_count * row on, along a row or down a column.
const MEAN = `${HEAD}
uniform sampler2D u_image;
uniform int u_count, u_down;
out vec4 four;
void main()
{
    int row = int(gl_FragCoord.y);
    four = vec4(0.0);
    for (int n = 0; n < u_count; ++n) four += texelFetch(u_image, u_down > 0 ? ivec2(0, row * u_count + n) : ivec2(n, row), 0);
    four /= float(u_count);
}`;

// Whether there is smoke in each block of pixels.
const NEAR = `${HEAD}
uniform sampler2D u_rest;
out vec4 near;
void main()
{
    ivec2 p = ${REACH} * ivec2(gl_FragCoord.xy), last = textureSize(u_rest, 0) - 1;
    near = vec4(0.0);
    for (int n = 0; n < ${REACH * REACH}; ++n)
        if (texelFetch(u_rest, min(p + ivec2(n % ${REACH}, n / ${REACH}), last), 0).a > 0.0) near = vec4(1.0);
}`;

// The network's planes near smoke: right, left, top, bottom, or front, back, opacity, emission.
const planesShader = (channels) => `${HEAD}
uniform sampler2D u_heads, u_filtered, u_near;
uniform ivec2 u_inner, u_padded;
uniform int u_half, u_stem;
out vec4 four;
const int CHANNELS[8] = int[8](${channels.join()});   // of the heads
void main()
{
    ivec2 p = ivec2(gl_FragCoord.xy), block = p / ${REACH}, last = textureSize(u_near, 0) - 1, q = p / u_stem;
    float near = 0.0;
    for (int n = 0; n < 9; ++n) near = max(near, texelFetch(u_near, clamp(block + ivec2(n % 3, n / 3) - 1, ivec2(0), last), 0).r);
    vec4 made = texelFetch(u_filtered, ivec2(p.x, p.y + u_half * u_padded.y), 0);
    for (int c = 0; c < 4; ++c) {
        int n = CHANNELS[4 * u_half + c] + (p.y % u_stem) * u_stem + p.x % u_stem;
        made[c] += texelFetch(u_heads, ivec2(q.x, q.y + (n >> 2) * u_inner.y), 0)[n & 3];
    }
    four = near * max(made, vec4(0.0));
    if (u_half == 1) four.zw = min(four.zw, vec2(1.0));
}`;

// The lightmaps as square roots, from the planes of the guide or of the network.
const ROOTS = `${HEAD}
uniform sampler2D u_planes;
uniform int u_half, u_guide, u_hot;
out vec4 four;
${CURVE}
void main()
{
    vec4 code = texelFetch(u_planes, ivec2(gl_FragCoord.xy), 0);
    if (u_half == 1 && u_guide == 1) code = code.xywz;
    vec4 light = wlm_linear(code);
    if (u_half == 1) light.zw = vec2(code.z, u_hot == 1 ? min(light.w / max(1.0 - light.w, 1e-6), 65504.0) : 0.0);
    four = sqrt(light);
}`;

const ceilTo = (n, step) => Math.ceil(n / step) * step;
const partsOf = (length, step) => Math.max(Math.ceil(length / step - 1e-6), 1);

// The lowest and the highest corner of the voxels with smoke, and their number.
function smokyBox(shape, density) {
  const low = [...shape], high = [0, 0, 0];
  let count = 0;
  for (let i = 0, n = 0; i < shape[0]; ++i) {
    for (let j = 0; j < shape[1]; ++j) {
      let first = -1, last = -1;
      for (let k = 0; k < shape[2]; ++k, ++n) {
        if (!density[n]) continue;
        count += 1;
        if (first < 0) first = k;
        last = k;
      }
      if (first < 0) continue;
      [[i, i], [j, j], [first, last]].forEach(([from, to], axis) => {
        low[axis] = Math.min(low[axis], from);
        high[axis] = Math.max(high[axis], to + 1);
      });
    }
  }
  return {low, high, count};
}

class LiveSmoke {
  // `network` has the settings, the names of the planes, and the shapes of all weights, which follow each other as half
  // floats in `weights`; null: only the march.
  constructor(graphics, network, weights) {
    Object.assign(this, {graphics, network, programs: new Map(), targets: new Map()});
    if (network) this.#pack(network, weights);
  }

  // Makes the textures of smoke: `shape`, `voxel` and `origin` of its grid, the factors of `density` and perhaps `heat`, the
  // settings of its `march`, and arrays [X, Y, Z] of half floats by the names of the factors.
  volume(settings, arrays) {
    const {gl} = this.graphics, {shape} = settings, most = gl.getParameter(gl.MAX_3D_TEXTURE_SIZE);
    if (Math.max(...shape) > most) throw new Error(`this browser shows smoke of at most ${most} voxels along an edge, found ${shape.join(' × ')}`);
    const field = (values) => {
      const result = {target: gl.TEXTURE_3D, texture: gl.createTexture()};
      gl.bindTexture(gl.TEXTURE_3D, result.texture);
      for (const name of ['MIN', 'MAG']) gl.texParameteri(gl.TEXTURE_3D, gl[`TEXTURE_${name}_FILTER`], gl.LINEAR);
      for (const axis of ['S', 'T', 'R']) gl.texParameteri(gl.TEXTURE_3D, gl[`TEXTURE_WRAP_${axis}`], gl.CLAMP_TO_EDGE);
      gl.texImage3D(gl.TEXTURE_3D, 0, gl.R16F, shape[2], shape[1], shape[0], 0, gl.RED, gl.HALF_FLOAT, values);
      return result;
    };
    const fields = Object.fromEntries(Object.entries(arrays).map(([name, values]) => [name, field(values)]));
    return {...settings, ...smokyBox(shape, arrays.density), fields};
  }

  discard({fields}) { this.graphics.discard(...Object.values(fields)); }

  // Computes the lightmaps of a `volume` seen by an orthographic camera: its axes, the point in the middle of its image and
  // the image's height in the world, and its size. They are `made` by the network, if there is one, or by the march. Returns
  // textures of square roots, `first` and `second`.
  render(volume, {right, up, toward, target, extent, width, height}, made = 'network') {
    const {gl} = this.graphics, {shape, march, voxel, origin} = volume, forward = toward.map((x) => -x), size = [width, height];
    const middle = target.map((x, i) => (x - origin[i]) / voxel), axes = [right, up, forward];
    const common = {
      u_density: volume.fields.density, u_shape: shape, u_origin: middle, u_right: right, u_up: up, u_forward: forward,
      u_extinction: volume.density, ...this.#lattice(volume, axes, middle),
    };
    const sums = this.#sums(common, volume);
    gl.disable(gl.DEPTH_TEST);
    const radius = 0.5 * Math.hypot(...shape), ahead = forward.reduce((sum, a, i) => sum + a * (0.5 * shape[i] - middle[i]), 0);
    const [u_sides, u_rest, u_surface] = this.#pass(MARCH, this.#target('guide', ...size, {count: 3}), {
      ...common, u_sums: sums, u_heat: volume.fields.heat ?? volume.fields.density, u_size: size, u_step: [march.step, march.jitter, march.cutoff], u_seed: 0,
      u_depth: [march.threshold, ahead - radius, 2 * radius], u_pitch: extent / height / voxel, u_emission: volume.heat ?? 0,
    }).each;
    const predicted = this.network && made === 'network', planes = predicted ? this.#infer({u_sides, u_rest, u_surface}, width, height) : [u_sides, u_rest];
    const [first, second] = [0, 1].map((u_half) => this.#pass(ROOTS, this.#target(`maps ${u_half}`, width, height, {filter: gl.LINEAR}), {
      u_planes: planes[u_half], u_half, u_guide: predicted ? 0 : 1, u_hot: volume.fields.heat ? 1 : 0,
    }));
    return {first, second};
  }

  #pass(shader, target, values) {
    const {gl} = this.graphics;
    if (!this.programs.has(shader)) this.programs.set(shader, this.graphics.program(WHOLE, shader));
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, target.from ?? 0, target.width, target.rows ?? target.height);
    this.graphics.use(this.programs.get(shader), values);
    this.graphics.draw(3);
    return target;
  }

  // A target by name, of half floats or in another `form`; it is made again when its size changes. `count` textures are drawn at once.
  #target(name, width, height, {filter, form = this.graphics.half(), count = 1} = {}) {
    const {gl} = this.graphics, old = this.targets.get(name), most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    if (old?.width === width && old.height === height) return old;
    if (Math.max(width, height) > most) throw new Error(`this browser has textures of at most ${most} texels along a side, expected ${width} × ${height}`);
    if (old) this.graphics.discard(...old.each);
    const made = this.graphics.target(width, height, form, filter ?? gl.NEAREST);
    made.each = [made];
    for (let n = 1; n < count; ++n) {
      made.each.push(this.graphics.plain(width, height, form, null, gl.NEAREST));
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + n, gl.TEXTURE_2D, made.each[n].texture, 0);
    }
    gl.drawBuffers(made.each.map((_, n) => gl.COLOR_ATTACHMENT0 + n));
    this.targets.set(name, made);
    return made;
  }

  // The lattice over the grid along the camera's axes, of which only the part with smoke is kept.
  #lattice({shape, march, low, high}, axes, middle) {
    const extents = axes.map((axis) => axis.reduce((sum, a, i) => sum + (shape[i] + 1) * Math.abs(a), 0));
    const ends = (from, to) => axes.map((axis) => [Math.min, Math.max].map((end) => (
      axis.reduce((sum, a, i) => sum + end((from[i] - 0.5 - middle[i]) * a, (to[i] + 0.5 - middle[i]) * a), 0))));
    const whole = ends([0, 0, 0], shape), smoky = ends(low, high), empty = high[0] === 0;
    for (let spacing = Math.max(march.spacing ?? march.step, LEAST_SPACING); ; spacing *= 1.1) {
      const gaps = extents.map((extent, i) => extent / partsOf(extent, spacing));
      const last = extents.map((extent, i) => partsOf(extent, spacing));
      const begin = smoky.map(([from], i) => empty ? 0 : Math.max(Math.floor((from - whole[i][0]) / gaps[i]), 0));
      const nodes = smoky.map(([, to], i) => empty ? 2 : Math.min(Math.ceil((to - whole[i][0]) / gaps[i]), last[i]) - begin[i] + 1);
      if (nodes[0] * nodes[1] * nodes[2] > MOST_NODES) continue;
      const across = Math.max(Math.round(Math.sqrt(nodes[2] * nodes[1] / nodes[0])), 1);
      return {u_low: begin.map((n, i) => whole[i][0] + n * gaps[i]), u_gap: gaps, u_nodes: nodes, u_across: across};
    }
  }

  // Sums of optical depths at the nodes, along x and y in two steps each: of few nodes, and of these sums.
  #sums(common, {low, high}) {
    const {gl} = this.graphics, {u_nodes: [x, y, z], u_across} = common, rows = Math.ceil(z / u_across), pair = {form: [gl.RG32F, gl.RG, gl.FLOAT]};
    const u_gaps = this.#pass(GAPS, this.#target('gaps', u_across * x, rows * y, pair), {...common, u_begin: low, u_end: high});
    const along = [[Math.ceil(x / FEW), y], [x, Math.ceil(y / FEW)]].map((u_made, u_axis) => {
      const size = [u_across * u_made[0], rows * u_made[1], pair];
      const few = this.#pass(GROUPED, this.#target(`few ${u_axis}`, ...size), {u_gaps, u_counts: [x, y], u_made, u_axis, u_few: FEW});
      return this.#pass(GROUPED, this.#target(`all ${u_axis}`, ...size), {u_gaps: few, u_counts: u_made, u_made, u_axis, u_few: u_made[u_axis]});
    });
    return this.#pass(SUM, this.#target('sums', u_across * x, rows * y, {filter: gl.LINEAR}), {
      u_gaps, u_across_sums: along[0], u_up_sums: along[1], u_counts: [x, y], u_few: FEW,
    });
  }

  // Packs the weights into one texture, four channels of an output a texel, and keeps where those of each name begin.
  #pack({shapes, names}, weights) {
    const texels = [];
    let offset = 0;
    this.places = {};
    for (const [name, [rows, columns = 1, height = 1, width = 1]] of Object.entries(shapes)) {
      const first = offset;
      offset += rows * columns * height * width;
      if (texels.length % 8) texels.push(0, 0, 0, 0);
      this.places[name] = texels.length / 4;
      const push = (count, texel) => { for (let n = 0; n < 4 * count; ++n) texels.push(texel(n)); };
      const taps = height * width, groups = Math.ceil(columns / 4), whole = Math.ceil(rows / 4);
      const at = (row, column, tap) => row < rows && column < columns ? weights[first + (row * columns + column) * taps + tap] : 0;
      // Rows of the guide's filter are in the order of the network's planes.
      const order = (row) => name === 'filter.weight' ? names.indexOf(PLANE_NAMES[row]) : row;
      if (columns === 1) push(whole * taps, (n) => at(4 * Math.floor(n / 4 / taps) + n % 4, 0, (n >> 2) % taps));
      else {
        push(whole * groups * taps * 4, (n) => {
          const tap = (n >> 4) % taps, group = Math.floor((n >> 4) / taps);
          return at(order(4 * Math.floor(group / groups) + (n & 3)), 4 * (group % groups) + (n >> 2 & 3), tap);
        });
      }
    }
    const {gl} = this.graphics, values = new Uint16Array(4096 * Math.ceil(texels.length / 4096));
    values.set(texels);
    const form = [gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT];
    this.weights = this.graphics.plain(512, values.length / 4096, form, new Uint32Array(values.buffer), gl.NEAREST);
  }

  // Runs the network on a guide; returns its encoded planes, in two textures.
  #infer(guide, width, height) {
    const {network: {settings: {width: first, levels, stem, adapters}, names}, places} = this, area = stem * stem;
    const step = stem * 2 ** (levels - 1), padded = [ceilTo(width, step), ceilTo(height, step)], sizes = [];
    for (let level = 0; level < levels; ++level) sizes.push(padded.map((n) => n / stem / 2 ** level));
    const target = (name, [across, down], groups, options) => this.#target(name, across, down * groups, options);
    const stack = (name, factor, [across, down]) => this.#pass(STACK, target(name, [across, down], Math.ceil(9 * factor * factor / 4)), {
      ...guide, u_size: [across, down], u_stem: factor,
    });
    // A convolution: `name` of its weights, the input's size and groups of channels, what its shader does, and further inputs.
    const convolve = (name, into, size, groups, edge, made, uses, values, options) => this.#pass(
      `${HEAD}#define EDGE ${edge}\n${uses.map((use) => `#define ${use}\n`).join('')}${CONVOLUTION}`, {...target(into, size, made, options), ...options},
      {u_weights: this.weights, u_size: size, u_groups: groups, u_begin: places[`${name}.weight`], u_bias: places[`${name}.bias`] ?? -1, u_at: 0, ...values},
    );
    const skips = [];
    let image = stack('inner', stem, sizes[0]), groups = Math.ceil(9 * area / 4);
    const twice = (name, level, uses, values) => {
      const size = sizes[level], made = first * 2 ** level / 4;
      const between = convolve(`${name}.0`, `between ${level}`, size, groups, 3, made, ['RELU', ...uses], values);
      image = convolve(`${name}.2`, `${name}`, size, made, 3, made, ['RELU'], {u_image: between});
      groups = made;
    };
    for (let level = 0; level < levels; ++level) {
      if (level) image = this.#pass(POOLED, target(`pooled ${level}`, sizes[level], groups), {u_image: image});
      twice(`encoder.${level}`, level, [], {u_image: image});
      skips.push(image);
    }
    for (let level = levels - 2; level >= 0; --level) {
      const above = groups / 2, raised = convolve(`up.${level}`, `up ${level}`, sizes[level + 1], groups, 1, above, [], {u_image: image});
      groups = 2 * above;
      twice(`decoder.${level}`, level, ['JOIN'], {u_image: raised, u_skip: skips[level], u_above: above});
    }
    const chosen = adapters ? ADAPTERS : [names], size = sizes[0], each = chosen.map((group) => Math.ceil(group.length * area / 4));
    const total = each.reduce((sum, n) => sum + n, 0), channels = {};
    let at = 0, heads;
    chosen.forEach((group, n) => {
      const block = `adapters.${n}`, place = (name) => places[`${block}.${name}`], norm = (number) => ({u_norm: place(`norm${number}.weight`)});
      const wide = convolve(`${block}.expand`, 'wide', size, groups, 1, 2 * groups, ['NORM'], {u_image: image, ...norm(1)});
      const gated = this.#pass(GATE, target('gated', size, groups), {
        u_weights: this.weights, u_image: wide, u_size: size, u_groups: groups, u_begin: place('depthwise.weight'), u_bias: place('depthwise.bias'),
      });
      const rows = this.#pass(MEAN, target('rows', [1, size[1]], groups, {form: this.graphics.single()}), {u_image: gated, u_count: size[0], u_down: 0});
      const mean = this.#pass(MEAN, target('mean', [1, 1], groups, {form: this.graphics.single()}), {u_image: rows, u_count: size[1], u_down: 1});
      const scale = convolve(`${block}.attend`, 'scale', [1, 1], groups, 1, groups, [], {u_image: mean}, {form: this.graphics.single()});
      const mixed = convolve(`${block}.project`, 'mixed', size, groups, 1, groups, ['SCALE', 'REST'], {
        u_image: gated, u_scale: scale, u_rest: image, u_beta: place('beta'),
      });
      const widened = convolve(`${block}.widen`, 'wide', size, groups, 1, 2 * groups, ['NORM'], {u_image: mixed, ...norm(2)});
      const made = convolve(`${block}.narrow`, 'adapted', size, groups, 1, groups, ['PRODUCT', 'REST'], {
        u_image: widened, u_rest: mixed, u_beta: place('gamma'),
      });
      // Each adapter writes its part of the heads.
      const part = {from: at * size[1], rows: each[n] * size[1]};
      heads = convolve(`heads.${n}`, 'heads', size, groups, 3, total, [], {u_image: made, u_at: at}, part);
      group.forEach((name, i) => { channels[name] = 4 * at + i * area; });
      at += each[n];
    });
    const u_filtered = convolve('filter', 'filtered', padded, 3, 5, 2, [], {u_image: stack('outer', 1, padded)});
    const blocks = [width, height].map((n) => Math.ceil(n / REACH));
    const u_near = this.#pass(NEAR, this.#target('near', ...blocks), guide);
    this.shader ??= planesShader(PLANE_NAMES.map((name) => channels[name]));
    return [0, 1].map((u_half) => this.#pass(this.shader, this.#target(`planes ${u_half}`, width, height), {
      u_heads: heads, u_filtered, u_near, u_inner: size, u_padded: padded, u_stem: stem, u_half,
    }));
  }
}
