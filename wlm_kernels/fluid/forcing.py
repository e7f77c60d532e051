"""Forces that keep the air in motion: vorticity confinement, and a random stirring that leaves no divergence.

Read `_confined` and `_stirred` in `tests/fluid/test_forcing.py` first: they compute the same in float64 NumPy.

- Confinement (Fedkiw, Stam and Jensen 2001, "Visual Simulation of Smoke", eq. 9 to 11): eps N x w, with the vorticity
  w = curl u and N = grad |w| / |grad |w||, in central differences, one-sided at the ends of an axis. It returns to
  small eddies what the grid takes from them.
- Stirring (random Fourier modes: Kraichnan 1970, "Diffusion by a Random Velocity Field"): the sum over modes m of
  p_m cos(k_m . x + s_m t + f_m), with p_m perpendicular to sin(k_m): its divergence in central differences is 0.

Nothing acts in solid cells. Gradients do not exist: `wlm.fluid.gradients` refuses air with these forces.
"""

import warp as wp

from wlm_kernels.fluid.advection_places import Box
from wlm_kernels.fluid.lattice_sets import Slab, cell_of, index_of, launch_slab

wp.set_module_options({"enable_backward": False})

# Gradients of the vorticity below this, in cells and steps, have no direction.
_STEEP = wp.constant(1.0e-12)


@wp.struct
class Modes:
    """The M modes of a stirring, [M] each: `k`, vec3, the wave vector in 1 / cell; `push`, vec3, the amplitude in cells
    per step squared; `turn`, vec2, the phase per step and at step 0."""

    k: wp.array1d[wp.vec3]
    push: wp.array1d[wp.vec3]
    turn: wp.array1d[wp.vec2]


@wp.func
def _slope(n: wp.vec3i, periodic: wp.vec3i, p: wp.vec3i, a: int):
    """Returns the cells before and after cell p along axis a, and 1 over the distance between them."""
    low = wp.vec3i(p)
    high = wp.vec3i(p)
    low[a] -= 1
    high[a] += 1
    if periodic[a] != 0:
        low[a] = (low[a] + n[a]) % n[a]
        high[a] = high[a] % n[a]
        return low, high, 0.5
    low[a] = wp.max(low[a], 0)
    high[a] = wp.min(high[a], n[a] - 1)
    return low, high, 1.0 / float(wp.max(high[a] - low[a], 1))


@wp.func
def _curl(n: wp.vec3i, periodic: wp.vec3i, u: wp.array1d[wp.vec3], p: wp.vec3i) -> wp.vec3:
    d = wp.mat33()
    for a in range(3):
        low, high, share = _slope(n, periodic, p, a)
        d[a] = share * (u[index_of(n, high)] - u[index_of(n, low)])
    return wp.vec3(d[1][2] - d[2][1], d[2][0] - d[0][2], d[0][1] - d[1][0])


@wp.kernel
def _stir(
    # in:
    first: int,
    n: wp.vec3i,
    periodic: wp.vec3i,
    u: wp.array1d[wp.vec3],
    solid: wp.array1d[wp.uint8],
    confinement: float,
    modes: Modes,
    clock: wp.array1d[int],
    kept: float,
    # in, out:
    force: wp.array1d[wp.vec3],
):
    i = first + wp.tid()
    push = wp.vec3()
    if solid.shape[0] == 0 or solid[i] == wp.uint8(0):
        p = cell_of(n, i)
        if confinement > 0.0:
            up = wp.vec3()
            for a in range(3):
                low, high, share = _slope(n, periodic, p, a)
                up[a] = share * (wp.length(_curl(n, periodic, u, high)) - wp.length(_curl(n, periodic, u, low)))
            push += (confinement / wp.max(wp.length(up), _STEEP)) * wp.cross(up, _curl(n, periodic, u, p))
        # The larger of the two is the number of steps done.
        step = float(wp.max(clock[0], clock[1]))
        x = wp.vec3(float(p[0]), float(p[1]), float(p[2]))
        for m in range(modes.k.shape[0]):
            push += wp.cos(wp.dot(modes.k[m], x) + modes.turn[m][0] * step + modes.turn[m][1]) * modes.push[m]
    if kept != 0.0:
        push += force[i]
    force[i] = push


def stir(box: Box, u: wp.array, solid, confinement: float, modes: Modes, clock, force, *, added, slab: Slab) -> None:
    """Writes the acceleration of a slab's air to `force`, vec3 [N cells], in cells per step squared, or adds it.

    `u`, vec3 [N], is the air's velocity; `solid`, uint8 [N] or [0], above 0 in solids; `confinement` eps per step;
    and `clock`, int [2], that of `lattice.step_kernel`.
    """
    inputs = [box.coarse, box.periodic, u, solid, confinement, modes, clock, float(added)]
    launch_slab(_stir, box.coarse, slab, inputs, [force])
