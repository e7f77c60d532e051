"""Resampling of voxels of any shape to cubic voxels."""

import warp as wp

from wlm_kernels.smoke.march import density_at, size_of

wp.set_module_options({"enable_backward": False})


@wp.kernel
def resample(
    # in:
    values: wp.array3d[float],
    turn: wp.mat33,
    shift: wp.vec3,
    # out:
    out: wp.array3d[float],
):
    """Resamples the grid `values` at the voxel centres of `out`: trilinear between voxel centres, 0 outside.

    The matrix `turn` and the vector `shift` convert a point p of `out` to the point turn p + shift of `values`, both
    in voxels.
    """
    i, j, k = wp.tid()
    p = turn * wp.vec3(float(i) + 0.5, float(j) + 0.5, float(k) + 0.5) + shift
    size = size_of(values)
    result = float(0.0)
    inside = int(1)
    for axis in range(3):
        if p[axis] < -0.5 or p[axis] > size[axis] + 0.5:
            inside = int(0)
    if inside != 0:
        result = density_at(values, p)
    out[i, j, k] = result
