"""Solid bodies on a lattice: the cells that they cover and the velocity of their surfaces.

Read `test_sphere_voxels` and `test_mesh_voxels` in `tests/kernels/test_lattice.py` first: the same in NumPy.

An array of uint8 holds for each cell the number of its body, 1 to 255, or 0 for fluid. Cell centres lie at half
integers, in units of a cell. Bodies are rigid: u(x) = velocity + spin x (x - centre).
"""

import warp as wp

from wlm_kernels.fluid.lattice_sets import cell_of

wp.set_module_options({"enable_backward": False})

# A sign of the distance by rays is wrong where a ray only grazes a triangle; the winding number casts none.
_INSIDE = wp.constant(0.5)


@wp.struct
class Bodies:
    """The motion of bodies; element 0 stands for the fluid and is 0.

    Attributes:
        velocity: vec3 [K + 1], of the body's centre, cells a step.
        spin: vec3 [K + 1], angular velocity, radians a step.
        centre: vec3 [K + 1], cells.
    """

    velocity: wp.array1d[wp.vec3]
    spin: wp.array1d[wp.vec3]
    centre: wp.array1d[wp.vec3]


@wp.func
def velocity_at(bodies: Bodies, k: int, x: wp.vec3) -> wp.vec3:
    """The velocity of body k at a point."""
    return bodies.velocity[k] + wp.cross(bodies.spin[k], x - bodies.centre[k])


@wp.func
def body_velocity(bodies: Bodies, k: int, p: wp.vec3i) -> wp.vec3:
    """The velocity of body k at the centre of cell p."""
    return velocity_at(bodies, k, wp.vec3(float(p[0]) + 0.5, float(p[1]) + 0.5, float(p[2]) + 0.5))


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
    query = wp.mesh_query_point_sign_winding_number(mesh, wp.transform_point(to_mesh, x) / scale, reach, 2.0, _INSIDE)
    if query.result and query.sign < 0.0:
        solid[i] = body
    elif solid[i] == body:
        solid[i] = wp.uint8(0)


def voxelise_sphere(solid, body: int, centre, radius: float) -> None:
    """Marks the cells whose centres lie in a sphere with a body's number, and frees its others.

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
    """Marks the cells whose centres lie in a closed mesh with a body's number, and frees its others.

    Args:
        solid: uint8 [X, Y, Z], changed.
        body: The body's number, 1 to 255.
        mesh: On the device of `solid`, made with `support_winding_number=True`.
        position: In cells, of the mesh's origin.
        rotation: `wp.quat`, None for none.
        scale: Cells a unit of the mesh.
    """
    n = wp.vec3i(*solid.shape)
    placed = wp.transform(wp.vec3(*position), wp.quat_identity() if rotation is None else rotation)
    # No cell is farther away than the domain's diagonal.
    reach = 4.0 * float(sum(solid.shape)) / scale
    inputs = [n, wp.uint8(body), mesh.id, wp.transform_inverse(placed), float(scale), reach]
    wp.launch(_mesh, solid.size, inputs=inputs, outputs=[solid.flatten()], device=solid.device)
