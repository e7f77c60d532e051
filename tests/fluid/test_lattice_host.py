"""The lattice's interface: limits, hard cases, states, bodies that move."""

import numpy as np
import pytest
import warp as wp

from wlm.errors import WlmError
from wlm.fluid import engine
from wlm.fluid.faces import FACES
from wlm.fluid.lattice import CHECK_EVERY, MAX_SPEED, Domain, Lattice
from wlm_kernels.fluid.lattice_fields import voxelise_sphere

SHAPE = (12, 8, 8)


def _box(device: str, shape=SHAPE, inlet: bool = True, **settings) -> Lattice:
    """An inlet and an outlet along x, walls elsewhere."""
    box = Lattice(shape, device=device, **{"viscosity": 0.02, **settings})
    for face in FACES[2:]:
        box.set_wall(face)
    if inlet:
        box.set_inlet("-x", (0.05, 0.0, 0.0))
        box.set_outlet("+x")
    else:
        box.set_wall("-x")
        box.set_wall("+x")
    return box


# A flow that blows up.


@pytest.mark.parametrize("where", [(3, 2, 5), (11, 7, 7)])
def test_not_a_number_is_reported(where: tuple[int, int, int], device: str):
    box = _box(device)
    box.step(5)
    state = box.state()
    q = 4
    populations = state["populations"].reshape(-1, *SHAPE)
    populations[(q, *where)] = np.nan
    box._engine.buffers[0].assign(state["populations"])
    with pytest.raises(WlmError, match=r"blew up in step 5 at cell \(\d+, \d+, \d+\): not a number") as caught:
        box.step(CHECK_EVERY)
    assert "\n" not in str(caught.value)
    with pytest.raises(WlmError, match="step 5 "):
        box.check()


def test_speed_and_density_are_reported(device: str):
    box = Lattice(SHAPE, viscosity=0.02, device=device)
    u = np.zeros((*SHAPE, 3))
    u[4, 3, 2] = (0.0, 0.7, 0.0)
    box.set_flow(u)
    box.step(0)
    with pytest.raises(WlmError, match="the speed exceeds that of sound"):
        box.set_flow(np.full((*SHAPE, 3), 0.4))
        box.step()
    box = Lattice(SHAPE, viscosity=0.02, device=device)
    box.set_flow(density=-0.1)
    with pytest.raises(WlmError, match=r"step 0 at cell \(0, 0, 0\): the density is not positive"):
        box.step()


def test_blow_up_stops_the_run_soon(device: str):
    """BGK without eddies at a viscosity near 0: the run ends within the steps between two checks."""
    box = Lattice(SHAPE, viscosity=1e-6, operator="bgk", smagorinsky=0.0, device=device)
    box.set_flow(0.1 * np.random.default_rng(1).uniform(-1, 1, (*SHAPE, 3)))
    with pytest.raises(WlmError, match="blew up in step") as caught:
        box.step(5000)
    step = int(str(caught.value).split("step ")[1].split()[0])
    assert step < box.steps <= step + CHECK_EVERY
    assert CHECK_EVERY <= 50 and CHECK_EVERY % box.period == 0


# Hard cases.


def test_body_over_the_inlet(device: str):
    """Air comes in where the inlet isn't covered; with all of it covered nothing moves."""
    covered = _box(device)
    mask = np.zeros(SHAPE, bool)
    mask[0] = True
    covered.set_solid(mask)
    covered.step(60)
    assert np.abs(covered.velocity().numpy()).max() == 0.0
    half = _box(device)
    mask[0, 4:] = False
    half.set_solid(mask)
    mass = half.mass()
    half.step(400)
    u = half.velocity().numpy()
    assert half.mass() == pytest.approx(mass, rel=1e-6)
    assert u[8, :, :, 0].sum() == pytest.approx(0.05 * 4 * 8, rel=0.15)


def test_body_over_everything(device: str):
    box = _box(device)
    box.set_solid(np.ones(SHAPE, bool), (0.1, 0.0, 0.0))
    box.step(3)
    np.testing.assert_allclose(box.velocity().numpy(), np.broadcast_to((0.1, 0.0, 0.0), (*SHAPE, 3)), rtol=1e-6)
    assert box.mass() == 0.0


@pytest.mark.parametrize("inlet", [False, True])
def test_one_voxel(inlet: bool, device: str):
    box = _box(device, (1, 1, 1), inlet)
    box.step(50)
    assert np.isfinite(box.velocity().numpy()).all()
    assert box.mass() == pytest.approx(1.0, abs=1e-6)


def test_too_fast(device: str):
    """Walls, inlets, and bodies by their translation or their spin."""
    box = Lattice(SHAPE, viscosity=0.02, device=device)
    for wrong in (lambda: box.set_wall("-y", (0.5, 0.0, 0.0)), lambda: box.set_inlet("-x", (0.31, 0.0, 0.0))):
        with pytest.raises(WlmError, match=f"at most {MAX_SPEED}: use a shorter step"):
            wrong()
    mask = np.zeros(SHAPE, bool)
    mask[4:8, 2:6, 3] = True
    with pytest.raises(WlmError, match="a solid's surface moves at 0.4 cells per step"):
        box.set_solid(mask, (0.0, 0.4, 0.0))
    box = Lattice(SHAPE, viscosity=0.02, device=device)
    box.set_solid(mask, spin=(0.0, 0.0, 0.05), centre=(6.0, 4.0, 3.5))
    with pytest.raises(WlmError, match="a solid's surface"):
        box.set_solid(mask, spin=(0.0, 0.0, 0.2), centre=(6.0, 4.0, 3.5))


def test_too_large_for_the_memory(device: str, monkeypatch: pytest.MonkeyPatch):
    """The error names the memory needed and that available, before anything is allocated."""
    monkeypatch.setattr(engine, "free_memory", lambda _device: 3 * 2**29)
    with pytest.raises(WlmError, match=r"256 x 256 x 256 cells need 2\.4 GiB on .*: expected at most the 1\.5 GiB"):
        Lattice((256, 256, 256), viscosity=0.02, device=device)
    with pytest.raises(WlmError, match="fewer than 2"):
        Lattice((2048, 1024, 1024), viscosity=0.02, device=device)


@pytest.mark.parametrize(
    "settings",
    [
        {"shape": (0, 4, 4)},
        {"viscosity": 0.0},
        {"viscosity": float("nan")},
        {"operator": "none"},
        {"storage": "int8"},
        {"lattice": "D2Q9"},
        {"ramp": -1},
    ],
)
def test_wrong_settings(settings: dict):
    with pytest.raises(ValueError):
        Lattice(**{"shape": (4, 4, 4), "viscosity": 0.02, **settings})


def test_wrong_calls(device: str):
    box = Lattice(SHAPE, viscosity=0.02, device=device)
    for wrong in (
        lambda: box.set_wall("x"),
        lambda: box.set_wall("-x", np.zeros((3, 3))),
        lambda: box.set_wall("-x", (np.nan, 0.0, 0.0)),
        lambda: box.set_inlet("-x", (0.1, 0.0, 0.0), where=np.ones((3, 3), bool)),
        lambda: box.set_outlet("-x", 0.0),
        lambda: box.set_solid(np.zeros((3, 3, 3), bool)),
        lambda: box.set_solid(np.zeros(SHAPE)),
        lambda: box.set_solid(np.full(SHAPE, 256)),
        lambda: box.set_solid(wp.zeros(SHAPE, dtype=int, device=device)),
        lambda: box.set_solid(np.zeros(SHAPE, bool), (0.0, np.inf, 0.0)),
        lambda: box.set_force((0.0, 0.0)),
        lambda: box.set_force(wp.zeros(SHAPE, dtype=float, device=device)),
        lambda: box.set_flow((np.nan, 0.0, 0.0)),
        lambda: box.step(-1),
        lambda: box.force_on_solid(0),
    ):
        with pytest.raises(ValueError):
            wrong()
    box.set_wall("-x")
    with pytest.raises(ValueError, match=r"'\+x': expected a wall"):
        box.step()
    box.set_wall("+x")
    box.step()
    with pytest.raises(ValueError, match="before the flow"):
        box.set_wall("-y")


# States.


@pytest.mark.parametrize("storage", ["float32", "float16"])
def test_a_state_goes_on_to_the_last_bit(storage: str, device: str):
    """An odd number of steps in, with a body, an inlet that still rises and the other buffer stale."""

    def make() -> Lattice:
        return _box(device, storage=storage, ramp=40)

    mask = np.zeros(SHAPE, bool)
    mask[4:6, 3:5, 3:6] = True
    first, second = make(), make()
    first.set_solid(mask, (0.01, 0.0, 0.0))
    first.step(7)
    state = first.state()
    first.step(8)
    second.load(state)
    assert second.steps == 7
    second.step(8)
    np.testing.assert_array_equal(first.velocity().numpy(), second.velocity().numpy())
    np.testing.assert_array_equal(first.excess_density().numpy(), second.excess_density().numpy())
    np.testing.assert_array_equal(first.force_on_solid(), second.force_on_solid())


def test_a_state_without_a_body_after_one(device: str):
    """Nothing is left of the body that was there."""
    free, blocked = (_box(device) for _ in range(2))
    free.step(3)
    mask = np.zeros(SHAPE, bool)
    mask[4:6, 3:5, 3:6] = True
    blocked.set_solid(mask)
    blocked.step(2)
    state = free.state()
    for box in (free, blocked):
        box.load(state)
        box.step(6)
    assert np.abs(free.velocity().numpy()).max() > 0.01
    np.testing.assert_array_equal(blocked.velocity().numpy(), free.velocity().numpy())


def test_states_are_checked(device: str):
    box = _box(device)
    state = box.state()
    missing = {name: value for name, value in state.items() if name != "bodies"}
    for wrong, match in (
        (missing, "part bodies is missing"),
        (state | {"populations": state["populations"][:9]}, "populations is float32"),
        (state | {"populations": state["populations"].astype(np.float16)}, "part populations is float16"),
        (state | {"solid": np.zeros(3, np.uint8)}, r"part solid is uint8 \(3,\), expected uint8"),
        (state | {"populations": np.full_like(state["populations"], np.nan)}, "part populations: expected finite"),
        (state | {"steps": np.array(-1)}, "part steps: expected 0 to 2.14748e.09, found -1"),
        (state | {"steps": np.array(2.5)}, "part steps is float64 .*, expected int64"),
    ):
        with pytest.raises(WlmError, match=match):
            box.load(wrong)


# Bodies that move.


def test_a_body_that_moves_pushes_air(device: str):
    """A sphere voxelised again at every step: no voids, no excess of air, and a drag against its motion."""
    shape = (40, 20, 20)
    box = _box(device, shape, inlet=False, viscosity=0.05)
    solid = wp.zeros(shape, dtype=wp.uint8, device=device)
    forces = []
    for k in range(150):
        voxelise_sphere(solid, 1, (8.0 + 0.1 * k, 10.0, 10.0), 4.0)
        box.set_solid(solid, (0.1, 0.0, 0.0))
        box.step()
        forces.append(box.force_on_solid())
    u, density = box.velocity().numpy(), box.density()
    assert np.mean(forces[50:], 0)[0] < 0
    assert np.abs(density - 1).max() <= 0.1
    assert np.linalg.norm(u, axis=-1).max() <= 0.2
    # The wake follows it.
    assert u[12:16, 8:12, 8:12, 0].mean() >= 0.02
    fluid = shape[0] * shape[1] * shape[2] - np.count_nonzero(solid.numpy())
    assert box.mass() == pytest.approx(fluid, rel=3e-3)


def test_a_body_may_come_before_or_after_the_flow(device: str):
    """Populations sent towards cells that become solid come back from them at once."""
    mask = np.zeros(SHAPE, np.uint8)
    mask[4:7, 3:6, 2:5], mask[9, 7, 7] = 1, 2
    motion = [(0.05, 0.0, 0.02), (0.0, 0.0, 0.0)]
    flow = 0.05 * np.random.default_rng(4).uniform(-1, 1, (*SHAPE, 3))
    velocities = []
    for first in ("body", "flow"):
        box = Lattice(SHAPE, viscosity=0.02, device=device)
        if first == "body":
            box.set_solid(mask, motion)
        box.set_flow(flow)
        if first == "flow":
            box.set_solid(mask, motion)
        velocities.append(box.velocity().numpy().copy())
        box.step(3)
        velocities.append(box.velocity().numpy().copy())
    np.testing.assert_array_equal(velocities[:2], velocities[2:])


def test_freed_cells_get_the_mean_of_their_neighbours(device: str):
    """In a uniform wind a body that vanishes leaves just the wind; a cell with no fluid around it is at rest."""
    wind = (0.04, -0.02, 0.01)
    box = Lattice(SHAPE, viscosity=0.02, device=device)
    box.set_flow(wind, 1.01)
    mask = np.zeros(SHAPE, np.uint8)
    mask[5, 4, 4] = 1
    box.set_solid(mask, wind)
    box.set_solid(np.zeros_like(mask))
    np.testing.assert_allclose(box.velocity().numpy(), np.broadcast_to(wind, (*SHAPE, 3)), atol=1e-5)
    np.testing.assert_allclose(box.density(), 1.01, atol=1e-5)
    # At a face the mean takes no cell of the far side.
    box = Lattice(SHAPE, viscosity=0.02, device=device)
    for face in FACES[:2]:
        box.set_wall(face, slip=True)
    mask[5, 4, 4], mask[0, 3, 3] = 0, 1
    box.set_solid(mask)
    density = np.full(SHAPE, 1.01)
    density[6:] = 0.99
    box.set_flow(density=density)
    box.set_solid(np.zeros_like(mask))
    np.testing.assert_allclose(box.density()[:5], 1.01, atol=1e-5)
    box = Lattice((3, 3, 3), viscosity=0.02, device=device)
    mask = np.ones((3, 3, 3), np.uint8)
    box.set_solid(mask)
    mask[1, 1, 1] = 0
    box.set_solid(mask)
    box.step(3)
    assert box.mass() == 1.0
    np.testing.assert_array_equal(box.velocity().numpy(), 0.0)


def test_a_rotor_turns_the_air(device: str):
    """A disc that spins drags air round with it, and feels no push along its axis."""
    box = Lattice((20, 20, 6), viscosity=0.05, device=device)
    place = np.indices((20, 20)) + 0.5 - 10
    mask = np.repeat((np.hypot(*place) < 4)[:, :, None], 6, axis=2)
    box.set_solid(mask, spin=(0.0, 0.0, 0.02), centre=(10.0, 10.0, 3.0))
    box.step(300)
    u = box.velocity().numpy()
    assert u[15, 10, 3, 1] == pytest.approx(-u[4, 10, 3, 1], rel=0.05)
    assert u[15, 10, 3, 1] >= 0.02
    np.testing.assert_allclose(box.force_on_solid(), 0.0, atol=1e-4)


# Conversions, outputs, graphs.


def test_domain_converts():
    domain = Domain(0.05, 0.1 * 0.05 / 4.0)
    assert domain.speed(4.0) == pytest.approx(0.1)
    assert domain.viscosity(1.5e-5) == pytest.approx(1.5e-5 * domain.step / 0.05**2)
    assert domain.acceleration(9.81) == pytest.approx(9.81 * domain.step**2 / 0.05)
    for wrong in ((0.0, 1.0), (1.0, float("nan"))):
        with pytest.raises(ValueError):
            Domain(*wrong)


def test_outputs_go_where_they_are_asked_to(device: str):
    box = _box(device)
    box.step(3)
    u, rho = wp.empty(SHAPE, dtype=wp.vec3, device=device), wp.empty(SHAPE, dtype=float, device=device)
    assert box.velocity(out=u) is u and box.excess_density(out=rho) is rho
    np.testing.assert_array_equal(u.numpy(), box.velocity().numpy())
    np.testing.assert_allclose(1 + rho.numpy().astype(float), box.density())
