"""Fluids: lattice Boltzmann air, smoke carried by it, obstacles, density volumes.

    from wlm import fluid

    air = fluid.Lattice((64, 32, 32), viscosity=1e-4)
    air.set_inlet("-x", (0.1, 0.0, 0.0))
    air.set_outlet("+x")
    for face in fluid.FACES[2:]:
        air.set_wall(face, slip=True)
    nozzle = fluid.Source("sphere", centre=(2, 16, 16), size=(2, 5, 5), density=1.0, fixed=True)
    sphere = fluid.Sphere(fluid.Trajectory.of((20, 16, 16)), radius=5)
    smoke = fluid.Solver(air, refinement=2, sources=[nozzle], obstacles=[sphere])
    smoke.step(100)
    fluid.save_volume("smoke.npz", smoke.frame(extinction=0.2))

Lengths are in cells of the lattice, times in its steps; ``Domain`` converts from SI units.
"""

from wlm._facade import facade

__all__ = [
    "FACES",
    "Buoyancy",
    "DensityVolume",
    "Domain",
    "Lattice",
    "Mesh",
    "Obstacle",
    "Solver",
    "Source",
    "Sphere",
    "Trajectory",
    "box_mesh",
    "from_array",
    "from_grid",
    "load_volume",
    "save_volume",
]

_MODULES = {
    "faces": ("FACES",),
    "lattice": ("Domain", "Lattice"),
    "obstacles": ("Mesh", "Obstacle", "Sphere", "Trajectory", "box_mesh"),
    "solver": ("Buoyancy", "Solver", "Source"),
    "volume": ("DensityVolume", "from_array", "from_grid", "load_volume", "save_volume"),
}

__getattr__, __dir__ = facade(
    __name__, {name: f"{__name__}.{module}" for module, names in _MODULES.items() for name in names}
)
