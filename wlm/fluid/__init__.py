"""Fluids: lattice Boltzmann air, smoke carried by it, obstacles, density volumes.

    from wlm import fluid

    air = fluid.Lattice((64, 32, 32), viscosity=1e-5)
    air.set_inlet("-x", (0.1, 0.0, 0.0))
    air.set_outlet("+x")
    for face in ("-y", "+y", "-z", "+z"):
        air.set_wall(face, slip=True)

    smoke = fluid.Solver(
        air,
        refinement=2,
        temperature=True,
        buoyancy=fluid.Buoyancy(lift=1e-4),
        sources=[fluid.Source("sphere", (2, 16, 16), (2, 5, 5), density=1.0, temperature=1.0, fixed=True)],
        obstacles=[fluid.Sphere(fluid.Trajectory.of((20, 16, 16)), radius=5)],
    )
    smoke.step(100)
    fluid.save_volume("smoke.npz", smoke.frame(extinction=0.2))

Lengths are in cells of the lattice, times in its steps; `Domain` converts from SI units.
"""

from wlm._facade import facade

_PLACES = {
    "Buoyancy": "wlm.fluid.solver",
    "DensityVolume": "wlm.fluid.volume",
    "Domain": "wlm.fluid.lattice",
    "FACES": "wlm.fluid.faces",
    "Lattice": "wlm.fluid.lattice",
    "Mesh": "wlm.fluid.obstacles",
    "Obstacle": "wlm.fluid.obstacles",
    "Solver": "wlm.fluid.solver",
    "Source": "wlm.fluid.solver",
    "Sphere": "wlm.fluid.obstacles",
    "Trajectory": "wlm.fluid.obstacles",
    "box_mesh": "wlm.fluid.obstacles",
    "from_array": "wlm.fluid.volume",
    "load_volume": "wlm.fluid.volume",
    "save_volume": "wlm.fluid.volume",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
