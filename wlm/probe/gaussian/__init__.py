"""Compresses light to 3D Gaussians with short latents and one small network (gaussian-probe-compression)."""
