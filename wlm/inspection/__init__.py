"""What files and folders hold, which command takes them, and what may be wrong with them: `inspect`."""

from wlm._facade import facade

_PLACES = {
    "Finding": "wlm.inspection.finding",
    "inspect": "wlm.inspection.folders",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
