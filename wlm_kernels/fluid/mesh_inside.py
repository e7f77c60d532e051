"""Tests whether points are in the solid that a mesh bounds.

Read `tests/kernels/test_mesh_inside.py` first: it computes the same in NumPy. A point is inside
if the generalised winding number of the mesh is above 1/2 there (Jacobson et al., "Robust inside-outside segmentation
using generalized winding numbers", 2013), so that small holes do not matter, or if the surface is within a distance,
the shell, which makes surfaces solid that bound nothing.
"""

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})

# The winding number is correct even where a sign from rays would fail because a ray grazes a triangle.
INSIDE = wp.constant(0.5)
ACCURACY = wp.constant(2.0)


@wp.func
def in_mesh(mesh: wp.uint64, x: wp.vec3, reach: float, shell: float) -> bool:
    """Tests a point in the mesh's unit, which is at most `reach` from the mesh if it is inside; shell 0: none."""
    query = wp.mesh_query_point_sign_winding_number(mesh, x, reach, ACCURACY, INSIDE)
    if not query.result:
        return False
    away = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - x)
    return query.sign < 0.0 or away < shell


@wp.kernel
def _contain(mesh: wp.uint64, points: wp.array1d[wp.vec3], reach: float, shell: float, out: wp.array1d[wp.bool]):
    i = wp.tid()
    out[i] = in_mesh(mesh, points[i], reach, shell)


def contains(mesh: wp.Mesh, points: np.ndarray, shell: float = 0.0) -> np.ndarray:
    """Returns which of some points, [N, 3] in the unit of a mesh with `support_winding_number=True`, are inside: bool
    [N]."""
    out = wp.zeros(len(points), dtype=wp.bool, device=mesh.device)
    places = wp.array(points, dtype=wp.vec3, device=mesh.device)
    low, high = (getattr(mesh.points.numpy(), end)(0) for end in ("min", "max"))
    reach = float(np.linalg.norm(high - low)) + shell
    wp.launch(_contain, len(points), inputs=[mesh.id, places, reach, shell], outputs=[out], device=mesh.device)
    return out.numpy()
