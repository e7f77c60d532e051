"""Fire: fuel that burns, makes heat and smoke and expands the gas; hot gas that radiates its heat.

Read `_burned` and `test_expansion` in `tests/fluid/test_fire.py` first: they compute the same in float64 NumPy.

- Burning (Feldman, O'Brien and Arikan 2003, "Animating Suspended Particle Explosions", section 4.3): fuel burns at a
  constant rate where it is hot enough, and gives heat and smoke in proportion. Heat is added up to a temperature of 1.
  Fuel below 1 fills this share of its cell, and burns at this share of the rate: mixing does not make it burn faster.
- Cooling (Nguyen, Fedkiw and Jensen 2002, "Physically Based Modeling and Animation of Fire", eq. 18):
  dT/dt = -c T^4, with T 0 in ambient air and 1 in the hottest flame; solved exactly in each step.
- Expansion (ideal gas at low Mach number): div u = D ln K / Dt, with K the absolute temperature. A cell receives its
  share of mass at its own velocity; pressure outlets take what is too much.

Half floats are rounded at random, so that small changes add up. Gradients do not exist.
"""

import functools

import warp as wp

from wlm_kernels.fluid.advection import Fields, fields_struct
from wlm_kernels.fluid.advection_places import Box, Bricks, address_of, is_solid
from wlm_kernels.fluid.lattice_sets import (
    STORAGES,
    Layout,
    Slab,
    Tables,
    cell_of,
    equilibrium,
    launch_slab,
    memory_functions,
)

# Largest growth of the gas in a cell and step of the lattice.
_MOST = wp.constant(0.02)
_OPTIONS = {"enable_backward": False}


@wp.struct
class Burning:
    """A fire in a step of the solver: `fuel` that burns at most; `heat` and `smoke` of a unit of it; temperature of
    `ignition`; `radiation` c; `ratio` of a temperature's 1 to the ambient one in kelvin; factor of the `expansion`."""

    fuel: float
    heat: float
    smoke: float
    ignition: float
    radiation: float
    ratio: float
    expansion: float


@functools.cache
def burn_kernel(stored: type) -> wp.Kernel:
    """Builds (once) the kernel that burns fuel in fields of `wp.float32` or `wp.float16`, a thread per coarse cell
    of a slab."""
    fields_type = fields_struct(stored)

    @wp.func
    def rounded(value: float, chance: float) -> stored:
        if wp.static(stored is wp.float16):
            unit = wp.pow(2.0, wp.floor(wp.log2(wp.max(value, 6.2e-5))) - 10.0)
            value = wp.min(value + (chance - 0.5) * unit, 65504.0)
        return stored(wp.max(value, 0.0))

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def burn(
        # in:
        begin: int,
        box: Box,
        walls: wp.array1d[wp.uint8],
        bricks: Bricks,
        fire: Burning,
        clock: wp.array1d[int],
        # in, out:
        fields: fields_type,
        fuel: fields_type,
        # out:
        growth: wp.array1d[float],
    ):
        i = begin + wp.tid()
        r = box.refinement
        first = r * cell_of(box.coarse, i)
        total = float(0.0)
        if not is_solid(box, walls, first):
            state = wp.rand_init(wp.max(clock[0], clock[1]), i)
            for k in range(r * r * r):
                at = address_of(box, bricks, first + cell_of(wp.vec3i(r, r, r), k))
                left = float(fuel.density[at])
                heat = float(fields.temperature[at])
                if left > 0.0 or heat > 0.0:
                    burnt = wp.where(heat >= fire.ignition, wp.min(left, fire.fuel * wp.min(left, 1.0)), 0.0)
                    hot = wp.max(heat, wp.min(heat + fire.heat * burnt, 1.0))
                    hot = hot * wp.pow(1.0 + 3.0 * fire.radiation * hot * hot * hot, -1.0 / 3.0)
                    total += wp.log((1.0 + fire.ratio * hot) / (1.0 + fire.ratio * heat))
                    fuel.density[at] = rounded(left - burnt, wp.randf(state))
                    fields.temperature[at] = rounded(hot, wp.randf(state))
                    if burnt > 0.0:
                        smoke = float(fields.density[at]) + fire.smoke * burnt
                        fields.density[at] = rounded(smoke, wp.randf(state))
        growth[i] = wp.clamp(fire.expansion * total / float(r * r * r), -_MOST, _MOST)

    return burn


def burn(box: Box, walls: wp.array, bricks: Bricks, fire: Burning, clock: wp.array, fields: Fields, growth, slab: Slab):
    """Burns the fuel of a slab's smoke and cools it; writes to `growth`, float [coarse cells], how much the gas of a
    cell expands in a step of the lattice, as a share. `clock` is that of `lattice.step_kernel`; for others see
    `advection`."""
    inputs = [box, walls, bricks, fire, clock]
    outputs = [fields.arrays, fields.burning.arrays, growth]
    kernel = burn_kernel(fields.density.dtype)
    launch_slab(kernel, box.coarse, slab, inputs, outputs)


@functools.cache
def expand_kernel(lattice_name: str, storage: str, in_place: bool = False) -> wp.Kernel:
    """Builds (once) the kernel that adds mass to a slab's cells after a step: a share `growth`, [N], at the cell's
    velocity.

    It changes the populations `f`, [Q, N], that leave the cells, before boundary conditions act; solid cells have none.
    """
    memory = memory_functions(lattice_name, storage, (False, False, False), in_place=in_place)
    stored = STORAGES[storage][0]
    load, store, leaving = memory.load, memory.store, memory.leaving

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def expand(first: int, t: Tables, at: Layout, growth: wp.array1d[float], f: wp.array2d[stored]):
        i = first + wp.tid()
        if growth[i] == 0.0:
            return
        p = cell_of(at.n, i)
        rho = float(1.0)
        j = wp.vec3()
        for q in range(t.w.shape[0]):
            left = load(f, leaving(f, at, i, p, q, t.c[q]))
            rho += left
            j += left * wp.vec3(float(t.c[q][0]), float(t.c[q][1]), float(t.c[q][2]))
        for q in range(t.w.shape[0]):
            share = t.w[q] + equilibrium(t.w[q], t.c[q], 0.0, j / rho)
            k = leaving(f, at, i, p, q, t.c[q])
            store(f, k, load(f, k) + growth[i] * rho * share)

    return expand
