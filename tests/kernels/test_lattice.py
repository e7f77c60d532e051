"""The lattice's step against float64: collisions, boundaries, storage; and the kernels beside it."""

import itertools

import numpy as np
import pytest
from reference import lattice as reference
from scipy.spatial.transform import Rotation

from wlm.fluid import lattice as lattice_module
from wlm.fluid.lattice import Lattice
from wlm.fluid.obstacles import Mesh, Sphere, Trajectory, box_mesh, cells_of
from wlm_kernels.fluid.lattice import CAUSES, trouble_of
from wlm_kernels.fluid.lattice_sets import LATTICES

STEPS = 2  # one of each parity
SHAPE = (5, 4, 3)
TOLERANCE = 3e-7  # of a velocity of 0.05 and a density of 1
HALF_TOLERANCE = 3e-5
VISCOSITY = 0.02


class Pair:
    """One flow, on a device and in float64."""

    def __init__(
        self,
        lattice: str,
        device: str,
        faces=(),
        solid=None,
        velocity=(0.0, 0.0, 0.0),
        shape=None,
        force=None,
        **settings,
    ):
        settings = {"smagorinsky": 0.17, "viscosity": VISCOSITY, **settings}
        self.shape = shape or ((5, 6, 1) if lattice == "D2Q9" else SHAPE)
        velocities = LATTICES[lattice]
        self.how = {key: settings[key] for key in ("viscosity", "smagorinsky")}
        random = np.random.default_rng(3)
        self.u = 0.05 * random.uniform(-1, 1, (*self.shape, 3))
        self.rho = 1.0 + 0.01 * random.uniform(-1, 1, self.shape)
        if lattice == "D2Q9":
            self.u[..., 2] = 0.0
        solid = np.zeros(self.shape, int) if solid is None else solid
        self.done, self.ramp = 0, settings.get("ramp", 1)
        self.inlets = {name: np.array(value) for name, (kind, value) in dict(faces).items() if kind == "inlet"}
        self.box = reference.Box(np.array(velocities.c), np.array(velocities.w), solid, dict(faces))
        self.force = np.zeros((*self.shape, 3)) if force is None else np.broadcast_to(force, (*self.shape, 3))
        self.device = Lattice(self.shape, lattice=lattice, device=device, **settings)
        for name, (kind, value) in dict(faces).items():
            if kind == "inlet":
                self.device.set_inlet(name, value)
            elif kind == "outlet":
                self.device.set_outlet(name, value)
            else:
                self.device.set_wall(name, value, slip=kind == "slip")
        if force is not None:
            self.device.set_force(force)
        if solid.any():
            self.device.set_solid(solid, velocity)
            self.box.velocity = velocity
        self.device.set_flow(self.u, self.rho)
        start = reference.equilibrium(self.box.c, self.box.w, self.rho, self.u)
        self._inflow()
        self.f = reference.stream(self.box, start)

    def step(self) -> None:
        self.device.step()
        left = reference.collide(self.box, self.f, force=self.force, **self.how)
        self.done += 1
        self._inflow()
        self.f = reference.stream(self.box, left)

    def change_step(self, factor: float) -> None:
        self.device.change_step(factor)
        self.f = reference.change_step(self.box, self.f, force=self.force, factor=factor, **self.how)
        self.how["viscosity"] *= factor
        self.done, self.ramp = round(self.done / factor), self.ramp / factor
        self.box.velocity = factor * np.asarray(self.box.velocity)
        self.inlets = {name: factor * value for name, value in self.inlets.items()}
        for name, (kind, value) in self.box.faces.items():
            if kind == "wall":
                self.box.faces[name] = (kind, factor * np.asarray(value))
            elif kind == "outlet" and value is not None:
                self.box.faces[name] = (kind, 1.0 + factor**2 * (value - 1.0))
        self.force = factor**2 * self.force
        if self.force.any():
            self.device.set_force(self.force)

    def _inflow(self) -> None:
        """Inlets rise smoothly with the steps done, to their velocity after the ramp."""
        risen = min(1.0, (self.done + 1) / self.ramp)
        for name, velocity in self.inlets.items():
            self.box.faces[name] = ("inlet", risen**2 * (3 - 2 * risen) * velocity)

    def hold(self, tolerance: float) -> None:
        rho, u = reference.fields(self.box, self.f + (self.box.solid[..., None] > 0), self.force)
        fluid = self.box.solid == 0
        got_u, got_rho = self.device.velocity().numpy(), self.device.density()
        assert np.abs(got_rho - rho)[fluid].max() <= tolerance, "density"
        assert np.abs(got_u - u)[fluid].max() <= tolerance, "velocity"


def _run(pair: Pair, tolerance: float = TOLERANCE) -> None:
    pair.hold(tolerance)
    for _ in range(STEPS):
        pair.step()
        pair.hold(tolerance)


def _slow(*values: object) -> object:
    """What a faster case covers but for the compilation of one more kernel."""
    return pytest.param(*values, marks=pytest.mark.slow)


COLLISIONS = [("D2Q9", 0.0), ("D3Q19", 0.0), ("D3Q19", 0.17), _slow("D2Q9", 0.17), ("D3Q27", 0.17)]


@pytest.mark.parametrize("name", LATTICES)
def test_velocities_are_isotropic_and_in_pairs(name: str):
    """Moments of the weights up to the fifth order, those on which Navier-Stokes depends."""
    c, w = np.array(LATTICES[name].c, float), np.array(LATTICES[name].w)
    axes = LATTICES[name].axes
    assert w.sum() == pytest.approx(1.0)
    np.testing.assert_array_equal(c[1::2], -c[2::2])
    eye = np.diag([1.0] * axes + [0.0] * (3 - axes))
    np.testing.assert_allclose(np.einsum("q,qa,qb->ab", w, c, c), eye / 3, atol=1e-15)
    expected = sum(np.einsum(order, eye, eye) for order in ("ab,cd->abcd", "ac,bd->abcd", "ad,bc->abcd")) / 9
    np.testing.assert_allclose(np.einsum("q,qa,qb,qc,qd->abcd", w, c, c, c, c), expected, atol=1e-15)


@pytest.mark.parametrize(("lattice", "smagorinsky"), COLLISIONS)
def test_collisions(lattice: str, smagorinsky: float, device: str):
    """A periodic box of noise; the eddies raise the relaxation time by a third of what it is over 1/2."""
    _run(Pair(lattice, device, smagorinsky=smagorinsky))


def test_forces(device: str):
    """One for each cell; for all cells it is the same kernel."""
    force = 2e-3 * np.random.default_rng(5).uniform(-1, 1, (*SHAPE, 3))
    _run(Pair("D3Q19", device, force=force))


WALLS = dict.fromkeys(reference.FACES, ("wall", (0.0, 0.0, 0.0)))
TUNNEL = {"-x": ("inlet", (0.05, 0.01, 0.0)), "+x": ("outlet", None)}
BOXES = {
    "walls": WALLS,
    "one pair of walls": {"-y": WALLS["-y"], "+y": ("wall", (0.1, 0.0, 0.02))},
    "lids": WALLS | {"+y": ("wall", (0.1, 0.0, 0.0)), "-z": ("wall", (0.0, -0.05, 0.0))},
    "slip": dict.fromkeys(reference.FACES, ("slip", (0.0, 0.0, 0.0))),
    "slip and walls": {"-x": WALLS["-x"], "+x": WALLS["+x"], "-z": ("slip", (0, 0, 0)), "+z": ("slip", (0, 0, 0))},
    "tunnel": WALLS | TUNNEL,
    "open tunnel": TUNNEL | {"-y": ("slip", (0, 0, 0)), "+y": ("outlet", None)},
    "tunnel over a belt": TUNNEL | {"-y": WALLS["-y"], "+y": ("wall", (0.1, 0.0, 0.0))},
    "pressure": WALLS | {"-z": ("inlet", (0.0, 0.0, 0.04)), "+z": ("outlet", 1.002), "+y": ("outlet", 1.0)},
    "two outlets": {"-x": ("outlet", None), "+x": ("outlet", None)},
}


@pytest.mark.parametrize("name", BOXES)
def test_faces(name: str, device: str):
    """Every kind of face, alone and along edges with others; inlets rise smoothly, moving walls don't."""
    _run(Pair("D3Q19", device, faces=BOXES[name], ramp=3))


def _obstacles() -> np.ndarray:
    solid = np.zeros((6, 5, 5), int)
    solid[2:4, 1:3, 2] = 1
    # A wall one cell thick, fluid on both sides of it, and a lone cell at a face.
    solid[4, :3, 1:] = 1
    solid[0, 0, 0] = 1
    return solid


@pytest.mark.parametrize("faces", ["walls", "tunnel", "slip", ""])
def test_solids(faces: str, device: str):
    """Bodies at faces, over a part of the inlet, and thin ones, which move; and in a box without faces."""
    solid, faces = _obstacles(), BOXES.get(faces, ())
    _run(Pair("D3Q19", device, faces=faces, solid=solid, velocity=(0.03, 0.01, -0.02), shape=solid.shape))


@pytest.mark.slow
def test_solids_with_other_lattices(device: str):
    """The tables of links serve D3Q27 and D2Q9 as well."""
    solid = _obstacles()
    _run(Pair("D3Q27", device, faces=BOXES["tunnel"], solid=solid, shape=solid.shape))
    flat = np.zeros((6, 6, 1), int)
    flat[2:4, 2] = 1
    faces = {name: WALLS[name] for name in ("-y", "+y")} | TUNNEL
    _run(Pair("D2Q9", device, faces=faces, solid=flat, shape=flat.shape))


@pytest.mark.parametrize("lattice", ["D3Q19", _slow("D2Q9"), _slow("D3Q27")])
def test_sixteen_bits(lattice: str, device: str):
    """A population keeps 11 bits of its deviation from rest: some 1e-5 of the velocity's scale after a few steps."""
    pair = Pair(lattice, device, storage="float16", smagorinsky=0.0)
    _run(pair, HALF_TOLERANCE)
    with pytest.raises(AssertionError):
        pair.hold(TOLERANCE / 10)


@pytest.mark.parametrize(("storage", "tolerance"), [("float32", TOLERANCE), _slow("float16", HALF_TOLERANCE)])
def test_indices_of_64_bits(storage: str, tolerance: float, device: str, monkeypatch: pytest.MonkeyPatch):
    """The indices of a domain of more populations than 32 bits count, in a small one."""
    closed = {face: ("wall", np.zeros(3)) for face in ("-y", "+y")}
    assert not Pair("D3Q19", device, closed, storage=storage).device._spec.wide
    monkeypatch.setattr(lattice_module, "NARROW", 0)
    pair = Pair("D3Q19", device, closed, storage=storage)
    assert pair.device._spec.wide
    _run(pair, tolerance)


def test_thin_domains(device: str):
    """Axes of one and two cells, where both neighbours are one cell, or the cell itself."""
    for shape in ((1, 1, 1), (2, 1, 3), (1, 4, 2)):
        for faces in ((), BOXES["lids"], BOXES["tunnel"]):
            _run(Pair("D3Q19", device, faces=faces, shape=shape))


@pytest.mark.parametrize("factor", [0.5, 2.0])
@pytest.mark.parametrize("name", ["pressure", "tunnel over a belt", _slow("walls")])
def test_another_time_step(name: str, factor: float, device: str):
    """The state is converted, with inlets that still rise, bodies that move, a force and eddies."""
    solid, half = _obstacles(), name == "walls"
    how = {"storage": "float16" if half else "float32", "ramp": 6, "force": (1e-3, -2e-3, 5e-4)}
    pair = Pair("D3Q19", device, BOXES[name], solid, (0.02, 0.0, -0.01), solid.shape, **how)
    for _ in range(3 if factor < 1.0 else 2):
        pair.step()
    pair.change_step(factor)
    _run(pair, max(factor, 1.0) ** 2 * HALF_TOLERANCE if half else 2 * TOLERANCE)  # pressure scales with the square


def test_trouble_of_decodes_a_key():
    for step, cell, code in itertools.product((0, 7, 10**8), (0, 12345, 2**31 - 1), range(3)):
        assert trouble_of((step * 2**31 + cell) * 4 + code) == (step, cell, CAUSES[code])


EXTENTS = np.array([3.3, 1.3, 1.7])


def _bodies(time: float = 0.0, at_rest: bool = False) -> list[Sphere | Mesh]:
    """A sphere and a box that move and turn, in each other's way; or at rest where they are at a time."""
    times, angles = np.array([-1.0, 4.0, 9.0]), np.array([[0.0, 0.3, 0.1], [0.3, 0.0, 0.4]])
    out = []
    for k, (first, way) in enumerate((((2.4, 3.1, 3.0), (0.9, 0.5, 0.1)), ((5.4, 4.2, 3.4), (-0.7, 0.2, 0.4)))):
        turns = Rotation.from_rotvec(np.outer(angles[k], [0.48, -0.6, 0.64])).as_quat()
        path = Trajectory.of(np.array(first) + np.outer([0, 1, 1.5], way), times, turns)
        if at_rest:
            turn = Rotation.from_matrix(path.turn(time)).as_quat()
            path = Trajectory.of(path.at(time), rotations=turn)
        out.append(box_mesh(path, EXTENTS) if k else Sphere(path, 1.45))
    return out


def _covered(bodies, time: float, shape, grown: float = 0.0) -> np.ndarray:
    x, out = np.stack(np.meshgrid(*[np.arange(n) + 0.5 for n in shape], indexing="ij"), -1), np.zeros(shape, int)
    for k, body in enumerate(bodies):
        own = (x - body.path.at(time)) @ body.path.turn(time)
        inside = (np.abs(own) < EXTENTS / 2 + grown).all(-1) if k else np.linalg.norm(own, axis=-1) < body.radius
        out[inside] = k + 1
    return out


def _marked(marks: np.ndarray, bodies, time: float) -> np.ndarray:
    """Checks and returns marks of moving bodies: right, those of the box within a tenth of a cell."""
    least, most = (_covered(bodies, time, marks.shape, grown) for grown in (-0.1, 0.1))
    np.testing.assert_array_equal(marks[least == most], least[least == most])
    assert ((marks == least) | (marks == most)).all()
    return marks.astype(int)


@pytest.mark.parametrize("faces", ["tunnel", ""])
def test_bodies_that_move(faces: str, device: str):
    """A step with bodies that cover and leave cells, also the other's, at a face and across a periodic one."""
    shape, bodies = (7, 6, 5), _bodies()
    pair = Pair("D3Q19", device, faces=BOXES.get(faces, ()), shape=shape)
    box, left_cells = pair.box, 0

    def motion(body: int, x: np.ndarray) -> np.ndarray:
        path, time = bodies[body - 1].path, pair.done + 0.5
        k = int(np.searchsorted(path.times, time)) - 1
        return path.rates[0][k] + np.cross(path.rates[1][k], x - path.at(time))

    box.velocity = motion
    pair.device.set_bodies(bodies)
    pair.device.set_flow(pair.u, pair.rho)
    start = reference.equilibrium(box.c, box.w, pair.rho, pair.u)
    box.solid = pair.device.solid.numpy().astype(int)
    pair.f = reference.stream(box, start)
    pair.hold(TOLERANCE)
    for _ in range(7):
        left = reference.collide(box, pair.f, force=pair.force, **pair.how)
        pair.device.step()
        pair.done += 1
        before, box.solid = box.solid, _marked(pair.device.solid.numpy(), bodies, pair.done + 0.5)
        left_cells += np.count_nonzero((before > 0) & (box.solid == 0))
        pair.f = reference.stream(box, reference.uncover(box, left, before))
        pair.hold(2 * TOLERANCE)
    assert left_cells > 5


@pytest.mark.parametrize("time", [-3.0, 0.0, 3.7, 20.0])
def test_marks_of_bodies_at_rest(time: float, device: str):
    """Turned, at once; the first of two bodies at rest has a cell."""
    expected = _covered(_bodies(), time, (7, 6, 5))
    got = cells_of(_bodies(time, at_rest=True), (7, 6, 5), device).numpy()
    np.testing.assert_array_equal(got > 0, expected > 0)
    assert (got[expected == 1] == 1).all()
