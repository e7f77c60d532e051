"""Ray casting: the first triangle hit by each ray."""

import warp as wp

wp.set_module_options({"enable_backward": False})

_FARTHEST = wp.constant(1.0e30)


@wp.kernel
def _first_hit(
    # in:
    mesh: wp.uint64,
    origin: wp.array[wp.vec3],  # [P]
    direction: wp.array[wp.vec3],  # [D], of unit length
    # out:
    distance: wp.array2d[float],  # [P, D]
    front: wp.array2d[wp.int8],  # [P, D]
):
    point, ray = wp.tid()
    hit = wp.mesh_query_ray(mesh, origin[point], direction[ray], _FARTHEST)
    if hit.result:
        distance[point, ray] = hit.t
        front[point, ray] = wp.where(hit.sign > 0.0, wp.int8(1), wp.int8(-1))
    else:
        distance[point, ray] = wp.inf
        front[point, ray] = wp.int8(0)


def first_hit(mesh: wp.Mesh, origin: wp.array, direction: wp.array, distance: wp.array, front: wp.array) -> None:
    """Casts rays from P points, vec3 [P], in D directions of unit length, vec3 [D].

    Written are `distance`, float [P, D], to the first triangle, infinite if there is none; and `front`, int8 [P, D], 1
    for a front face (corners counter-clockwise), -1 for a back face, 0 for none.
    """
    wp.launch(
        _first_hit,
        dim=distance.shape,
        inputs=[mesh.id, origin, direction],
        outputs=[distance, front],
        device=distance.device,
    )
