"""The lattice's step against float64: collisions, boundaries, storage; and the kernels beside it."""

import itertools

import numpy as np
import pytest
import warp as wp
from reference import lattice as reference

from wlm.fluid import lattice as lattice_module
from wlm.fluid.lattice import Lattice
from wlm_kernels.fluid.lattice import CAUSES, trouble_of
from wlm_kernels.fluid.lattice_fields import voxelise_mesh, voxelise_sphere
from wlm_kernels.fluid.lattice_sets import LATTICES

STEPS = 2  # one from each of the two buffers
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
    for _ in range(2):
        pair.step()
    pair.change_step(factor)
    _run(pair, max(factor, 1.0) ** 2 * HALF_TOLERANCE if half else 2 * TOLERANCE)  # pressure scales with the square


def test_trouble_of_decodes_a_key():
    for step, cell, code in itertools.product((0, 7, 10**8), (0, 12345, 2**31 - 1), range(3)):
        assert trouble_of((step * 2**31 + cell) * 4 + code) == (step, cell, CAUSES[code])


def test_sphere_voxels(device: str):
    """Its volume; cells that it leaves are free again, and those of another body stay."""
    solid = wp.zeros((24, 20, 22), dtype=wp.uint8, device=device)
    voxelise_sphere(solid, 2, (18.0, 10.0, 11.0), 3.0)
    cells = (solid.numpy() == 2).sum()
    voxelise_sphere(solid, 1, (8.0, 10.0, 11.0), 6.0)
    assert (solid.numpy() == 1).sum() == pytest.approx(4 / 3 * np.pi * 6**3, rel=0.03)
    voxelise_sphere(solid, 1, (9.5, 10.0, 11.0), 2.0)
    places = np.argwhere(solid.numpy() == 1) + 0.5
    np.testing.assert_allclose(places.mean(0), (9.5, 10.0, 11.0), atol=0.1)
    assert (solid.numpy() == 2).sum() == cells


def test_mesh_voxels(device: str):
    """A box as a mesh, scaled and moved."""
    corners = np.array(list(itertools.product((-0.5, 0.5), (-1.0, 1.0), (-0.25, 0.25))), np.float32)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([(a, b, c) + (a, c, d) for a, b, c, d in quads], np.int32).ravel()
    mesh = wp.Mesh(
        points=wp.array(corners, dtype=wp.vec3, device=device),
        indices=wp.array(faces, dtype=int, device=device),
        support_winding_number=True,
    )
    solid = wp.zeros((16, 16, 16), dtype=wp.uint8, device=device)
    voxelise_mesh(solid, 3, mesh, (8.0, 8.0, 8.0), 4.0)
    expected = np.zeros((16, 16, 16), np.uint8)
    expected[6:10, 4:12, 7:9] = 3
    np.testing.assert_array_equal(solid.numpy(), expected)
