"""Data model of a compressed lightmap over time: its arrays and their meaning.

A tile of 128 x 128 texels over T times is stored as the feature maps F_uv, F_uvt, F_ut, F_vt and a small MLP
(neural-dynamic-gi, eq. 5). The network's output y is normalised colour; decoding undoes the normalisation:

    colour(u, v, t) = (shift + spread y) * scale(t),     radiance = max(colour, 0) ** gamma

`colour` is in gamma space. `scale` is the mean of each channel at each time (section 4), `shift` and `spread` are the
mean and the standard deviation, over all times, of colour / scale. The paper only divides by the mean; the network of a
tile whose light hardly varies would then have to output 1 +- 0.001. All three are stored rounded, and the fit
normalises with the rounded values, so that rounding adds no error.

A `LightmapModel` is a collection of sheets (`wlm.lightmap.sheet`); the arrays of each sheet are a `SheetModel`. Of a
file the arrays that hold maps, networks and frames are read when they are first used, or for some tiles alone.
"""

import math
from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from wlm.errors import WlmError
from wlm.formats.bc7 import BLOCK_BYTES
from wlm.formats.exr import HALF_MAX
from wlm.formats.parts import Part
from wlm.lightmap.groups import Sheets, in_groups
from wlm.lightmap.profile import Profile, TimeAxis
from wlm.lightmap.sheet import Sheet, first_light, layer_sheets
from wlm.lightmap.tiles import TILE, TileGrid, TileKind
from wlm.system import Model
from wlm_kernels import mlp
from wlm_kernels.lightmap.features import INPUTS

BLOCKS = TILE // 4
"""Blocks along a side of a tile."""

_CHECKED = 64  # tiles that are unpacked at once to check them

SCALE_SPAN = (-21.0, 16.0)
"""Range of scale codes as log2 of radiance: from small half floats to the largest one."""


PACKED_KINDS = TileKind.DYNAMIC, TileKind.FRAMES
"""The kinds of tiles that are packed: each is a piece of the file, which is read alone."""

PACKED = ("uv", "uvt", "ut", "vt", "net", "frames")
"""The arrays of a sheet that are packed by tile."""

_KINDS = {
    **dict.fromkeys(("uv", "uvt", "ut", "vt", "net", "scale", "peak", "affine"), TileKind.DYNAMIC),
    "constant": TileKind.CONSTANT,
    **dict.fromkeys(("frames", "ranges"), TileKind.FRAMES),
}
"""The kind of tiles that have a row in each array, by rising number."""


def encode_scale(values: np.ndarray, gamma: float, up: bool = False) -> np.ndarray:
    """Encodes values >= 0 in gamma space, of any shape, as 8-bit logarithmic codes: code 0 is 0, codes 1 to 255 divide
    `SCALE_SPAN` evenly; `up` rounds up, for upper bounds.

    At gamma 2.2 one step is 4.7%. The span is fixed, so that the bytes of a tile do not depend on other tiles. Values
    above 0 but below the span take code 1.
    """
    low, high = (bound / gamma for bound in SCALE_SPAN)
    with np.errstate(divide="ignore"):
        position = (np.log2(np.maximum(values, 0.0)) - low) / (high - low) * 254.0
    position = np.where(values > 0, position, 0.0)
    code = np.ceil(position - 1e-6) if up else np.rint(position)
    return np.where(values > 0, 1 + np.clip(code, 0, 254), 0).astype(np.uint8)


def decode_scale(codes: np.ndarray, gamma: float) -> np.ndarray:
    """Returns the values, float32, that codes of `encode_scale` stand for."""
    low, high = (bound / gamma for bound in SCALE_SPAN)
    value = np.exp2(low + (codes.astype(np.float64) - 1.0) * ((high - low) / 254.0))
    return np.where(codes > 0, value, 0.0).astype(np.float32)


def tiles_of(kind: np.ndarray, kinds: Iterable[TileKind]) -> np.ndarray:
    """Returns the numbers of the tiles of some kinds, rising, int [n]; `kind` is uint8 [tiles]."""
    chosen = np.zeros(256, bool)
    chosen[list(kinds)] = True
    return np.flatnonzero(chosen[kind])


def part_table(profile: Profile, kind: np.ndarray, times: int) -> dict[str, Part]:
    """Returns the types and shapes of the arrays of a sheet with tiles of the given `TileKind`s, uint8 [tiles], at T =
    `times` times. The rows are the tiles of one kind, by rising number: dynamic, constant or stored as frames."""
    constant, dynamic, framed = (int((kind == own).sum()) for own in (TileKind.CONSTANT, *PACKED_KINDS))
    r = profile.uvt_resolution // 4
    plane = Part(np.uint8, (dynamic, profile.plane_rows, profile.plane_columns, 2))
    return {
        "uv": Part(np.uint8, (dynamic, BLOCKS, BLOCKS, BLOCK_BYTES)),
        "uvt": Part(np.uint8, (dynamic, profile.uvt_slices, r, r, BLOCK_BYTES)),
        "ut": plane,
        "vt": plane,
        "net": Part(np.float16, (dynamic, mlp.parameter_count(INPUTS, profile.hidden))),
        "scale": Part(np.uint8, (dynamic, times, 3)),
        "peak": Part(np.uint8, (dynamic, times)),
        "affine": Part(np.float16, (dynamic, 2, 3), least=0.0),
        "constant": Part((np.float16, np.float32), (constant, times, 3), least=0.0, most=HALF_MAX),
        "frames": Part(np.uint8, (framed, times, BLOCKS, BLOCKS, BLOCK_BYTES)),
        "ranges": Part(np.float16, (framed, times, 2, 3), least=0.0),
    }


@dataclass(eq=False)
class SheetModel:
    """The arrays of one sheet (up to three channels of a layer). Their types and shapes are in `part_table`.

    The sheets of a file read the mask and the arrays in `PACKED` at their first use: the mask by itself, and all tiles
    together. `only` reads some of the tiles. Both raise a `WlmError`, which names the tile, if the file is damaged
    there or was closed. Several threads may read at once.

    Attributes:
        name, width, height, times, period: Properties of the input, see `wlm.lightmap.data.SheetFrames`.
        profile: The settings of the fit of this sheet.
        mask: bool [H, W], true where a texel is valid; gaps are filled after decoding (`wlm.texels.near_gaps`).
        kind: uint8 [tiles], `TileKind` of each tile of the grid, row-major; EMPTY also for tiles that were not fitted.
        uv: BC7 blocks of F_uv.
        uvt: BC7 blocks of F_uvt, slice by slice.
        ut, vt: F_ut and F_vt, one row for each step of time.
        net: Networks, `hidden` rows and then `output` rows, see `wlm_kernels.mlp`.
        scale: Codes of the mean of each channel at each time, in gamma space.
        peak: Codes of an upper bound of the tile at each time, in gamma space: the colour of level 255 of the 8-bit
            output.
        affine: The numbers `shift` and `spread` of the formula at the top of the module.
        constant: Radiance of constant tiles: half floats, or float32 if a half float would be more than 1% off.
        frames: BC7 blocks of any mode of the tiles that are stored as frames; blocks that no filtered read touches are
            black.
        ranges: Least and greatest colour of each frame, in gamma space.
    """

    name: str
    width: int
    height: int
    times: np.ndarray
    period: float | None
    profile: Profile
    mask: np.ndarray
    kind: np.ndarray
    uv: np.ndarray
    uvt: np.ndarray
    ut: np.ndarray
    vt: np.ndarray
    net: np.ndarray
    scale: np.ndarray
    peak: np.ndarray
    affine: np.ndarray
    constant: np.ndarray
    frames: np.ndarray
    ranges: np.ndarray

    @classmethod
    def of_file(cls, tiles: object, **fields: object) -> Self:
        """Makes a sheet of a file from its `wlm.lightmap.stored.StoredTiles` and the fields of the class, without the
        mask and the arrays in `PACKED`."""
        sheet = cls.__new__(cls)
        vars(sheet).update(fields, _tiles=tiles)
        return sheet

    def __getattr__(self, name: str) -> np.ndarray:
        # Python asks for what is missing: of a sheet of a file the mask and the packed arrays before their first use.
        tiles = vars(self).get("_tiles")
        if tiles is None or name not in ("mask", *PACKED):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        vars(self).update({"mask": tiles.mask.texels} if name == "mask" else tiles.read(self))
        return vars(self)[name]

    @property
    def pieces(self) -> Sequence[bytes] | None:
        """The packed tiles as the file has them; None unless the sheet is one of a file whose tiles were not read."""
        return None if "_tiles" not in vars(self) or "uv" in vars(self) else vars(self)["_tiles"].pieces

    def only(self, numbers: Sequence[int] | np.ndarray) -> "SheetModel":
        """Returns the sheet with some of its tiles; the others are empty. Of a file only these are read. `numbers` are
        the numbers of the tiles in the grid, in any order; empty tiles stay empty."""
        # In this order, since another thread may read all tiles meanwhile.
        stored = None if self.pieces is None else vars(self)["_tiles"]
        chosen, part = np.asarray(numbers, np.int64).reshape(-1), copy(self)
        if chosen.size and not 0 <= chosen.min() <= chosen.max() < len(self.kind):
            raise WlmError(
                f"{self.name}: tiles: expected 0 to {len(self.kind) - 1}, got {chosen.min()}, {chosen.max()}"
            )
        part.kind = np.zeros_like(self.kind)
        part.kind[chosen] = self.kind[chosen]
        rows = {kind: part.kind[self.numbers(kind)] > 0 for kind in set(_KINDS.values())}
        for name, kind in _KINDS.items():
            if name not in PACKED or stored is None:
                setattr(part, name, getattr(self, name)[rows[kind]])
        if stored is not None:
            vars(part).update(stored.read(part))
        return part

    def check(self) -> None:
        """Reads and checks the mask and all tiles of a sheet of a file, some at a time, and keeps none."""
        numbers = self.numbers(*PACKED_KINDS)
        if "_tiles" in vars(self):
            vars(self)["_tiles"].mask.bits()
        if self.pieces is not None:
            for start in range(0, len(numbers), _CHECKED):
                self.only(numbers[start : start + _CHECKED])

    def close(self) -> None:
        """Closes the file of the sheet, see `LightmapModel.close`."""
        if "_tiles" in vars(self):
            vars(self)["_tiles"].close()

    @property
    def parts(self) -> dict[str, np.ndarray]:
        """The arrays by name, in the order of `part_table`, and `kind` last."""
        return {name: getattr(self, name) for name in (*part_table(self.profile, self.kind, len(self.times)), "kind")}

    @property
    def plain(self) -> dict[str, np.ndarray]:
        """The arrays by name that are not packed by tile, `kind` last."""
        return {name: getattr(self, name) for name in (*_KINDS, "kind") if name not in PACKED}

    @property
    def axis(self) -> TimeAxis:
        """Maps times to positions on the time axis of the feature maps."""
        return TimeAxis(self.times, self.period, self.profile.time_axis, self.profile.interpolation)

    @property
    def grid(self) -> TileGrid:
        """The grid of the tiles."""
        return TileGrid.of(self.height, self.width)

    @property
    def stored_texels(self) -> np.ndarray:
        """The texels of tiles that are not empty, bool [H, W]."""
        return self.grid.texels_of((self.kind != TileKind.EMPTY).reshape(self.grid.rows, self.grid.cols))

    @property
    def scales(self) -> np.ndarray:
        """The mean of each channel of each dynamic tile at each time, as decoded, float32 [N, T, 3]."""
        return decode_scale(self.scale, self.profile.gamma)

    @property
    def memory_bytes(self) -> int:
        """Bytes that the sheet takes on a GPU: maps, networks as half floats, scales, colours and frames."""
        table = part_table(self.profile, self.kind, len(self.times))
        packed = sum(math.prod(table[name].shape) * np.dtype(table[name].dtype).itemsize for name in PACKED)
        return packed + sum(value.nbytes for value in self.plain.values())

    def numbers(self, *kinds: TileKind) -> np.ndarray:
        """Returns the numbers of the tiles of these kinds, rising, int [n]."""
        return tiles_of(self.kind, kinds)

    def row(self, number: int) -> int:
        """Returns the index of tile `number` among the tiles of its own kind."""
        return int((self.kind[:number] == self.kind[number]).sum())


@dataclass(eq=False)
class LightmapModel(Sheets[SheetModel], Model):
    """A compressed lightmap set: a `SheetModel` for each sheet (up to three channels of a layer).

    A model from `wlm.load` keeps its file open and reads tiles when they are needed; a tile whose bytes do not match
    their digest is a `WlmError` then. `check` reads all. It may be used in a `with` statement, which closes it.

    Attributes:
        name: Name of the set.
        source: Hash of the input, see `wlm.lightmap.data.LightmapSet.source`.
        profile: The settings of the fit; each sheet's own settings follow from them (`Profile.for_sheet`).
        sheets: The sheets, group by group (`wlm.lightmap.groups`), with the same times in a group; those of one atlas
            and size share the mask.
        warnings: Settings that the fit could not follow, and light that it lost though the PSNR is high, one line each;
            they are not saved to the file.
    """

    SYSTEM: ClassVar[str] = "lightmap"

    name: str
    source: str
    profile: Profile
    sheets: dict[Sheet, SheetModel]
    warnings: tuple[str, ...] = ()

    @property
    def memory_bytes(self) -> int:
        """Bytes that all sheets together take on a GPU."""
        return sum(own.memory_bytes for own in self.sheets.values())

    def group_sizes(self) -> dict[str, tuple[np.ndarray, int]]:
        """Returns for each light group its stored times, float64 [T], and the bytes that it takes on a GPU."""
        result: dict[str, tuple[np.ndarray, int]] = {}
        for sheet, own in self.sheets.items():
            result[sheet.group] = own.times, result.get(sheet.group, (own.times, 0))[1] + own.memory_bytes
        return result

    def check(self) -> None:
        """Reads and checks all tiles of the file that the model was loaded from, without keeping them.

        Raises:
            WlmError: A tile is damaged; the line names its sheet and its number.
        """
        for own in self.sheets.values():
            own.check()

    def close(self) -> None:
        """Closes the file that the model was loaded from: tiles that were not read before are errors from now on. The
        file is also closed when the model and everything that was made of it are no longer referred to."""
        for own in self.sheets.values():
            own.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def layer(self, name: str | None = None, atlas: str | None = None) -> list[Sheet]:
        """Returns the sheets of one layer of one atlas in all groups, see `wlm.lightmap.sheet.layer_sheets`."""
        return layer_sheets(self.name, self.sheets, name, atlas)

    def maps(self, sheet: Sheet | None = None) -> dict[str, SheetModel]:
        """Returns a sheet in all light groups that have it, by group.

        Args:
            sheet: The sheet of any of the groups; None: the first sheet of radiance.

        Raises:
            WlmError: The model has no such sheet.
        """
        wanted = sheet or first_light(self.sheets)
        if not (found := in_groups(self.sheets, wanted)):
            raise WlmError(f"{self.name}: expected a sheet of the model, got {wanted.plain.label}")
        return {one.group: own for one, own in found.items()}
