"""The common parts of all marches through smoke: medium, cameras, rays and their steps, samples, phase function.

All is in voxels: the grid `[X, Y, Z]` fills the box from 0 to (X, Y, Z), the centre of voxel i is at i + 1/2, and
between centres the density is trilinear, with zero outside the grid; so there is smoke up to half a voxel beyond the
box. Extinction is `extinction * density` per voxel. A step is taken as of one density, that at its sample, and is
integrated exactly: 1 - exp(-sigma h), not sigma h. A density below zero or NaN isn't looked for; the caller keeps them
out.

A light is a direction towards it, of irradiance 4 pi, so that an isotropic phase function is 1 and not 1 / (4 pi).
`march_guide`, `march_coarse`, `march_six` and `march_motion` are the marches themselves; none has a gradient,
but `single_scatter` has.
Read first: `tests/reference/marching.py`, the same in float64 NumPy, with nothing shared.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels.smoke.settings import March

Empty = Callable[[tuple[int, ...], Any], wp.array]
"""Makes a buffer, not set, of a shape and a type."""

BRICK = 8
"""Voxels along an edge of a brick, the unit in which empty space is left out."""

NO_BRICKS = wp.constant(0)
"""In place of bricks where there are too few samples for bricks to pay."""

_OPTIONS = {"enable_backward": False}
_NEVER = 1.0e30
_SEEDS = 2**32  # of which kernels tell apart


@dataclass(frozen=True)
class Medium:
    """Smoke on a device, as the functions that launch marches take it.

    Attributes:
        density: float or half [X, Y, Z].
        extinction: Per voxel, of density 1.
        temperature: As the density, of its shape; None: nothing emits.
        emission: Light given off per voxel of way where the temperature is 1.
        empty: Makes buffers, `empty(shape, dtype)` on the density's device; None: in Warp's own memory.
    """

    density: wp.array
    extinction: float
    temperature: wp.array | None = None
    emission: float = 0.0
    empty: Empty | None = None

    def buffer(self, shape: tuple[int, ...], dtype: Any) -> wp.array:
        """Makes a buffer, not set."""
        if self.empty is None:
            return wp.empty(shape, dtype=dtype, device=self.density.device)
        return self.empty(shape, dtype)

    @property
    def glow(self) -> tuple[wp.array, float]:
        """Temperature and emission for a kernel: of cold smoke any array, and 0."""
        return (self.density, 0.0) if self.temperature is None else (self.temperature, self.emission)


@wp.struct
class View:
    """A camera, in voxels. Row 0 is the top row; a pixel is seen at its centre.

    `pitch` is a pixel's size: in voxels where the view is orthographic, at distance 1 where it is in perspective.
    `origin` is the image's centre in the camera's plane, or the eye; nothing behind it is seen. `voxel` is a
    voxel's edge in the unit of depths, which are measured from `moved` voxels behind the origin.
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
    """`March` as kernels take it. Its `spacing` and `light_step` become a lattice before a kernel runs."""

    step: float
    jitter: float
    seed: int
    threshold: float
    g: float
    cutoff: float


@wp.struct
class Ray:
    """A pixel's ray, and equal steps along it, of which the first begins `first` from its origin."""

    origin: wp.vec3
    direction: wp.vec3
    first: float
    length: float
    count: int


@wp.func
def ray(view: View, row: int, column: int) -> Ray:
    """The ray of a pixel, without steps."""
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


@wp.func
def clip(size: wp.vec3, origin: wp.vec3, direction: wp.vec3) -> wp.vec2:
    """First and last distance along a ray where a density may be; first > last: it misses the smoke."""
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
    """A ray with steps no longer than `step` through all of the smoke before the origin; none where it is missed."""
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
def marched_ray(view: View, row: int, column: int, size: wp.vec3, step: float) -> Ray:
    """A pixel's ray with its steps through the smoke."""
    r = ray(view, row, column)
    return steps_along(size, r.origin, r.direction, step)


@wp.func
def point_on(r: Ray, n: int, offset: float) -> wp.vec3:
    """Where the n-th step's sample is; `offset` is 1/2 in the step's middle."""
    return r.origin + (r.first + (float(n) + offset) * r.length) * r.direction


@wp.func
def density_at(density: wp.array3d[Any], p: wp.vec3) -> float:
    """Trilinear, zero outside; `p` is no farther out than half a voxel and rounding."""
    x = p[0] - 0.5
    y = p[1] - 0.5
    z = p[2] - 0.5
    i = int(wp.floor(x))
    j = int(wp.floor(y))
    k = int(wp.floor(z))
    fx = x - float(i)
    fy = y - float(j)
    fz = z - float(k)
    # Voxels outside have no weight, and an index that can be read.
    nx = density.shape[0]
    ny = density.shape[1]
    nz = density.shape[2]
    wx0 = wp.where(i >= 0 and i < nx, 1.0 - fx, 0.0)
    wx1 = wp.where(i >= -1 and i < nx - 1, fx, 0.0)
    wy0 = wp.where(j >= 0 and j < ny, 1.0 - fy, 0.0)
    wy1 = wp.where(j >= -1 and j < ny - 1, fy, 0.0)
    wz0 = wp.where(k >= 0 and k < nz, 1.0 - fz, 0.0)
    wz1 = wp.where(k >= -1 and k < nz - 1, fz, 0.0)
    i0 = wp.clamp(i, 0, nx - 1)
    i1 = wp.clamp(i + 1, 0, nx - 1)
    j0 = wp.clamp(j, 0, ny - 1)
    j1 = wp.clamp(j + 1, 0, ny - 1)
    k0 = wp.clamp(k, 0, nz - 1)
    k1 = wp.clamp(k + 1, 0, nz - 1)
    a = wy0 * (wz0 * float(density[i0, j0, k0]) + wz1 * float(density[i0, j0, k1]))
    a += wy1 * (wz0 * float(density[i0, j1, k0]) + wz1 * float(density[i0, j1, k1]))
    b = wy0 * (wz0 * float(density[i1, j0, k0]) + wz1 * float(density[i1, j0, k1]))
    b += wy1 * (wz0 * float(density[i1, j1, k0]) + wz1 * float(density[i1, j1, k1]))
    return wx0 * a + wx1 * b


@wp.func
def sample(density: wp.array3d[Any], bricks: wp.array3d[wp.uint8], p: wp.vec3) -> float:
    """`density_at`, which looks no further where the brick is empty: the same number."""
    i = wp.clamp(int(p[0]) // BRICK, 0, bricks.shape[0] - 1)
    j = wp.clamp(int(p[1]) // BRICK, 0, bricks.shape[1] - 1)
    k = wp.clamp(int(p[2]) // BRICK, 0, bricks.shape[2] - 1)
    if bricks[i, j, k] == wp.uint8(0):
        return 0.0
    return density_at(density, p)


@wp.func
def sample(density: wp.array3d[Any], no_bricks: int, p: wp.vec3) -> float:  # noqa: F811, Warp overloads by type
    """`density_at`: of `NO_BRICKS`."""
    return density_at(density, p)


@wp.func
def absorbed(x: float) -> float:
    """1 - exp(-x), without cancellation where x is small."""
    if x < 0.05:
        return x * (1.0 - x * (0.5 - x * (1.0 / 6.0 - x * (1.0 / 24.0 - x / 120.0))))
    return 1.0 - wp.exp(-x)


@wp.func
def phase(g: float, cosine: float) -> float:
    """Henyey-Greenstein phase function times 4 pi; `cosine` is 1 where the light goes straight on."""
    d = 1.0 + g * g - 2.0 * g * cosine
    return (1.0 - g * g) / (d * wp.sqrt(d))


@wp.func
def optical_depth(
    density: wp.array3d[Any], bricks: Any, p: wp.vec3, toward: wp.vec3, extinction: float, step: float
) -> float:
    """From p out of the smoke, in equal steps no longer than `step`, each sampled at its middle (eq. 3)."""
    r = steps_along(size_of(density), p, toward, step)
    tau = float(0.0)
    for n in range(r.count):
        tau += sample(density, bricks, point_on(r, n, 0.5))
    return tau * r.length * extinction


@wp.func
def node_position(nodes: wp.array3d[Any], size: wp.vec3, i: int, j: int, k: int) -> wp.vec3:
    """Where a lattice's node lies: the first and the last along an axis on the borders of the smoke."""
    return wp.vec3(
        float(i) * (size[0] + 1.0) / float(nodes.shape[0] - 1) - 0.5,
        float(j) * (size[1] + 1.0) / float(nodes.shape[1] - 1) - 0.5,
        float(k) * (size[2] + 1.0) / float(nodes.shape[2] - 1) - 0.5,
    )


def nodes_along(shape: Sequence[int], step: float) -> tuple[int, ...]:
    """Nodes of a lattice no farther apart than a step, or a voxel, from half a voxel out of the grid to half beyond."""
    # Each marches to its lights by itself: of closer ones the time would grow with the fourth power.
    return tuple(math.ceil((n + 1) / max(step, 1.0)) + 1 for n in shape)


@functools.cache
def occupied_kernel(dtype: Any) -> wp.Kernel:
    """Builds (once) the kernel for densities of a type, `wp.float32` or `wp.float16`."""

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def rows(
        # in:
        density: wp.array3d[dtype],
        # out:
        out: wp.array3d[wp.uint8],
    ):
        """Smoke in a row of voxels as long as a brick, and the voxel beyond either end."""
        i, j, c = wp.tid()
        smoke = wp.uint8(0)
        for k in range(wp.max(c * BRICK - 1, 0), wp.min((c + 1) * BRICK + 1, density.shape[2])):
            if float(density[i, j, k]) > 0.0:
                smoke = wp.uint8(1)
        out[i, j, c] = smoke

    return rows


@wp.kernel(module="unique", module_options=_OPTIONS)
def _bricks_of_rows(
    # in:
    rows: wp.array3d[wp.uint8],
    # out:
    bricks: wp.array3d[wp.uint8],
):
    a, b, c = wp.tid()
    smoke = wp.uint8(0)
    # A point in a brick reads half a voxel beyond it too.
    for i in range(wp.max(a * BRICK - 1, 0), wp.min((a + 1) * BRICK + 1, rows.shape[0])):
        for j in range(wp.max(b * BRICK - 1, 0), wp.min((b + 1) * BRICK + 1, rows.shape[1])):
            smoke = wp.max(smoke, rows[i, j, c])
    bricks[a, b, c] = smoke


def occupied(medium: Medium) -> wp.array:
    """Which bricks have smoke within reach of a sample in them.

    Returns:
        uint8 [X / 8, Y / 8, Z / 8], rounded up, 1 where there is any.
    """
    density = medium.density
    shape = tuple(-(-n // BRICK) for n in density.shape)
    # By rows first: neighbouring threads then read neighbouring voxels, each of them once.
    rows, bricks = medium.buffer((*density.shape[:2], shape[2]), wp.uint8), medium.buffer(shape, wp.uint8)
    wp.launch(occupied_kernel(density.dtype), rows.shape, [density], [rows], device=density.device)
    wp.launch(_bricks_of_rows, shape, [rows], [bricks], device=density.device)
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
    """Makes a `View`; the three directions are orthogonal and of length 1."""
    view = View()
    view.origin, view.right, view.up, view.forward = (wp.vec3(*map(float, v)) for v in (origin, right, up, forward))
    view.pitch, view.width, view.height, view.perspective = float(pitch), width, height, int(perspective)
    view.voxel, view.moved = float(voxel), float(moved)
    return view


def parameters(march: March) -> MarchParameters:
    """A march's settings for a kernel."""
    values = MarchParameters()
    values.step, values.jitter, values.threshold = float(march.step), float(march.jitter), float(march.threshold)
    values.g, values.cutoff = float(march.g), float(march.cutoff)
    # Any whole number as one of 32 bits with a sign.
    values.seed = (march.seed + _SEEDS // 2) % _SEEDS - _SEEDS // 2
    return values
