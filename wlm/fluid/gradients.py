"""Gradients through air and smoke: the steps of `Lattice` and `Solver` as differentiable operations.

The forward pass runs the kernels of `Lattice` and `Solver` themselves, so its values are theirs. The backward pass
(`wlm_kernels.fluid.lattice_adjoint` and `advection_adjoint`) is exact for the discretised step; those modules state
what it does at kinks. It needs the state before each step; `wlm.fluid.reversal` stores a fixed number of states and
computes the others again.

Arguments are torch tensors, with autograd, or Warp arrays, whose gradients are recorded on the active `wp.Tape`, as in
`wlm.ops`. All floats are float32. No gradient exists for storage in 16 bits, for bricks, for moving obstacles, and to
the positions of sources, faces and solids. Lengths are in cells of the lattice, times in its steps.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from wlm.errors import WlmError
from wlm.fluid import reversal
from wlm.fluid.lattice import BODIES, MAX_SPEED, Lattice, blown_up
from wlm.fluid.solver import Solver, ways_of
from wlm.interop import to_warp
from wlm.ops.tapes import takes_arrays
from wlm.ops.tensors import check, check_finite, dense, on_stream
from wlm_kernels.fluid import advection, advection_adjoint, advection_sources, lattice_adjoint, lattice_links
from wlm_kernels.fluid.advection_places import trace
from wlm_kernels.fluid.lattice import QUIET, step_kernel
from wlm_kernels.fluid.lattice_links import OUTLET, WIND
from wlm_kernels.fluid.lattice_sets import Slab

STATES = 8
"""Most states that are stored for the backward pass, by default."""

_Tensors = tuple[torch.Tensor, ...]


@dataclass(frozen=True, eq=False)
class SmokeState:
    """The state of air and smoke, as tensors or as Warp arrays.

    Attributes:
        populations: float [Q, X, Y, Z], the populations of the lattice, as `Lattice.populations` returns them.
        density: float [X r, Y r, Z r], the density of the smoke, at least 0; r is the refinement.
        temperature: Its temperature, like the density; None if the smoke has none.
    """

    populations: torch.Tensor
    density: torch.Tensor
    temperature: torch.Tensor | None = None


class DifferentiableLattice:
    """The air of a `Lattice` with its present faces, solids and force; later changes of these do not affect it.

    Args:
        lattice: The air.

    Attributes:
        device: The device of all tensors.
        inlets: I, the number of cells of inlets. They are numbered face by face in the order of `FACES`, on a face by
            its two axes in the order x, y, z.

    Raises:
        WlmError: The lattice stores 16-bit floats or saves memory, or a body of it moves.
    """

    def __init__(self, lattice: Lattice) -> None:
        self._lattice, self._setup = lattice, lattice.setup()
        setup = self._setup
        if setup.spec.storage != "float32":
            raise WlmError("lattice: expected storage='float32', since float16 has no gradients, got 'float16'")
        if setup.spec.in_place:
            raise WlmError("lattice: expected save_memory=False, since steps in place have no gradients, got True")
        if any((face.kind == WIND).any() for face in lattice.faces.values()):
            raise WlmError("lattice: expected inlets in place of wind, since wind has no gradients, got wind")
        if lattice.moving:
            raise WlmError("lattice: expected bodies at rest, since others have no gradients, got one that moves")
        self._cells, self._directions = math.prod(setup.shape), setup.tables.w.shape[0]
        self.device, self.inlets = torch.device(wp.device_to_torch(lattice.device)), setup.inlets
        # The step takes a force only if it has been compiled for one.
        self._unforced = wp.empty(0, dtype=wp.vec3, device=lattice.device)
        code, cell = setup.links.code.numpy(), setup.links.cell.numpy()
        balanced = code >> 5 == OUTLET
        if setup.solid.shape[0]:
            balanced &= setup.solid.numpy()[cell] == 0
        weight = float(setup.tables.w.numpy()[code[balanced] & 31].sum(dtype=float))
        self._weight = wp.array([0.0, weight], dtype=wp.float64, device=lattice.device)

    def populations(self) -> torch.Tensor:
        """Returns a copy of the lattice's present populations, float [Q, X, Y, Z]."""
        return wp.to_torch(self._lattice.populations())

    @takes_arrays("populations", "inlet", "force")
    def advance(
        self,
        populations: torch.Tensor,
        steps: int = 1,
        *,
        inlet: torch.Tensor | None = None,
        force: torch.Tensor | None = None,
        begin: int | None = None,
        states: int = STATES,
    ) -> torch.Tensor:
        """Advances the air by T steps.

        Args:
            populations: float [Q, X, Y, Z]; has a gradient, like `inlet` and `force`.
            steps: T, at least 0.
            inlet: Velocities of the I cells of inlets in cells per step: (3,) for all, [I, 3], or [T, 1, 3] or
                [T, I, 3] for each step; components at most `MAX_SPEED`. None: the lattice's own.
            force: Acceleration in cells per step squared, (3,) or [X, Y, Z, 3]. None: the lattice's own.
            begin: Number of steps done before, from which the ramp of inlets goes on; None: those of the lattice.
            states: Most states stored for the backward pass, at least 1; with fewer of them, steps are computed more
                often, see `wlm.fluid.reversal`.

        Returns:
            The populations after the steps, float [Q, X, Y, Z].

        Raises:
            ValueError: A shape, type or device does not fit, or a number is not finite or in range.
            WlmError: The air blew up. Like the check of numbers, this waits for the GPU and is skipped while a CUDA
                graph is captured.
        """
        self._check(populations)
        controls = self._inlet(inlet, steps), self._force(force)
        machine = _Air(self, self._lattice.steps if begin is None else begin)
        return _Steps.apply(machine, *_counts(steps, states), 1, populations, *controls)[0]

    @takes_arrays("populations", "force")
    def fields(self, populations: torch.Tensor, force: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Computes the density minus 1, [X, Y, Z], and the velocity, [X, Y, Z, 3], of the air. In solid cells they are
        0 and the body's velocity, without gradients. Arguments and errors: see `advance`."""
        self._check(populations)
        return _Fields.apply(self, populations, self._force(force))

    @takes_arrays("populations")
    def force_on_solid(self, populations: torch.Tensor, body: int = 1) -> torch.Tensor:
        """Computes the force of the air on a body in the last step, (3,), see `Lattice.force_on_solid`.

        Raises:
            ValueError: As for `advance`, or the lattice has no solid, or the number is none of a body.
        """
        self._check(populations)
        if not (0 < body < BODIES and self._setup.solid.shape[0]):
            raise ValueError(f"body: expected 1 to {BODIES - 1}, in a lattice with solids, got {body}")
        return _Force.apply(self, populations, body)

    # Checked arguments.

    def _check(self, populations: torch.Tensor) -> None:
        check("populations", populations, (self._directions, *self._setup.shape), self.device)

    def _inlet(self, inlet: torch.Tensor | None, steps: int) -> torch.Tensor | None:
        """Returns velocities of inlets as [1 or T, 1 or I, 3]."""
        if inlet is None:
            return None
        if not self.inlets:
            raise ValueError("inlet: expected None, since the lattice has no inlet, got velocities")
        rows = 1 if inlet.ndim == 3 and inlet.shape[1] == 1 else self.inlets
        check("inlet", inlet, {1: (3,), 2: (self.inlets, 3)}.get(inlet.ndim, (steps, rows, 3)), self.device)
        check_finite({"inlet": (-MAX_SPEED, MAX_SPEED)}, inlet=inlet)
        return inlet if inlet.ndim == 3 else inlet.reshape(1, -1, 3)

    def _force(self, force: torch.Tensor | None) -> torch.Tensor | None:
        if force is None:
            return None
        check("force", force, (3,) if force.ndim == 1 else (*self._setup.shape, 3), self.device)
        check_finite(force=force)
        return force.expand(*self._setup.shape, 3)

    # On the device.

    def _forces(self, force: torch.Tensor | None) -> wp.array:
        """Returns the acceleration of each cell as a vec3 [N], or [0] without a force."""
        return self._setup.forces if force is None else _flat(force, wp.vec3)

    def _flow(self, forces: wp.array) -> lattice_adjoint.Flow:
        setup, flow = self._setup, lattice_adjoint.Flow()
        flow.n, flow.bounded, flow.walled = setup.layout.n, setup.layout.bounded, setup.layout.walled
        flow.tau, flow.eddy, flow.axes = setup.tau, setup.eddy, 2 if setup.spec.lattice == "D2Q9" else 3
        flow.solid, flow.forces = setup.solid, forces
        return flow

    def _collide(self, work: "_Work", f: wp.array, done: int, forces: wp.array, out: wp.array) -> None:
        setup = self._setup
        spec = replace(setup.spec, forced=forces.shape[0] > 0)
        work.done.fill_(done)
        inputs = [0, setup.layout.n, f, setup.solid, setup.tau, setup.eddy, forces, 0]
        outputs = [work.clock, work.trouble, work.sums, out]
        wp.launch(step_kernel(spec), self._cells, inputs=inputs, outputs=outputs, device=f.device)

    def _advance(
        self, work: "_Work", f: torch.Tensor, done: int, inlet: torch.Tensor | None, forces: wp.array
    ) -> torch.Tensor:
        """Does a step; `inlet` is [1 or I, 3]."""
        setup = self._setup
        # A step leaves solid cells as they are.
        out = torch.zeros_like(f) if setup.solid.shape[0] else torch.empty_like(f)
        if inlet is not None:
            lattice_adjoint.set_inlets(setup.tables, work.links, setup.inlet, _flat(inlet, wp.vec3))
        left = self._populations(out)
        self._collide(work, self._populations(f), done, forces, left)
        slab, links = Slab(left.device, 0, setup.shape[0]), work.links
        where = [setup.tables, slab, 0, links.cell.shape[0], setup.layout, links, setup.solid]
        rise = 1.0 / max(setup.ramp, 1)
        for writing in (False, True):
            lattice_links.apply(setup.link_kernels, *where, work.clock, rise, left, work.sums, writing=writing)
        return out

    def _reverse(
        self,
        work: "_Work",
        f: torch.Tensor,
        done: int,
        forces: wp.array,
        on_out: torch.Tensor,
        on_inlet: torch.Tensor | None,
        on_forces: wp.array,
    ) -> torch.Tensor:
        """Returns the gradient to the populations before a step; `on_out` is overwritten, the others are added to."""
        setup, flow = self._setup, self._flow(forces)
        before, grad, on_f = self._populations(f), self._populations(on_out), torch.zeros_like(f)
        left = before
        if setup.outlets:
            # Their gradient depends on the populations that left the cells, which the links have overwritten.
            left = self._populations(torch.zeros_like(f))
            self._collide(work, before, done, forces, left)
        risen = min(1.0, (done + 2) / max(setup.ramp, 1))
        risen = risen * risen * (3.0 - 2.0 * risen)
        rows = on_out.new_zeros(0 if on_inlet is None else self.inlets, 3)
        where = [setup.tables, flow, work.links, setup.inlet, risen, left, self._weight]
        lattice_adjoint.links_backward(*where, grad, _flat(rows, wp.vec3))
        lattice_adjoint.step_backward(setup.tables, flow, before, grad, self._populations(on_f), on_forces)
        if on_inlet is not None:
            on_inlet += rows if len(on_inlet) == len(rows) else rows.sum(0)
        return on_f

    def _populations(self, f: torch.Tensor) -> wp.array:
        return to_warp(f.view(self._directions, self._cells))

    def _read(self, f: torch.Tensor, forces: wp.array, drho: wp.array, u: wp.array) -> None:
        setup = self._setup
        inputs = [0, setup.layout, self._populations(f), setup.solid, setup.bodies, forces]
        wp.launch(setup.fluid_kernels.fields, self._cells, inputs=inputs, outputs=[drho, u], device=u.device)


class DifferentiableSolver:
    """The smoke of a `Solver` and its air, with their present settings; later changes of the lattice do not affect it.

    Args:
        solver: Air and smoke. Its obstacles are placed, if it has done no step yet.

    Attributes:
        air: The air; with buoyancy the force of its own steps and fields is 0.

    Raises:
        WlmError: The solver stores 16-bit floats, computes bricks or has a moving obstacle.
    """

    def __init__(self, solver: Solver) -> None:
        self._solver, self._setup = solver, solver.setup()
        for wrong, expected, found in (
            (self._setup.storage != "float32", "storage='float32'", "'float16'"),
            (self._setup.bricks, "bricks=False", "bricks"),
            (solver.lattice.moving, "obstacles at rest", "one that moves"),
            (self._setup.stirred, "no confinement, turbulence or fire", "one of them"),
        ):
            if wrong:
                raise WlmError(f"smoke: expected {expected}, since other smoke has no gradients, got {found}")
        self.air = DifferentiableLattice(solver.lattice)
        if self._setup.buoyancy is not None:
            # The lattice's force is the buoyancy of a moment; each step has its own.
            self.air._setup = replace(self.air._setup, forces=self.air._unforced)

    def state(self) -> SmokeState:
        """Returns a copy of the solver's present state."""
        density, temperature = self._solver.density, self._solver.temperature
        heat = None if temperature is None else wp.to_torch(temperature).clone()
        return SmokeState(self.air.populations(), wp.to_torch(density).clone(), heat)

    @takes_arrays("state.populations", "state.density", "state.temperature", "inlet", "sources")
    def advance(
        self,
        state: SmokeState,
        steps: int = 1,
        *,
        inlet: torch.Tensor | None = None,
        sources: torch.Tensor | None = None,
        begin: int | None = None,
        states: int = STATES,
    ) -> SmokeState:
        """Advances air and smoke by T steps of the solver.

        Args:
            state: Air and smoke; all have gradients, like `inlet` and `sources`.
            steps, begin: In steps of the solver; else as for `DifferentiableLattice.advance`.
            inlet, states: As for `DifferentiableLattice.advance`.
            sources: Density and temperature of the solver's S sources, at least 0: [S, 2], or [T, S, 2] for each step,
                in the units of `Source`. None: the sources' own. The values are copied to the host.

        Returns:
            The state after the steps.

        Raises:
            ValueError, WlmError: As for `DifferentiableLattice.advance`.
        """
        smoke = self._check(state.density, state.temperature)
        self.air._check(state.populations)
        if sources is not None:
            tail = (len(self._setup.sources), 2)
            check("sources", sources, (steps, *tail) if sources.ndim == 3 else tail, self.air.device)
            check_finite({"sources": (0.0, math.inf)}, sources=sources)
            sources = sources if sources.ndim == 3 else sources[None]
        controls = self.air._inlet(inlet, steps), sources
        machine = _Smoke(self, self._solver.steps if begin is None else begin, controls[1])
        f, density, heat = _Steps.apply(machine, *_counts(steps, states), 3, state.populations, *smoke, *controls)
        return SmokeState(f, density, heat if self._setup.temperature else None)

    @takes_arrays("density", "velocity", "temperature")
    def carry(
        self, density: torch.Tensor, velocity: torch.Tensor, temperature: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Moves smoke through air of a given velocity for a step of the solver, without its sources.

        Args:
            density: float [X r, Y r, Z r], at least 0; has a gradient, like the others.
            velocity: float [X, Y, Z, 3], cells per step.
            temperature: Like the density; None if the smoke has none.

        Returns:
            The density and the temperature after the step, with their decay.

        Raises:
            ValueError: A shape, type or device does not fit, or a number is not finite or in range.
        """
        smoke = self._check(density, temperature)
        check("velocity", velocity, (*self.air._setup.shape, 3), self.air.device)
        check_finite(velocity=velocity)
        density, heat = _Carry.apply(self, velocity, *smoke)
        return density, heat if self._setup.temperature else None

    def _check(self, density: torch.Tensor, temperature: torch.Tensor | None) -> _Tensors:
        """Returns density and temperature; the latter is empty for smoke that has none."""
        if (temperature is not None) != self._setup.temperature:
            kinds = ("None", "a tensor")
            expected, found = kinds[self._setup.temperature], kinds[temperature is not None]
            raise ValueError(f"temperature: expected {expected}, as the solver's smoke has it, got {found}")
        check("density", density, self._setup.shape, self.air.device)
        if temperature is None:
            temperature = density.new_empty(0)
        else:
            check("temperature", temperature, self._setup.shape, self.air.device)
        check_finite(
            dict.fromkeys(("density", "temperature"), (0.0, math.inf)), density=density, temperature=temperature
        )
        return density, temperature

    # On the device.

    def _traces(self, zero: bool = False) -> wp.array:
        size = ways_of(self._setup.scheme) * self.air._cells, 3
        return _flat((torch.zeros if zero else torch.empty)(size, device=self.air.device), wp.vec3)

    def _advect(self, u: wp.array, smoke: _Tensors) -> tuple[_Tensors, _Tensors | None]:
        """Returns smoke after a step without sources, and the prediction of a MacCormack step."""
        setup, predicted, last = self._setup, None, tuple(torch.empty_like(part) for part in smoke)
        traces = self._traces()
        trace(setup.box, u, setup.substeps, traces)
        where = [setup.box, traces, setup.walls, _fields(smoke)]
        if setup.scheme == "maccormack":
            predicted = tuple(torch.empty_like(part) for part in smoke)
            advection.advect(*where, _fields(predicted))
        known = None if predicted is None else _fields(predicted)
        advection.advect(*where, _fields(last), setup.decay, predicted=known)
        return last, predicted

    def _advect_backward(
        self, u: wp.array, smoke: _Tensors, predicted: _Tensors | None, on_out: _Tensors, on_u: wp.array
    ) -> _Tensors:
        """Returns the gradients to the smoke before a step; that to the velocity is added to `on_u`."""
        setup, on_smoke = self._setup, tuple(torch.zeros_like(part) for part in smoke)
        traces, on_traces = self._traces(), self._traces(zero=True)
        trace(setup.box, u, setup.substeps, traces)
        where = [setup.box, traces, setup.walls, _fields(smoke)]
        into, decay = [_fields(on_smoke), on_traces], setup.decay
        on_last = _fields(on_out)
        if predicted is not None:
            on_predicted = _fields(tuple(torch.zeros_like(part) for part in smoke))
            second = {"predicted": _fields(predicted), "on_predicted": on_predicted}
            advection_adjoint.advect_backward(*where, on_last, *into, decay, **second)
            on_last, decay = on_predicted, (1.0, 1.0)
        advection_adjoint.advect_backward(*where, on_last, *into, decay)
        advection_adjoint.trace_backward(setup.box, u, setup.substeps, on_traces, on_u)
        return on_smoke


class _Work:
    """Small arrays that the steps of a call use, in torch's memory: `clock`, `trouble` and `sums` of
    `wlm_kernels.fluid.lattice.step_kernel`, the first two also as tensors, and the lattice's links with terms and
    values of this call."""

    def __init__(self, air: DifferentiableLattice) -> None:
        links, device = air._setup.links, air.device
        self.done = torch.zeros(2, dtype=torch.int32, device=device)
        self.first_trouble = torch.full((1,), QUIET, dtype=torch.int64, device=device)
        self.clock, self.trouble = to_warp(self.done), to_warp(self.first_trouble)
        self.sums = to_warp(torch.zeros(2, dtype=torch.float64, device=device))
        self.links = lattice_links.Links()
        self.links.cell, self.links.code, self.links.term = links.cell, links.code, links.term
        self.links.used, self.links.faces = links.used, links.faces
        if links.term.shape[0]:
            self.links.term = to_warp(wp.to_torch(links.term).clone())
        self.links.value = _flat(torch.zeros(links.term.shape[0], device=device))


class _Air:
    """The steps of a lattice, for `_Steps`: the state is its populations, the controls are inlets and force."""

    def __init__(self, air: DifferentiableLattice, begin: int) -> None:
        self.air, self.begin = air, begin

    def advance(self, work: _Work, step: int, state: _Tensors, controls: tuple) -> _Tensors:
        inlet, force = controls
        return (self.air._advance(work, state[0], self.begin + step, _at(inlet, step), self.air._forces(force)),)

    def backward(
        self, work: _Work, step: int, state: _Tensors, controls: tuple, on_state: _Tensors, on_controls: tuple
    ) -> _Tensors:
        forces = self.air._forces(controls[1])
        on_force = self.air._unforced if on_controls[1] is None else _flat(on_controls[1], wp.vec3)
        on_inlet = _at(on_controls[0], step)
        return (self.air._reverse(work, state[0], self.begin + step, forces, *on_state, on_inlet, on_force),)


class _Smoke:
    """The steps of a solver, for `_Steps`: the state is populations, density and temperature, the controls are inlets
    and sources."""

    def __init__(self, solver: DifferentiableSolver, begin: int, sources: torch.Tensor | None) -> None:
        self.solver, self.air, self.setup = solver, solver.air, solver._setup
        self.begin = begin * self.setup.substeps
        self.values = None if sources is None else sources.detach().cpu().tolist()

    def advance(self, work: _Work, step: int, state: _Tensors, controls: tuple) -> _Tensors:
        f, *smoke = state
        forces = self._buoyancy(tuple(smoke))
        *_, f = self._moved(work, step, f, controls[0], forces)
        (density, heat), _ = self.solver._advect(self._velocity(f, forces), tuple(smoke))
        fields = _fields((density, heat))
        for number, source in enumerate(self.setup.sources):
            values = (source.density, source.temperature)
            if self.values is not None:
                values = self.values[step if len(self.values) > 1 else 0][number]
            scale = source.steps(self.setup.substeps)
            where = [self.setup.box, self.setup.walls, source.region(self.setup.box.refinement, str(self.air.device))]
            value = scale * values[0], scale * values[1]
            advection_sources.add_source(*where, value, fields, fixed=source.fixed)
        return f, density, heat

    def backward(
        self, work: _Work, step: int, state: _Tensors, controls: tuple, on_state: _Tensors, on_controls: tuple
    ) -> _Tensors:
        setup, air = self.setup, self.air
        f, *rest = state
        on_f, *on_rest = on_state
        smoke, on_smoke = tuple(rest), tuple(on_rest)
        forces = self._buoyancy(smoke)
        before = self._moved(work, step, f, controls[0], forces)
        u = self._velocity(before[-1], forces)
        if setup.sources:
            on_values = on_f.new_zeros(len(setup.sources), 2)
            fields, into = _fields(on_smoke), _flat(on_values, wp.vec2)
            for number, source in reversed(list(enumerate(setup.sources))):
                where = [setup.box, setup.walls, source.region(setup.box.refinement, str(air.device)), number]
                advection_adjoint.source_backward(*where, fields, into, fixed=source.fixed)
            if on_controls[1] is not None:
                scales = [source.steps(setup.substeps) for source in setup.sources]
                _at(on_controls[1], step).add_(on_values * on_values.new_tensor(scales)[:, None])
        on_u = torch.zeros(air._cells, 3, device=air.device)
        predicted = self.solver._advect(u, smoke)[1] if setup.scheme == "maccormack" else None
        on_smoke = self.solver._advect_backward(u, smoke, predicted, on_smoke, _flat(on_u, wp.vec3))
        del predicted
        on_forces = air._unforced if setup.buoyancy is None else _flat(torch.zeros_like(on_u), wp.vec3)
        last, into = air._populations(before.pop()), air._populations(on_f)
        where = [air._setup.tables, air._flow(forces), last, _flat(on_u.new_empty(0)), _flat(on_u, wp.vec3)]
        lattice_adjoint.fields_backward(*where, into, on_forces)
        on_inlet = _at(on_controls[0], step)
        for number in reversed(range(setup.substeps)):
            done = self.begin + step * setup.substeps + number
            on_f = air._reverse(work, before.pop(), done, forces, on_f, on_inlet, on_forces)
        if setup.buoyancy is not None:
            by = setup.buoyancy.by_density, setup.buoyancy.by_temperature
            advection_adjoint.buoyancy_backward(setup.box, setup.walls, *by, on_forces, _fields(on_smoke))
        return on_f, *on_smoke

    def _buoyancy(self, smoke: _Tensors) -> wp.array:
        """Returns the force on the air, vec3 [N], or the lattice's own."""
        if (buoyancy := self.setup.buoyancy) is None:
            return self.air._forces(None)
        force = _flat(torch.empty(self.air._cells, 3, device=self.air.device), wp.vec3)
        by = buoyancy.by_density, buoyancy.by_temperature
        advection_sources.buoyancy(self.setup.box, self.setup.walls, _fields(smoke), *by, force)
        return force

    def _moved(
        self, work: _Work, step: int, f: torch.Tensor, inlet: torch.Tensor | None, forces: wp.array
    ) -> list[torch.Tensor]:
        """Returns the populations before each of the lattice's steps, and after the last."""
        moved = [f]
        for number in range(self.setup.substeps):
            done = self.begin + step * self.setup.substeps + number
            moved.append(self.air._advance(work, moved[-1], done, _at(inlet, step), forces))
        return moved

    def _velocity(self, f: torch.Tensor, forces: wp.array) -> wp.array:
        u = _flat(torch.empty(self.air._cells, 3, device=f.device), wp.vec3)
        self.air._read(f, forces, _flat(f.new_empty(0)), u)
        return u


class _Steps(torch.autograd.Function):
    """Runs the steps of `_Air` or `_Smoke`; the first `count` tensors are the state, the others the controls."""

    @staticmethod
    def forward(ctx, machine, steps, states, count, *tensors):
        ctx.machine, ctx.steps, ctx.count = machine, steps, count
        ctx.most = states if any(ctx.needs_input_grad) else 1
        tensors = [tensor if tensor is None else dense(tensor) for tensor in tensors]
        with on_stream(machine.air.device):
            work, stored = _Work(machine.air), [(0, tuple(tensors[:count]))]
            out = reversal.run(stored, steps, ctx.most, _Steps._advance(machine, work, tuple(tensors[count:])))
            if steps == 0:
                out = tuple(part.clone() for part in out)
            _check_trouble(machine.air, work)
        ctx.save_for_backward(*tensors)
        ctx.stored = stored[1:]
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, *on_out):
        tensors, machine = ctx.saved_tensors, ctx.machine
        state, controls = tensors[: ctx.count], tensors[ctx.count :]
        # A second backward pass begins from the start again.
        stored, ctx.stored = [(0, state), *ctx.stored], []
        needed = ctx.needs_input_grad[4 + ctx.count :]
        on_controls = tuple(torch.zeros_like(c) if need else None for c, need in zip(controls, needed, strict=True))
        with on_stream(machine.air.device):
            work = _Work(machine.air)

            def backward(step, state, on_state):
                return machine.backward(work, step, state, controls, on_state, on_controls)

            advance, on_state = _Steps._advance(machine, work, controls), tuple(dense(g).clone() for g in on_out)
            on_state = reversal.reverse(stored, ctx.steps, ctx.most, advance, backward, on_state)
        return None, None, None, None, *on_state, *on_controls

    @staticmethod
    def _advance(machine: Any, work: _Work, controls: tuple) -> Callable[[int, _Tensors], _Tensors]:
        return lambda step, state: machine.advance(work, step, state, controls)


class _Fields(torch.autograd.Function):
    @staticmethod
    def forward(ctx, air, f, force):
        f, force = dense(f), force if force is None else dense(force)
        ctx.air = air
        drho, u = f.new_empty(air._setup.shape), f.new_empty(*air._setup.shape, 3)
        with on_stream(air.device):
            air._read(f, air._forces(force), _flat(drho), _flat(u, wp.vec3))
        ctx.save_for_backward(f, force)
        return drho, u

    @staticmethod
    @once_differentiable
    def backward(ctx, on_drho, on_u):
        (f, force), air = ctx.saved_tensors, ctx.air
        on_f, on_force = torch.zeros_like(f), torch.zeros_like(force) if ctx.needs_input_grad[2] else None
        with on_stream(air.device):
            forces = air._unforced if on_force is None else _flat(on_force, wp.vec3)
            where = [air._setup.tables, air._flow(air._forces(force)), air._populations(f)]
            into = air._populations(on_f), forces
            lattice_adjoint.fields_backward(*where, _flat(dense(on_drho)), _flat(dense(on_u), wp.vec3), *into)
        return None, on_f, on_force


class _Force(torch.autograd.Function):
    @staticmethod
    def forward(ctx, air, f, body):
        f, setup = dense(f), air._setup
        ctx.air, ctx.body, ctx.like = air, body, f.new_empty(0)
        total = torch.zeros(BODIES, 3, dtype=torch.float64, device=air.device)
        with on_stream(air.device):
            inputs = [setup.tables, setup.layout, setup.links, setup.solid, air._populations(f)]
            size, kernel, into = setup.links.cell.shape[0], setup.link_kernels.force, to_warp(total, wp.vec3d)
            wp.launch(kernel, size, inputs=inputs, outputs=[into], device=into.device)
        return total[body].float()

    @staticmethod
    @once_differentiable
    def backward(ctx, on_total):
        air, setup = ctx.air, ctx.air._setup
        on_f = ctx.like.new_zeros(air._directions, *setup.shape)
        with on_stream(air.device):
            where = [setup.tables, air._flow(setup.forces), setup.links, ctx.body]
            lattice_adjoint.force_backward(*where, to_warp(dense(on_total)[None], wp.vec3), air._populations(on_f))
        return None, on_f, None


class _Carry(torch.autograd.Function):
    @staticmethod
    def forward(ctx, solver, velocity, *smoke):
        velocity, smoke = dense(velocity), tuple(dense(part) for part in smoke)
        ctx.solver = solver
        with on_stream(velocity.device):
            out, predicted = solver._advect(_flat(velocity, wp.vec3), smoke)
        ctx.save_for_backward(velocity, *smoke, *(predicted or ()))
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, *on_out):
        velocity, *parts = ctx.saved_tensors
        on_velocity = torch.zeros_like(velocity)
        with on_stream(velocity.device):
            u, on_u = _flat(velocity, wp.vec3), _flat(on_velocity, wp.vec3)
            out = tuple(dense(part) for part in on_out)
            on_smoke = ctx.solver._advect_backward(u, tuple(parts[:2]), tuple(parts[2:]) or None, out, on_u)
        return None, on_velocity, *on_smoke


def _flat(tensor: torch.Tensor, vector: Any = None) -> wp.array:
    """Returns a tensor as an array of one axis, of numbers or of vectors along the tensor's last axis."""
    if not tensor.numel():
        return wp.empty(0, dtype=vector or float, device=wp.device_from_torch(tensor.device))
    return to_warp(tensor.reshape(-1) if vector is None else tensor.reshape(-1, tensor.shape[-1]), vector)


def _fields(smoke: _Tensors) -> advection.Fields:
    return advection.Fields(_flat(smoke[0]), _flat(smoke[1]))


def _at(control: torch.Tensor | None, step: int) -> torch.Tensor | None:
    """Returns a control's values in a step; its first axis is of steps, or 1."""
    return None if control is None else control[step if len(control) > 1 else 0]


def _counts(steps: int, states: int) -> tuple[int, int]:
    for name, value, least in (("steps", steps, 0), ("states", states, 1)):
        if value < least:
            raise ValueError(f"{name}: expected at least {least}, got {value}")
    return steps, states


def _check_trouble(air: DifferentiableLattice, work: _Work) -> None:
    if work.first_trouble.is_cuda and torch.cuda.is_current_stream_capturing():
        return
    if (key := int(work.first_trouble)) != QUIET:
        raise blown_up(key, air._setup.shape)
