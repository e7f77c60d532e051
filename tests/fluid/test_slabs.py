"""Several devices compute the slabs of a box: the result is that of one device."""

from collections.abc import Callable

import numpy as np
import pytest
import warp as wp
from builders.checks import error_of

from wlm.fluid.faces import FACES
from wlm.fluid.forcing import Fire, Turbulence, Wind
from wlm.fluid.lattice import Lattice
from wlm.fluid.obstacles import Sphere, Trajectory, box_mesh
from wlm.fluid.slabs import Slabs, _Divided
from wlm.fluid.solver import SCHEMES, Buoyancy, Solver, Source
from wlm_kernels.fluid.lattice_sets import Slab

SHAPE = (11, 9, 10)
PLATES = np.indices(SHAPE)[0] % 4 == 1
RESTING = box_mesh(Trajectory.of([[5.5, 2.0, 5.0]]), (4.0, 2.5, 2.5))
MOVING = Sphere(Trajectory.of([[3.0, 5.0, 5.0], [8.0, 6.0, 5.0]], [0, 60]), 1.9)


def _periodic(device: str, **settings) -> Lattice:
    lattice = Lattice(SHAPE, viscosity=1e-3, device=device, **settings)
    lattice.set_flow(np.random.default_rng(1).normal(0.0, 0.03, (*SHAPE, 3)))
    lattice.set_force((1e-4, 0.0, 0.0))
    return lattice


def _tunnel(device: str, outlet: float | None = 1.0, **settings) -> Lattice:
    """All kinds of boundaries, with slip walls that cross the slabs."""
    lattice = Lattice(SHAPE, viscosity=1e-3, ramp=8, device=device, **settings)
    lattice.set_inlet("-x", (0.08, 0.01, 0.0), np.indices(SHAPE[1:])[0] < 6)
    lattice.set_outlet("+x", outlet)
    lattice.set_wind("-y")
    lattice.set_outlet("+y", outlet)
    lattice.set_wall("-z", slip=True)
    lattice.set_wall("+z", (0.05, 0.0, 0.0))
    lattice.blow((0.02, 0.03, 0.0))
    return lattice


def _closed(device: str, **settings) -> Lattice:
    lattice = Lattice(SHAPE, viscosity=1e-2, device=device, **settings)
    for face in FACES:
        lattice.set_wall(face)
    lattice.set_force(np.random.default_rng(2).normal(0.0, 1e-3, (*SHAPE, 3)))
    return lattice


def _assert_same(one: Lattice, other: Lattice) -> None:
    for first, second in zip(one.state().values(), other.state().values(), strict=True):
        np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("parts", [2, 3, 11])
@pytest.mark.parametrize("make", [_periodic, _tunnel, _closed])
def test_air_is_that_of_one_device(make: Callable[..., Lattice], parts: int, device: str):
    """To the last bit, with bodies at rest and moving, a change of the step, and cells that become solid."""
    one, several = (make(names) for names in (device, [device] * parts))
    for lattice in (one, several):
        lattice.set_bodies([RESTING, MOVING])
        lattice.step(20)
        lattice.change_step(0.5)
        lattice.step(7)
        lattice.set_solid(PLATES, (0.0, 0.01, 0.0))
        lattice.step(5)
    _assert_same(one, several)
    np.testing.assert_allclose(one.force_on_solid(), several.force_on_solid(), rtol=1e-12)


@pytest.mark.parametrize("storage", [pytest.param("float32", marks=pytest.mark.slow), "float16"])
@pytest.mark.parametrize("make", [pytest.param(_periodic, marks=pytest.mark.slow), _tunnel, _closed])
def test_steps_in_place_give_the_same(make: Callable[..., Lattice], storage: str, device: str):
    """To the last bit after odd and even numbers of steps, also from a state of the other and on several devices."""
    two, one = make(device, storage=storage), make([device] * 2, storage=storage, save_memory=True)

    def assert_same() -> None:
        for read in (Lattice.velocity, Lattice.excess_density):
            np.testing.assert_array_equal(read(two).numpy(), read(one).numpy())
        np.testing.assert_allclose(two.force_on_solid(), one.force_on_solid(), rtol=1e-12, atol=1e-15)

    for lattice in (two, one):
        growth = np.random.default_rng(3).uniform(0, 1e-3, SHAPE).astype(np.float32)
        lattice.set_growth(wp.array(growth, device=device))
        lattice.set_bodies([RESTING, MOVING])
        lattice.step(7)
    assert_same()
    states = two.state(), one.state()
    two.load(states[1])
    one.load(states[0])
    for change in (lambda _: None, lambda each: each.change_step(0.5)):
        for lattice in (two, one):
            lattice.step(4)
            change(lattice)
        assert_same()
    for lattice in (two, one):
        lattice.step(1)
        lattice.set_solid(PLATES, (0.0, 0.01, 0.0))
        lattice.step(3)
    assert_same()
    np.testing.assert_array_equal(two.populations().numpy()[:, ~PLATES], one.populations().numpy()[:, ~PLATES])


@pytest.mark.parametrize("storage", ["float32", "float16"])
def test_outlets_of_all_slabs_conserve_mass(storage: str, device: str):
    """Their shift is of sums over all slabs, whose order of summation differs."""
    one, several = (_tunnel(names, outlet=None, storage=storage) for names in (device, [device] * 3))
    for lattice in (one, several):
        lattice.step(60)
    fields = [np.dstack([each.density(), each.velocity().numpy().reshape(*SHAPE[:2], -1)]) for each in (one, several)]
    np.testing.assert_allclose(*fields, atol=1e-6 if storage == "float32" else 2e-4)
    assert abs(several.mass() / np.prod(SHAPE) - 1.0) < (1e-6 if storage == "float32" else 1e-3)


def test_a_blow_up_names_the_cell_of_the_box(device: str):
    several = Lattice(SHAPE, viscosity=0.0, device=[device] * 2)
    velocity = np.zeros((*SHAPE, 3))
    velocity[9, 4, 3] = 0.9
    several.set_flow(velocity)
    several.step(1)
    assert "step 0 at cell (9, 4, 3)" in error_of(several.check)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("storage", ["float32", "float16"])
def test_smoke_is_that_of_one_device(scheme: str, storage: str, device: str, tmp_path):
    """To the last bit, with all that moves air and smoke, also after a checkpoint of another number of devices."""

    def make(names) -> Solver:
        return Solver(
            _tunnel(names),
            refinement=3,
            scheme=scheme,
            storage=storage,
            temperature=True,
            sources=[Source("sphere", (5, 5, 5), (3, 2, 2), 0.6, 0.5, fixed=True, fuel=1.0)],
            obstacles=[RESTING, MOVING],
            buoyancy=Buoyancy(1e-3, 1e-4),
            confinement=0.02,
            turbulence=Turbulence(1e-4, 5.0, 20.0),
            fire=Fire(rate=0.02, ignition=0.3, radiation=0.01, expansion=0.1),
            wind=Wind(((0, 0.0, 0.03, 0.0), (40, 0.05, 0.0, 0.0))),
        )

    one, several = make(device), make([device] * 3)
    for solver in (one, several):
        solver.step(9)
    several.save(tmp_path / "state")
    resumed = make([device] * 2)
    resumed.load(tmp_path / "state")
    for solver in (one, resumed):
        solver.step(6)
    _assert_same(one.lattice, resumed.lattice)
    for first, second in zip(one.bricks()[1], resumed.bricks()[1], strict=True):
        assert (first == second).all() and first.any()


def test_what_is_refused(device: str):
    wrong = [device] * 12, "device: expected 1 to 11, the number of cells along x, got 12 devices"
    for names, message in (wrong, ([], "got 0 devices")):
        with pytest.raises(ValueError, match=message):
            Lattice(SHAPE, viscosity=0.1, device=names)
    with pytest.raises(ValueError, match="bricks: expected none on several devices"):
        Solver(Lattice(SHAPE, viscosity=0.1, device=f"{device},{device}"), bricks=True)


class _Device:
    """Stands for a GPU: notes what its stream waits for."""

    def __init__(self, ordinal: int, log: list[str]) -> None:
        self.ordinal, self.stream, self._log = ordinal, self, log

    def wait_stream(self, other: "_Device") -> None:
        self._log.append(f"{self.ordinal} waits for {other.ordinal}")


def test_work_of_other_devices_is_between_that_of_the_first():
    log: list[str] = []
    slabs, devices = Slabs((3, 1, 1), ["cpu"] * 3), [_Device(k, log) for k in range(3)]
    slabs.home, *slabs._others = devices
    slabs.parts = [Slab(device, k, k + 1, k) for k, device in enumerate(devices)]
    slabs.each(lambda slab: log.append(f"{slab.device.ordinal} computes"))
    before, after = (["1 waits for 0", "2 waits for 0"], ["0 waits for 1", "0 waits for 2"])
    assert log == [*before, "0 computes", "1 computes", "2 computes", *after]


def test_rows_of_an_array_are_divided_among_devices(monkeypatch: pytest.MonkeyPatch):
    """Each page of two rows of 80 bytes is said to be on one device, and mapped by all."""
    said = []

    class Driver:
        def cuMemAdvise(self, start, size, advice, ordinal):
            said.append((start.value - 1000, size.value, advice, ordinal))

        def cuMemPrefetchAsync(self, start, size, ordinal, stream):
            said.append((start.value - 1000, size.value, "moved", ordinal))

    monkeypatch.setattr("ctypes.CDLL", lambda _name: Driver())
    monkeypatch.setattr(wp.CudaManagedAllocator, "allocate", lambda self, size: 1000)
    parts = [Slab(_Device(0, []), 0, 3), Slab(_Device(1, []), 3, 8, 1)]
    assert _Divided(parts, 2).allocate(160) == 1000
    for key in (3, "moved"):
        assert [each for each in said if each[2] == key] == [
            (start, size, key, ordinal) for start, size, ordinal in ((0, 30, 0), (30, 50, 1), (80, 30, 0), (110, 50, 1))
        ]
    assert sum(each[1] for each in said if each[2] == 5) == 2 * 160


def test_free_memory_is_that_of_the_fullest_device(device: str, monkeypatch: pytest.MonkeyPatch):
    """A device named three times of four takes the memory of three quarters of the planes."""
    monkeypatch.setattr("wlm.fluid.slabs.free_memory", lambda _device: 300)
    slabs = Slabs((8, 2, 2), [device] * 4)
    assert [(slab.begin, slab.end) for slab in slabs.parts] == [(0, 2), (2, 4), (4, 6), (6, 8)]
    assert slabs.free == 300 and slabs.home == wp.get_device(device)
