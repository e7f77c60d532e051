"""Gradients through air and smoke against finite differences in float64, in torch and on tapes; stored states."""

import math
import re
import weakref
from collections.abc import Callable

import numpy as np
import pytest
import torch
import warp as wp
from builders.checks import error_of
from reference import lattice as reference
from reference.smoke_steps import Air, Smoke

from wlm import fluid
from wlm.errors import WlmError
from wlm.fluid import reversal
from wlm.fluid.faces import axis_ends
from wlm.fluid.lattice import Lattice
from wlm.fluid.solver import SCHEMES, Buoyancy, Solver, Source
from wlm_kernels.fluid.lattice_sets import LATTICES

STEPS = 20
VISCOSITY = 0.02
TOLERANCE = 1e-3  # of a derivative
CHANNEL = {"-x": ("inlet", (0.06, 0.02, 0.0)), "+x": ("outlet", None)}
WALLS = dict.fromkeys(("-y", "+y"), ("wall", (0.0, 0.0, 0.0)))
FLOWS = {
    # Walls at rest, mass-conserving outlets, a ramp, a force.
    "channel": ("D2Q9", (9, 8, 1), CHANNEL | WALLS, {"ramp": 6}, (0.0, 0.0, 0.0)),
    # An outlet with a density, a slip wall, a moving wall; a moving solid.
    "outlet": (
        "D2Q9",
        (9, 8, 1),
        {"-x": CHANNEL["-x"], "+x": ("outlet", 1.01), "-y": ("slip", (0.0,) * 3), "+y": ("wall", (0.05, 0.0, 0.0))},
        {},
        (0.0, 0.03, 0.0),
    ),
    "3d": ("D3Q19", (6, 5, 3), CHANNEL | WALLS, {"smagorinsky": 0.3}, (0.0, 0.0, 0.0)),
}


def _flow(kind: str, device: str, solid: bool = True) -> tuple[Lattice, Air]:
    """A lattice in a random flow, and the same in float64."""
    name, shape, faces, settings, moves = FLOWS[kind]
    settings = {"smagorinsky": 0.17, "ramp": 0} | settings
    lattice = Lattice(shape, lattice=name, viscosity=VISCOSITY, device=device, **settings)
    for face, (what, value) in faces.items():
        if what == "inlet":
            lattice.set_inlet(face, value)
        elif what == "outlet":
            lattice.set_outlet(face, value)
        else:
            lattice.set_wall(face, value, slip=what == "slip")
    mask = np.zeros(shape, int)
    if solid:
        mask[3:5, 2:4, :2] = 1
        lattice.set_solid(mask, moves)
    random = np.random.default_rng(5)
    u = 0.04 * random.uniform(-1, 1, (*shape, 3)) + (0.04, 0.0, 0.0)
    if name == "D2Q9":
        u[..., 2] = 0.0
    lattice.set_flow(u, 1.0 + 0.01 * random.uniform(-1, 1, shape))
    c, w = np.array(LATTICES[name].c), np.array(LATTICES[name].w)
    box = reference.Box(c, w, mask, dict(faces), moves)
    ramp = settings.pop("ramp")
    return lattice, Air(box, viscosity=VISCOSITY, ramp=ramp, force=np.zeros((*shape, 3)), **settings)


def _tensor(values: np.ndarray, device: str) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float32, device=device, requires_grad=True)


def _double(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().astype(np.float64)


def _hold(loss: torch.Tensor, leaves: list[torch.Tensor], twin: Callable[..., float], step: float = 1e-8) -> None:
    """Compares the value of a loss, and its derivative in a random direction to which all leaves contribute alike, with
    those of a twin in float64."""
    loss.backward()
    points, random, ways = [_double(leaf) for leaf in leaves], np.random.default_rng(7), []
    for leaf in leaves:
        grad = _double(leaf.grad)
        # No cancellation makes this small.
        way = np.sign(grad) * random.uniform(0.5, 1.5, grad.shape)
        ways.append(way / (grad * way).sum())
    assert loss.item() == pytest.approx(twin(*points), rel=1e-4, abs=1e-4)
    ends = [twin(*(p + sign * step * way for p, way in zip(points, ways, strict=True))) for sign in (1.0, -1.0)]
    # All of the error may be that of one leaf.
    assert (ends[0] - ends[1]) / (2.0 * step) == pytest.approx(len(leaves), abs=TOLERANCE)


@pytest.mark.parametrize("kind", FLOWS)
def test_air(kind: str, device: str):
    """20 steps of every boundary: gradients to the start, to the inlet at each step, and to a force;
    through velocity, density and drag."""
    lattice, twin = _flow(kind, device)
    air = fluid.DifferentiableLattice(lattice)
    random = np.random.default_rng(2)
    shape = lattice.shape
    # Populations of solid cells have no gradients, but those there that faces and solids return have.
    weight_u, weight_rho, weight_drag = (random.normal(size=size) for size in ((*shape, 3), shape, 3))
    plane = np.array([1.0, 1.0, 0.0 if shape[2] == 1 else 1.0])
    start = air.populations().requires_grad_()
    inlet = _tensor(0.06 * plane * random.uniform(-0.2, 1.0, (STEPS, 1, 3)), device)
    force = _tensor(1e-4 * plane * random.normal(size=(*shape, 3)), device)

    def value(f, inlet, force) -> float:
        f = twin.arrived(f)
        for step in range(STEPS):
            f = twin.step(f, step, inlet[step, 0], force)
        rho, u = twin.fields(f, force)
        return (weight_u * u).sum() + (weight_rho * rho).sum() + weight_drag @ twin.drag(f)

    out = air.advance(start, STEPS, inlet=inlet, force=force, begin=0, states=5)
    rho, u = air.fields(out, force)
    weights = (weight_u, weight_rho, weight_drag)
    w_u, w_rho, w_drag = (torch.tensor(w, dtype=torch.float32, device=device) for w in weights)
    loss = (w_u * u).sum() + (w_rho * rho).sum() + (w_drag * air.force_on_solid(out)).sum()
    _hold(loss, [start, inlet, force], value)
    # A uniform velocity and one for each cell are the same.
    totals = []
    for shaped in ((3,), (air.inlets, 3), (STEPS, air.inlets, 3)):
        many = _tensor(np.broadcast_to((0.05, 0.01, 0.0), shaped), device)
        moved = air.advance(start.detach(), STEPS, inlet=many, force=force.detach(), begin=0)
        (air.fields(moved)[1] * w_u).sum().backward()
        totals.append(_double(many.grad).reshape(-1, 3).sum(0))
    np.testing.assert_allclose(totals[1:], totals[:1] * 2, rtol=1e-4, atol=1e-4)


BOX = Source("box", (2.0, 4.0, 0.5), (1.0, 1.5, 2.0), 0.05, 0.02)
SOURCES = (BOX, Source("sphere", (5.0, 5.0, 0.5), (1.6, 1.6, 1.6), 0.3, 0.5, fixed=True))
BUOYANCY = Buoyancy(2e-3, 1e-3)


def _smoke(kind: str, device: str, scheme: str, **settings) -> tuple[fluid.DifferentiableSolver, Air, Smoke]:
    """Smoke with an obstacle in the air of `_flow`."""
    lattice, air = _flow(kind, device, solid=False)
    centre, radius = ((4.0, 2.0, 1.0), 1.2) if kind == "3d" else ((4.0, 3.0, 0.5), 1.0)
    obstacle = fluid.Sphere(fluid.Trajectory.of([centre]), radius)
    solver = Solver(lattice, refinement=2, scheme=scheme, obstacles=[obstacle], temperature=True, **settings)
    model = fluid.DifferentiableSolver(solver)  # which places the obstacle
    air.box.solid = solver.solid.numpy().astype(int)
    assert air.box.solid.sum() in (4, 8)
    decay = math.exp(-2.0 * settings.get("dissipation", 0.0)), math.exp(-2.0 * settings.get("cooling", 0.0))
    return model, air, Smoke(air.box.solid > 0, 2, axis_ends(lattice.faces), 2.0, scheme, decay)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_advection(scheme: str, device: str):
    """20 steps around an obstacle: gradients to both fields and to the velocity, past open, closed and periodic faces,
    into the solid, and with traces longer than a cell."""
    model, _, twin = _smoke("3d", device, scheme, dissipation=1e-3, cooling=2e-3)
    random = np.random.default_rng(4)
    cells = tuple(twin.n.tolist())
    weights = random.normal(size=(2, *cells))
    density, heat = (_tensor(random.uniform(0.0, 1.0, cells), device) for _ in range(2))
    velocity = _tensor(0.25 * random.normal(size=(*twin.coarse.tolist(), 3)), device)

    def value(density, velocity, heat) -> float:
        for _ in range(STEPS):
            density, heat = twin.carry(velocity, density, heat)
        return (weights[0] * density).sum() + (weights[1] * heat).sum()

    smoke, warmth = density, heat
    for _ in range(STEPS):
        smoke, warmth = model.carry(smoke, velocity, warmth)
    w = torch.tensor(weights, dtype=torch.float32, device=device)
    _hold((w[0] * smoke).sum() + (w[1] * warmth).sum(), [density, velocity, heat], value)


def test_smoke_and_air(device: str):
    """20 steps of all together around an obstacle: gradients to air, smoke, inlets and sources at each step."""
    model, air, twin = _smoke("channel", device, "maccormack", buoyancy=BUOYANCY, sources=SOURCES, cooling=1e-3)
    random = np.random.default_rng(4)
    cells = tuple(twin.n.tolist())
    weights, weight_u = random.normal(size=(2, *cells)), random.normal(size=(*twin.coarse.tolist(), 3))
    state = model.state()
    f = state.populations.requires_grad_()
    density, heat = (_tensor(random.uniform(0.0, 1.0, cells), device) for _ in range(2))
    inlet = _tensor(np.array([0.08, 0.02, 0.0]) * random.uniform(-0.2, 1.0, (STEPS, 1, 3)), device)
    sources = _tensor(random.uniform(0.1, 0.5, (STEPS, 2, 2)), device)
    emits = [twin.region(source.centre, source.size, source.shape == "sphere") for source in SOURCES]

    def value(f, density, heat, inlet, sources) -> float:
        f = air.arrived(f)
        for step in range(STEPS):
            force = np.zeros((*twin.coarse, 3))
            force[..., 1] = BUOYANCY.lift * twin.means(heat) - BUOYANCY.weight * twin.means(density)
            for part in range(2):
                f = air.step(f, 2 * step + part, inlet[step, 0], force)
            _, u = air.fields(f, force)
            density, heat = twin.carry(u, density, heat)
            for number, (source, within) in enumerate(zip(SOURCES, emits, strict=True)):
                kept, scale = (0.0, 1.0) if source.fixed else (1.0, 2.0)
                pairs = zip((density, heat), sources[step, number], strict=True)
                density, heat = (np.where(within, kept * values + scale * source, values) for values, source in pairs)
        _, u = air.fields(f)
        return (weights[0] * density).sum() + (weights[1] * heat).sum() + (weight_u * u).sum()

    out = model.advance(fluid.SmokeState(f, density, heat), STEPS, inlet=inlet, sources=sources, begin=0, states=4)
    w, w_u = (torch.tensor(weight, dtype=torch.float32, device=device) for weight in (weights, weight_u))
    loss = (w[0] * out.density).sum() + (w[1] * out.temperature).sum()
    loss = loss + (w_u * model.air.fields(out.populations)[1]).sum()
    _hold(loss, [f, density, heat, inlet, sources], value)


def test_values_are_the_solvers(device: str):
    """The same kernels in the same order: the same smoke, with the lattice's and the sources' own settings."""
    model, _, _ = _smoke("channel", device, "maccormack", buoyancy=BUOYANCY, sources=SOURCES)
    solver = model._solver
    out = model.advance(model.state(), 6)
    solver.step(6)
    np.testing.assert_allclose(out.density.cpu().numpy(), solver.density.numpy(), atol=1e-6)
    np.testing.assert_allclose(out.temperature.cpu().numpy(), solver.temperature.numpy(), atol=1e-6)
    fluid_cells = solver.solid.numpy() == 0
    populations = solver.lattice.populations().numpy()[:, fluid_cells]
    np.testing.assert_allclose(out.populations.cpu().numpy()[:, fluid_cells], populations, atol=1e-6)


@pytest.mark.parametrize("smoky", [False, True])
def test_tape(smoky: bool, device: str):
    """The gradients of Warp arrays on a tape are those of tensors."""
    model, _, _ = _smoke("channel", device, "maccormack", buoyancy=BUOYANCY, sources=SOURCES)
    air = model.air
    inlet = torch.tensor([[[0.05, 0.01, 0.0]]] * 3, device=device)
    leaves = {"populations": air.populations(), "inlet": inlet}
    if smoky:
        cells = model.state().density.shape
        random = torch.Generator(device).manual_seed(1)
        leaves |= {name: torch.rand(cells, generator=random, device=device) for name in ("density", "temperature")}
        leaves["sources"] = torch.full((2, 2), 0.2, device=device)

    def run(populations, inlet, density=None, temperature=None, sources=None) -> tuple:
        if not smoky:
            out = air.advance(populations, 3, inlet=inlet)
            return *air.fields(out), air.force_on_solid(out)
        out = model.advance(fluid.SmokeState(populations, density, temperature), 3, inlet=inlet, sources=sources)
        _, u = air.fields(out.populations)
        return model.carry(out.density, u, out.temperature)

    tensors = {name: leaf.clone().requires_grad_() for name, leaf in leaves.items()}
    results = run(**tensors)
    sum((k + 1) * (result**2).sum() for k, result in enumerate(results)).backward()
    arrays = {name: wp.from_torch(leaf.clone(), requires_grad=True) for name, leaf in leaves.items()}
    with wp.Tape() as tape:
        found = run(**arrays)
    for result, expected in zip(found, results, strict=True):
        torch.testing.assert_close(wp.to_torch(result), expected.detach().view(result.shape))
    seeds = [2.0 * (k + 1) * wp.to_torch(result, requires_grad=False) for k, result in enumerate(found)]
    tape.backward(grads=dict(zip(found, map(wp.from_torch, seeds), strict=True)))
    for name, array in arrays.items():
        expected = tensors[name].grad
        difference = (wp.to_torch(array.grad).view(expected.shape) - expected).abs().max()
        assert difference <= 1e-5 * expected.abs().max() and expected.any(), name


def _eddying() -> tuple[fluid.DifferentiableLattice, torch.Tensor, int]:
    """A periodic flow, its populations, and the bytes of its lattice's arrays."""
    lattice = Lattice((32, 32, 1), lattice="D2Q9", viscosity=VISCOSITY)
    lattice.set_flow(0.05 * np.random.default_rng(1).uniform(-1, 1, (32, 32, 1, 3)) * (1.0, 1.0, 0.0))
    air = fluid.DifferentiableLattice(lattice)
    return air, air.populations().requires_grad_(), Lattice.bytes_needed(lattice.shape, lattice="D2Q9")


def test_memory_of_200_steps():
    """200 steps and their backward pass allocate at most 8 times the arrays of the lattice itself at a time."""
    air, start, own = _eddying()
    with torch.profiler.profile(profile_memory=True) as profile:
        air.advance(start, 200).square().sum().backward()
    events = profile.profiler.kineto_results.events()
    changes = sorted((e.start_ns(), e.nbytes()) for e in events if e.name() == "[memory]")
    peak = np.cumsum([size for _, size in changes]).max()
    assert own < peak <= 8 * own
    assert start.grad.any()


def test_any_number_of_states_gives_the_same_gradients():
    grads = []
    for states in (1, 3, 40):
        air, start, _ = _eddying()
        air.advance(start, 30, states=states).square().sum().backward()
        grads.append(start.grad)
    assert torch.equal(grads[0], grads[2]) and torch.equal(grads[1], grads[2])


@pytest.mark.parametrize(
    ("steps", "most", "sweeps"), [(1, 1, 1), (7, 1, 7), (9, 9, 1), (45, 8, 3), (200, 8, 5), (200, 30, 3)]
)
def test_reversal(steps: int, most: int, sweeps: int):
    """Each state is there in turn, no more are stored than allowed, and no step is computed too often."""

    class State:
        def __init__(self, number: int) -> None:
            self.number = number
            alive.add(self)
            assert len(alive) <= most + 2  # and one before and one after a step

    alive: weakref.WeakSet = weakref.WeakSet()
    computed = np.zeros(steps, int)

    def advance(step: int, state: State) -> State:
        assert state.number == step
        computed[step] += 1
        return State(step + 1)

    def backward(step: int, state: State, gradient: int) -> int:
        assert state.number == step and gradient == step + 1
        return step

    stored = [(0, State(0))]
    assert reversal.run(stored, steps, most, advance).number == steps
    assert reversal.reverse(stored, steps, most, advance, backward, steps) == 0
    assert len(stored) == 1 and computed.max() <= sweeps


def test_hard_cases():
    """A single cell, a lattice that is all solid, no step, and two backward passes."""
    for solid in (0, 1):
        lattice = Lattice((1, 1, 1), lattice="D2Q9", viscosity=VISCOSITY)
        lattice.set_flow((0.1, 0.0, 0.0))
        if solid:
            lattice.set_solid(np.ones((1, 1, 1), int))
        air = fluid.DifferentiableLattice(lattice)
        start = air.populations().requires_grad_()
        excess, u = air.fields(air.advance(start, 12))
        total = (excess + u[..., 0]).sum()
        # Mass and momentum of the only cell stay as they are.
        assert total.item() == pytest.approx(0.0 if solid else 0.1, abs=1e-6)
        total.backward(retain_graph=True)
        once = start.grad.clone()
        total.backward()
        assert torch.equal(start.grad, 2.0 * once) and once.any() == (not solid)
        start.grad = None
        air.advance(start, 0).sum().backward()
        assert torch.equal(start.grad, torch.ones_like(start))


def test_refusals():
    """What has no gradient, and what does not fit, is one line."""
    small = Lattice((4, 4, 1), lattice="D2Q9", viscosity=VISCOSITY, save_memory=True)
    assert re.search(r"^lattice: expected save_memory=False.*$", error_of(fluid.DifferentiableLattice, small))
    half = Lattice((4, 4, 1), lattice="D2Q9", viscosity=VISCOSITY, storage="float16")
    assert re.search(r"^lattice: expected storage='float32'.*$", error_of(fluid.DifferentiableLattice, half))
    moving = fluid.Sphere(fluid.Trajectory.of([[2, 2, 0.5], [3, 2, 0.5]], [0, 50]), 1.0)
    lattice = Lattice((6, 4, 1), lattice="D2Q9", viscosity=VISCOSITY)
    lattice.set_bodies([moving])
    assert re.search(r"^lattice: expected bodies at rest.*$", error_of(fluid.DifferentiableLattice, lattice))
    for settings, words in (
        ({"storage": "float16"}, "float16"),
        ({"bricks": True}, "bricks"),
        ({"obstacles": [moving]}, "one that moves"),
    ):
        lattice = Lattice((6, 4, 1), lattice="D2Q9", viscosity=VISCOSITY)
        with pytest.raises(WlmError, match=f"^smoke: .* got .*{words}.*$"):
            fluid.DifferentiableSolver(Solver(lattice, refinement=1, **settings))
    model, _, _ = _smoke("channel", "cpu", "maccormack", sources=SOURCES)
    state, air = model.state(), model.air
    with pytest.raises(WlmError, match=r"blew up in step \d+ at cell .*not a number"):
        air.advance(torch.full_like(state.populations, math.nan), 2)
    assert torch.equal(air.advance(state.populations, 0), state.populations)
