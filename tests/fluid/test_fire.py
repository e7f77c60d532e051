"""Fire: burning, cooling and expansion against float64, in every storage, with bricks, and after a checkpoint."""

import numpy as np
import pytest
import torch
from builders.checks import misuse_of

from wlm import fluid
from wlm.errors import WlmError
from wlm.fluid.faces import FACES
from wlm.fluid.forcing import Fire
from wlm.fluid.lattice import Lattice
from wlm.fluid.solver import Buoyancy, Solver, Source

FIRE = Fire(rate=0.02, heat=0.8, smoke=0.5, ignition=0.3, radiation=0.01)
FUEL = Source("sphere", (6, 6, 6), (3, 3, 3), 0.0, 0.5, fixed=True, fuel=1.0)


def _burned(fire: Fire, steps: int, fuel: float, heat: float):
    """Fuel, temperature, density and growth after each step of still smoke."""
    density, rows = 0.0, []
    for _ in range(steps):
        burnt = min(fuel, fire.rate * min(fuel, 1.0)) if heat >= fire.ignition else 0.0
        hot = max(heat, min(heat + fire.heat * burnt, 1.0))
        hot = (hot**-3 + 3.0 * fire.radiation) ** (-1 / 3)
        ratio = fire.flame / fire.ambient - 1.0
        growth = np.log((1.0 + ratio * hot) / (1.0 + ratio * heat))
        fuel, heat, density = fuel - burnt, hot, density + fire.smoke * burnt
        rows.append((fuel, heat, density, growth))
    return np.array(rows)


def _still(device: str, fire: Fire, heat: float, **settings) -> Solver:
    """Air at rest in a closed box, full of fuel."""
    lattice = Lattice((4, 4, 4), viscosity=0.05, device=device)
    for face in FACES:
        lattice.set_wall(face)
    full = Source("box", (2, 2, 2), (9, 9, 9), 0.0, heat, fixed=True, fuel=1.2)
    settings = {"refinement": 2, "substeps": 1, "temperature": True} | settings
    solver = Solver(lattice, sources=[full], fire=fire, **settings)
    solver.step(1)
    solver.sources = ()
    return solver


@pytest.mark.parametrize("storage", ["float32", "float16"])
@pytest.mark.parametrize("heat", [0.5, 0.2])
def test_fuel_burns_and_cools(heat: float, storage: str, device: str):
    """As the reference does, in half floats on average; below the temperature of ignition it only cools. In a closed
    box the air becomes denser by the growth of the gas."""
    fire = Fire(0.04, 0.8, 0.5, 0.3, 0.01, expansion=0.1)
    solver = _still(device, fire, heat, storage=storage)
    solver.step(40)
    rows = _burned(fire, 40, 1.2, heat)
    fuel, hot, density, growth = rows[-1]
    if storage == "float32":
        np.testing.assert_allclose(solver._growth.numpy(), 0.1 * growth, rtol=1e-4, atol=1e-7)
        np.testing.assert_allclose(solver.lattice.density(), np.prod(1.0 + 0.1 * rows[:, 3]), rtol=1e-4)
    assert (fuel < 0.3) == (heat > 0.3)
    _, values = solver.bricks()
    for part, expected in zip(values, (density, hot, fuel), strict=True):
        assert part.float().mean().item() == pytest.approx(expected, rel=1e-5 if storage == "float32" else 2e-3)


def test_expansion(device: str):
    """In an open box as much gas flows out as it grows."""
    lattice = Lattice((16, 16, 16), viscosity=0.02, device=device)
    for face in FACES:
        lattice.set_outlet(face, density=1.0)
    ball = Source("sphere", (8, 8, 8), (3, 3, 3), 0.0, 0.6, fixed=True, fuel=1.0)
    fire = Fire(0.002, 1.0, 0.0)
    solver = Solver(lattice, refinement=2, temperature=True, sources=[ball], fire=fire)
    solver.step(1)
    solver.sources = ()
    solver.step(20)
    flux = growth = 0.0
    for _ in range(60):
        solver.step(1)
        growth += float(solver._growth.numpy().sum())
        for a in range(3):
            along = np.moveaxis(solver.velocity.numpy()[..., a].astype(float), a, 0)
            flux += (along[13] + along[14] - along[1] - along[2]).sum() / 2.0
    assert flux == pytest.approx(growth, rel=0.1)
    assert abs(lattice.density() - 1.0).max() < 0.02


def _flame(device: str, fire: Fire = FIRE, **settings) -> Solver:
    lattice = Lattice((12, 12, 12), viscosity=1e-3, device=device)
    for face in FACES:
        lattice.set_outlet(face, density=1.0)
    settings = {"refinement": 2, "temperature": True, "sources": [FUEL], "buoyancy": Buoyancy(2e-3)} | settings
    return Solver(lattice, fire=fire, **settings)


@pytest.mark.parametrize("storage", ["float32", "float16"])
@pytest.mark.parametrize("bricks", [False, True])
def test_a_flame_goes_on_exactly(bricks: bool, storage: str, device: str, tmp_path):
    """From a checkpoint; with bricks it is the flame without them."""
    whole, first, second, dense = (
        _flame(device, bricks=each, storage=storage, threshold=0.0) for each in (bricks, bricks, bricks, False)
    )
    first.step(10)
    first.save(tmp_path / "state.wlm")
    second.load(tmp_path / "state.wlm")
    second.step(10)
    for solver in (whole, dense):
        solver.step(20)
    for other in (second, dense):
        for name in ("density", "temperature", "velocity"):
            np.testing.assert_array_equal(getattr(other, name).numpy(), getattr(whole, name).numpy())
    numbers, (_, heat, fuel) = whole.bricks()
    assert len(numbers) and fuel.max() <= 1.0 and heat.max() <= 1.0 and whole.density.numpy().max() > 0.1
    with pytest.raises(WlmError, match="expected no confinement, turbulence or fire|bricks|float16"):
        fluid.DifferentiableSolver(whole)
    with pytest.raises(WlmError):
        _flame(device, None, sources=(), storage=storage).load(tmp_path / "state.wlm")


def test_kelvins():
    assert Fire(1.0, ambient=300.0, flame=2000.0).kelvin(torch.tensor([0.0, 1.0, 2.0])).tolist() == [0, 2000, 3700]


@pytest.mark.parametrize(("settings", "message"), [
    ({"rate": -1.0}, "expected numbers from 0 to 1e6"), ({"rate": float("nan")}, "expected numbers"),
    ({"rate": 1.0, "flame": 200.0}, "expected 100 K <= ambient < flame"),
])  # fmt: skip
def test_wrong_fires(settings, message: str, device: str):
    with pytest.raises(ValueError, match=message):
        Fire(**settings)
    assert "temperature: expected True" in misuse_of(_flame, device, temperature=False, sources=(), buoyancy=None)
