"""The encoding of each tile of a sheet, its bytes in the file, and the reason for the encoding."""

from dataclasses import dataclass

from wlm.lightmap.codec import tile_sizes
from wlm.lightmap.encodings import encoding_of
from wlm.lightmap.model import SheetModel
from wlm.lightmap.tiles import TileKind, valid_texels


@dataclass(frozen=True)
class TileReport:
    """A tile of a sheet.

    Attributes:
        number, row, column: Its place in the grid.
        kind: Name of its `TileKind`, in small letters.
        valid: Number of texels inside charts.
        bytes: Its packed bytes in the file, or those of its colours, without the ranges and scales of all tiles.
        why: Reason for the encoding.
    """

    number: int
    row: int
    column: int
    kind: str
    valid: int
    bytes: int
    why: str


def report_tiles(sheet: SheetModel) -> list[TileReport]:
    """Lists the tiles of a sheet's grid, row by row."""
    sizes = tile_sizes(sheet)
    constant = sheet.constant[0].nbytes if len(sheet.constant) else 0
    result = []
    for number, kind in enumerate(map(TileKind, sheet.kind.tolist())):
        valid, encoding = int(valid_texels(sheet.mask, number).sum()), encoding_of(kind)
        if encoding is None:
            why = "it was left out of the fit" if valid else "no texel is inside a chart"
        else:
            why = encoding.reason(sheet, kind)
        size = constant if kind == TileKind.CONSTANT else int(sizes[number])
        place = divmod(number, sheet.grid.cols)
        result.append(TileReport(number, *place, kind.name.lower(), valid, size, why))
    return result
