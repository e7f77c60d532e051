"""Fluids: lattice Boltzmann air, smoke carried by it, obstacles, density volumes.

Lengths are in cells of the lattice, times in its steps; `Domain` converts from SI units.
`docs/fluid.md` begins with an example.
"""

from wlm._facade import facade

__getattr__, __dir__, __all__ = facade(__name__, __file__)
