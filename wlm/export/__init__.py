"""Exports models for other programs: raw folders, kits for engines, shaders in other languages, and HTML pages.

import wlm

model = wlm.load("city.wlm")
wlm.export.export(model, "city-raw", shader="wgsl")
wlm.export.export(model, "city-three", "three")
wlm.export.write_page("city.html", ["city.wlm"])
"""

from wlm._facade import facade

__getattr__, __dir__, __all__ = facade(__name__, __file__)
