"""Decodes to 32 bits per texel at run time: all data stays on the device, and a decode only launches kernels.

`wlm.lightmap.Decoder` returns arrays on the host; the decoders of this module are for a renderer's loop. Each decodes
the tiles of one kind of one sheet, without filling gaps between charts: an `ExactDecoder`, on CUDA a `MatrixDecoder`
for dynamic tiles, and a `FrameDecoder`.

`MapDecoder` combines them to fill one texture with the whole map: RGB9E5, which needs no bounds, so that a filter may
read across two tiles. It adds light groups, fills gaps between charts, and its mips average only texels inside charts.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from wlm.errors import WlmError
from wlm.formats.shared_exponent import unpack_rgb9e5
from wlm.lightmap.decode import device_of, gelu_of
from wlm.lightmap.encodings.base import inverse_of, rgba
from wlm.lightmap.encodings.constant import ConstantTiles
from wlm.lightmap.encodings.frames import FrameTiles
from wlm.lightmap.encodings.maps import MapTiles
from wlm.lightmap.groups import Weight, changed_weights
from wlm.lightmap.model import SheetModel
from wlm.lightmap.sheet import BASE
from wlm.lightmap.tiles import TILE, TileKind
from wlm.texels import near_gaps
from wlm_kernels.lightmap import decode as decode_kernels
from wlm_kernels.lightmap import matrix_decode, output, texture


class RuntimeDecoder:
    """Base class: decodes all tiles of one kind on a device at a time that `set_time` chooses.

    `decode` writes `out`, `wp.array` uint32 [n, 128, 128], in the order of the tiles' `numbers`: 8-bit RGBA with R in
    the lowest byte and alpha 255; or RGB9E5.
    """

    _tiles: MapTiles | FrameTiles

    def __init__(self, model: SheetModel, device: str, shared: bool) -> None:
        """Allocates the output: RGB9E5 if `shared`, else 8-bit RGBA. The time is initially the first stored one."""
        self.model, self.device, self.shared = model, device, shared
        self.numbers = self._tiles.numbers
        self._rows = wp.array(np.arange(len(self.numbers), dtype=np.int32), dtype=int, device=device)
        self.out = self._empty()
        self.set_time(float(model.times[0]))

    def _empty(self) -> wp.array:
        return wp.zeros((len(self.numbers), TILE, TILE), dtype=wp.uint32, device=self.device)

    def set_time(self, time: float) -> None:
        """Sets the time of the following decodes, in the unit of the set's times, stored or between; see
        `wlm.lightmap.decode.SheetDecoder`.

        A CUDA graph that was captured before must be captured again, because the position on the time axis is an
        argument of the launches. Between two stored times, each decode decodes the light of both times and
        interpolates. A renderer that keeps the light of both and interpolates by itself only has to decode once for
        each stored time.
        """
        raise NotImplementedError

    def decode(self) -> None:
        """Decodes all tiles into `out`. It only launches kernels, so that a CUDA graph can capture it."""
        raise NotImplementedError

    def numpy(self) -> np.ndarray:
        """Returns the decoded tiles: RGBA, uint8 [n, 128, 128, 4]; for RGB9E5 radiance, float32 [n, 128, 128, 3]."""
        return unpack_rgb9e5(self.out.numpy()) if self.shared else rgba(self.out)

    @property
    def bounds(self) -> np.ndarray:
        """Bound of each tile's 8-bit colours, float32 [n]: radiance = (byte / 255 * bound) ** gamma."""
        return self._tiles.bounds(self._time).copy()


class _MapDecoder(RuntimeDecoder):
    """Base class of the decoders of static or dynamic tiles."""

    def __init__(
        self,
        model: SheetModel,
        device: str = "cpu",
        gelu: str | None = None,
        kind: TileKind = TileKind.DYNAMIC,
        shared: bool = False,
    ) -> None:
        """Uploads the tiles of one kind, STATIC or DYNAMIC, and allocates all buffers; the time is initially the first
        stored one.

        `gelu` is a variant to use instead of the model's, see `wlm_kernels.mlp`; with `shared`, texels are linear
        radiance as RGB9E5 instead of 8-bit colour relative to `bounds`.
        """
        device, self.gelu = device_of(device), gelu_of(model, gelu)
        self._tiles = MapTiles(model, kind, device, self.gelu)
        self._states: list[decode_kernels.TimeState | None] = [None, None]
        super().__init__(model, device, shared)

    def set_time(self, time: float) -> None:
        self._time, self._reads = time, self.model.axis.reads(time)
        for i, (stamp, _) in enumerate(self._reads):
            self._states[i] = self._tiles.state(stamp, self._states[i])


class MatrixDecoder(_MapDecoder):
    """Fast decoder of dynamic tiles on a GPU's matrix units (tensor cores), in half floats, with GELU by its tanh form.

    A decode is one launch, also between two stored times.
    """

    def __init__(self, model: SheetModel, device: str = "cuda", shared: bool = False) -> None:
        """Uploads the dynamic tiles of a sheet; for the arguments see `ExactDecoder`."""
        name, profile = device_of(device), model.profile
        if name == "cpu":
            raise WlmError("device: expected cuda for MatrixDecoder, got cpu")
        if profile.hidden % 16:
            raise WlmError(f"model: expected networks whose hidden width is a multiple of 16, got {profile.hidden}")
        super().__init__(model, name, "fast", TileKind.DYNAMIC, shared)
        self._kernels = matrix_decode.matrix_kernels(profile.hidden, profile.uvt_resolution, shared)
        _, hidden, output_layers = self._tiles.arguments
        n = len(self.numbers)
        packed = matrix_decode.pack_networks(
            hidden.numpy().reshape(n, -1, profile.hidden), output_layers.numpy().reshape(n, -1, 3)
        )
        self._packed = wp.array(packed, dtype=wp.uint32, device=self.device)

    def decode(self) -> None:
        (stored, hidden, _), places = self._tiles.arguments, self._tiles.places
        states = self._states[: len(self._reads)]
        share = self._reads[1][1] if len(states) == 2 else 0.0
        self._kernels.decode(stored, self._packed, hidden, states, share, places, self._rows, self.out)


class ExactDecoder(_MapDecoder):
    """Plain decoder of static or dynamic tiles: a thread decodes a texel, in the training's order of operations.

    Between two stored times, a last kernel interpolates the results of both.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._early, self._late = self._empty(), self._empty()

    def decode(self) -> None:
        early, late = self._states
        if len(self._reads) == 1:
            self._launch(early, self.out)
            return
        self._launch(early, self._early)
        self._launch(late, self._late)
        share, arrays = self._reads[1][1], (self._early, self._late, self.out)
        if self.shared:
            *both, out = (array.flatten() for array in arrays)
            output.blend_shared(*both, share, out)
        else:
            *both, out = (array.reshape((len(self.numbers), -1)) for array in arrays)
            output.blend(*both, early.inverse_peak, late.inverse_peak, share, self.model.profile.gamma, out)

    def _launch(self, state: decode_kernels.TimeState, out: wp.array) -> None:
        self._tiles.launch(state, self._rows, 1 + self.shared, out)


class FrameDecoder(RuntimeDecoder):
    """Decoder of tiles that are stored as frames: one thread reads one texel of one frame, or of two to interpolate."""

    def __init__(self, model: SheetModel, device: str = "cpu", shared: bool = False) -> None:
        """Uploads the frames of a sheet and allocates all buffers; for the arguments see `ExactDecoder`."""
        device = device_of(device)
        self._tiles = FrameTiles(model, device)
        self._inverse = wp.empty(len(self._tiles.numbers), dtype=float, device=device)
        super().__init__(model, device, shared)

    def set_time(self, time: float) -> None:
        self._time = time
        self._inverse.assign(inverse_of(self._tiles.bounds(time)))

    def decode(self) -> None:
        self._tiles.decode(self._time, self._rows, self.out, None if self.shared else self._inverse)


def fast_decoder(model: SheetModel, device: str = "cpu", shared: bool = False) -> ExactDecoder | MatrixDecoder:
    """Makes the fastest decoder of dynamic tiles: on CUDA a `MatrixDecoder` if network width and GELU allow it."""
    device = device_of(device)
    tanh = device != "cpu" and model.profile.gelu == "tanh"
    if tanh and model.profile.hidden % 16 == 0:
        return MatrixDecoder(model, device, shared)
    return ExactDecoder(model, device, "fast" if tanh else None, shared=shared)


def runtime_decoders(model: SheetModel, device: str = "cpu", shared: bool = False) -> list[RuntimeDecoder]:
    """Makes the fastest decoder of each kind of tile that a sheet has; constant tiles need none."""
    decoders: list[RuntimeDecoder] = []
    if (model.kind == TileKind.DYNAMIC).any():
        decoders.append(fast_decoder(model, device, shared))
    if (model.kind == TileKind.STATIC).any():
        decoders.append(ExactDecoder(model, device, kind=TileKind.STATIC, shared=shared))
    if (model.kind == TileKind.FRAMES).any():
        decoders.append(FrameDecoder(model, device, shared))
    return decoders


class MapDecoder:
    """Decodes all tiles of a map into one texture and its mips, and adds its light groups by their weights.

    The decoded tiles of each group stay in memory, so that a change of weights alone needs only `add`, no other decode.
    A group with one stored time, such as a lamp, is decoded once, when the decoder is made.

    Attributes:
        groups: The sheet of each light group by name.
        weights: float32 [3] by group, the factors of red, green and blue; initially 1. Changed by `set_weights`.
        levels: `wp.array` uint32 [h, w] each, RGB9E5, written by `decode`: the map, then mips of half the size, rounded
            down. A mip texel is the mean of the valid texels that it covers, in tiles that are not empty; texels in
            gaps within `wlm.texels.REACH` of a valid texel have the light of the nearest valid one of the same level.
        decoders: The decoder of each kind of tile, group by group.
    """

    def __init__(
        self, model: SheetModel | Mapping[str, SheetModel], device: str = "cpu", mips: int | None = None
    ) -> None:
        """Uploads a map and allocates all buffers; the time is initially the first stored one.

        `model` is the sheet, or the sheet of each light group, as `LightmapModel.maps` returns them, which share size
        and mask. `mips` counts the mips besides the map itself; None: down to one texel.
        """
        self.device = device_of(device)
        self.groups = {BASE: model} if isinstance(model, SheetModel) else dict(model)
        self._first = first = next(iter(self.groups.values()))
        for name, own in self.groups.items():
            if (own.height, own.width) != (first.height, first.width):
                raise WlmError(f"{name}: expected a map of {first.width}x{first.height}, got {own.width}x{own.height}")
        most = max(first.height, first.width).bit_length() - 1
        if mips is not None and not 0 <= mips <= most:
            raise WlmError(f"mips: expected 0 to {most} for a map of {first.width}x{first.height}, got {mips}")
        self.decoders: list[RuntimeDecoder] = []
        self._fill_slots()
        self._allocate(most if mips is None else mips)
        self.weights = {name: np.ones(3, np.float32) for name in self.groups}
        self._factors = wp.ones(len(self.groups), dtype=wp.vec3, device=self.device)
        self.set_time(float(first.times[0]))
        for decoder in self.decoders:
            decoder.decode()

    def _fill_slots(self) -> None:
        """Makes the decoders of all groups, and the table of where the tiles of each are found, see `texture.add`."""
        stored = np.flatnonzero(np.any([own.kind != TileKind.EMPTY for own in self.groups.values()], axis=0))
        slots = np.full((len(self._first.kind), len(self.groups)), -1, np.int32)
        self._constant, made, colours = [], 0, 1
        for group, own in enumerate(self.groups.values()):
            for decoder in runtime_decoders(own, self.device, shared=True):
                self.decoders.append(decoder)
                slots[decoder.numbers, group] = made + np.arange(len(decoder.numbers))
                made += len(decoder.numbers)
            constant = ConstantTiles(own)
            self._constant.append(constant)
            slots[constant.numbers, group] = -1 - colours - np.arange(len(constant.numbers))
            colours += len(constant.numbers)
        self._decoded = wp.zeros((made, TILE, TILE), dtype=wp.uint32, device=self.device)
        start = 0
        for decoder in self.decoders:
            decoder.out = self._decoded[start : start + len(decoder.numbers)]
            start += len(decoder.numbers)
        self._colours = wp.zeros(colours, dtype=wp.vec3, device=self.device)
        self._slots = wp.array(slots[stored], dtype=int, device=self.device)
        self._corners = self._vectors(np.array([self._first.grid.origin(n) for n in stored.tolist()]).reshape(-1, 2))

    def _allocate(self, mips: int) -> None:
        self.levels, self._coverage, self._gaps = [], [], []
        coverage = self._first.mask.astype(np.float32)
        # Valid texels of tiles that no group stores would darken mips.
        empty = np.all([own.kind == TileKind.EMPTY for own in self.groups.values()], axis=0)
        for number in np.flatnonzero(empty).tolist():
            coverage[self._first.grid.window(number)] = 0.0
        for level in range(mips + 1):
            if level:
                coverage = _halved(coverage)
            self.levels.append(wp.zeros(coverage.shape, dtype=wp.uint32, device=self.device))
            self._coverage.append(wp.array(coverage, dtype=float, device=self.device))
            self._gaps.append([self._vectors(at) for at in near_gaps(coverage > 0)])

    def _vectors(self, at: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(at, np.int32), dtype=wp.vec2i, device=self.device)

    def set_time(self, time: float) -> None:
        """Sets the time of the following decodes; a CUDA graph captured before must be captured again.

        Args:
            time: In the unit of the set's times, stored or between; see `wlm.lightmap.decode.SheetDecoder`.
        """
        for decoder in self.decoders:
            decoder.set_time(time)
        lacking = np.zeros((1, 3), np.float32)
        self._colours.assign(
            np.concatenate([lacking, *(own.colours(time) for own in self._constant)]).astype(np.float32)
        )

    def set_weights(self, weights: Mapping[str, Weight]) -> None:
        """Sets the weights of some groups for the following decodes, see `wlm.lightmap.Decoder.set_weights`.

        The weights are an array on the device: a CUDA graph that was captured before uses the new ones.
        """
        self.weights = changed_weights(self._first.name, self.weights, weights)
        self._factors.assign(np.stack(list(self.weights.values())))

    def decode(self) -> None:
        """Decodes the map into `levels`; it only launches kernels and allocates nothing: CUDA graphs can capture it."""
        for decoder in self.decoders:
            if len(decoder.model.times) > 1:
                decoder.decode()
        self.add()

    def add(self) -> None:
        """Adds the groups as they were last decoded into `levels`: all that a change of weights alone needs.

        It only launches kernels, as `decode` does.
        """
        if len(self._corners):
            texture.add(self._decoded, self._colours, self._slots, self._factors, self._corners, self.levels[0])
        for i, (level, (target, source)) in enumerate(zip(self.levels, self._gaps, strict=True)):
            if i:
                texture.halve(self.levels[i - 1], self._coverage[i - 1], level)
            if len(target):
                texture.fill(target, source, level)

    def numpy(self, level: int = 0) -> np.ndarray:
        """Copies a level (0: the map, 1: the first mip) to the host: linear radiance, float32 [h, w, 3]."""
        return unpack_rgb9e5(self.levels[level].numpy())


def _halved(weight: np.ndarray) -> np.ndarray:
    """Sums blocks of 2x2 texels of an image [h, w]; if a side is odd, its last blocks are three texels long."""
    for axis in (0, 1):
        starts = np.arange(max(weight.shape[axis] // 2, 1)) * 2
        weight = np.add.reduceat(weight, starts, axis)
    return weight
