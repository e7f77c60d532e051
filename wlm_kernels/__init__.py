"""Warp kernels of wlm, which need no torch, read no files and keep no state.

Each module holds the kernels of one subject and the functions that launch them; see the module docstrings.
"""
