"""A whole simulation: smoke in moving air, obstacles, checkpoints, hard cases, and the documented examples."""

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp
from builders.checks import error_of, misuse_of

from wlm import fluid
from wlm.errors import WlmError
from wlm.fluid.bricks import require_memory
from wlm.fluid.faces import FACES
from wlm.fluid.lattice import CHECK_EVERY, Lattice
from wlm.fluid.obstacles import Sphere, Trajectory, box_mesh, surface
from wlm.fluid.slabs import Slabs
from wlm.fluid.solver import SCHEMES, Buoyancy, Solver, Source, bytes_needed

SHAPE = (20, 10, 10)
NOZZLE = Source("box", (2, 5, 5), (1.5, 2.5, 2.5), 1.0, 0.5, fixed=True)
MOVING = Sphere(Trajectory.of([[9, 5, 5], [12, 5, 5]], [0, 60]), 2.0)


def _tunnel(device: str, shape=SHAPE, speed: float = 0.1, **settings) -> Lattice:
    lattice = Lattice(shape, device=device, **({"viscosity": 1e-4, "ramp": 10} | settings))
    lattice.set_inlet("-x", (speed, 0.0, 0.0))
    lattice.set_outlet("+x")
    for face in FACES[2:]:
        lattice.set_wall(face, slip=True)
    return lattice


def _room(device: str, shape=(10, 12, 10), viscosity: float = 0.02) -> Lattice:
    lattice = Lattice(shape, viscosity=viscosity, device=device)
    for face in FACES:
        lattice.set_wall(face)
    return lattice


def _jet(device: str, obstacles=(MOVING,), ramp: int = 10, **settings) -> Solver:
    settings = {"refinement": 2, "temperature": True, "sources": [NOZZLE], "dissipation": 1e-3} | settings
    return Solver(_tunnel(device, ramp=ramp), obstacles=obstacles, buoyancy=Buoyancy(1e-4), **settings)


def _numbers(solver: Solver) -> np.ndarray:
    return solver.density.numpy().astype(np.float64)


def _assert_same(first: Solver, second: Solver) -> None:
    for name in ("density", "temperature", "velocity", "solid"):
        np.testing.assert_array_equal(getattr(first, name).numpy(), getattr(second, name).numpy())


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_jet_carries_smoke_past_a_sphere(scheme: str, device: str):
    """It comes as far as the air does, none lies in the sphere, and no value exceeds the nozzle's."""
    jet = _jet(device, scheme=scheme)
    jet.step(50)
    density = _numbers(jet)
    assert density.shape == (40, 20, 20)
    assert density.min() >= 0.0 and density.max() == 1.0
    solid = jet.solid.numpy() == 1
    assert np.count_nonzero(solid) > 20
    np.testing.assert_array_equal(density[np.kron(solid, np.ones((2, 2, 2), bool))], 0.0)
    front = np.flatnonzero(density.sum((1, 2)) > 0.5).max() / 2
    assert 8 < front < 18
    assert jet.steps == 50 and jet.lattice.steps == 100


def test_still_smoke_costs_its_bricks(device: str):
    """A puff in a long, still room: the bricks around it are computed, and no others."""
    source = Source("sphere", (4, 4, 4), (1, 1, 1), 1.0, fixed=True)
    solver = Solver(_room(device, (64, 8, 8)), refinement=2, sources=[source], bricks=True)
    # At first all bricks count as busy.
    solver.step(3)
    # The puff's bricks and one ring around them, of 16 x 2 x 2.
    assert solver.active_cells == 3 * 2 * 2 * 512


@pytest.mark.parametrize("scheme", SCHEMES)
def test_bricks_are_the_smoke_of_all_cells(scheme: str, device: str):
    """To the last bit at a threshold of 0: with a moving obstacle, buoyancy, decay, a source that moves and one that an
    obstacle covers; the pool grows."""
    leaving = Source("sphere", (9, 5, 5), (0.5, 0.5, 0.5), 0.3, fixed=True)
    dense, sparse = (
        _jet(device, refinement=3, scheme=scheme, bricks=bricks, threshold=0.0, sources=[leaving])
        for bricks in (False, True)
    )
    sizes = []
    for step in range(24):
        for each in (dense, sparse):
            each.sources = (leaving, Source("box", (4 + 0.5 * step, 3, 5), (0.7, 0.7, 0.7), 0.1, 1.0))
            each.step()
        sizes.append(sparse.active_cells)
        _assert_same(dense, sparse)
    assert 0 < sizes[0] < 0.8 * dense.active_cells < sizes[-1]
    for numbers, values in (dense.bricks(), sparse.bricks()):
        assert len(numbers) * 512 <= sizes[-1] and len(values) == 2 and values[0].shape == (len(numbers), 8, 8, 8)
    assert all((a == b).all() for a, b in zip(dense.bricks()[1], sparse.bricks()[1], strict=True))
    whole, part = (each.frame() for each in (dense, sparse))
    assert part.shape == whole.shape and part.places is not None and whole.places is None
    assert part.density.data_ptr() == sparse.frame().density.data_ptr()
    assert torch.equal(torch.cat(list(part.slabs(part.temperature))), whole.temperature)


def test_bricks_take_memory_where_smoke_is(device: str, monkeypatch: pytest.MonkeyPatch):
    """A box of 512^3 voxels holds a puff in 60 MB; a full pool has room for a whole box, and one that does not fit
    ends with an error."""
    source = Source("sphere", (4, 4, 4), (1, 1, 1), 1.0, fixed=True)
    large = Solver(Lattice((16, 16, 16), viscosity=0.1, device=device), refinement=32, sources=[source], bricks=True)
    large.step()
    assert 512 < large.active_cells < 4e6 and large.stored_bytes < 12 * 2**20 + 3 * 5 * large.active_cells
    small = Solver(_room(device, (8, 8, 8)), refinement=2, bricks=True)
    small.step()
    empty = small.stored_bytes
    assert small.active_cells == 0 and not small.bricks()[0].numel() and not _numbers(small).any()
    small.reserve()
    small.sources = [Source("box", (4, 4, 4), (9, 9, 9), 1.0, fixed=True)]
    small.step()
    assert small.active_cells == 16**3 and (_numbers(small) == 1.0).all() and small.stored_bytes > empty
    scarce = Solver(_room(device, (8, 8, 8)), sources=small.sources, bricks=True)
    monkeypatch.setattr("wlm.fluid.slabs.free_memory", lambda device: 1000)
    assert re.search("bricks of smoke: 65 x 512 x 1 cells need 0.0 GiB on .*: expected at most", error_of(scarce.step))


def test_smoke_decays(device: str):
    """Still smoke decays by exp(-rate t), its temperature by its own rate."""
    source = Source("box", (4, 4, 4), (9, 9, 9), 1.0, 2.0)
    lattice = _room(device, (8, 8, 8))
    rates = {"dissipation": 0.01, "cooling": 0.03, "substeps": 1}
    solver = Solver(lattice, refinement=1, temperature=True, sources=[source], **rates)
    solver.step(1)
    solver.sources = ()
    solver.step(20)
    np.testing.assert_allclose(solver.density.numpy(), np.exp(-0.2), rtol=1e-5)
    np.testing.assert_allclose(solver.temperature.numpy(), 2.0 * np.exp(-0.6), rtol=1e-5)


@pytest.mark.parametrize("bricks", [False, True])
def test_hot_smoke_rises_and_heavy_smoke_falls(bricks: bool, device: str):
    heights = []
    for buoyancy in (Buoyancy(2e-3), Buoyancy(0.0, 2e-3)):
        source = Source("sphere", (5, 6, 5), (2, 2, 2), 0.05, 0.05)
        settings = {"bricks": bricks, "scheme": "semi-lagrangian" if bricks else "maccormack"}
        solver = Solver(_room(device), refinement=2, temperature=True, sources=[source], buoyancy=buoyancy, **settings)
        solver.step(30)
        density = _numbers(solver)
        heights.append((density.sum((0, 2)) * (np.arange(24) + 0.5)).sum() / density.sum() / 2)
    assert heights[0] > 6.15 and heights[1] < 5.85


def test_an_obstacle_too_fast(device: str):
    fast = Sphere(Trajectory.of([[9, 5, 5], [19, 5, 5]], [10, 20]), 2.0)
    solver = _jet(device, obstacles=[fast])
    solver.step(5)
    assert "moves at 1 cells per step: expected at most 0.3" in error_of(solver.step, 1)


def test_obstacles_cover_what_they_should(device: str):
    """A sphere and a box, numbered in their order."""
    box = box_mesh(Trajectory.of((14, 5, 5)), (4, 6, 2))
    solver = _jet(device, obstacles=[MOVING, box])
    solver.step(1)
    solid = solver.solid.numpy()
    x = np.stack(np.meshgrid(*[np.arange(n) + 0.5 for n in SHAPE], indexing="ij"), -1)
    np.testing.assert_array_equal(solid == 2, (np.abs(x - (14, 5, 5)) < (2, 3, 1)).all(-1))
    # The sphere moves 3 cells in 60 steps, and is placed where it is in the middle of the third.
    np.testing.assert_array_equal(solid == 1, np.linalg.norm(x - (9.125, 5, 5), axis=-1) < 2)


@pytest.mark.parametrize(("shape", "volume"), [("sphere", 4 / 3 * np.pi), ("box", 8.0), ("cylinder", 2 * np.pi)])
def test_surfaces_are_closed(shape: str, volume: float):
    """Each edge has two triangles, one on either side, and all of them face outwards."""
    points, triangles = surface(shape)
    edges = {(a, b) for t in triangles.tolist() for a, b in zip(t, t[1:] + t[:1], strict=True)}
    assert len(edges) == 3 * len(triangles) and edges == {(b, a) for a, b in edges}
    a, b, c = points[triangles].transpose(1, 0, 2)
    assert np.einsum("fk,fk->", a, np.cross(b, c)) / 6 == pytest.approx(volume, rel=0.01)


def test_a_path_with_ramps():
    """It rests at time 0, has no jump of its velocity, leaves the keys by little, and ends where it should."""
    path = Trajectory.of([[0, 0, 0], [10, 0, 0], [10, 5, 0], [10, 5, 0]], [-1, 9, 14, 15])
    eased, times = path.eased(2.0), np.linspace(0, 20, 2001)
    places = np.array([eased.at(time) for time in times])
    speed = np.diff(places, axis=0) / 0.01
    assert np.linalg.norm(speed[0]) < 0.15 and np.linalg.norm(speed, axis=1).max() < 4 / 3 + 0.01
    assert np.abs(np.diff(speed, axis=0)).max() < 0.3
    assert np.linalg.norm(places - [path.at(time) for time in times], axis=1).max() < 0.36
    np.testing.assert_allclose(eased.at(4.0), path.at(4.0))
    np.testing.assert_allclose(eased.at(99.0), path.at(99.0))
    rest = Trajectory.of((1, 2, 3)).eased(1.0)
    assert not rest.moves and rest.at(5.0).tolist() == [1, 2, 3]


def test_paths():
    path = Trajectory.of([[0, 0, 0], [2, 0, 0], [2, 4, 0]], [10, 20, 30])
    for time, at in ((0, (0, 0, 0)), (15, (1, 0, 0)), (25, (2, 2, 0)), (99, (2, 4, 0))):
        np.testing.assert_allclose(path.at(time), at)
    assert path.moves and not path.turns
    assert "quaternions of length 1" in misuse_of(Trajectory.of, (0, 0, 0), rotations=(0, 0, 0, 0))


def test_a_path_that_turns():
    """The shorter way between two keys, whatever their signs; eased, it starts and stops gently and ends there."""
    angles, times = np.array([0.0, 2.0, 2.0 + np.pi - 0.1, 5.0]), [0, 10, 20, 30]
    quaternions = np.column_stack([0 * angles, np.sin(angles / 2), 0 * angles, np.cos(angles / 2)])
    quaternions[2] *= -1
    path = Trajectory.of([(1, 2, 3)] * 4, times, quaternions)
    moments = np.linspace(-5, 40, 901)
    for given, most in ((path, 0.31), (path.eased(2.0), 0.06)):
        turns = np.array([given.turn(time) for time in moments])
        np.testing.assert_allclose(turns[:, :, 1], np.broadcast_to((0, 1, 0), (901, 3)), atol=1e-12)
        angle = np.unwrap(np.arctan2(turns[:, 0, 2], turns[:, 0, 0]))
        assert np.abs(angle - np.interp(moments, times, angles)).max() < (1e-9 if given is path else 0.4)
        assert angle[-1] == pytest.approx(5.0) and np.abs(np.diff(angle, 2)).max() < most * 0.05
        assert given.moves and given.turns and given.at(7.0).tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    "settings",
    [
        *({"scheme": scheme} for scheme in SCHEMES),
        {"storage": "float16", "dissipation": 0.0},
        {"bricks": True, "threshold": 0.0},
    ],
    ids=str,
)
def test_a_checkpoint_goes_on_to_the_last_bit(settings: dict, device: str, tmp_path: Path):
    """The simulation goes on from an odd step, past the time when the obstacle comes to rest."""
    resting = [Sphere(Trajectory.of([[9, 5, 5], [10, 5, 5]], [0, 14]), 2.0)]
    first, second = (_jet(device, resting, **settings) for _ in range(2))
    first.step(5)
    first.save(tmp_path / "state")
    first.step(5)
    second.step(2)
    second.load(tmp_path / "state")
    assert second.steps == 5
    second.step(5)
    _assert_same(first, second)


def test_a_checkpoint_of_all_cells_goes_on_in_bricks_and_back(device: str, tmp_path: Path):
    solvers = [_jet(device, bricks=bricks, threshold=0.0) for bricks in (False, True, False)]
    solvers[0].step(5)
    for earlier, later in itertools.pairwise(solvers):
        earlier.save(tmp_path / "state")
        later.step(3)
        later.load(tmp_path / "state")
        for each in solvers[: solvers.index(later) + 1]:
            each.step(3)
    for other in solvers[1:]:
        _assert_same(solvers[0], other)


@pytest.mark.parametrize("before", [0, 5])
def test_a_checkpoint_of_before_the_first_step(before: int, device: str, tmp_path: Path):
    """The obstacles of the solver that loads it may have moved."""
    first, second = _jet(device), _jet(device)
    first.save(tmp_path / "state")
    second.step(before)
    second.load(tmp_path / "state")
    assert second.steps == 0
    for solver in (first, second):
        solver.step(6)
    _assert_same(first, second)


def test_checkpoints_of_other_simulations(device: str, tmp_path: Path):
    solver, path = _jet(device), tmp_path / "state"
    solver.step(2)
    solver.save(path)
    for different, match in (
        (_jet(device, refinement=1), "refinement: expected 1, found 2"),
        (_jet(device, duration=1e9), "duration: expected about 1e.09 for a step, found 1.0"),
    ):
        assert re.search(match, error_of(different.load, path))


def test_a_checkpoint_goes_on_with_other_settings(device: str, tmp_path: Path):
    """An obstacle that is elsewhere moves there; the step of the file is taken over; smoke decays as it did."""
    there = Sphere(Trajectory.of((13, 5, 5)), 2.0)
    solver, other = _jet(device), _jet(device, [there], duration=2.0, dissipation=2e-3)
    solver.step(6)
    solver.save(tmp_path / "state")
    other.load(tmp_path / "state")
    assert (other.steps, other.duration) == (6, 1.0) and solver.solid.numpy()[13, 5, 5] == 0
    solver.step(6)
    other.step(6)
    assert np.abs(_numbers(other) - _numbers(solver)).max() > 0.01 and other.solid.numpy()[13, 5, 5] == 1
    first, second = (float(each.density.numpy()[:6].astype(float).sum()) for each in (solver, other))
    assert second == pytest.approx(first, rel=0.02)


@pytest.mark.parametrize("storage", ["float32", "float16"])
def test_a_flow_in_shorter_steps(storage: str, device: str, tmp_path: Path):
    """Halved in its course the step gives nearly the same flow, with a body, buoyancy and decay; and a checkpoint of
    after goes on to the last bit."""
    settings = {"storage": storage, "dissipation": 1e-3, "substeps": 1 if storage == "float16" else 2}
    body = MOVING if storage == "float16" else Sphere(Trajectory.of((9, 5, 5)), 2.0)
    solvers = [_jet(device, [body], ramp=180, **settings) for _ in range(3)]
    for each in solvers:
        each.step(100)
    plain, halved, resumed = solvers
    plain.step(20)
    assert "divides 100 steps into whole ones, got 3" in misuse_of(halved.change_step, 3.0)
    halved.change_step(0.5)
    assert (halved.steps, halved.duration) == (200, 0.5)
    halved.step(20)
    halved.save(tmp_path / "state")
    resumed.load(tmp_path / "state")
    for each in (halved, resumed):
        each.step(20)
    _assert_same(halved, resumed)
    assert halved.fastest == pytest.approx(0.5 * plain.fastest, rel=0.05)
    assert np.abs(2.0 * halved.velocity.numpy() - plain.velocity.numpy()).mean() < 2e-3
    assert _numbers(halved).sum() == pytest.approx(_numbers(plain).sum(), rel=0.01)
    halved.change_step(2.0)
    assert (halved.steps, halved.duration) == (120, 1.0)


def test_a_blow_up_stops_with_the_last_good_state(device: str, tmp_path: Path):
    """Ever hotter smoke drives the air beyond the speed of sound: it stops soon, and the file is from before."""
    path = tmp_path / "good"
    source = Source("sphere", (5, 6, 5), (3, 3, 3), 0.1, 0.1)

    def make() -> Solver:
        settings = {"temperature": True, "sources": [source], "buoyancy": Buoyancy(0.02), "refinement": 1}
        return Solver(_room(device), **settings)

    solver = make()
    with pytest.raises(WlmError, match=r"blew up in step \d+ at cell .*; the state of step \d+ is kept in") as caught:
        for _ in range(125):
            solver.step(4)
            solver.save(path)
    words = str(caught.value).split()
    blown, kept = int(words[words.index("step") + 1]), int(words[words.index("kept") - 2])
    assert solver.lattice.steps <= blown + CHECK_EVERY + 2
    assert 8 <= kept <= blown
    # An error names the file that was loaded if there is none newer; a state that blew up isn't saved over it.
    content = path.read_bytes()
    assert "blew up in step" in error_of(solver.save, path)
    assert path.read_bytes() == content
    resumed = make()
    resumed.load(path)
    assert resumed.lattice.steps == kept and np.isfinite(resumed.lattice.velocity().numpy()).all()
    assert f"; the state of step {kept} is kept in {path}" in error_of(resumed.step, 500)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_one_voxel(scheme: str, device: str):
    source = Source("box", (0.5, 0.5, 0.5), (1, 1, 1), 0.25)
    for bricks in (False, True):
        lattice = Lattice((1, 1, 1), viscosity=0.1, device=device)
        solver = Solver(lattice, refinement=1, scheme=scheme, sources=[source], bricks=bricks, substeps=1)
        solver.step(4)
        assert _numbers(solver).tolist() == [[[1.0]]]


def test_too_large(device: str):
    with pytest.raises(WlmError, match="1600 x 1600 x 1600 cells: expected fewer than 2\\^31"):
        Solver(Lattice((8, 8, 8), viscosity=0.1, device=device), refinement=200)
    with pytest.raises(WlmError, match=r"100 x 100 x 100 cells need .* GiB on .*: expected at most"):
        require_memory("smoke", (100, 100, 100), 10**15, Slabs((1, 1, 1), device))
    # Three buffers of 64 voxels, and the traces back and ahead of a cell of air.
    assert bytes_needed((2, 1, 1), 4, "maccormack", "float32", False, False) == 2 * (3 * 64 * 4 + 24)


def test_a_frame_is_the_smoke_as_it_is(device: str):
    solver = _jet(device)
    solver.step(4)
    frame = solver.frame(extinction=3.0, emission=2.0, cell=0.5, origin=(1.0, 2.0, 3.0))
    assert frame.voxel == 0.25 and frame.origin == (1.0, 2.0, 3.0)
    assert (frame.extinction, frame.emission) == (3.0, 2.0)
    np.testing.assert_array_equal(frame.density.cpu().numpy(), solver.density.numpy())
    np.testing.assert_array_equal(frame.temperature.cpu().numpy(), solver.temperature.numpy())
    assert frame.density.data_ptr() == solver.density.ptr
    cold = Solver(_room(device, (4, 4, 4)))
    assert cold.frame().temperature is None and cold.temperature is None


def test_steps_can_be_captured(device: str):
    """In a graph of the user's: the same smoke as by eager steps, counted too."""
    if device == "cpu":
        pytest.skip("graphs are CUDA's")
    at_rest = Sphere(Trajectory.of((9, 5, 5)), 2.0)
    for bricks, body in itertools.product((False, True), (at_rest, MOVING)):
        eager, graphed = (_jet(device, obstacles=[body], bricks=bricks) for _ in range(2))
        graphed.step(2)
        graphed.reserve()
        with wp.ScopedCapture(device) as capture:
            graphed.step(2)
        for _ in range(5):
            wp.capture_launch(capture.graph)
        graphed.check()
        eager.step(12)
        np.testing.assert_allclose(_numbers(eager), _numbers(graphed), atol=1e-5)
        np.testing.assert_array_equal(eager.solid.numpy(), graphed.solid.numpy())
        assert graphed.steps == eager.steps == 12


@pytest.mark.parametrize("bricks", [False, True])
def test_many_steps_are_as_many_single_ones(bricks: bool, device: str):
    """On a GPU they are replays of a graph, which is captured anew after a change of sources, inlets or the step."""
    single, many = (_jet(device, bricks=bricks, threshold=0.0) for _ in range(2))

    def both(steps: int) -> None:
        for _ in range(steps):
            single.step()
        many.step(steps)
        assert single.steps == many.steps
        _assert_same(single, many)

    both(7)
    both(5)
    for each in (single, many):
        each.sources = (Source("sphere", (4, 5, 3), (1, 1, 1), 0.2, 0.5),)
    both(5)
    for each in (single, many):
        each.change_step(0.5)
    both(8)
    for each in (single, many):
        each.lattice.set_inlet("-x", (0.03, 0.0, 0.0))
    both(6)


PAGE = Path(__file__).resolve().parents[2] / "docs" / "fluid.md"


def test_the_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """In fewer steps."""
    text = PAGE.read_text(encoding="utf-8").split("\n## ")[0]
    monkeypatch.chdir(tmp_path)
    code = "\n".join(line[4:] for line in text.splitlines() if line.startswith("    "))
    assert "smoke.step(100)" in code
    exec(code.replace("smoke.step(100)", "smoke.step(2)"), {})
    assert float(fluid.load_volume("smoke.npz").density.sum()) > 0.0
