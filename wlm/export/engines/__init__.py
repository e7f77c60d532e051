"""Kits for engines: folders with textures, a component or material that reads them, and a README.

Each module has a function `write_kit(bundle, folder, engine)`, which `wlm.export.export` calls. The kits of probes are
in `wlm.probe.engines`, beside the functions that read these files back.
"""
