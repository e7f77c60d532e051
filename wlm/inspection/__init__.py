"""Describes files and folders: their content, the command that reads them, and possible problems."""

from wlm._facade import facade

_PLACES = {
    "Finding": "wlm.inspection.finding",
    "input_system": "wlm.inspection.folders",
    "inspect": "wlm.inspection.folders",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
