"""Warp kernels of wlm: no torch, no files, no state.

Each module holds the kernels of one subject and the functions that launch them; see the module docstrings.
"""
