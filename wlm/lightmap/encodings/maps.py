"""Encoding of dynamic tiles as the feature maps F_uv, F_uvt, F_ut and F_vt and a network.

In the file each tile is one zstd frame (`wlm.lightmap.codec`) of its maps, as a GPU holds them, and its network.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp

from wlm.bundle import Texture
from wlm.errors import WlmError
from wlm.formats.folder import rounded
from wlm.lightmap.encodings.base import DeviceTiles, Encoding, side_by_side
from wlm.lightmap.model import SheetModel, decode_scale
from wlm.lightmap.profile import Profile
from wlm.lightmap.tiles import TILE, TileKind
from wlm_kernels import mlp
from wlm_kernels.lightmap import decode as decode_kernels
from wlm_kernels.lightmap.features import INPUTS, MAP_INPUTS
from wlm_kernels.lightmap.levels import LEVELS

_SQRT_12 = math.sqrt(12.0)  # features in [0, 1] enter the network as (f - 1/2) sqrt(12)
_MODE_BITS, _MODE_6 = 127, 64  # of the first byte of a BC7 block, and their value in mode 6


# ---- sizes ----


def tile_bytes(profile: Profile) -> int:
    """Returns the bytes of the maps and the network of one tile before packing (neural-dynamic-gi, table 3)."""
    hidden = profile.hidden
    network = 2 * mlp.parameter_count(INPUTS, hidden)
    if profile.net_bits == 8:
        network = (INPUTS + hidden + 3) * hidden + 2 * 2 * (2 * hidden + 3)
    planes = 2 * 2 * profile.plane_rows * profile.plane_columns
    return TILE * TILE + profile.uvt_slices * profile.uvt_resolution**2 + planes + network


# ---- bytes of a tile in the file ----


def check_packable(parts: Mapping[str, np.ndarray], profile: Profile) -> None:
    """Raises WlmError unless a trainer's maps are BC7 mode 6 and its weights are exact in the profile's `net_bits`."""
    for name in ("uv", "uvt"):
        _check_mode(parts[name])
    if profile.net_bits == 8:
        for net in parts["net"]:
            pack_network(net, profile.hidden)


def _check_mode(blocks: np.ndarray) -> None:
    if ((blocks[..., 0] & _MODE_BITS) != _MODE_6).any():
        raise WlmError("maps: expected BC7 blocks of mode 6, found another mode")


def pack_network(net: np.ndarray, hidden: int) -> np.ndarray:
    """Packs a network with 8-bit weights into bytes: the integer weights, then the largest magnitudes and the biases.

    The weights into one unit share the largest magnitude m among them, a half float; a weight is q m / 127 with an
    integer q from -127 to 127, rounded to a half float. Biases are half floats. The fit evaluates exactly these numbers
    (`wlm_kernels.lightmap.levels`), so that the file loses nothing; a weight that is not on its level is a `WlmError`.
    """
    whole, halves = [], []
    for weights, bias in _layers(net, hidden):
        most = np.abs(weights).max(0)
        step = most.astype(np.float32) / np.float32(LEVELS)
        q = np.rint(np.divide(weights, step, out=np.zeros(weights.shape, np.float32), where=step > 0))
        if not np.array_equal((q * step).astype(np.float16), weights):
            raise WlmError("net: expected weights that 8 bits store exactly (net_bits is 8), found others")
        whole.append(q.astype(np.int8).ravel())
        halves += [most, bias]
    return np.concatenate([np.concatenate(whole).view(np.uint8), np.concatenate(halves).view(np.uint8)])


def unpack_network(data: np.ndarray, hidden: int) -> np.ndarray:
    """Inverts `pack_network`: converts its bytes to the network's parameters, float16 [P]."""
    shapes = (INPUTS, hidden), (hidden, hidden), (hidden, 3)
    count = sum(rows * units for rows, units in shapes)
    whole, halves = data[:count].view(np.int8), data[count:].view("<f2")
    parts, at, place = [], 0, 0
    for rows, units in shapes:
        most, bias = halves[place : place + 2 * units].reshape(2, units)
        step = most.astype(np.float32) / np.float32(LEVELS)
        q = whole[at : at + rows * units].reshape(rows, units).astype(np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # numbers that are not finite are refused later
            parts += [(q * step).astype(np.float16).ravel(), bias]
        at, place = at + rows * units, place + 2 * units
    return np.concatenate(parts).astype(np.float16)


def _layers(net: np.ndarray, hidden: int) -> list[tuple[np.ndarray, np.ndarray]]:
    rows, output = split_networks(net, hidden)
    return [(rows[:INPUTS], rows[INPUTS]), (rows[INPUTS + 1 : -1], rows[-1]), (output[:-1], output[-1])]


def split_networks(nets: np.ndarray, hidden: int) -> tuple[np.ndarray, np.ndarray]:
    """Splits the parameters of networks, [..., P], into hidden layers [..., 18 + H, H] and output layers
    [..., H + 1, 3], see `wlm_kernels.mlp`."""
    split = (INPUTS + hidden + 2) * hidden
    return nets[..., :split].reshape(*nets.shape[:-1], -1, hidden), nets[..., split:].reshape(*nets.shape[:-1], -1, 3)


# ---- tiles on a device ----


class MapTiles(DeviceTiles):
    """The dynamic tiles of a sheet on a device; `arguments` are the first arguments of each decode kernel: `Stored` and
    the networks, see `wlm_kernels.mlp`."""

    def __init__(self, sheet: SheetModel, device: str, gelu: str) -> None:
        """Uploads the dynamic tiles of a sheet."""
        profile = sheet.profile
        super().__init__(sheet.numbers(TileKind.DYNAMIC))
        if not len(self.numbers):
            raise WlmError(f"{sheet.name}: expected at least one dynamic tile, found none")
        self.model, self._device = sheet, device
        self._axis, self._scale = sheet.axis, sheet.scales
        affine = np.ascontiguousarray(sheet.affine.astype(np.float32).swapaxes(0, 1))
        self._shift, self._spread = (wp.array(values, dtype=wp.vec3, device=device) for values in affine)
        self._kernel = decode_kernels.exact_kernel(profile.hidden, gelu)

        def blocks(values: np.ndarray) -> wp.array:
            words = np.ascontiguousarray(values).view("<u8")
            return wp.array(words.reshape(-1, *words.shape[-3:]), dtype=wp.uint64, device=device)

        stored = decode_kernels.Stored()
        stored.slices, stored.periodic = profile.uvt_slices, int(self._axis.periodic)
        maps = {"uv": blocks(sheet.uv), "uvt": blocks(sheet.uvt)}
        for name in ("ut", "vt"):
            maps[name] = wp.array(np.ascontiguousarray(getattr(sheet, name)), dtype=wp.vec2ub, device=device)
        for name, values in maps.items():
            setattr(stored, name, values)
        hidden, output = map(np.ascontiguousarray, split_networks(sheet.net.astype(np.float32), profile.hidden))
        hidden = wp.array(hidden, dtype=wp.types.vector(profile.hidden, float), device=device)
        output = wp.array(output, dtype=wp.vec3, device=device)
        self.arguments = (stored, hidden, output)
        self.device_bytes = sum(array.capacity for array in (*maps.values(), hidden, output))

    def state(self, time: float) -> decode_kernels.TimeState:
        """Returns a time's position, encoding and tile scales for the decode kernel."""
        before, after, share = self._axis.neighbours(time)
        scale = (1.0 - share) * self._scale[:, before] + share * self._scale[:, after]
        state = decode_kernels.TimeState()
        state.gamma, state.shift, state.spread = self.model.profile.gamma, self._shift, self._spread
        state.scale = wp.array(scale.astype(np.float32), dtype=wp.vec3, device=self._device)
        state.tau, state.encoding = self._axis.place(time), wp.vec4(*self._axis.encode(time))
        return state

    def launch(self, state: decode_kernels.TimeState, rows: wp.array, out: wp.array) -> None:
        """Decodes the tiles `rows`, int [k], indices into `numbers`, in the training's order of operations, one thread
        per texel. Their radiance is written to `out`, vec3 [k, 128, 128]."""
        wp.launch(self._kernel, out.shape, inputs=[*self.arguments, state, rows], outputs=[out], device=self._device)

    def radiance(self, rows: np.ndarray, time: float) -> np.ndarray:
        reads, chosen = self._axis.reads(time), wp.array(rows, dtype=int, device=self._device)
        out = wp.empty((len(rows), TILE, TILE), dtype=wp.vec3, device=self._device)
        total = np.float32(0.0)
        for stamp, share in reads:
            self.launch(self.state(stamp), chosen, out)
            total = total + np.float32(share) * out.numpy()
        return total


# ---- textures, networks and tables of the shader ----


def fours(profile: Profile) -> int:
    """Returns how many groups of four floats hold one float per hidden unit; the last group is padded with zeros."""
    return -(-profile.hidden // 4)


def shader_networks(sheet: SheetModel) -> np.ndarray:
    """Returns all networks as the shader reads them, float32 [n, 4]: weights W and bias b of layers 1 to 3, one row of
    W per input; `network_starts` says where each network begins.

    Rows are padded with zeros to groups of four, and so are the inputs of the next layer. The shader passes features f
    as the textures hold them: their centring, (f - 1/2) sqrt(12), is part of W1 and b1.
    """
    hidden, wide = sheet.profile.hidden, 4 * fours(sheet.profile)
    made = [np.zeros((0, 4), np.float32)]
    for net in sheet.net.astype(np.float64):
        layers, output = split_networks(net, hidden)
        # W (f - 1/2) sqrt(12) + b = (sqrt(12) W) f + (b - sqrt(12)/2 W 1).
        layers[:MAP_INPUTS] *= _SQRT_12
        layers[INPUTS] -= 0.5 * layers[:MAP_INPUTS].sum(0)
        added = wide - hidden
        layers = np.insert(layers, np.full(added, len(layers) - 1), 0.0, axis=0)
        output = np.insert(output, np.full(added, hidden), 0.0, axis=0)
        rows = np.pad(layers, ((0, 0), (0, added))).reshape(-1, 4), np.pad(output, ((0, 0), (0, 1)))
        made += [part.astype(np.float32) for part in rows]
    return np.concatenate(made)


def network_fours(profile: Profile) -> int:
    """Returns the rows of each network in `shader_networks`."""
    wide = fours(profile)
    return (INPUTS + 4 * wide + 2) * wide + 4 * wide + 1


class Maps(Encoding):
    """Stores a tile as feature maps and a network."""

    kind = TileKind.DYNAMIC

    def packed_size(self, sheet: SheetModel, number: int) -> int:
        return tile_bytes(sheet.profile)

    def pack(self, sheet: SheetModel, number: int) -> bytes:
        net, maps = self._arrays(sheet, number)
        for blocks in maps[:2]:
            _check_mode(blocks)
        if sheet.profile.net_bits == 8:
            net = pack_network(net, sheet.profile.hidden)
        return b"".join(part.tobytes() for part in (*maps, net))

    def unpack(self, sheet: SheetModel, number: int, data: np.ndarray) -> None:
        net, maps = self._arrays(sheet, number)
        at = 0
        for values in maps:
            values[...] = data[at : at + values.size].reshape(values.shape)
            at += values.size
        for blocks in maps[:2]:
            _check_mode(blocks)
        rest, profile = data[at:], sheet.profile
        net[:] = rest.view("<f2") if profile.net_bits == 16 else unpack_network(rest, profile.hidden)
        if not np.isfinite(net).all():
            raise ValueError("expected finite numbers in the network, found NaN or infinity")

    def _arrays(self, sheet: SheetModel, number: int) -> tuple[np.ndarray, list[np.ndarray]]:
        """Returns the network of a tile, and its maps in their order in the file, as views of a sheet's arrays."""
        row = sheet.row(number)
        return sheet.net[row], [sheet.uv[row], sheet.uvt[row], sheet.ut[row], sheet.vt[row]]

    def upload(self, sheet: SheetModel, device: str, gelu: str) -> list[DeviceTiles]:
        return [MapTiles(sheet, device, gelu)] if len(sheet.net) else []

    def textures(self, sheet: SheetModel) -> dict[str, Texture]:
        if not len(sheet.uv):
            return {}
        side, slices = sheet.profile.uvt_resolution, sheet.uvt.reshape(-1, *sheet.uvt.shape[2:])
        planes = np.stack([sheet.ut, sheet.vt], 1).reshape(-1, *sheet.ut.shape[1:])
        made = {
            "uv": side_by_side(sheet.uv, "BC7_UNORM", TILE, TILE),
            "uvt": side_by_side(slices, "BC7_UNORM", side, side),
            "planes": side_by_side(planes, "R8G8_UNORM", *planes.shape[1:3]),
        }
        return {name: Texture(**texture) for name, texture in made.items()}

    def describe(self, sheet: SheetModel, number: int) -> dict[str, Any]:
        row, gamma = sheet.row(number), sheet.profile.gamma
        shift, spread = sheet.affine[row]
        return {
            "image": row,
            "shift": rounded(shift),
            "spread": rounded(spread),
            "scale": rounded(decode_scale(sheet.scale[row], gamma)),
            "peak": rounded(decode_scale(sheet.peak[row], gamma)),
            "network_four": row * network_fours(sheet.profile),
        }

    def fill_records(self, sheet: SheetModel, times: Sequence[float], records: np.ndarray) -> None:
        axis, wide = sheet.axis, fours(sheet.profile)
        weights = shader_networks(sheet).astype(np.float64)
        scales, affine = sheet.scales.astype(np.float64), sheet.affine.astype(np.float64)
        for row, number in enumerate(sheet.numbers(TileKind.DYNAMIC)):
            start, (shift, spread) = row * network_fours(sheet.profile), affine[row]
            layer = weights[start + MAP_INPUTS * wide : start + (INPUTS + 1) * wide].reshape(-1, wide, 4)
            for table, time in zip(records, times, strict=True):
                before, after, share = axis.neighbours(time)
                scale = (1.0 - share) * scales[row, before] + share * scales[row, after]
                record = table[number]
                record[0, 1:3] = row, start
                record[1, :3], record[2, :3] = shift * scale, spread * scale
                record[3 : 3 + wide] = layer[-1] + np.tensordot(axis.encode(time).astype(np.float64), layer[:-1], 1)
