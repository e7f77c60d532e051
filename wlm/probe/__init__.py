"""Light probes as 3D Gaussians and a small network (gaussian-probe-compression)."""
