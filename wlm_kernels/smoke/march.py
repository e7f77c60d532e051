"""Common parts of all ray marches through smoke: medium, cameras, rays and their steps, sampling, phase function.

Lengths are in voxels. The grid [X, Y, Z] fills the box from 0 to (X, Y, Z); the centre of voxel i is at i + 1/2.
Density is trilinear between centres and 0 outside the grid, so that smoke extends half a voxel beyond the box.
Extinction per voxel is `extinction * density`. A step has the density of its sample and is integrated exactly:
1 - exp(-sigma h) instead of sigma h. The caller must pass densities that are finite and not negative.

A light is given by the direction towards it and has irradiance 4 pi, so that an isotropic phase function is 1 instead
of 1 / (4 pi).

Every march of a camera ray calls `begin` and then, while `r.done < r.count`, `look`, which sets the ray's place, sigma
and x, and then `pass_step`. Kernels differ only in what they add up between `look` and `pass_step`.

None of these marches has a gradient; `single_scatter` has one. Read `tests/reference/marching.py` first: it is the same
in float64 NumPy, without shared work between pixels.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import warp as wp

from wlm_kernels.smoke.settings import March

Empty = Callable[[tuple[int, ...], Any], wp.array]
"""Function that allocates an uninitialised buffer of a shape and a type."""

BRICK = 8
"""Voxels along an edge of a brick. Marches skip bricks without smoke."""

OPTIONS = {"enable_backward": False}
"""Options of every module of smoke kernels."""

_NEVER = wp.constant(1.0e30)
_Eight = wp.types.vector(length=8, dtype=float)
_SEEDS = 2**32
_PATTERNS = wp.constant(64)  # number of patterns of the gradient noise, a power of 2


@wp.struct
class Solid:
    """Obstacles in smoke: a mesh of the world's unit in which the smoke's voxel (0, 0, 0) has its corner at `corner`,
    the edge of a voxel in this unit, and the distance at which the ray of each pixel of the camera ends, [H, W] in this
    unit as in `View`. Without obstacles the mesh is 0, and without a camera the distances are empty."""

    mesh: wp.uint64
    corner: wp.vec3
    voxel: float
    stop: wp.array2d[float]


@functools.cache
def smoke_struct(dtype: Any, in_bricks: bool, stored: bool = False) -> Any:
    """Builds (once) the struct in which kernels take smoke with densities of `wp.float32` or `wp.float16`.

    `in_bricks` tells whether it is known which bricks of 8^3 voxels contain smoke, and `stored` whether only these are
    stored. If not, `bricks` or `places` is a meaningless integer, so that marches contain no test of bricks.
    """

    @wp.struct
    class Smoke:
        density: wp.array3d[dtype]
        temperature: wp.array3d[dtype]
        bricks: wp.array3d[wp.uint8] if in_bricks else int
        places: wp.array3d[int] if stored else int
        cells: wp.vec3i
        extinction: float
        emission: float
        solid: Solid

    return Smoke


@dataclass(frozen=True)
class Medium:
    """Smoke on a device: density, contiguous float or half [X, Y, Z], and extinction per voxel at density 1;
    temperature in an array like it, None for smoke without light, and light emitted per voxel at temperature 1.

    `empty` allocates buffers on the density's device; None: Warp's own allocator. `bricks` tells which bricks of 8^3
    voxels contain smoke, a result of `occupied`; None: marches sample every voxel. With `places`, int [X / 8, Y / 8,
    Z / 8], the numbers of bricks in `density` and `temperature`, these are [8 N, 8, 8], with 0 in brick 0; None: all
    voxels are stored. `cells` are X, Y and Z; None: the density's. `solid` are obstacles in
    the way of light and camera; None: there are none.
    """

    density: wp.array
    extinction: float
    temperature: wp.array | None = None
    emission: float = 0.0
    empty: Empty | None = None
    bricks: wp.array | None = None
    places: wp.array | None = None
    cells: tuple[int, ...] | None = None
    solid: "Solid | None" = None

    @property
    def device(self) -> wp.Device:
        return self.density.device

    def buffer(self, shape: tuple[int, ...], dtype: Any) -> wp.array:
        """Allocates an uninitialised buffer on the device of the density."""
        if self.empty is None:
            return wp.empty(shape, dtype=dtype, device=self.device)
        return self.empty(shape, dtype)

    def in_bricks(self) -> "Medium":
        """Returns the same smoke with `bricks`, so that marches skip empty bricks, which changes no result."""
        return replace(self, bricks=occupied(self)) if self.bricks is None else self

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of voxels along x, y and z."""
        return self.cells or self.density.shape

    @property
    def smoke_type(self) -> Any:
        """Type of the struct `smoke`: kernels are compiled for each such type."""
        return smoke_struct(self.density.dtype, self.bricks is not None, self.places is not None)

    @functools.cached_property
    def smoke(self) -> Any:
        """The struct in which kernels take the smoke; without a temperature the density takes its place, emission 0."""
        smoke = self.smoke_type()
        smoke.density, smoke.extinction = self.density, float(self.extinction)
        smoke.cells = wp.vec3i(*self.shape)
        smoke.temperature, smoke.emission = self.density, 0.0
        if self.temperature is not None:
            smoke.temperature, smoke.emission = self.temperature, float(self.emission)
        if self.bricks is not None:
            smoke.bricks = self.bricks
        if self.places is not None:
            smoke.places = self.places
        if self.solid is not None:
            smoke.solid = self.solid
        return smoke


def for_smoke(build: Callable[..., wp.Kernel]) -> Callable[..., None]:
    """Turns a function that builds a kernel for a `Medium.smoke_type`, and for further compile-time arguments, into the
    function that launches it.

    The kernel and its first argument, the smoke, come from the same medium: Warp does not check the type of a struct,
    and a kernel for another type of smoke would read other memory. The result takes the medium, the size of the launch,
    the kernel's inputs after the smoke, its outputs, and the further arguments of `build`. Its attribute `build` is
    `build` with a cache.
    """
    build = functools.cache(build)

    def launch(medium: Medium, size: int | tuple[int, ...], inputs: list, outputs: list, *variants: Any) -> None:
        kernel = build(medium.smoke_type, *variants)
        wp.launch(kernel, size, [medium.smoke, *inputs], outputs, device=medium.device)

    launch.build = build  # type: ignore[attr-defined]
    return launch


@wp.struct
class View:
    """A camera, in voxels. Row 0 is the top row; rays go through pixel centres.

    `origin` is the eye in perspective, or the image's centre in the plane of an orthographic camera; smoke behind it is
    not visible. `pitch` is the edge of a pixel in voxels, in perspective at distance 1. `voxel` is the edge of a voxel
    in the unit of depth images. Depths are measured from a point or plane `moved` voxels behind the origin.
    """

    origin: wp.vec3
    right: wp.vec3
    up: wp.vec3
    forward: wp.vec3
    pitch: float
    width: int
    height: int
    perspective: int
    voxel: float
    moved: float


@wp.struct
class MarchParameters:
    """The settings of `March` that kernels use, in the form for kernels."""

    step: float
    jitter: float
    seed: int
    threshold: float
    g: float
    cutoff: float


@wp.struct
class Ray:
    """A camera ray in voxels, divided into `count` steps of `length` from distance `first` on, and its current step.

    `done` is the number of the current step, and `offset` the position of the sample in each step, 0 to 1. The sample
    of the current step is at `distance` along the ray, at the point `place`, and has the extinction `sigma` per voxel;
    `x` is the optical depth of the step. `tau` and `t` are the ray's optical depth and transparency before the step.
    `pair` has the densities of an even step and of the next one.
    """

    origin: wp.vec3
    direction: wp.vec3
    first: float
    length: float
    count: int
    offset: float
    done: int
    distance: float
    place: wp.vec3
    sigma: float
    x: float
    tau: float
    t: float
    pair: wp.vec2


@wp.func
def ray(view: View, row: int, column: int) -> Ray:
    """Makes the ray of a pixel; `steps_along` divides it into steps."""
    u = (float(column) + 0.5 - 0.5 * float(view.width)) * view.pitch
    v = (0.5 * float(view.height) - float(row) - 0.5) * view.pitch
    r = Ray()
    if view.perspective != 0:
        r.origin = view.origin
        r.direction = wp.normalize(view.forward + u * view.right + v * view.up)
    else:
        r.origin = view.origin + u * view.right + v * view.up
        r.direction = view.forward
    return r


def in_tiles(height: int, width: int) -> tuple[int, int, int]:
    """Returns the size of a launch in which the 32 threads of a warp have the pixels of 4 rows and 8 columns: their
    rays read neighbouring voxels. See `pixel_of`."""
    return -(-height // 4), -(-width // 8), 32


@wp.func
def pixel_of(a: int, b: int, lane: int):
    """Returns the row and the column of a thread of an `in_tiles` launch, which may lie outside the image."""
    return 4 * a + lane // 8, 8 * b + lane % 8


@wp.func
def clip(size: wp.vec3, origin: wp.vec3, direction: wp.vec3) -> wp.vec2:
    """Finds the first and last distance along a ray at which smoke may be; first > last if the ray misses the grid."""
    first = float(-_NEVER)
    last = float(_NEVER)
    for axis in range(3):
        low = -0.5 - origin[axis]
        high = size[axis] + 0.5 - origin[axis]
        d = direction[axis]
        if wp.abs(d) > 1.0e-9:
            first = wp.max(first, wp.min(low / d, high / d))
            last = wp.min(last, wp.max(low / d, high / d))
        elif low > 0.0 or high < 0.0:
            last = -_NEVER
    return wp.vec2(first, last)


@wp.func
def size_of(density: wp.array3d[Any]) -> wp.vec3:
    return wp.vec3(float(density.shape[0]), float(density.shape[1]), float(density.shape[2]))


@wp.func
def steps_along(size: wp.vec3, origin: wp.vec3, direction: wp.vec3, step: float) -> Ray:
    """Divides the part of a ray in front of its origin and within the grid into equal steps, no longer than `step`."""
    r = Ray()
    r.origin = origin
    r.direction = direction
    span = clip(size, origin, direction)
    r.first = wp.max(span[0], 0.0)
    if span[1] > r.first:
        r.count = int(wp.ceil((span[1] - r.first) / step))
        r.length = (span[1] - r.first) / float(r.count)
    return r


@wp.func
def point_on(r: Ray, n: int, offset: float) -> wp.vec3:
    """Computes the position of the sample of step n; an offset of 1/2 is the step's middle."""
    return r.origin + (r.first + (float(n) + offset) * r.length) * r.direction


@wp.func
def box_of(smoke: Any) -> wp.vec3:
    return wp.vec3(float(smoke.cells[0]), float(smoke.cells[1]), float(smoke.cells[2]))


# Addresses from Warp's 64-bit strides would take a GPU twice as long.
@wp.func_native("return (float)field.data[i];")
def _element(field: wp.array3d[wp.float32], i: int) -> float: ...


@wp.func_native("return (float)field.data[i];")
def _element(field: wp.array3d[wp.float16], i: int) -> float: ...


_IN_BRICK = "return bricks.data[(i * bricks.shape[1] + j) * bricks.shape[2] + k];"


@wp.func_native(_IN_BRICK)
def _of_brick(bricks: wp.array3d[wp.uint8], i: int, j: int, k: int) -> int: ...


@wp.func_native(_IN_BRICK)
def _of_brick(bricks: wp.array3d[int], i: int, j: int, k: int) -> int: ...


@wp.func
def _of_brick(bricks: int, i: int, j: int, k: int) -> int:
    return 1


@wp.func
def _place(places: int, cells: wp.vec3i, i: int, j: int, k: int) -> int:
    return (i * cells[1] + j) * cells[2] + k


@wp.func
def _place(places: wp.array3d[int], cells: wp.vec3i, i: int, j: int, k: int) -> int:
    return (_of_brick(places, i >> 3, j >> 3, k >> 3) << 9) + ((i & 7) << 6) + ((j & 7) << 3) + (k & 7)


@wp.func
def voxel(field: wp.array3d[Any], smoke: Any, i: int, j: int, k: int) -> float:
    """Returns the density or the temperature of a voxel."""
    return _element(field, _place(smoke.places, smoke.cells, i, j, k))


@wp.struct
class Corners:
    """The eight voxels around a point, z fastest, and their weights along the axes: `low` of the first ones, `high` of
    the others."""

    values: _Eight
    low: wp.vec3
    high: wp.vec3


@wp.func
def _around(field: wp.array3d[Any], smoke: Any, p: wp.vec3) -> Corners:
    c = Corners()
    low = wp.vec3i()
    high = wp.vec3i()
    for a in range(3):
        x = p[a] - 0.5
        n = int(wp.floor(x))
        # Voxels outside the grid have weight 0 and a clamped index.
        last = smoke.cells[a] - 1
        c.low[a] = wp.where(n >= 0 and n <= last, 1.0 - (x - float(n)), 0.0)
        c.high[a] = wp.where(n >= -1 and n < last, x - float(n), 0.0)
        low[a] = wp.clamp(n, 0, last)
        high[a] = wp.clamp(n + 1, 0, last)
    for n in range(8):
        i = wp.where(n < 4, low[0], high[0])
        j = wp.where(n // 2 % 2 == 0, low[1], high[1])
        k = wp.where(n % 2 == 0, low[2], high[2])
        c.values[n] = voxel(field, smoke, i, j, k)
    return c


@wp.func
def _between(c: Corners) -> float:
    v = c.values
    a = c.low[1] * (c.low[2] * v[0] + c.high[2] * v[1]) + c.high[1] * (c.low[2] * v[2] + c.high[2] * v[3])
    b = c.low[1] * (c.low[2] * v[4] + c.high[2] * v[5]) + c.high[1] * (c.low[2] * v[6] + c.high[2] * v[7])
    return c.low[0] * a + c.high[0] * b


@wp.func
def density_at(field: wp.array3d[Any], smoke: Any, p: wp.vec3) -> float:
    """Interpolates the density or the temperature of smoke trilinearly, with 0 outside the grid."""
    return _between(_around(field, smoke, p))


@wp.func
def has_smoke(smoke: Any, p: wp.vec3) -> bool:
    """Tells whether there may be smoke at p, at most half a voxel outside the grid."""
    i = wp.clamp(int(p[0]), 0, smoke.cells[0] - 1)
    j = wp.clamp(int(p[1]), 0, smoke.cells[1] - 1)
    k = wp.clamp(int(p[2]), 0, smoke.cells[2] - 1)
    return _of_brick(smoke.bricks, i >> 3, j >> 3, k >> 3) != 0


@wp.func
def sample(smoke: Any, p: wp.vec3) -> float:
    """Interpolates density at p, at most half a voxel outside the grid; returns 0 at once in a brick known as empty."""
    if has_smoke(smoke, p):
        return density_at(smoke.density, smoke, p)
    return 0.0


@wp.func_native("""
    const size_t n = (i * nodes.shape[1] + j) * nodes.shape[2] + k;
#if defined(__CUDA_ARCH__)
    const float2 value = reinterpret_cast<const float2*>(nodes.data)[n];
    return wp::vec2f(value.x, value.y);
#else
    return nodes.data[n];
#endif
""")
def _node(nodes: wp.array3d[wp.vec2], i: int, j: int, k: int) -> wp.vec2: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    reinterpret_cast<float2*>(nodes.data)[n] = make_float2(value[0], value[1]);
#else
    nodes.data[n] = value;
#endif
""")
def store_node(nodes: wp.array4d[wp.vec2], n: int, value: wp.vec2): ...


@wp.func
def _node(nodes: wp.array3d[Any], i: int, j: int, k: int):
    return nodes[i, j, k]


@wp.func
def node(nodes: wp.array3d[Any], i: int, j: int, k: int):
    """Returns an element of an array, which must be contiguous for pairs; a GPU loads these at once."""
    return _node(nodes, i, j, k)


@wp.func
def between_nodes(nodes: wp.array3d[Any], q: wp.vec3):
    """Interpolates an array trilinearly at the index q, which may have fractions; q is clamped to the array."""
    x = wp.clamp(q[0], 0.0, float(nodes.shape[0] - 1))
    y = wp.clamp(q[1], 0.0, float(nodes.shape[1] - 1))
    z = wp.clamp(q[2], 0.0, float(nodes.shape[2] - 1))
    i = int(x)
    j = int(y)
    k = int(z)
    i1 = wp.min(i + 1, nodes.shape[0] - 1)
    j1 = wp.min(j + 1, nodes.shape[1] - 1)
    k1 = wp.min(k + 1, nodes.shape[2] - 1)
    fy = y - float(j)
    fz = z - float(k)
    a = wp.lerp(node(nodes, i, j, k), node(nodes, i, j, k1), fz)
    b = wp.lerp(node(nodes, i, j1, k), node(nodes, i, j1, k1), fz)
    c = wp.lerp(node(nodes, i1, j, k), node(nodes, i1, j, k1), fz)
    d = wp.lerp(node(nodes, i1, j1, k), node(nodes, i1, j1, k1), fz)
    return wp.lerp(wp.lerp(a, b, fy), wp.lerp(c, d, fy), x - float(i))


@wp.func
def absorbed(x: float) -> float:
    """Computes 1 - exp(-x), without cancellation where x is small."""
    if x < 0.05:
        return x * (1.0 - x * (0.5 - x * (1.0 / 6.0 - x * (1.0 / 24.0 - x / 120.0))))
    return 1.0 - wp.exp(-x)


@wp.func
def mean_transparency(x: float) -> float:
    """Computes (1 - exp(-x)) / x, the mean transparency along a step of optical depth x; 1 without smoke."""
    return wp.where(x > 0.0, absorbed(x) / x, 1.0)


@wp.func
def phase(g: float, cosine: float) -> float:
    """Computes the Henyey-Greenstein phase function times 4 pi; `cosine` is 1 for light that is not deflected."""
    d = 1.0 + g * g - 2.0 * g * cosine
    return (1.0 - g * g) / (d * wp.sqrt(d))


@wp.func
def noise(row: int, column: int, seed: int) -> float:
    """Computes interleaved gradient noise in [0, 1) (Jimenez 2014), whose mean over a few pixels is near 1/2."""
    pattern = float(seed & (_PATTERNS - 1))
    x = float(column) + 5.588238 * pattern
    y = float(row) + 5.588238 * pattern
    f = 0.06711056 * x + 0.00583715 * y
    f = 52.9829189 * (f - wp.floor(f))
    # A product that is rounded once for the floor and not for the difference may leave the range by an ulp.
    return wp.clamp(f - wp.floor(f), 0.0, 0.99999994)


@wp.func
def begin(view: View, row: int, column: int, smoke: Any, step: float, offset: float) -> Ray:
    """Makes the ray of a pixel, before its first step; it samples each step at `offset` of its length, 0 to 1."""
    r = ray(view, row, column)
    r = steps_along(box_of(smoke), r.origin, r.direction, step)
    if smoke.solid.stop.shape[0] > 0:
        left = wp.min(smoke.solid.stop[row, column] / view.voxel - view.moved - r.first, float(r.count) * r.length)
        r.count = int(wp.ceil(wp.max(left, 0.0) / step))
        r.length = left / float(wp.max(r.count, 1))
    r.offset = offset
    r.t = 1.0
    return r


@wp.func
def begin_jittered(view: View, row: int, column: int, smoke: Any, march: MarchParameters) -> Ray:
    """Makes the ray of a pixel like `begin`, with samples shifted by gradient noise."""
    offset = 0.5 + march.jitter * (noise(row, column, march.seed) - 0.5)
    return begin(view, row, column, smoke, march.step, offset)


@wp.func
def _two_may_have_smoke(r: Ray, smoke: Any) -> bool:
    this = has_smoke(smoke, point_on(r, r.done, r.offset))
    next = has_smoke(smoke, point_on(r, r.done + 1, r.offset))
    return this or next


@wp.func
def look(r: Ray, smoke: Any) -> Ray:
    """Samples the smoke in the ray's current step, or passes cold steps in empty bricks to a later one: sets the step's
    `distance`, `place`, `sigma` and `x`. Steps follow one another from step 0."""
    if r.done % 2 == 0:
        # Two samples at once, since a GPU's threads wait for them. One beyond the ray's end is not used.
        some = _two_may_have_smoke(r, smoke)
        while not some and smoke.emission == 0.0 and r.done + 2 < r.count:
            r.done += 2
            some = _two_may_have_smoke(r, smoke)
        r.pair = wp.vec2()
        if some:
            # All voxels are loaded before the first is used.
            one = _around(smoke.density, smoke, point_on(r, r.done, r.offset))
            two = _around(smoke.density, smoke, point_on(r, r.done + 1, r.offset))
            r.pair = wp.vec2(_between(one), _between(two))
    r.distance = r.first + (float(r.done) + r.offset) * r.length
    r.place = r.origin + r.distance * r.direction
    r.sigma = smoke.extinction * wp.where(r.done % 2 == 0, r.pair[0], r.pair[1])
    r.x = r.sigma * r.length
    return r


@wp.func
def pass_step(r: Ray, cutoff: float) -> Ray:
    """Advances to the next step, or to the end of the ray if its transparency is below the cutoff."""
    r.done += 1
    if r.x > 0.0:
        r.tau += r.x
        r.t = wp.exp(-r.tau)
        if r.t < cutoff:
            r.done = r.count
    return r


@wp.func
def surface(depth: float, r: Ray, view: View, threshold: float) -> float:
    """Returns the depth of the first sample whose extinction exceeds the threshold; `depth` is the result of the
    earlier steps, 0 if there was none."""
    if depth == 0.0 and r.sigma > threshold:
        return (r.distance + view.moved) * view.voxel
    return depth


@wp.func
def emitted(r: Ray, smoke: Any) -> float:
    """Computes the light that a step emits and that reaches the camera; air without smoke emits too where it is hot."""
    return r.t * mean_transparency(r.x) * smoke.emission * r.length * density_at(smoke.temperature, smoke, r.place)


@wp.func
def way_to_solid(solid: Solid, p: wp.vec3, toward: wp.vec3) -> float:
    """Computes the distance in voxels from p to the first obstacle in a direction; 1e30 if there is none."""
    hit = wp.mesh_query_ray(solid.mesh, solid.corner + solid.voxel * p, toward, _NEVER)
    return wp.where(hit.result, hit.t / solid.voxel, _NEVER)


@wp.func
def optical_depth(smoke: Any, p: wp.vec3, toward: wp.vec3, step: float) -> float:
    """Computes the optical depth (eq. 3) from p out of the grid, with samples in the middles of steps up to `step`."""
    r = steps_along(box_of(smoke), p, toward, step)
    tau = float(0.0)
    for n in range(r.count):
        tau += sample(smoke, point_on(r, n, 0.5))
    return tau * r.length * smoke.extinction


@wp.func
def node_position(nodes: wp.array3d[Any], size: wp.vec3, i: int, j: int, k: int) -> wp.vec3:
    """Computes a node's position in voxels; the outermost nodes lie half a voxel outside the grid of size `size`."""
    return wp.vec3(
        float(i) * (size[0] + 1.0) / float(nodes.shape[0] - 1) - 0.5,
        float(j) * (size[1] + 1.0) / float(nodes.shape[1] - 1) - 0.5,
        float(k) * (size[2] + 1.0) / float(nodes.shape[2] - 1) - 0.5,
    )


def nodes_along(shape: Sequence[int], step: float) -> tuple[int, ...]:
    """Computes the nodes along each axis for a spacing of at most `step` voxels; a step below 1 counts as 1."""
    # Each node marches to its lights separately, so the work grows with the fourth power of the resolution.
    return tuple(math.ceil((n + 1) / max(step, 1.0)) + 1 for n in shape)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int step = 16; step > 0; step /= 2)
        bits |= __shfl_xor_sync(0xffffffffu, bits, step);
#endif
    return bits;
""")
def _of_any_lane(bits: int) -> int:
    """Returns the bits that any thread of a warp has; on a CPU the bits themselves."""
    ...


@wp.func
def _marks_of(some: bool, first: bool, last: bool, shift: int) -> int:
    """Returns marks along an axis: whether there is some voxel, one of the first and one of the last of a brick."""
    return int(some) | int(first) << shift | int(last) << 2 * shift


@for_smoke
def _mark(smoke_type: Any, lanes: int) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        # out:
        marks: wp.array3d[int],
    ):
        """Marks where in a brick there is smoke: bit 9 x + 3 y + z says whether in any voxel (x, y and z 0), in one of
        the first ones along an axis (1) or of the last ones (2). A warp has a brick, a thread two columns along x."""
        a, b, c, lane = wp.tid()
        bits = int(0)
        if _of_brick(smoke.places, a, b, c) != 0:
            for n in range(lane, BRICK * BRICK, wp.static(lanes)):
                # Beyond the grid its last voxel is read again, which belongs to the same brick.
                j = wp.min(BRICK * b + (n >> 3), smoke.cells[1] - 1)
                k = wp.min(BRICK * c + (n & 7), smoke.cells[2] - 1)
                column = _Eight()
                for x in range(BRICK):
                    column[x] = voxel(smoke.density, smoke, wp.min(BRICK * a + x, smoke.cells[0] - 1), j, k)
                along = _marks_of(wp.max(column) > 0.0, column[0] > 0.0, column[BRICK - 1] > 0.0, 9)
                y = _marks_of(True, n < 8, n >= BRICK * BRICK - BRICK, 3)
                bits = bits | along * y * _marks_of(True, (n & 7) == 0, (n & 7) == BRICK - 1, 1)
        bits = _of_any_lane(bits)
        if lane == 0:
            marks[a, b, c] = bits

    return kernel


@wp.kernel(module="unique", module_options=OPTIONS)
def _join(
    # in:
    marks: wp.array3d[int],
    # out:
    bricks: wp.array3d[wp.uint8],
):
    a, b, c = wp.tid()
    bits = int(0)
    # A sample in a brick reads up to half a voxel beyond the brick: of a brick behind it the first voxels.
    for x in range(3):
        for y in range(3):
            for z in range(3):
                i = a + (x + 1) % 3 - 1
                j = b + (y + 1) % 3 - 1
                k = c + (z + 1) % 3 - 1
                if wp.min(i, wp.min(j, k)) >= 0 and i < marks.shape[0] and j < marks.shape[1] and k < marks.shape[2]:
                    bits = bits | marks[i, j, k] >> (9 * x + 3 * y + z)
    bricks[a, b, c] = wp.uint8(bits & 1)


def occupied(medium: Medium) -> wp.array:
    """Finds the bricks of 8^3 voxels in which an interpolated density may be above 0.

    Returns:
        uint8 [X / 8, Y / 8, Z / 8], rounded up: 1 where the brick, or a voxel next to it, has smoke; else 0.
    """
    shape, lanes = tuple(-(-n // BRICK) for n in medium.shape), 32 if medium.device.is_cuda else 1
    marks, bricks = medium.buffer(shape, int), medium.buffer(shape, wp.uint8)
    _mark(medium, (*shape, lanes), [], [marks], lanes)
    wp.launch(_join, shape, [marks], [bricks], device=medium.device)
    return bricks


def make_view(
    origin,
    right,
    up,
    forward,
    pitch: float,
    width: int,
    height: int,
    perspective: bool = False,
    voxel: float = 1.0,
    moved: float = 0.0,
) -> View:
    """Makes a `View`; `right`, `up` and `forward` are orthogonal and of length 1."""
    view = View()
    view.origin, view.right, view.up, view.forward = (wp.vec3(*map(float, v)) for v in (origin, right, up, forward))
    view.pitch, view.width, view.height, view.perspective = float(pitch), width, height, int(perspective)
    view.voxel, view.moved = float(voxel), float(moved)
    return view


def require_orthographic(view: View, what: str) -> None:
    """Raises ValueError if a camera is in perspective; `what` names, in the plural, the images that need another."""
    if view.perspective:
        raise ValueError(f"{what} need an orthographic camera, got one in perspective")


def parameters(march: March) -> MarchParameters:
    values = MarchParameters()
    values.step, values.jitter, values.threshold = float(march.step), float(march.jitter), float(march.threshold)
    values.g, values.cutoff = float(march.g), float(march.cutoff)
    # Kernels take 32-bit signed integers.
    values.seed = (march.seed + _SEEDS // 2) % _SEEDS - _SEEDS // 2
    return values
