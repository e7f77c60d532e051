"""Shader text: what the systems' GLSL has in common, and the same text in other languages."""

from wlm.shading.samplers import sampler

__all__ = ["sampler"]
