"""Solid bodies on a lattice: which cells they cover, how their surfaces move, which links they cut.

A body is a number from 1 to 255 in an array of uint8, one for each cell; 0 is fluid. Cell centres lie at half
integers, in units of a cell, and a body moves as a rigid one. A link is a fluid cell and the direction in which
something comes to it out of a solid; ``lattice_links`` says what.
"""

import warp as wp

from wlm_kernels.fluid.lattice_sets import Tables, cell_of, crosses, index_of, wrapped

__all__ = ["Bodies", "body_velocity", "find_links", "voxelise_mesh", "voxelise_sphere"]

wp.set_module_options({"enable_backward": False})

# Rays that only graze a closed mesh's triangles make the sign of a distance wrong; the winding number has no rays.
_INSIDE = wp.constant(0.5)


@wp.struct
class Bodies:
    """How bodies move; element 0 stands for the fluid and is 0.

    Attributes:
        velocity: vec3 [K + 1], of the body's centre, cells a step.
        spin: vec3 [K + 1], radians a step.
        centre: vec3 [K + 1], cells.
    """

    velocity: wp.array1d[wp.vec3]
    spin: wp.array1d[wp.vec3]
    centre: wp.array1d[wp.vec3]


@wp.func
def _velocity_at(bodies: Bodies, k: int, x: wp.vec3) -> wp.vec3:
    return bodies.velocity[k] + wp.cross(bodies.spin[k], x - bodies.centre[k])


@wp.func
def body_velocity(bodies: Bodies, k: int, p: wp.vec3i) -> wp.vec3:
    """Of body k at the centre of a cell."""
    return _velocity_at(bodies, k, wp.vec3(float(p[0]) + 0.5, float(p[1]) + 0.5, float(p[2]) + 0.5))


@wp.kernel
def _links(
    # in:
    t: Tables,
    n: wp.vec3i,
    bounded: wp.vec3i,
    solid: wp.array1d[wp.uint8],
    bodies: Bodies,
    first: int,
    # out:
    count: wp.array1d[int],
    fastest: wp.array1d[float],
    cell: wp.array1d[int],
    code: wp.array1d[wp.uint8],
    term: wp.array1d[float],
):
    i = wp.tid()
    if solid[i] != wp.uint8(0):
        return
    p = cell_of(n, i)
    for q in range(1, t.w.shape[0]):
        source = p - t.c[q]
        if not crosses(n, bounded, source):
            k = int(solid[index_of(n, wrapped(n, source))])
            if k > 0:
                # The wall lies halfway between the two cells' centres.
                c = wp.vec3(float(t.c[q][0]), float(t.c[q][1]), float(t.c[q][2]))
                x = wp.vec3(float(p[0]) + 0.5, float(p[1]) + 0.5, float(p[2]) + 0.5) - 0.5 * c
                u = _velocity_at(bodies, k, x)
                if wp.dot(u, u) > 0.0:
                    wp.atomic_max(fastest, 0, wp.length(u))
                at = first + wp.atomic_add(count, 0, 1)
                if at < cell.shape[0]:
                    cell[at] = i
                    code[at] = wp.uint8(q)
                    term[at] = 6.0 * t.w[q] * wp.dot(c, u)


@wp.kernel
def _sphere(
    # in:
    n: wp.vec3i,
    body: wp.uint8,
    centre: wp.vec3,
    radius: float,
    # out:
    solid: wp.array1d[wp.uint8],
):
    i = wp.tid()
    p = cell_of(n, i)
    x = wp.vec3(float(p[0]) + 0.5, float(p[1]) + 0.5, float(p[2]) + 0.5)
    inside = wp.length(x - centre) < radius
    if inside:
        solid[i] = body
    elif solid[i] == body:
        solid[i] = wp.uint8(0)


@wp.kernel
def _mesh(
    # in:
    n: wp.vec3i,
    body: wp.uint8,
    mesh: wp.uint64,
    to_mesh: wp.transform,
    scale: float,
    reach: float,
    # out:
    solid: wp.array1d[wp.uint8],
):
    i = wp.tid()
    p = cell_of(n, i)
    x = wp.vec3(float(p[0]) + 0.5, float(p[1]) + 0.5, float(p[2]) + 0.5)
    found = wp.mesh_query_point_sign_winding_number(mesh, wp.transform_point(to_mesh, x) / scale, reach, 2.0, _INSIDE)
    if found.result and found.sign < 0.0:
        solid[i] = body
    elif solid[i] == body:
        solid[i] = wp.uint8(0)


def find_links(tables, n, bounded, solid, bodies, first: int, count, fastest, cell, code, term) -> None:
    """Lists the links of solid cells, in any order, from place ``first`` on.

    Args:
        tables: ``lattice_sets.Tables``.
        n: Cells along x, y and z.
        bounded: vec3i, 1 for each axis that isn't periodic.
        solid: uint8 [N].
        bodies: How they move.
        first: Places taken already.
        count: int [1], set to how many there are, whether or not they find a place.
        fastest: float [1], set to the speed of the fastest surface.
        cell, code, term: int, uint8 and float [places], see ``lattice_links``.
    """
    count.zero_()
    fastest.zero_()
    inputs = [tables, n, bounded, solid, bodies, first]
    wp.launch(_links, solid.shape[0], inputs=inputs, outputs=[count, fastest, cell, code, term], device=solid.device)


def voxelise_sphere(solid, body: int, centre, radius: float) -> None:
    """Covers the cells whose centres lie in a sphere, and frees those that the body covered before.

    Args:
        solid: uint8 [X, Y, Z], changed.
        body: The body's number, 1 to 255.
        centre: In cells.
        radius: In cells.
    """
    n = wp.vec3i(*solid.shape)
    inputs = [n, wp.uint8(body), wp.vec3(*centre), float(radius)]
    wp.launch(_sphere, solid.size, inputs=inputs, outputs=[solid.flatten()], device=solid.device)


def voxelise_mesh(solid, body: int, mesh: wp.Mesh, position=(0.0, 0.0, 0.0), rotation=None, scale: float = 1.0) -> None:
    """Covers the cells whose centres lie in a closed mesh, and frees those that the body covered before.

    Args:
        solid: uint8 [X, Y, Z], changed.
        body: The body's number, 1 to 255.
        mesh: On the device of ``solid``, made with ``support_winding_number=True``.
        position: In cells, of the mesh's origin.
        rotation: ``wp.quat``, None for none.
        scale: Cells a unit of the mesh.
    """
    n = wp.vec3i(*solid.shape)
    placed = wp.transform(wp.vec3(*position), wp.quat_identity() if rotation is None else rotation)
    # A query looks no further than it must: beyond the domain's diagonal there is no cell.
    reach = 4.0 * float(sum(solid.shape)) / scale
    inputs = [n, wp.uint8(body), mesh.id, wp.transform_inverse(placed), float(scale), reach]
    wp.launch(_mesh, solid.size, inputs=inputs, outputs=[solid.flatten()], device=solid.device)
