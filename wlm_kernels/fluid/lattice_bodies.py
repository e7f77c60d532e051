"""Rigid bodies in the air: their poses at a step, and the cells that they cover.

Read `test_poses` and `test_marks` in `tests/kernels/test_lattice.py` first: they compute the same in NumPy.

An array of uint8 stores for each cell the number of its body, 1 to 255, or 0 for fluid. Cell centres are at half
integers, in units of a cell. Bodies at rest keep their cells where moving ones reach them; of two bodies at rest the
first has a cell, of two moving ones the last.

The kernels of a body run over a window, a box of cells around it whose size is constant, so that a CUDA graph can
contain them. It is two cells wider than the body on each side, and thus also contains the cells where the body was one
step before, and the fluid beside them.
"""

import functools

import numpy as np
import warp as wp

from wlm_kernels.fluid.lattice_sets import cell_of, crosses, index_of
from wlm_kernels.fluid.mesh_inside import ACCURACY, INSIDE, in_mesh

wp.set_module_options({"enable_backward": False})

_MARGIN = wp.constant(2)
_FAR = wp.constant(1e9)
_SPACING = 0.5  # of the points at which a mesh is measured, in cells
_POINTS = 1 << 24  # most of these points


@wp.struct
class Motion:
    """Motion of bodies, in arrays [256] by their numbers: `centre`, a body's origin in cells; `turn`, its rotation;
    `velocity`, in cells per step; `spin`, its angular velocity in radians per step; `moving`, whether its path moves.
    """

    centre: wp.array1d[wp.vec3]
    turn: wp.array1d[wp.quat]
    velocity: wp.array1d[wp.vec3]
    spin: wp.array1d[wp.vec3]
    moving: wp.array1d[wp.uint8]


@wp.struct
class Keys:
    """Paths of B bodies, one after the other: the poses of body b are `first[b]` to `first[b + 1]`, int [B + 1], of K.
    Each is at a `time`, increasing, and has a `position` in cells and a `turn`; `velocity` and `spin` are the rates of
    change until the next pose, per unit of time."""

    first: wp.array1d[int]
    time: wp.array1d[wp.float64]
    position: wp.array1d[wp.vec3d]
    turn: wp.array1d[wp.quatd]
    velocity: wp.array1d[wp.vec3d]
    spin: wp.array1d[wp.vec3d]


@wp.struct
class Window:
    """The box of cells around body `body`: `low`, the body's lowest coordinates relative to its origin, and `cells`,
    the size of the box, at most that of the domain of `n` cells."""

    n: wp.vec3i
    body: int
    low: wp.vec3
    cells: wp.vec3i


@wp.struct
class Form:
    """The form of a body: a sphere of radius `size` in cells, or a `mesh` with `size` cells per unit and a `shell` in
    cells (`mesh_inside`), whose surface is at most `reach` units from a point inside.

    A query of a mesh takes as long as some steps, so that a mesh that moves is measured once: `distance`, float [P], is
    its signed distance in cells at points of its own frame, `points` along each axis, `spacing` cells apart from `low`;
    [0]: not measured. It is interpolated trilinearly, which moves edges by up to a tenth of a cell.
    """

    mesh: wp.uint64
    size: float
    reach: float
    shell: float
    low: wp.vec3
    spacing: float
    points: wp.vec3i
    distance: wp.array1d[float]


@wp.func
def wall_velocity(motion: Motion, body: int, x: wp.vec3) -> wp.vec3:
    """Returns the velocity of a body at a point."""
    return motion.velocity[body] + wp.cross(motion.spin[body], x - motion.centre[body])


@wp.func
def centre_of(p: wp.vec3i) -> wp.vec3:
    return wp.vec3(float(p[0]) + 0.5, float(p[1]) + 0.5, float(p[2]) + 0.5)


@wp.func
def window_cell(window: Window, centre: wp.vec3, i: int) -> wp.vec3i:
    """Returns the cell with index i of a window around a body at `centre`, which may be outside the domain."""
    p = cell_of(window.cells, i)
    for a in range(3):
        n = window.n[a]
        size = window.cells[a]
        if size < n:
            # A body far away must not exceed the range of integers.
            p[a] += int(wp.clamp(wp.floor(centre[a] + window.low[a]), -2.0 * float(n), 2.0 * float(n))) - _MARGIN
    return p


@wp.kernel
def _pose(
    # in:
    keys: Keys,
    clock: wp.array1d[int],
    pace: wp.float64,
    # out:
    motion: Motion,
):
    b = wp.tid()
    # The larger of the two is the number of steps done.
    time = (wp.float64(wp.max(clock[0], clock[1])) + wp.float64(0.5)) * pace
    low = keys.first[b]
    high = keys.first[b + 1]
    past = time - keys.time[low]
    while high - low > 1:
        middle = (low + high) // 2
        if keys.time[middle] <= time:
            low = middle
        else:
            high = middle
    rate = wp.where(past < wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
    span = rate * (time - keys.time[low])
    turn = keys.turn[low]
    fast = wp.length(keys.spin[low])
    if fast > wp.float64(0.0):
        turn = wp.quat_from_axis_angle(keys.spin[low] / fast, span * fast) * turn
    motion.centre[b + 1] = wp.vec3(keys.position[low] + span * keys.velocity[low])
    motion.turn[b + 1] = wp.quat(turn)
    motion.velocity[b + 1] = wp.vec3(rate * pace * keys.velocity[low])
    motion.spin[b + 1] = wp.vec3(rate * pace * keys.spin[low])


@wp.kernel
def _measure(form: Form, distance: wp.array1d[float]):
    i = wp.tid()
    p = cell_of(form.points, i)
    x = (form.low + form.spacing * wp.vec3(float(p[0]), float(p[1]), float(p[2]))) / form.size
    query = wp.mesh_query_point_sign_winding_number(form.mesh, x, form.reach, ACCURACY, INSIDE)
    away = wp.length(wp.mesh_eval_position(form.mesh, query.face, query.u, query.v) - x)
    distance[i] = wp.where(query.result, query.sign * away * form.size, _FAR)


@wp.func
def _in_form(form: Form, x: wp.vec3) -> bool:
    """Tests a point in a mesh's own frame, in cells."""
    if form.distance.shape[0] == 0:
        return in_mesh(form.mesh, x / form.size, form.reach, form.shell / form.size)
    near = (x - form.low) / form.spacing
    p = wp.vec3i(int(wp.floor(near[0])), int(wp.floor(near[1])), int(wp.floor(near[2])))
    high = p + wp.vec3i(1, 1, 1)
    if crosses(form.points, wp.vec3i(1, 1, 1), p) or crosses(form.points, wp.vec3i(1, 1, 1), high):
        return False
    away = float(0.0)
    for k in range(8):
        corner = p + wp.vec3i(k // 4, k // 2 % 2, k % 2)
        weight = float(1.0)
        for a in range(3):
            weight *= 1.0 - wp.abs(near[a] - float(corner[a]))
        away += weight * form.distance[index_of(form.points, corner)]
    return away < form.shell


@functools.cache
def _mark_kernel(is_mesh: bool) -> wp.Kernel:
    """Builds (once) the kernel that marks the cells of a sphere or mesh, with a thread for each cell of a window."""

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def mark(
        # in:
        window: Window,
        motion: Motion,
        form: Form,
        stamp: wp.uint8,
        # out:
        solid: wp.array1d[wp.uint8],
        fresh: wp.array1d[wp.uint8],
    ):
        body = window.body
        p = window_cell(window, motion.centre[body], wp.tid())
        if crosses(window.n, wp.vec3i(1, 1, 1), p):
            return
        x = wp.quat_rotate_inv(motion.turn[body], centre_of(p) - motion.centre[body])
        inside = bool(False)
        if wp.static(is_mesh):
            inside = _in_form(form, x)
        else:
            inside = wp.length(x) < form.size
        i = index_of(window.n, p)
        was = int(solid[i])
        if inside:
            if was == 0 or motion.moving[was] != wp.uint8(0):
                solid[i] = wp.uint8(body)
        elif was == body:
            solid[i] = wp.uint8(0)
        if fresh.shape[0] > 0:
            if was == body and not inside:
                fresh[i] = stamp
            elif fresh[i] != stamp:
                fresh[i] = wp.uint8(0)

    return mark


def make_motion(device: wp.Device) -> Motion:
    """Makes the motion of bodies at rest."""
    motion = Motion()
    for name, dtype in (("centre", wp.vec3), ("velocity", wp.vec3), ("spin", wp.vec3), ("moving", wp.uint8)):
        setattr(motion, name, wp.zeros(256, dtype=dtype, device=device))
    motion.turn = wp.full(256, wp.quat_identity(), dtype=wp.quat, device=device)
    return motion


def make_window(shape: tuple[int, int, int], body: int, low: np.ndarray, high: np.ndarray) -> Window:
    """Makes the window of a body that extends from `low` to `high`, (3,), relative to its origin in cells."""
    window, margin = Window(), 2 * int(_MARGIN) + 1
    window.n, window.body, window.low = wp.vec3i(*shape), body, wp.vec3(*map(float, low))
    sizes = np.minimum(np.ceil(np.asarray(high) - low) + margin, shape)
    window.cells = wp.vec3i(*(int(size) for size in sizes))
    return window


def size_of(window: Window) -> int:
    """Returns the number of cells of a window."""
    return window.cells[0] * window.cells[1] * window.cells[2]


def set_poses(keys: Keys, clock: wp.array, pace: float, motion: Motion) -> None:
    """Sets the motion of the bodies of `keys`, from number 1 on, to that in the middle of the next step.

    The larger element of `clock`, int [2], is the number of steps done, and `pace` the duration of a step in the unit
    of the times of `keys`.
    """
    bodies = keys.first.shape[0] - 1
    wp.launch(_pose, bodies, inputs=[keys, clock, wp.float64(pace)], outputs=[motion], device=clock.device)


def make_form(shape: float | wp.Mesh, scale: float, shell: float, moves: bool) -> Form:
    """Makes the form of a sphere of a radius in cells, or of a mesh with `scale` cells per unit and a shell in cells,
    which was made with `support_winding_number=True` and is measured if it `moves`."""
    form = Form()
    if not isinstance(shape, wp.Mesh):
        form.size = shape
        return form
    corners = scale * shape.points.numpy().astype(np.float64)
    extent = np.ptp(corners, axis=0) + 2.0 * shell + 3.0
    form.mesh, form.size, form.shell, form.reach = shape.id, scale, shell, float(np.linalg.norm(extent)) / scale
    if moves:
        form.low = wp.vec3(*map(float, corners.min(axis=0) - shell - 1.0))
        form.spacing = max(_SPACING, float(np.cbrt(extent.prod() / _POINTS)))
        form.points = wp.vec3i(*(int(n) for n in np.ceil(extent / form.spacing) + 1.0))
        distance = wp.empty(form.points[0] * form.points[1] * form.points[2], dtype=float, device=shape.device)
        wp.launch(_measure, distance.size, inputs=[form], outputs=[distance], device=shape.device)
        form.distance = distance
    return form


def mark(window: Window, motion: Motion, form: Form, stamp: int, solid: wp.array, fresh: wp.array) -> None:
    """Marks the cells whose centres are in a body, and clears its other cells in its window.

    Args:
        window: The body's window.
        motion: The pose of the body.
        form: Its form.
        stamp: A number that differs from that of the step before.
        solid: uint8 [N], the bodies' marks.
        fresh: uint8 [N], set to `stamp` in the cells that the body leaves, and to 0 in the window's others without this
            stamp; [0]: not needed.
    """
    kernel = _mark_kernel(form.mesh != 0)
    inputs = [window, motion, form, wp.uint8(stamp)]
    wp.launch(kernel, size_of(window), inputs=inputs, outputs=[solid, fresh], device=solid.device)
