"""Fluids: a lattice Boltzmann solver of air, smoke carried by it, density volumes and obstacles."""
