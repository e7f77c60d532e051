"""Exports models for other programs: raw folders, kits for engines, shaders in other languages, and HTML pages.

import wlm

model = wlm.load("city.wlm")
wlm.export.export(model, "city-raw", shader="wgsl")
wlm.export.export(model, "city-three", "three")
wlm.export.write_page("city.html", ["city.wlm"])
"""

from wlm._facade import facade

_PLACES = {
    "ENGINES": "wlm.export.engines.kit",
    "LANGUAGES": "wlm.export.shading",
    "export": "wlm.export.writing",
    "make_page": "wlm.export.page.pages",
    "translate": "wlm.export.shading",
    "write_page": "wlm.export.page.pages",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
