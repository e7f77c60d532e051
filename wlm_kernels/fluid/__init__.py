"""Kernels of the fluid solver: lattice Boltzmann air and advected smoke."""
