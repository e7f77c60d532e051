"""Lightmaps of more than RGB: several layers (light, directions, SH) of several atlases over the same hours.

The rooms are those of a system (docs/architecture.md). All is stored as *sheets*, lightmaps of three channels, with the
models, kernels and decoders of `wlm.lightmap`.
"""
