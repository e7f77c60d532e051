"""Encoding of tiles as frames: plain BC7 at each time, for tiles where a network would not be smaller.

A frame stores a level from 0 to 1 for each channel of each texel, between the tile's least and greatest colour at the
frame's time, in gamma space:

    colour = least + level (greatest - least),     radiance = colour ** gamma

This is how engines store lightmaps in BC7, so that even a set with few times is about as small and exact as theirs.
Unlike a network with its maps, frames take bytes in proportion to the number of times.
"""

import importlib.util
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from wlm.bundle import Texture
from wlm.errors import WlmError, counted
from wlm.formats import bc7
from wlm.formats.folder import rounded
from wlm.lightmap.encodings.base import DeviceTiles, Encoding, side_by_side
from wlm.lightmap.encodings.maps import tile_bytes
from wlm.lightmap.model import BLOCKS, SheetModel
from wlm.lightmap.profile import Profile
from wlm.lightmap.tiles import TILE, TileKind
from wlm_kernels.lightmap import frames as frame_kernels

EXTRA = "frames"
"""Name of the extra (`pip install 'wlm[frames]'`) that installs the BC7 encoder."""

_ENCODER = "ispc_texcomp"
_RANGE_BYTES = 2 * 3 * 2  # two half floats for each channel of a frame


def missing_encoder(count: int) -> str | None:
    """Returns a warning about `count` tiles that would be stored as frames, or None if the encoder is installed."""
    if importlib.util.find_spec(_ENCODER) is not None:
        return None
    return (
        f"{counted(count, 'tile')} would take no more bytes as BC7 frames, but {_ENCODER} is missing, so networks are "
        f"fitted to them; needs the extra: pip install 'wlm[{EXTRA}]'"
    )


def choose_frames(kinds: np.ndarray, times: int, profile: Profile) -> np.ndarray:
    """Returns which of N tiles, of the given `TileKind`s and number of stored times, are stored as frames, see
    `Profile.frames`, bool [N]."""
    smaller = times * (TILE * TILE + _RANGE_BYTES) <= tile_bytes(profile)
    return (kinds == TileKind.DYNAMIC) & (profile.frames == "always" or (profile.frames == "auto" and smaller))


def encode_frames(colour: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Encodes the frames of a tile at T times: colour float32 [T, 128, 128, 3], in gamma space, gaps filled.

    `valid`, bool [128, 128], is true where a texel of the tile is valid. Returns BC7 blocks, uint8 [T, 32, 32, 16], and
    the least and greatest colour of each frame, float16 [T, 2, 3].
    """
    texels = colour[:, valid]
    ranges = np.stack([round_half(texels.min(1), -np.inf), round_half(texels.max(1), np.inf)], 1)
    least, greatest = ranges.astype(np.float32).swapaxes(0, 1)[:, :, None, None]
    span = np.where(greatest > least, greatest - least, np.float32(1.0))
    levels = np.clip((colour - least) / span, 0.0, 1.0).reshape(-1, TILE, 3)
    blocks = bc7.encode_image((levels * 255.0 + 0.5).astype(np.uint8), EXTRA)
    return blocks.reshape(len(colour), BLOCKS, BLOCKS, -1), ranges


def round_half(values: np.ndarray, toward: float) -> np.ndarray:
    """Rounds values to half floats toward `toward`: infinity for upper bounds, minus infinity for lower bounds."""
    nearest = values.astype(np.float16)
    wrong = nearest > values if toward < 0 else nearest < values
    return np.where(wrong, np.nextafter(nearest, np.float16(toward)), nearest)


def bc7_tables(device: str) -> frame_kernels.Tables:
    """Uploads the tables of the BC7 format to a device."""
    tables = frame_kernels.Tables()
    tables.modes = wp.array(bc7.MODES, dtype=int, device=device)
    tables.partitions = wp.array(bc7.PARTITIONS, dtype=wp.uint32, device=device)
    tables.anchors = wp.array(bc7.ANCHORS, dtype=int, device=device)
    tables.shares = wp.array(bc7.SHARES, dtype=int, device=device)
    return tables


class FrameTiles(DeviceTiles):
    """The tiles of a sheet that are stored as frames, on a device."""

    def __init__(self, sheet: SheetModel, device: str) -> None:
        """Uploads the frames of a sheet."""
        super().__init__(sheet.numbers(TileKind.FRAMES))
        if not len(self.numbers):
            raise WlmError(f"{sheet.name}: expected at least one tile that is stored as frames, found none")
        self._axis, self._device = sheet.axis, device
        ends = sheet.ranges.astype(np.float32).reshape(-1, 2, 3)
        words = np.ascontiguousarray(sheet.frames).view("<u8").reshape(-1, BLOCKS, BLOCKS, 2)
        stored = frame_kernels.StoredFrames()
        stored.blocks = wp.array(words, dtype=wp.uint64, device=device)
        stored.least = wp.array(np.ascontiguousarray(ends[:, 0]), dtype=wp.vec3, device=device)
        stored.span = wp.array(np.ascontiguousarray(ends[:, 1] - ends[:, 0]), dtype=wp.vec3, device=device)
        stored.times, stored.gamma = len(sheet.times), sheet.profile.gamma
        stored.tables = bc7_tables(device)
        self._stored = stored
        self.device_bytes = sum(array.capacity for array in (stored.blocks, stored.least, stored.span))

    def decode(self, time: float, rows: wp.array, out: wp.array) -> None:
        """Decodes the tiles `rows`, int [k], indices into `numbers`, with one kernel launch, which a CUDA graph can
        capture. Their radiance is written to `out`, vec3 [k, 128, 128]; between two stored times it is interpolated
        (neural-dynamic-gi, eq. 2)."""
        frame_kernels.decode(self._stored, *self._axis.neighbours(time), rows, out)

    def radiance(self, rows: np.ndarray, time: float) -> np.ndarray:
        out = wp.empty((len(rows), TILE, TILE), dtype=wp.vec3, device=self._device)
        self.decode(time, wp.array(rows, dtype=int, device=self._device), out)
        return out.numpy()


class Frames(Encoding):
    """Stores a tile as BC7 blocks at each time."""

    kind = TileKind.FRAMES

    def packed_size(self, sheet: SheetModel, number: int) -> int:
        return len(sheet.times) * TILE * TILE

    def pack(self, sheet: SheetModel, number: int) -> bytes:
        blocks = sheet.frames[sheet.row(number)]
        _check_modes(blocks, number)
        return blocks.tobytes()

    def unpack(self, sheet: SheetModel, number: int, data: np.ndarray) -> None:
        blocks = sheet.frames[sheet.row(number)]
        blocks[...] = data.reshape(blocks.shape)
        _check_modes(blocks, number)

    def upload(self, sheet: SheetModel, device: str, gelu: str) -> list[DeviceTiles]:
        return [FrameTiles(sheet, device)] if len(sheet.frames) else []

    def textures(self, sheet: SheetModel) -> dict[str, Texture]:
        if not len(sheet.frames):
            return {}
        made = [side_by_side(images, "BC7_UNORM", TILE, TILE) for images in sheet.frames.swapaxes(0, 1)]
        data = np.stack([layer["data"] for layer in made])
        return {"frames": Texture(**made[0] | {"data": data}, layers=len(made))}

    def describe(self, sheet: SheetModel, number: int) -> dict[str, Any]:
        row = sheet.row(number)
        least, greatest = sheet.ranges[row].swapaxes(0, 1)
        ends = {"least": rounded(least), "greatest": rounded(greatest), "peak": rounded(greatest.max(1))}
        return {"image": row} | ends

    def fill_records(self, sheet: SheetModel, times: Sequence[float], records: np.ndarray) -> None:
        numbers = sheet.numbers(TileKind.FRAMES)
        for table, time in zip(records, times, strict=True):
            before, after, share = sheet.axis.neighbours(time)
            table[numbers, 0, 1], table[numbers, 0, 3] = np.arange(len(numbers)), share
            for first, image in ((1, before), (3, after)):
                table[numbers, first, :3], table[numbers, first + 1, :3] = sheet.ranges[:, image].swapaxes(0, 1)
                table[numbers, first, 3] = image


def _check_modes(blocks: np.ndarray, number: int) -> None:
    if (blocks[..., 0] == 0).any():  # the modes 0 to 7 set one of the bits
        raise WlmError(f"frames: tile {number}: expected BC7 blocks of modes 0 to 7, found a reserved mode")
