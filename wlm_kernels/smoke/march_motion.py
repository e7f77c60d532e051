"""Motion of smoke across the image: along each ray, how far the air carried the visible smoke between two frames.

A step is weighted by the light that it absorbs, T (1 - exp(-sigma h)), so that hidden smoke has little weight. The
air's velocities lie on a separate grid over the same box, as in `wlm_kernels.fluid.advection`: trilinear between cell
centres, constant beyond the outermost centres. Smoke is traced back by the midpoint rule, as the solver carries it,
with the velocities of the later frame. Smoke that entered the box between the frames is taken to have been at the
nearest position at the border. Read `_loop` of `tests/smoke/test_motion.py` first: the same in float64, pixel by pixel.
"""

import functools
from typing import Any

import warp as wp

from wlm_kernels.smoke.march import (
    OPTIONS,
    MarchParameters,
    Medium,
    View,
    absorbed,
    begin,
    between_nodes,
    look,
    parameters,
    pass_step,
    require_orthographic,
    size_of,
)
from wlm_kernels.smoke.settings import March

_BORDER = wp.constant(1.0)  # voxels from the box's faces, nearer to which the trilinear density fades
_CLEAR = wp.constant(1e-3)  # largest opacity of a pixel that counts as free of smoke


@functools.cache
def motion_kernel(smoke_type: Any) -> wp.Kernel:
    """Builds (once) the kernel for densities of a type, `wp.float32` or `wp.float16`."""

    @wp.kernel(module="unique", module_options=OPTIONS)
    def motion(
        # in:
        smoke: smoke_type,
        velocity: wp.array3d[wp.vec3],
        reach: float,
        view: View,
        march: MarchParameters,
        # out:
        out: wp.array3d[float],
    ):
        row, column = wp.tid()
        r = begin(view, row, column, smoke, march.step, 0.5)
        size = size_of(smoke.density)
        cells = wp.vec3(float(velocity.shape[0]), float(velocity.shape[1]), float(velocity.shape[2]))
        share = wp.cw_div(cells, size)
        border = wp.vec3(_BORDER, _BORDER, _BORDER)
        half = wp.vec3(0.5, 0.5, 0.5)
        moved = wp.vec3()
        opacity = float(0.0)
        while r.done < r.count:
            r = look(r, smoke)
            if r.x > 0.0:
                p = r.place
                middle = p - 0.5 * reach * between_nodes(velocity, wp.cw_mul(share, p) - half)
                weight = r.t * absorbed(r.x)
                start = p - reach * between_nodes(velocity, wp.cw_mul(share, middle) - half)
                start = wp.min(wp.max(start, wp.min(p, border)), wp.max(p, size - border))
                moved += weight * (p - start)
                opacity += weight
            r = pass_step(r, march.cutoff)
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
    """Computes by how many pixels the smoke of each pixel has moved since the frame before.

    Args:
        medium: The smoke of the later frame.
        view: An orthographic camera, [H, W] pixels, the same for both frames.
        velocity: vec3 [A, B, C], velocity of the air over the same box, with any number of cells.
        reach: Voxels that a velocity of 1 moves between the frames.
        march: Its step and cutoff; samples lie in the middles of the steps.
        out: float [2, H, W], written: pixels to the right and down; 0 where there is no smoke.

    Raises:
        ValueError: The camera is in perspective.
    """
    require_orthographic(view, "motion vectors")
    medium = medium.in_bricks()
    inputs = [medium.smoke, velocity, reach, view, parameters(march)]
    wp.launch(motion_kernel(medium.smoke_type), out.shape[1:], inputs, [out], device=medium.device)
