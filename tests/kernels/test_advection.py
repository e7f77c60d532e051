"""Advection against a float64 reference and exact solutions, on every device; bricks, solids, sources, buoyancy."""

import numpy as np
import pytest
import warp as wp
from reference.smoke_steps import Smoke
from scipy.spatial.transform import Rotation

from wlm.fluid.obstacles import surface
from wlm_kernels.fluid import advection_sources
from wlm_kernels.fluid.advection import STORAGES, Fields, advect, mark_smoke
from wlm_kernels.fluid.advection_adjoint import source_backward
from wlm_kernels.fluid.advection_places import (
    BRICK,
    CLOSED,
    DENSE,
    OPEN,
    PERIODIC,
    choose,
    make_box,
    make_bricks,
    mark_walls,
    relist,
    rings_for,
    trace,
)

WRAPPED = ((PERIODIC, PERIODIC),) * 3
SHUT = ((CLOSED, CLOSED),) * 3
SCHEMES = ("semi-lagrangian", "maccormack")


def _flat(values: np.ndarray, dtype, device: str) -> wp.array:
    shape = (-1, 3) if dtype is wp.vec3 else (-1,)
    number = wp.dtype_to_numpy(dtype) if dtype is not wp.vec3 else np.float32
    return wp.array(np.ascontiguousarray(values, number).reshape(shape), dtype=dtype, device=device)


def _fine(solid: np.ndarray, refinement: int = 2) -> np.ndarray:
    """Coarse cells as fine ones."""
    return np.kron(solid, np.ones((refinement,) * 3, bool))


class Grid:
    """Smoke carried by air of a constant velocity field u [X, Y, Z, 3], coarse cells a step."""

    def __init__(
        self,
        u: np.ndarray,
        refinement: int,
        ends,
        device: str,
        *,
        solid: np.ndarray | None = None,
        storage: str = "float32",
        scheme: str = "maccormack",
        reach: float | None = None,
        threshold: float = 0.0,
        pool: bool = True,
    ):
        """`reach`: fine cells that a trace goes in a step, with bricks, in a pool or not; None: without bricks."""
        coarse = u.shape[:3]
        self.box, self.device, self.scheme = make_box(coarse, refinement, ends), device, scheme
        self.dtype = STORAGES[storage]
        self.shape = tuple(refinement * n for n in coarse)
        self.u = _flat(u, wp.vec3, device)
        self.walls = wp.zeros(0 if solid is None else solid.size, dtype=wp.uint8, device=device)
        if solid is not None:
            mark_walls(self.box, _flat(solid, wp.uint8, device), self.walls)
        self.bricks, self.computed = DENSE, 0
        if reach is not None:
            self.bricks = make_bricks(self.box, rings_for(reach), threshold, device)
            total = self.bricks.busy.size
            self.bricks.free = wp.array(np.arange(1, total + 1), dtype=int, device=device)
            self.bricks.depth.fill_(total)
            if not pool:
                self.bricks.workers = 0

    def fields(self, density: np.ndarray, temperature: np.ndarray | None = None) -> Fields:
        values = np.zeros(0) if temperature is None else temperature
        return Fields(_flat(density, self.dtype, self.device), _flat(values, self.dtype, self.device))

    def pooled(self, density: np.ndarray) -> Fields:
        """A density in bricks, all of which are busy."""
        self.bricks.busy.fill_(1)
        relist(self.box, self.bricks)
        fields = self.fields(np.zeros((self.bricks.free.size + 1) * BRICK**3))
        advection_sources.store(self.bricks, fields, clear=False)
        pool = fields.density.numpy()
        pool[self.indices] = density.ravel()
        fields.density.assign(pool)
        return fields

    @property
    def indices(self) -> np.ndarray:
        """The index of each cell in the pool."""
        x = np.indices(self.shape).reshape(3, -1)
        places = self.bricks.places.numpy()[np.ravel_multi_index(x // BRICK, self.box.bricks)]
        return places * BRICK**3 + np.ravel_multi_index(x % BRICK, (BRICK,) * 3)

    def run(self, fields: Fields, dt: float, steps: int = 1, decay=(1.0, 1.0)) -> Fields:
        spare = [Fields(wp.zeros_like(fields.density), wp.zeros_like(fields.temperature)) for _ in range(2)]
        traces = wp.full(2 * self.u.size, np.nan, dtype=wp.vec3, device=self.device)
        at = [self.box, traces, self.walls]
        for _ in range(steps):
            if self.bricks.workers > 0:
                relist(self.box, self.bricks)
                advection_sources.store(self.bricks, fields)
            elif self.bricks is not DENSE:
                mark_smoke(self.box, fields, self.bricks)
                choose(self.box, self.bricks)
            if self.bricks is not DENSE:
                self.computed += np.count_nonzero(self.bricks.places.numpy()) * BRICK**3
            trace(self.box, self.u, dt, traces, self.bricks)
            if self.scheme == "maccormack":
                advect(*at, fields, spare[0], bricks=self.bricks)
                advect(*at, fields, spare[1], decay, self.bricks, spare[0])
                fields, spare[1] = spare[1], fields
            else:
                advect(*at, fields, spare[0], decay, self.bricks)
                fields, spare[0] = spare[0], fields
        return fields

    def array(self, flat: wp.array) -> np.ndarray:
        values = flat.numpy() if self.bricks.workers == 0 else flat.numpy()[self.indices]
        return values.reshape(self.shape).astype(np.float64)

    def carried(self, density: np.ndarray, dt: float, steps: int = 1) -> np.ndarray:
        """A density after some steps."""
        fields = self.fields(density) if self.bricks.workers == 0 else self.pooled(density)
        return self.array(self.run(fields, dt, steps).density)


def _centres(shape, refinement=1) -> np.ndarray:
    return np.stack(np.meshgrid(*[(np.arange(n) + 0.5) / refinement for n in shape], indexing="ij"), -1)


def _blob(shape, refinement, at, width: float) -> np.ndarray:
    return np.exp(-((_centres(shape, refinement) - at) ** 2).sum(-1) / (2 * width**2))


def _turning(n: int, angle: float) -> np.ndarray:
    """Air that turns about z through a box's middle by an angle a step; three cells thick."""
    at = _centres((n, n, 3)) - n / 2
    return np.stack([-angle * at[..., 1], angle * at[..., 0], 0 * at[..., 2]], -1)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(
    ("ends", "refinement"), [(((OPEN, CLOSED), (PERIODIC, PERIODIC), (CLOSED, OPEN)), 2), (SHUT, 3)]
)
def test_a_step_is_the_references(ends, refinement: int, scheme: str, device: str):
    """Random air as fast as 1.2 fine cells a step, a body, all kinds of faces; both fields."""
    rng = np.random.default_rng(0)
    coarse = (3, 3, 4)
    u = rng.uniform(-0.6, 0.6, (*coarse, 3)).astype(np.float32)
    solid = np.zeros(coarse, bool)
    solid[1, 1:3, 2] = solid[0, 0, 0] = True
    twin = Smoke(solid, refinement, ends, 0.9, scheme, decay=(0.5, 0.25))
    values = rng.uniform(0, 1, (2, *twin.n)).astype(np.float32) * ~twin.fine_solid
    grid = Grid(u, refinement, ends, device, solid=solid, scheme=scheme)
    got = grid.run(grid.fields(*values), 0.9, decay=twin.decay)
    for field, expected in zip((got.density, got.temperature), twin.carry(u.astype(float), *values), strict=True):
        np.testing.assert_allclose(grid.array(field), expected, rtol=0, atol=2e-6)


def test_half_floats_round_once_a_step(device: str):
    rng = np.random.default_rng(1)
    u = rng.uniform(-0.5, 0.5, (4, 4, 4, 3))
    values = rng.uniform(0, 1, (8, 8, 8)).astype(np.float16)
    single, half = (Grid(u, 2, SHUT, device, scheme="semi-lagrangian", storage=s) for s in STORAGES)
    expected, got = (grid.carried(values, 1.0) for grid in (single, half))
    np.testing.assert_allclose(got, expected, rtol=2.0**-11, atol=1e-7)


def _turn_error(n: int, scheme: str, device: str) -> float:
    """RMS error of a blob after a quarter turn in 4 n / 16 steps, one cell of smoke for one of air."""
    steps = n // 2
    grid = Grid(_turning(n, 0.5 * np.pi / steps), 1, (*SHUT[:2], WRAPPED[0]), device, scheme=scheme)
    width = n / 12
    start = _blob(grid.shape, 1, (0.68 * n, n / 2, 1.5), width)
    # It doesn't vary along z.
    start = np.repeat(start[:, :, 1:2], 3, 2)
    expected = np.rot90(start, 1, (0, 1))
    got = grid.carried(start, 1.0, steps)
    assert got.min() >= 0.0 and got.max() <= start.max()
    return float(np.sqrt(np.mean((got - expected) ** 2)))


@pytest.mark.parametrize(("scheme", "order", "most"), [("semi-lagrangian", 0.7, 0.03), ("maccormack", 1.6, 0.008)])
def test_a_turn_converges(scheme: str, order: float, most: float, device: str):
    """Solid-body rotation, cells and steps halved together: first and second order."""
    errors = [_turn_error(n, scheme, device) for n in (24, 48)]
    assert errors[1] <= most
    assert np.log2(errors[0] / errors[1]) >= order


@pytest.mark.parametrize(("scheme", "storage"), [("maccormack", "float32"), ("semi-lagrangian", "float16")])
def test_a_constant_stays(scheme: str, storage: str, device: str):
    """In any air, where nothing comes in: bit for bit, and to rounding beside solids."""
    rng = np.random.default_rng(2)
    solid = np.zeros((5, 5, 5), bool)
    solid[2, 2, 1:4] = True
    u = rng.uniform(-0.5, 0.5, (5, 5, 5, 3))
    grid = Grid(u, 2, SHUT, device, storage=storage, scheme=scheme)
    constant = np.full(grid.shape, 0.625)
    np.testing.assert_array_equal(grid.carried(constant, 1.0, 5), constant)
    grid = Grid(u, 2, SHUT, device, storage=storage, scheme=scheme, solid=solid)
    constant = 0.625 * ~_fine(solid)
    got, tolerance = grid.run(grid.fields(constant, constant), 1.0, 5), 1e-6 if storage == "float32" else 1e-3
    for field in (got.density, got.temperature):
        np.testing.assert_allclose(grid.array(field), constant, rtol=0, atol=tolerance)


def test_solids_that_come_and_go(device: str):
    """Covered smoke is lost; freed cells get the mean of their coarse neighbours."""
    coarse = (4, 3, 3)
    grid = Grid(np.zeros((*coarse, 3)), 2, SHUT, device)
    before, after = np.zeros(coarse, np.uint8), np.zeros(coarse, np.uint8)
    before[1, 1, 1] = after[2, 1, 1] = 1
    walls = [wp.zeros(36, dtype=wp.uint8, device=device) for _ in range(2)]
    for mask, wall in zip((before, after), walls, strict=True):
        mark_walls(grid.box, _flat(mask, wp.uint8, device), wall)
    start = np.full(grid.shape, 0.5)
    start[2:4, 2:4, 2:4] = 0.0
    fields = grid.fields(start, start)
    advection_sources.change_solids(grid.box, *walls, fields)
    expected = np.full(grid.shape, 0.5)
    expected[4:6, 2:4, 2:4] = 0.0
    for field in (fields.density, fields.temperature):
        np.testing.assert_allclose(grid.array(field), expected, atol=1e-6)
    # In a brick, which then is busy; without one nothing is written.
    sparse = Grid(np.zeros((*coarse, 3)), 2, SHUT, device, reach=1.0)
    for stored in (True, False):
        fields = sparse.pooled(start)
        sparse.bricks.busy.zero_()
        if not stored:
            sparse.bricks.places.zero_()
        advection_sources.change_solids(grid.box, *walls, fields, sparse.bricks)
        assert sparse.bricks.busy.numpy().tolist() == [stored]
        np.testing.assert_allclose(sparse.array(fields.density), expected if stored else 0.0, atol=1e-6)
    # With nothing but solids around there is nothing to take.
    full = wp.full(36, wp.uint8(2), dtype=wp.uint8, device=device)
    fields = grid.fields(np.zeros(grid.shape))
    advection_sources.change_solids(grid.box, full, walls[0], fields)
    np.testing.assert_array_equal(grid.array(fields.density), 0.0)


@pytest.mark.parametrize("storage", STORAGES)
def test_sources(storage: str, device: str):
    solid = np.zeros((4, 4, 4), bool)
    solid[1, 1, 1] = True
    grid = Grid(np.zeros((4, 4, 4, 3)), 2, SHUT, device, solid=solid, storage=storage)
    fields = grid.fields(np.full(grid.shape, 0.25), np.zeros(grid.shape))
    at = [grid.box, grid.walls]
    x = _centres(grid.shape)
    fluid = ~_fine(solid)
    ball = (((x - 3.0) / (2.2, 3.2, 2.2)) ** 2).sum(-1) <= 1
    source = advection_sources.make_region("sphere", (3.0, 3.0, 3.0), (2.2, 3.2, 2.2))
    advection_sources.add_source(*at, source, (0.5, 2.0), fields, fixed=False)
    np.testing.assert_array_equal(grid.array(fields.density), 0.25 + 0.5 * (ball & fluid))
    np.testing.assert_array_equal(grid.array(fields.temperature), 2.0 * (ball & fluid))
    # Half out of the domain, held at a value.
    box = (np.abs(x - (8.0, 4.0, 4.0)) <= (2.0, 1.0, 9.0)).all(-1)
    source = advection_sources.make_region("box", (8.0, 4.0, 4.0), (2.0, 1.0, 9.0))
    advection_sources.add_source(*at, source, (0.125, 1.0), fields, fixed=True)
    np.testing.assert_array_equal(grid.array(fields.density)[box & fluid], 0.125)
    before = grid.array(fields.density)
    for centre in ((-9.0, 4.0, 4.0), (30.0, 4.0, 4.0)):
        source = advection_sources.make_region("box", centre, (2.0, 1.0, 9.0))
        advection_sources.add_source(*at, source, (9.0, 9.0), fields, fixed=False)
    np.testing.assert_array_equal(grid.array(fields.density), before)


@pytest.mark.parametrize("shape", ["box", "cylinder", "mesh"])
def test_turned_sources(shape: str, device: str):
    """Regions that are stretched, turned and partly outside, against their frames in NumPy."""
    grid, centre, size = Grid(np.zeros((5, 6, 7, 3)), 2, SHUT, device), (4.3, 6.1, 11.8), (2.1, 4.2, 1.3)
    turn = Rotation.from_euler("xyz", (0.3, -1.1, 2.0))
    away = turn.inv().apply((_centres(grid.shape) - centre).reshape(-1, 3)).reshape(*grid.shape, 3) / size
    far = np.abs(away)
    if shape == "mesh":
        points, triangles = surface("sphere")
        points = wp.array(points + (0.5, 0, 0), dtype=wp.vec3, device=device)
        arrays = (points, wp.array(triangles.ravel(), dtype=int, device=device))
        mesh = wp.Mesh(*arrays, support_winding_number=True)
        source = advection_sources.make_region(mesh, centre, size, extent=(1.5, 1.0, 1.0), turn=turn.as_quat())
        reach = np.linalg.norm(away - (0.5, 0, 0), axis=-1)
    else:
        source = advection_sources.make_region(shape, centre, size, turn=turn.as_quat())
        reach = far.max(-1) if shape == "box" else np.maximum(np.hypot(far[..., 0], far[..., 2]), far[..., 1])
    fields = grid.fields(np.zeros(grid.shape))
    advection_sources.add_source(grid.box, grid.walls, source, (1.0, 0.0), fields, fixed=False)
    sure = np.abs(reach - 1.0) > 0.02
    assert (reach < 1.0).sum() > 20
    np.testing.assert_array_equal(grid.array(fields.density)[sure], 1.0 * (reach < 1.0)[sure])


def test_noise_of_a_source(device: str):
    """Warp's own noise in the source's frame: within its amount, smooth in space and time, and of its seed alone."""
    grid = Grid(np.zeros((12, 12, 12, 3)), 2, SHUT, device)

    def emitted(amount=0.8, phase=0.3, seed=5, centre=12.0):
        source = advection_sources.make_region("box", (centre,) * 3, (40.0,) * 3, noise=(amount, 6.0, phase), seed=seed)
        fields = grid.fields(np.zeros(grid.shape), np.zeros(grid.shape))
        advection_sources.add_source(grid.box, grid.walls, source, (2.0, 1.0), fields, fixed=True)
        np.testing.assert_allclose(grid.array(fields.temperature), 0.5 * grid.array(fields.density), rtol=1e-6)
        return grid.array(fields.density)

    got = emitted()
    for p in ((0, 3, 7), (20, 11, 5), (9, 23, 14)):
        x = (np.array(p) + 0.5 - 12.0) / 6.0
        value = float(wp.noise(wp.rand_init(5), wp.vec4(*x, 0.3)))
        assert got[p] == pytest.approx(2.0 * max(1.0 + 0.8 * np.clip(2.0 * value, -1.0, 1.0), 0.0), rel=1e-4)
    assert 0.1 < got.std() < 1.0 and got.min() >= 0.4 - 1e-6 and got.max() <= 3.6 + 1e-6
    assert max(np.abs(np.diff(got, axis=axis)).max() for axis in range(3)) < 0.8
    np.testing.assert_array_equal(got, emitted())
    np.testing.assert_allclose(emitted(centre=14.0)[2:, 2:, 2:], got[:-2, :-2, :-2], rtol=1e-4)
    assert 0.0 < np.abs(emitted(phase=0.35) - got).max() < 0.5 < np.abs(emitted(seed=6) - got).max()
    assert emitted(amount=9.0).min() == 0.0
    np.testing.assert_array_equal(emitted(amount=0.0), 2.0)
    # What is emitted is linear in the source's values, and so are their gradients in those of the smoke.
    weights = np.random.default_rng(4).normal(size=(2, *grid.shape))
    noisy = advection_sources.make_region("box", (12.0,) * 3, (40.0,) * 3, noise=(0.8, 6.0, 0.3), seed=5)
    on_values = wp.zeros(2, dtype=wp.vec2, device=device)
    source_backward(grid.box, grid.walls, noisy, 1, grid.fields(*weights), on_values, fixed=True)
    expected = (0.5 * weights * got).sum((1, 2, 3))
    np.testing.assert_allclose(on_values.numpy(), [(0.0, 0.0), expected], rtol=1e-3, atol=1e-2)


def test_half_floats_do_not_overflow(device: str):
    grid = Grid(np.zeros((2, 2, 2, 3)), 1, SHUT, device, storage="float16")
    fields = grid.fields(np.full(grid.shape, 60000.0))
    source = advection_sources.make_region("box", (1.0, 1.0, 1.0), (5.0, 5.0, 5.0))
    advection_sources.add_source(grid.box, grid.walls, source, (60000.0, 0.0), fields, fixed=False)
    np.testing.assert_array_equal(grid.array(fields.density), 65504.0)
    np.testing.assert_array_equal(grid.array(grid.run(fields, 1.0).density), 65504.0)


@pytest.mark.parametrize("refinement", [1, 3])
def test_buoyancy_is_of_means(refinement: int, device: str):
    rng = np.random.default_rng(5)
    coarse = (3, 4, 2)
    solid = np.zeros(coarse, bool)
    solid[1, 2, 0] = True
    grid = Grid(np.zeros((*coarse, 3)), refinement, SHUT, device, solid=solid)
    density, heat = rng.uniform(0, 1, (2, *grid.shape))
    force = wp.empty(24, dtype=wp.vec3, device=device)
    fields = grid.fields(density, heat)
    advection_sources.buoyancy(grid.box, grid.walls, fields, (0, -0.5, 0), (0.1, 2.0, 0), force)
    blocks = (3, refinement, 4, refinement, 2, refinement)
    d, t = (v.reshape(blocks).mean((1, 3, 5))[..., None] for v in (density, heat))
    expected = (d * (0, -0.5, 0) + t * (0.1, 2.0, 0)) * ~solid[..., None]
    np.testing.assert_allclose(force.numpy().reshape(*coarse, 3), expected, atol=1e-5)
    # Where no brick is listed there is nothing to lift.
    sparse = Grid(np.zeros((*coarse, 3)), refinement, SHUT, device, reach=1.0)
    fields = sparse.pooled(density)
    advection_sources.buoyancy(grid.box, grid.walls, fields, (0, -0.5, 0), (0.1, 2.0, 0), force, sparse.bricks)
    expected = d * (0, -0.5, 0) * ~solid[..., None]
    np.testing.assert_allclose(force.numpy().reshape(*coarse, 3), expected, atol=1e-5)
    sparse.bricks.places.zero_()
    advection_sources.buoyancy(grid.box, grid.walls, fields, (0, -0.5, 0), (0.1, 2.0, 0), force, sparse.bricks)
    np.testing.assert_array_equal(force.numpy(), 0.0)


@pytest.mark.parametrize("ends", [WRAPPED, SHUT])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_bricks_give_the_dense_result(scheme: str, ends, device: str):
    """A puff that crosses the domain's end, and its cut bricks: within 1e-5 at a threshold of 1e-6; with 0 exactly, in
    a pool and not."""
    u = np.random.default_rng(6).uniform(-0.2, 0.2, (25, 3, 4, 3)) + (0.6, 0.0, -0.4)
    dense = Grid(u, 3, ends, device, scheme=scheme)
    start = 1.0 * (_blob(dense.shape, 3, (22.0, 1.5, 2.0), 0.5) > 0.1)
    expected = dense.carried(start, 1.0, 12)
    for threshold, most, pool in ((0.0, 0.0, True), (1e-6, 1e-5, True), (0.0, 0.0, False)):
        sparse = Grid(u, 3, ends, device, scheme=scheme, reach=3.0 * 1.1, threshold=threshold, pool=pool)
        got = sparse.carried(start, 1.0, 12)
        np.testing.assert_allclose(got, expected, rtol=0, atol=most)
        assert sparse.computed < 0.8 * 12 * sparse.bricks.busy.size * BRICK**3


def test_smoke_jumps_over_a_brick_that_is_cut_short(device: str):
    """The last brick of a periodic axis is one cell thick: in a step smoke crosses it."""
    u = np.broadcast_to((-2.5, 0.0, 0.0), (33, 8, 8, 3))
    dense, sparse = (Grid(u, 1, WRAPPED, device, reach=reach) for reach in (None, 2.5))
    start = np.zeros(dense.shape)
    # All bricks are computed in the first step, only those about the first in the second.
    start[3] = 1.0
    got, expected = (grid.carried(start, 1.0, 4) for grid in (sparse, dense))
    assert expected[24:28].sum() > 1
    np.testing.assert_array_equal(got, expected)


def test_bricks_follow_the_smoke(device: str):
    """Only bricks near smoke are stored and computed, and those that it has left are free again."""
    u = np.broadcast_to((0.9, 0.0, 0.0), (48, 8, 8, 3))
    grid = Grid(u, 1, ((OPEN, OPEN), *SHUT[:2]), device, scheme="semi-lagrangian", reach=1.0, threshold=1e-4)
    start = np.zeros(grid.shape)
    start[2:6, 2:6, 2:6] = 1.0
    fields = grid.pooled(start)
    counts = []
    for _ in range(14):
        fields = grid.run(fields, 1.0, 5)
        counts.append(int(grid.bricks.counts.numpy()[0]))
        places = grid.bricks.places.numpy()
        free = grid.bricks.free.numpy()[: grid.bricks.depth.numpy()[0]]
        assert np.count_nonzero(places) == counts[-1]
        assert sorted([*free, *places[places > 0]]) == list(range(1, 7))
    assert 2 <= max(counts[1:8]) <= 5
    assert counts[-1] == 0


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30, -1e30])
def test_air_that_blew_up_does_no_harm(value: float, device: str):
    """All reads lie within the grid, and results are within range or NaN."""
    u = np.zeros((3, 3, 3, 3))
    u[1, 1, 1] = value
    for ends in (WRAPPED, SHUT):
        grid = Grid(u, 2, ends, device, reach=2.0)
        got = grid.carried(np.ones(grid.shape), 1.0, 2)
        finite = got[np.isfinite(got)]
        assert finite.size > 0 and finite.min() >= 0 and finite.max() <= 1
