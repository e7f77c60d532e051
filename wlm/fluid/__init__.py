"""Fluids: lattice Boltzmann air, smoke carried by it, obstacles, density volumes.

Lengths are in cells of the lattice, times in its steps; `Domain` converts from SI units.
`docs/fluid.md` begins with an example.
"""

from wlm._facade import facade

_PLACES = {
    "Buoyancy": "wlm.fluid.solver",
    "DensityVolume": "wlm.fluid.volume",
    "DifferentiableLattice": "wlm.fluid.gradients",
    "DifferentiableSolver": "wlm.fluid.gradients",
    "Domain": "wlm.fluid.lattice",
    "FACES": "wlm.fluid.faces",
    "Fire": "wlm.fluid.forcing",
    "Lattice": "wlm.fluid.lattice",
    "Mesh": "wlm.fluid.obstacles",
    "Noise": "wlm.fluid.solver",
    "Obstacle": "wlm.fluid.obstacles",
    "SmokeState": "wlm.fluid.gradients",
    "Solver": "wlm.fluid.solver",
    "Source": "wlm.fluid.solver",
    "Sphere": "wlm.fluid.obstacles",
    "Trajectory": "wlm.fluid.obstacles",
    "Turbulence": "wlm.fluid.forcing",
    "Wind": "wlm.fluid.forcing",
    "box_mesh": "wlm.fluid.obstacles",
    "from_array": "wlm.fluid.volume",
    "load_volume": "wlm.fluid.volume",
    "save_volume": "wlm.fluid.volume",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
