"""Kits for engines: folders with textures, a component or material that reads them, and a README.

Each module has a function `write_kit(bundle, folder, engine)`, which `wlm.export.export` calls.
"""
