"""Pages of one file that show a model in any browser with WebGL2, without a network: `write_page`."""

from wlm._facade import facade

_PLACES = {
    "Page": "wlm.web.page",
    "write_page": "wlm.web.pages",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
