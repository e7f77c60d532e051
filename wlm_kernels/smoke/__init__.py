"""Kernels that render and process six-way lightmaps of smoke."""
