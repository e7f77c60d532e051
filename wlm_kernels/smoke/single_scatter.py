"""Single scattering, emission and optical depth along any rays through a density grid, and their adjoints.

Units, sampling and steps are those of `march`; the density is the extinction per voxel. Along a ray of steps h, with
x_n = sigma(p_n) h and T_n = exp(-x_0 - ... - x_(n-1)) (neural-six-way-lightmaps, eq. 1 to 3),

    scattered of light l    sum_n T_n (1 - exp(-x_n)) exp(-tau_l(p_n))        without phase function and colour
    emitted                 sum_n T_n (1 - exp(-x_n)) / x_n h e(p_n)
    depth                   sum_n x_n

where tau_l, the optical depth from a point to light l, is computed at the nodes of a lattice, which all rays use, and
interpolated linearly between them. The derivatives are exact: steps depend only on the geometry, and a ray ends early
only where its transparency is 0 in float32. `benchmarks.plain.march` is the same in torch.

Adjoints run from a ray's end to its start, so that the light behind a sample is a running sum. They are added to the
gradients of the density, the emission and the nodes by atomic additions: on CUDA in any order, so that the last bits
vary from run to run. The gradients of the rays themselves are a kernel of their own, as few callers need them.
"""

import functools
from typing import Any

import warp as wp

from wlm_kernels.smoke.march import absorbed, clip, mean_transparency, node_position, point_on, size_of, steps_along

_OPTIONS = {"enable_backward": False}
wp.set_module_options(_OPTIONS)

# Rounding must not add a step to a length that is a whole number of steps.
_SLACK = 1.0001

# exp(-104) is 0 in float32. Depths are limited to 104: the adjoint subtracts what was added, and a sum of thousands
# would leave no digits for the visible part.
_OPAQUE = wp.constant(104.0)


@wp.struct
class _Cell:
    """The eight grid values around a point; values outside the grid have weight 0."""

    low: wp.vec3i
    high: wp.vec3i
    low_weight: wp.vec3
    high_weight: wp.vec3


@wp.func
def _cell(q: wp.vec3, counts: wp.vec3i) -> _Cell:
    cell = _Cell()
    for axis in range(3):
        i = int(wp.floor(q[axis]))
        f = q[axis] - float(i)
        n = counts[axis]
        cell.low[axis] = wp.clamp(i, 0, n - 1)
        cell.high[axis] = wp.clamp(i + 1, 0, n - 1)
        cell.low_weight[axis] = wp.where(i >= 0 and i < n, 1.0 - f, 0.0)
        cell.high_weight[axis] = wp.where(i >= -1 and i < n - 1, f, 0.0)
    return cell


@wp.func
def _counts(grid: wp.array3d[Any]) -> wp.vec3i:
    return wp.vec3i(grid.shape[0], grid.shape[1], grid.shape[2])


@wp.func
def _voxel(density: wp.array3d[Any], p: wp.vec3) -> _Cell:
    return _cell(p - wp.vec3(0.5, 0.5, 0.5), _counts(density))


@wp.func
def _among_nodes(nodes: wp.array3d[float], size: wp.vec3, p: wp.vec3) -> wp.vec3:
    n = _counts(nodes)
    first = p + wp.vec3(0.5, 0.5, 0.5)
    return wp.vec3(
        first[0] * float(n[0] - 1) / (size[0] + 1.0),
        first[1] * float(n[1] - 1) / (size[1] + 1.0),
        first[2] * float(n[2] - 1) / (size[2] + 1.0),
    )


@wp.func
def _node(nodes: wp.array3d[float], size: wp.vec3, p: wp.vec3) -> _Cell:
    return _cell(_among_nodes(nodes, size, p), _counts(nodes))


@wp.func
def _corner(cell: _Cell, corner: int) -> wp.vec3i:
    return wp.vec3i(
        wp.where((corner & 4) == 0, cell.low[0], cell.high[0]),
        wp.where((corner & 2) == 0, cell.low[1], cell.high[1]),
        wp.where((corner & 1) == 0, cell.low[2], cell.high[2]),
    )


@wp.func
def _weight(cell: _Cell, corner: int) -> float:
    x = wp.where((corner & 4) == 0, cell.low_weight[0], cell.high_weight[0])
    y = wp.where((corner & 2) == 0, cell.low_weight[1], cell.high_weight[1])
    z = wp.where((corner & 1) == 0, cell.low_weight[2], cell.high_weight[2])
    return x * y * z


@wp.func
def _read(grid: wp.array3d[Any], cell: _Cell):
    value = _weight(cell, 0) * grid[cell.low[0], cell.low[1], cell.low[2]]
    for corner in range(1, 8):
        i = _corner(cell, corner)
        value += _weight(cell, corner) * grid[i[0], i[1], i[2]]
    return value


@wp.func
def _add(grad: wp.array3d[Any], cell: _Cell, g: Any):
    for corner in range(8):
        w = _weight(cell, corner)
        if w != 0.0:
            i = _corner(cell, corner)
            wp.atomic_add(grad, i[0], i[1], i[2], w * g)


@wp.func
def _steep(q: wp.vec3, counts: wp.vec3i) -> _Cell:
    """Returns the cell of a point with the derivatives of its weights in place of the weights."""
    cell = _cell(q, counts)
    for axis in range(3):
        i = int(wp.floor(q[axis]))
        cell.low_weight[axis] = wp.where(i >= 0 and i < counts[axis], -1.0, 0.0)
        cell.high_weight[axis] = wp.where(i >= -1 and i < counts[axis] - 1, 1.0, 0.0)
    return cell


@wp.func
def _along(value: float, g: float) -> float:
    return value * g


@wp.func
def _along(value: wp.vec3, g: wp.vec3) -> float:
    return wp.dot(value, g)


@wp.func
def _slope(grid: wp.array3d[Any], cell: _Cell, steep: _Cell, g: Any) -> wp.vec3:
    """Computes the derivative, by the point in units of cells, of g times the value that `_read` returns."""
    slope = wp.vec3()
    for axis in range(3):
        part = cell
        part.low_weight[axis] = steep.low_weight[axis]
        part.high_weight[axis] = steep.high_weight[axis]
        total = float(0.0)
        for corner in range(8):
            i = _corner(part, corner)
            total += _weight(part, corner) * _along(grid[i[0], i[1], i[2]], g)
        slope[axis] = total
    return slope


@wp.func
def _share_slope(x: float) -> float:
    """Computes the derivative of `mean_transparency`, without cancellation where x is small."""
    if x < 0.05:
        return -0.5 + x * (1.0 / 3.0 - x * (0.125 - x * (1.0 / 30.0 - x / 144.0)))
    return (wp.exp(-x) - absorbed(x) / x) / x


@wp.kernel
def _depths(
    # in:
    density: wp.array3d[float],
    toward: wp.array1d[wp.vec3],
    step: float,
    # out:
    nodes: wp.array4d[float],
):
    light, a, b, c = wp.tid()
    size = size_of(density)
    p = node_position(nodes[light], size, a, b, c)
    r = steps_along(size, p, toward[light], step)
    tau = float(0.0)
    for n in range(r.count):
        tau += _read(density, _voxel(density, point_on(r, n, 0.5)))
    nodes[light, a, b, c] = tau * r.length


@wp.kernel
def _depths_backward(
    # in:
    toward: wp.array1d[wp.vec3],
    step: float,
    grad_nodes: wp.array4d[float],
    # out:
    grad_density: wp.array3d[float],
):
    light, a, b, c = wp.tid()
    g = grad_nodes[light, a, b, c]
    if g != 0.0:
        size = size_of(grad_density)
        p = node_position(grad_nodes[light], size, a, b, c)
        r = steps_along(size, p, toward[light], step)
        for n in range(r.count):
            _add(grad_density, _voxel(grad_density, point_on(r, n, 0.5)), g * r.length)


@wp.kernel
def _march(
    # in:
    density: wp.array3d[float],
    emission: wp.array3d[wp.vec3],
    nodes: wp.array4d[float],
    origin: wp.array1d[wp.vec3],
    direction: wp.array1d[wp.vec3],
    step: float,
    # out:
    scattered: wp.array2d[float],
    emitted: wp.array1d[wp.vec3],
    depth: wp.array1d[float],
    count: wp.array1d[int],
):
    i = wp.tid()
    size = size_of(density)
    r = steps_along(size, origin[i], direction[i], step)
    for light in range(nodes.shape[0]):
        scattered[i, light] = 0.0
    glow = wp.vec3()
    tau = float(0.0)
    n = int(0)
    while n < r.count and tau < _OPAQUE:
        p = point_on(r, n, 0.5)
        voxel = _voxel(density, p)
        x = _read(density, voxel) * r.length
        t = wp.exp(-tau)
        if emission.shape[0] > 0:
            glow += t * mean_transparency(x) * r.length * _read(emission, voxel)
        if nodes.shape[0] > 0 and x > 0.0:
            node = _node(nodes[0], size, p)
            for light in range(nodes.shape[0]):
                scattered[i, light] += t * absorbed(x) * wp.exp(-_read(nodes[light], node))
        tau += wp.min(x, _OPAQUE)
        n += 1
    emitted[i] = glow
    depth[i] = tau
    count[i] = n


@functools.cache
def _backward(rays: bool) -> wp.Kernel:
    """Builds (once) the adjoint of `_march` by the grids, or by the `rays`: by each sample's place and by the start and
    the length of the steps. The gradients of the other kind are not read."""

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def kernel(
        # in:
        density: wp.array3d[float],
        emission: wp.array3d[wp.vec3],
        nodes: wp.array4d[float],
        origin: wp.array1d[wp.vec3],
        direction: wp.array1d[wp.vec3],
        step: float,
        depth: wp.array1d[float],
        count: wp.array1d[int],
        grad_scattered: wp.array2d[float],
        grad_emitted: wp.array1d[wp.vec3],
        grad_depth: wp.array1d[float],
        # out:
        grad_density: wp.array3d[float],
        grad_emission: wp.array3d[wp.vec3],
        grad_nodes: wp.array4d[float],
        grad_origin: wp.array1d[wp.vec3],
        grad_direction: wp.array1d[wp.vec3],
    ):
        i = wp.tid()
        size = size_of(density)
        way = direction[i]
        r = steps_along(size, origin[i], way, step)
        tau = depth[i]
        hidden = float(0.0)  # contribution of the samples behind this one to the objective
        on_origin = wp.vec3()
        on_direction = wp.vec3()
        on_first = float(0.0)
        on_length = float(0.0)
        for back in range(count[i]):
            n = count[i] - 1 - back
            p = point_on(r, n, 0.5)
            voxel = _voxel(density, p)
            sigma = _read(density, voxel)
            x = sigma * r.length
            tau -= wp.min(x, _OPAQUE)
            t = wp.exp(-tau)
            on_p = wp.vec3()
            lit = float(0.0)
            if nodes.shape[0] > 0:
                node = _node(nodes[0], size, p)
                on_q = wp.vec3()
                if wp.static(rays):
                    steep_node = _steep(_among_nodes(nodes[0], size, p), _counts(nodes[0]))
                for light in range(nodes.shape[0]):
                    share = grad_scattered[i, light] * wp.exp(-_read(nodes[light], node))
                    lit += share
                    if wp.static(rays):
                        on_q += _slope(nodes[light], node, steep_node, -t * absorbed(x) * share)
                    elif x > 0.0:
                        _add(grad_nodes[light], node, -t * absorbed(x) * share)
                for axis in range(3):
                    on_p[axis] = on_q[axis] * float(_counts(nodes[0])[axis] - 1) / (size[axis] + 1.0)
            if wp.static(rays):
                steep = _steep(p - wp.vec3(0.5, 0.5, 0.5), _counts(density))
            glow = float(0.0)
            if emission.shape[0] > 0:
                colour = wp.dot(_read(emission, voxel), grad_emitted[i])
                glow = r.length * colour
                reaching = t * mean_transparency(x)
                if wp.static(rays):
                    on_p += _slope(emission, voxel, steep, reaching * r.length * grad_emitted[i])
                    on_length += reaching * colour
                elif grad_emission.shape[0] > 0:
                    _add(grad_emission, voxel, reaching * r.length * grad_emitted[i])
            on_x = t * (wp.exp(-x) * lit + _share_slope(x) * glow) - hidden + grad_depth[i]
            hidden += t * (absorbed(x) * lit + mean_transparency(x) * glow)
            if wp.static(rays):
                on_p += _slope(density, voxel, steep, on_x * r.length)
                steps = float(n) + 0.5
                on_origin += on_p
                on_direction += (r.first + steps * r.length) * on_p
                along = wp.dot(on_p, way)
                on_first += along
                on_length += on_x * sigma + steps * along
            else:
                _add(grad_density, voxel, on_x * r.length)
        if wp.static(rays):
            if r.count > 0:
                # The length of a step is (last - first) / count, and the ray begins and ends on a face or its origin.
                on_last = on_length / float(r.count)
                on_first -= on_last
                span = clip(size, origin[i], way)
                begun = bool(False)
                ended = bool(False)
                for axis in range(3):
                    d = way[axis]
                    if wp.abs(d) > 1.0e-9:
                        low = (-0.5 - origin[i][axis]) / d
                        high = (size[axis] + 0.5 - origin[i][axis]) / d
                        on_axis = float(0.0)
                        on_way = float(0.0)
                        if not begun and span[0] > 0.0 and wp.min(low, high) == span[0]:
                            begun = True
                            on_axis -= on_first / d
                            on_way -= on_first * span[0] / d
                        if not ended and wp.max(low, high) == span[1]:
                            ended = True
                            on_axis -= on_last / d
                            on_way -= on_last * span[1] / d
                        on_origin[axis] = on_origin[axis] + on_axis
                        on_direction[axis] = on_direction[axis] + on_way
            grad_origin[i] = on_origin
            grad_direction[i] = on_direction

    return kernel


def depths(density, toward, step: float, nodes) -> None:
    """Computes optical depths towards L lights at the nodes of a lattice.

    `density`, float [X, Y, Z], is extinction per voxel, at least 0; `toward`, vec3 [L], are directions of length 1;
    `step` is the longest step, in voxels. `nodes`, float [L, A, B, C], is written; `march.nodes_along` gives the
    numbers of nodes and `march.node_position` their positions.
    """
    inputs = [density, toward, step * _SLACK]
    wp.launch(_depths, nodes.shape, inputs=inputs, outputs=[nodes], device=density.device)


def depths_backward(toward, step: float, grad_nodes, grad_density) -> None:
    """Adds the gradient of the density, float [X, Y, Z], from that of the optical depths towards lights, float [L, A,
    B, C], the result of `depths`."""
    inputs = [toward, step * _SLACK, grad_nodes]
    wp.launch(_depths_backward, grad_nodes.shape, inputs=inputs, outputs=[grad_density], device=grad_density.device)


def march(density, emission, nodes, origin, direction, step: float, scattered, emitted, depth, count) -> None:
    """Marches rays, for lights of colour 1 and a phase function of 1.

    Args:
        density: float [X, Y, Z], extinction per voxel, at least 0.
        emission: vec3 [X, Y, Z], radiance emitted per voxel; shape [0, 0, 0]: no emission.
        nodes: float [L, A, B, C], the result of `depths` for L lights; L may be 0.
        origin, direction: vec3 [R], the origin of each of R rays in voxels, and its direction, of length 1.
        step: The longest step, in voxels.
        scattered: float [R, L], written: light scattered once to each ray, from each light.
        emitted: vec3 [R], written: light emitted to each ray.
        depth: float [R], written: optical depth along each ray, up to where it is opaque.
        count: int [R], written: number of samples of each ray, up to where it is opaque.
    """
    inputs = [density, emission, nodes, origin, direction, step * _SLACK]
    wp.launch(_march, origin.shape, inputs=inputs, outputs=[scattered, emitted, depth, count], device=density.device)


def march_backward(
    density,
    emission,
    nodes,
    origin,
    direction,
    step: float,
    depth,
    count,
    grad_scattered,
    grad_emitted,
    grad_depth,
    *,
    scene=(),
    rays=(),
) -> None:
    """Computes the adjoint of `march`; the gradient that reaches the density through the nodes is added by
    `depths_backward`.

    Args:
        density, emission, nodes, origin, direction, step, depth, count: Arguments and results of `march`.
        grad_scattered, grad_emitted, grad_depth: float [R, L], vec3 [R], float [R]: gradients of the loss with respect
            to the results of `march`.
        scene: Float [X, Y, Z], vec3 [X, Y, Z], float [L, A, B, C]: the gradients with respect to density, emission and
            nodes are added to them; with an emission of shape [0, 0, 0] its gradient is not computed. Empty: none.
        rays: vec3 [R] each, written: the gradients of origins and directions. The number of a ray's steps is constant,
            and the three numbers of a direction count as independent. Empty: not computed.
    """
    inputs = [density, emission, nodes, origin, direction, step * _SLACK, depth, count]
    inputs += [grad_scattered, grad_emitted, grad_depth]
    # The others are not read.
    others = density, emission, nodes, origin, direction
    for wanted, outputs in ((scene, [*scene, *others[3:]]), (rays, [*others[:3], *rays])):
        if wanted:
            wp.launch(_backward(wanted is rays), origin.shape, inputs=inputs, outputs=outputs, device=density.device)
