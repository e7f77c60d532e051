"""Measures gradients through air and smoke: the time of a step both ways beside the solver's own, and memory.

The air is a tunnel with a sphere, D3Q19, regularised with eddy viscosity: an inlet, an outlet, walls and slip walls.
Smoke has the air's resolution, two steps of the air per step, MacCormack's scheme, a temperature and buoyancy. "whole"
stores the state before each step, "bounded" as many as by default. The time of a step is that of a call of T steps
over T; the solver's own steps are replayed as graphs on CUDA. Memory is the most that torch allocates at a time beyond
the start, in MiB; that of the solver is the size of its own arrays.
"""

from collections.abc import Callable, Iterator

import torch

from benchmarks.rows import Row
from benchmarks.runner import Bench, Note
from wlm import fluid
from wlm.fluid.gradients import STATES

_MIB = 2**20
_STEPS, _MANY = 20, 200
_SPEED = 0.05


def run(*, quick: bool, device: str, progress: Note | None = None) -> list[Row]:
    """Measures steps of air and of smoke, and the memory of 200 steps of air.

    Args:
        quick: Whether to measure small grids and few steps, for a CPU.
        device: "cpu" or "cuda:0".
        progress: Called with a line before each part of the work.

    Returns:
        A row for each grid, method and direction.

    Raises:
        WlmError: The device is not there.
    """
    bench = Bench("smoke", device, progress, scene="gradients", clock="step_ms", repeats=5)
    rows: list[Row] = []
    for cells in (16,) if quick else (64, 128):
        steps = 4 if quick else _STEPS
        for method, cases in (("air", _air(cells, device, steps)), ("smoke", _smoke(cells, device, steps))):
            bench.note(f"{method}, {cells}^3 cells")
            rows += _timed(bench, method, cells, steps, dict(cases))
    bench.note(f"{_MANY} steps of air")
    rows += _memory(bench, 16 if quick else 64, 20 if quick else _MANY)
    return rows


def _tunnel(cells: int, device: str) -> fluid.Lattice:
    lattice = fluid.Lattice((cells,) * 3, viscosity=1e-3, device=device)
    lattice.set_inlet("-x", (_SPEED, 0.0, 0.0))
    lattice.set_outlet("+x")
    for face in ("-y", "+y"):
        lattice.set_wall(face)
    for face in ("-z", "+z"):
        lattice.set_wall(face, slip=True)
    return lattice


def _sphere(cells: int) -> fluid.Sphere:
    return fluid.Sphere(fluid.Trajectory.of([[0.4 * cells, 0.5 * cells, 0.5 * cells]]), cells / 8)


def _air(cells: int, device: str, steps: int) -> Iterator[tuple[str, Callable[[], object]]]:
    """The calls that are timed, by option."""
    lattice = _tunnel(cells, device)
    fluid.Solver(lattice, refinement=1, obstacles=[_sphere(cells)]).setup()  # which sets the solid cells
    lattice.set_flow((_SPEED, 0.0, 0.0))
    model = fluid.DifferentiableLattice(lattice)
    start = model.populations().requires_grad_()
    inlet = torch.tensor([_SPEED, 0.0, 0.0], device=device, requires_grad=True)

    def forwards() -> object:
        with torch.no_grad():
            return model.advance(start, steps, inlet=inlet, begin=0)

    def whole(states: int) -> None:
        model.advance(start, steps, inlet=inlet, begin=0, states=states).square().sum().backward()
        start.grad = inlet.grad = None

    yield "solver", lambda: lattice.step(steps)
    yield "forwards", forwards
    yield "both ways, whole", lambda: whole(steps)
    yield "both ways, bounded", lambda: whole(STATES)


def _smoke(cells: int, device: str, steps: int) -> Iterator[tuple[str, Callable[[], object]]]:
    source = fluid.Source("sphere", (0.2 * cells, 0.5 * cells, 0.5 * cells), (0.1 * cells,) * 3, 0.05, 0.05)
    settings = {"refinement": 1, "temperature": True, "sources": [source], "buoyancy": fluid.Buoyancy(1e-4)}
    solver = fluid.Solver(_tunnel(cells, device), obstacles=[_sphere(cells)], **settings)
    solver.lattice.set_flow((_SPEED, 0.0, 0.0))
    solver.step(4)
    model = fluid.DifferentiableSolver(solver)
    state = model.state()
    for part in (state.populations, state.density, state.temperature):
        part.requires_grad_()
    sources = torch.full((1, 2), 0.05, device=device, requires_grad=True)

    def forwards() -> object:
        with torch.no_grad():
            return model.advance(state, steps, sources=sources, begin=4)

    def whole(states: int) -> None:
        out = model.advance(state, steps, sources=sources, begin=4, states=states)
        (out.density.square().sum() + out.populations.square().sum()).backward()
        state.populations.grad = state.density.grad = state.temperature.grad = sources.grad = None

    yield "solver", lambda: solver.step(steps)
    yield "forwards", forwards
    yield "both ways, whole", lambda: whole(steps)
    yield "both ways, bounded", lambda: whole(STATES)


def _timed(bench: Bench, method: str, cells: int, steps: int, calls: dict[str, Callable[[], object]]) -> list[Row]:
    times = bench.time(calls, few=bench.device == "cpu")
    return [
        bench.row(method, option, f"{steps} steps a call", timing=times[option], calls=steps, cells=cells)
        for option in calls
    ]


def _memory(bench: Bench, cells: int, steps: int) -> list[Row]:
    lattice = _tunnel(cells, bench.device)
    lattice.set_flow((_SPEED, 0.0, 0.0))
    model = fluid.DifferentiableLattice(lattice)
    own = fluid.Lattice.bytes_needed(lattice.shape)
    rows = [bench.row("air", "memory of the solver", "", cells=cells, memory=own / _MIB)]
    if bench.device == "cpu":
        return rows
    for count in (1, steps):
        start = model.populations().requires_grad_()
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        model.advance(start, count, begin=0).square().sum().backward()
        torch.cuda.synchronize()
        used = torch.cuda.max_memory_allocated() - before
        notes = f"{STATES} stored states at most; {used / own:.2f} times the solver's arrays"
        rows.append(bench.row("air", f"memory of {count} steps", notes, cells=cells, memory=used / _MIB))
    return rows
