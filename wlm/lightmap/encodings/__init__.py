"""The encodings in which tiles are stored, one module each; `encoding_of` returns the encoding of a kind of tile."""

from wlm.lightmap.encodings.base import Encoding
from wlm.lightmap.encodings.constant import Constant
from wlm.lightmap.encodings.frames import Frames
from wlm.lightmap.encodings.maps import Maps
from wlm.lightmap.tiles import TileKind

ENCODINGS: tuple[Encoding, ...] = (Maps(), Frames(), Constant())
"""All encodings; empty tiles are not stored and have no encoding."""

_BY_KIND = {encoding.kind: encoding for encoding in ENCODINGS}


def encoding_of(kind: int) -> Encoding | None:
    """Returns the encoding that stores tiles of a kind; None for empty tiles."""
    return _BY_KIND.get(TileKind(int(kind)))
