"""What moves the air besides smoke, against float64 references."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from builders.checks import error_of

from wlm import fluid
from wlm.errors import WlmError
from wlm.fluid.forcing import CALM, Turbulence, Wind
from wlm.fluid.lattice import Lattice
from wlm.fluid.solver import Solver
from wlm_kernels.fluid import forcing
from wlm_kernels.fluid.advection_places import Box
from wlm_kernels.fluid.lattice_sets import Slab

ENDS = [(0, 0, 0), (1, 0, 1), (1, 1, 1)]


def _slope(values: np.ndarray, axis: int, periodic: int) -> np.ndarray:
    if values.shape[axis] == 1:
        return np.zeros_like(values)
    if periodic:
        return (np.roll(values, -1, axis) - np.roll(values, 1, axis)) / 2
    return np.gradient(values, axis=axis)


def _curl(u: np.ndarray, periodic) -> np.ndarray:
    x, y, z = (_slope(u, a, periodic[a]) for a in range(3))
    return np.stack([y[..., 2] - z[..., 1], z[..., 0] - x[..., 2], x[..., 1] - y[..., 0]], -1)


def _confined(u: np.ndarray, periodic, strength: float) -> np.ndarray:
    curl = _curl(u, periodic)
    up = np.stack([_slope(np.linalg.norm(curl, axis=-1), a, periodic[a]) for a in range(3)], -1)
    return strength * np.cross(up / np.maximum(np.linalg.norm(up, axis=-1, keepdims=True), 1e-12), curl)


def _stirred(shape, modes: forcing.Modes, step: float) -> np.ndarray:
    k, push, turn = (getattr(modes, name).numpy().astype(float) for name in ("k", "push", "turn"))
    x = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
    return np.cos(x @ k.T + turn[:, 0] * step + turn[:, 1]) @ push


def _stir(u, periodic, solid, confinement, modes, step, force, device, *, added=False) -> np.ndarray:
    shape = u.shape[:3]
    air = wp.array(u.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=device)
    out = wp.array(force.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=device)
    clock = wp.array([step, step - 1], dtype=int, device=device)
    marks = wp.array(solid.ravel().astype(np.uint8), device=device)
    box = Box()
    box.coarse, box.periodic = wp.vec3i(*shape), wp.vec3i(*periodic)
    forcing.stir(box, air, marks, confinement, modes, clock, out, added=added, slab=Slab(air.device, 0, shape[0]))
    return out.numpy().reshape(u.shape)


@pytest.mark.parametrize("periodic", ENDS)
def test_forces_are_the_references(periodic, device: str):
    shape, random = (5, 1, 7), np.random.default_rng(1)
    u, before = random.normal(size=(2, *shape, 3))
    solid = random.random(shape) < 0.2
    modes = Turbulence(0.3, 6.0, 40.0, seed=3).modes(device)
    expected = _confined(u, periodic, 0.7)
    got = _stir(u, periodic, np.zeros(0), 0.7, CALM, 0, before, device)
    np.testing.assert_allclose(got, expected, atol=2e-6)
    got = _stir(u, periodic, solid, 0.7, modes, 11, before, device, added=True)
    expected += _stirred(shape, modes, 11)
    np.testing.assert_allclose(got, before + expected * ~solid[..., None], atol=5e-6)
    assert np.isfinite(_stir(0 * u, periodic, solid, 1e6, CALM, 0, before, device)).all()


def test_turbulence_has_no_divergence_and_its_strength(device: str):
    modes = Turbulence(0.3, 5.0, 40.0).modes(device)
    push = _stirred((24, 24, 24), modes, 5.0)
    divergence = sum(_slope(push[..., a], a, 0) for a in range(3))
    assert np.abs(divergence[1:-1, 1:-1, 1:-1]).max() < 1e-6 < np.abs(_slope(push[..., 0], 0, 0)).max()
    assert np.sqrt((push**2).sum(-1).mean()) == pytest.approx(0.3, rel=0.1)
    other = Turbulence(0.3, 5.0, 40.0, seed=1).modes(device)
    assert not np.allclose(other.k.numpy(), modes.k.numpy())


def _swirl(device: str, **settings) -> Solver:
    lattice = Lattice((16, 16, 16), viscosity=1e-3, device=device)
    x, y, _ = np.meshgrid(*[2 * np.pi * np.arange(16) / 16] * 3, indexing="ij")
    lattice.set_flow(0.05 * np.stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y), 0 * x], -1))
    return Solver(lattice, refinement=1, **settings)


def test_confinement_keeps_vortices_and_turbulence_makes_them(device: str):
    energy = {}
    stirring = Turbulence(1e-3, 8.0, 50.0)
    for name, settings in {"": {}, "kept": {"confinement": 2e-3}, "made": {"turbulence": stirring}}.items():
        solver = _swirl(device, **settings)
        solver.step(60)
        energy[name] = float((solver.velocity.numpy() ** 2).sum())
    assert energy["kept"] > 1.1 * energy[""] and energy["made"] > 1.1 * energy[""]


def test_forced_air_goes_on_exactly(device: str, tmp_path):
    """From a checkpoint, and after its step was halved."""
    settings = {"confinement": 2e-3, "turbulence": Turbulence(2e-4, 8.0, 50.0)}
    whole, first, second = (_swirl(device, **settings) for _ in range(3))
    for solver in (whole, first):
        solver.step(8)
        solver.change_step(0.5)
    first.save(tmp_path / "state.wlm")
    second.load(tmp_path / "state.wlm")
    for solver in (whole, second):
        solver.step(6)
    np.testing.assert_array_equal(second.velocity.numpy(), whole.velocity.numpy())


def test_a_halved_step_is_the_same_flow(device: str):
    settings = {"confinement": 2e-3, "turbulence": Turbulence(2e-4, 8.0, 50.0)}
    long, short = (_swirl(device, **settings) for _ in range(2))
    long.step(20)
    short.step(10)
    short.change_step(0.5)
    short.step(20)
    a, b = long.velocity.numpy(), 2.0 * short.velocity.numpy()
    assert np.sqrt(((a - b) ** 2).mean() / (a**2).mean()) < 0.03


@pytest.mark.parametrize(("settings", "message"), [
    ({"strength": -1.0, "size": 8.0, "period": 5.0}, "strength: expected a finite number of at least 0"),
    ({"strength": 1.0, "size": float("nan"), "period": 5.0}, "size: expected a finite number"),
    ({"strength": 1.0, "size": 8.0, "period": 0.0}, "period: expected a finite number of at least 1e-12"),
    ({"keys": [[0, 1, 0, 0], [0, 1, 0, 0]]}, "keys: expected rows of an increasing time"),
    ({"keys": [[0, 1, 0, 0]], "gusts": 1.5}, "gusts, period, seed: expected 0 to 1"),
])  # fmt: skip
def test_wrong_settings(settings, message: str):
    with pytest.raises(ValueError, match=message):
        (Wind if "keys" in settings else Turbulence)(**settings)


def test_wind_follows_its_keys(device: str):
    """Air behind a face moves as its wind does, and turns with it; gusts stay within their bounds."""
    wind = Wind(((0.0, 0.05, 0.0, 0.0), (400.0, 0.05, 0.0, 0.0), (500.0, 0.02, 0.01, 0.0)))
    lattice = Lattice((24, 4, 4), viscosity=0.02, device=device, ramp=100)
    lattice.set_wind("-x")
    lattice.set_outlet("+x", density=1.0)
    solver = Solver(lattice, refinement=1, wind=wind)
    for steps, expected in ((400, (0.05, 0.0, 0.0)), (900, (0.02, 0.01, 0.0))):
        solver.step((steps - solver.lattice.steps) // 2)
        np.testing.assert_allclose(solver.velocity.numpy().mean((1, 2))[:5], [expected] * 5, atol=2e-3)
    gusty = replace(wind, gusts=0.4, period=30.0)
    speeds = [np.linalg.norm(gusty.at(time)) / np.linalg.norm(wind.at(time)) for time in np.linspace(0, 400, 200)]
    assert 0.6 <= min(speeds) < 0.85 and 1.15 < max(speeds) <= 1.4 and gusty.fastest == pytest.approx(0.07)
    assert "wind has no gradients" in error_of(fluid.DifferentiableLattice, lattice)
    with pytest.raises(ValueError, match="expected a lattice with a face for it"):
        Solver(Lattice((4, 4, 4), viscosity=0.1, device=device), wind=wind)


def test_forced_air_has_no_gradients(device: str):
    with pytest.raises(WlmError, match="expected no confinement, turbulence or fire"):
        fluid.DifferentiableSolver(_swirl(device, confinement=1e-3))
