"""How smoke moves across the image: the visible smoke along a ray, and how far the air carried it between two frames.

Units, sampling and cameras are those of `march`. What a ray sees of a step is what the step keeps of the light,
T (1 - exp(-sigma h)): hidden smoke counts as little as it is seen. The air's velocities lie on a grid of their own over
the same box, as `wlm_kernels.fluid.advection` has them: trilinear between cell centres, constant beyond the
outermost. Smoke is traced back by the midpoint rule, as the solver carries it; the velocities are taken to be those of
the later frame all the while. Smoke that came into the box since counts as having been where smoke at its border looks
the same. Read first: `_loop` of `tests/smoke/test_motion.py`, the same in float64, pixel by pixel.
"""

import functools
from typing import Any

import warp as wp

from wlm_kernels.smoke.march import (
    MarchParameters,
    Medium,
    View,
    absorbed,
    marched_ray,
    occupied,
    parameters,
    point_on,
    sample,
    size_of,
)
from wlm_kernels.smoke.settings import March

_OPTIONS = {"enable_backward": False}

# Voxels from the box's faces, nearer to which the trilinear density fades.
_BORDER = wp.constant(1.0)
_CLEAR = wp.constant(1e-3)  # the opacity up to which a pixel counts as one without smoke


@wp.func
def _velocity_at(velocity: wp.array3d[wp.vec3], p: wp.vec3) -> wp.vec3:
    x = wp.clamp(p[0] - 0.5, 0.0, float(velocity.shape[0] - 1))
    y = wp.clamp(p[1] - 0.5, 0.0, float(velocity.shape[1] - 1))
    z = wp.clamp(p[2] - 0.5, 0.0, float(velocity.shape[2] - 1))
    i = int(x)
    j = int(y)
    k = int(z)
    # At the last cell its like has no weight.
    i1 = wp.min(i + 1, velocity.shape[0] - 1)
    j1 = wp.min(j + 1, velocity.shape[1] - 1)
    k1 = wp.min(k + 1, velocity.shape[2] - 1)
    fx = x - float(i)
    fy = y - float(j)
    fz = z - float(k)
    near = wp.lerp(
        wp.lerp(velocity[i, j, k], velocity[i, j, k1], fz), wp.lerp(velocity[i, j1, k], velocity[i, j1, k1], fz), fy
    )
    far = wp.lerp(
        wp.lerp(velocity[i1, j, k], velocity[i1, j, k1], fz), wp.lerp(velocity[i1, j1, k], velocity[i1, j1, k1], fz), fy
    )
    return wp.lerp(near, far, fx)


@functools.cache
def motion_kernel(dtype: Any) -> wp.Kernel:
    """Builds (once) the kernel for densities of a type, `wp.float32` or `wp.float16`."""

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def motion(
        # in:
        density: wp.array3d[dtype],
        bricks: wp.array3d[wp.uint8],
        extinction: float,
        velocity: wp.array3d[wp.vec3],
        reach: float,
        view: View,
        march: MarchParameters,
        # out:
        out: wp.array3d[float],
    ):
        row, column = wp.tid()
        size = size_of(density)
        r = marched_ray(view, row, column, size, march.step)
        cells = wp.vec3(float(velocity.shape[0]), float(velocity.shape[1]), float(velocity.shape[2]))
        share = wp.cw_div(cells, size)
        border = wp.vec3(_BORDER, _BORDER, _BORDER)
        moved = wp.vec3()
        opacity = float(0.0)
        t = float(1.0)
        for n in range(r.count):
            p = point_on(r, n, 0.5)
            x = extinction * sample(density, bricks, p) * r.length
            if x > 0.0:
                middle = p - 0.5 * reach * _velocity_at(velocity, wp.cw_mul(share, p))
                weight = t * absorbed(x)
                begin = p - reach * _velocity_at(velocity, wp.cw_mul(share, middle))
                begin = wp.min(wp.max(begin, wp.min(p, border)), wp.max(p, size - border))
                moved += weight * (p - begin)
                opacity += weight
                t *= wp.exp(-x)
                if t < march.cutoff:
                    break
        across = float(0.0)
        down = float(0.0)
        if opacity > _CLEAR:
            scale = 1.0 / (opacity * view.pitch)
            across = scale * wp.dot(moved, view.right)
            down = -scale * wp.dot(moved, view.up)
        out[0, row, column] = across
        out[1, row, column] = down

    return motion


def motion(medium: Medium, view: View, velocity: wp.array, reach: float, march: March, out: wp.array) -> None:
    """By how many pixels the smoke of each pixel has moved since the frame before.

    Args:
        medium: The smoke of the later frame.
        view: An orthographic camera, [H, W] pixels, the same for both frames.
        velocity: vec3 [A, B, C], of the air over the same box, of any number of cells.
        reach: Voxels that a velocity of 1 goes between the frames.
        march: Its step and cutoff; samples lie in their steps' middles.
        out: float [2, H, W], written: pixels to the right and down; 0 where there is no smoke.

    Raises:
        ValueError: The camera is in perspective.
    """
    if view.perspective:
        raise ValueError("motion needs an orthographic camera, as the lightmaps do")
    density = medium.density
    inputs = [density, occupied(medium), medium.extinction, velocity, reach, view, parameters(march)]
    wp.launch(motion_kernel(density.dtype), out.shape[1:], inputs=inputs, outputs=[out], device=density.device)
