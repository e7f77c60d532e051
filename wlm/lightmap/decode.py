"""The runtime path: any tile at any time, or a whole frame, from the stored bytes alone."""

from collections.abc import Sequence

import numpy as np
import warp as wp

from wlm import interop
from wlm.errors import WlmError
from wlm.lightmap.model import TILE, LightmapModel, decode_scale
from wlm.lightmap.tiles import TileGrid, TileKind, assemble
from wlm_kernels.lightmap import decode as lightmap_decode
from wlm_kernels.mlp import GELUS

__all__ = ["Decoder"]


class Decoder:
    """Holds a model's stored bytes on a device and decodes from them.

    At times between the stored ones the features, the scales and the bounds are interpolated, so that light moves
    smoothly; times outside the day wrap round, or stop at the first and last where the set isn't periodic.
    """

    def __init__(self, model: LightmapModel, device: str = "cpu", gelu: str | None = None):
        """Uploads a model.

        Args:
            model: From ``codec.read`` or ``fit.compress``.
            device: "cpu" or "cuda:0".
            gelu: Another GELU than the one that the model was trained with, for speed; None: its own.

        Raises:
            WlmError: On a device or a GELU that isn't there.
        """
        self.model, self.device = model, interop.check_device(device)
        self.gelu = gelu or model.profile.gelu
        if self.gelu not in GELUS:
            raise WlmError(f"gelu: expected one of {', '.join(GELUS)}, got {self.gelu!r}")
        self._axis = model.axis
        self._grid = TileGrid.of(model.height, model.width)
        self._scale = model.scales
        self._peak = decode_scale(model.peak, model.profile.gamma)
        mapped = np.flatnonzero(model.kind >= TileKind.STATIC)
        kinds = model.kind[mapped]
        self._groups = {}
        for kind in (TileKind.DYNAMIC, TileKind.STATIC):
            rows = np.flatnonzero(kinds == kind)
            if len(rows):
                self._groups[kind] = _Group(model, kind, mapped[rows], rows, self.device, self.gelu)
        self._constants = {int(tile): i for i, tile in enumerate(np.flatnonzero(model.kind == TileKind.CONSTANT))}

    @property
    def device_bytes(self) -> int:
        """Memory that the maps and networks take up on the device, in bytes: what a runtime keeps resident."""
        return sum(array.capacity for group in self._groups.values() for array in group.arrays)

    def tile(self, number: int, time: float, border: int = 0) -> np.ndarray:
        """Decodes one tile.

        Args:
            number: Of the tile in the grid, row-major.
            time: In the unit of the set's times.
            border: Texels added on each side, mirrored (section 9), so that a texture of tiles can be filtered.

        Returns:
            Linear radiance, float32 [128 + 2 border, 128 + 2 border, 3].

        Raises:
            WlmError: There is no such tile, the time isn't finite, or the border isn't in 0..128.
        """
        self._grid.origin(number)
        if not 0 <= border <= TILE:
            raise WlmError(f"border: expected 0 to {TILE} texels, got {border}")
        tile = self.tiles([number], time)[0]
        return np.pad(tile, ((border, border), (border, border), (0, 0)), mode="symmetric")

    def tiles(self, numbers: Sequence[int], time: float) -> np.ndarray:
        """Decodes tiles to linear radiance, float32 [n, 128, 128, 3]; empty ones are 0."""
        out = np.zeros((len(numbers), TILE, TILE, 3), np.float32)
        before, after, share = self._neighbours(time)
        for i, number in enumerate(numbers):
            if number in self._constants:
                row = self.model.constant[self._constants[number]].astype(np.float32)
                out[i] = (1.0 - share) * row[before] + share * row[after]
        self._decode(numbers, time, out, as_bytes=False)
        return out

    def tiles_8bit(self, numbers: Sequence[int], time: float) -> tuple[np.ndarray, np.ndarray]:
        """Decodes tiles to what a texture cache holds.

        Returns:
            uint8 [n, 128, 128, 4] and the bound b, float32 [n]: radiance = (byte / 255 * b) ** gamma. Alpha is 255,
            0 in empty tiles.
        """
        out = np.zeros((len(numbers), TILE, TILE, 4), np.uint8)
        peak = np.zeros(len(numbers), np.float32)
        before, after, share = self._neighbours(time)
        bounds = self._bounds(time)
        gamma = self.model.profile.gamma
        for i, number in enumerate(numbers):
            if number in self._constants:
                row = self.model.constant[self._constants[number]].astype(np.float32)
                colour = ((1.0 - share) * row[before] + share * row[after]) ** (1.0 / gamma)
                peak[i] = colour.max()
                if peak[i] > 0:
                    out[i, ..., :3] = np.floor(colour / peak[i] * 255.0 + 0.5)
                out[i, ..., 3] = 255
        for group in self._groups.values():
            for i, number in enumerate(numbers):
                if number in group.place:
                    peak[i] = bounds[group.rows[group.place[number]]]
        self._decode(numbers, time, out, as_bytes=True)
        return out, peak

    def frame(self, time: float) -> np.ndarray:
        """Decodes the whole map to linear radiance, float32 [H, W, 3]; texels of empty tiles are 0."""
        numbers = np.arange(self._grid.count)
        return assemble(self.tiles(numbers.tolist(), time), numbers, self._grid)

    def frame_8bit(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Decodes the whole map to 8 bits: uint8 [H, W, 4], and the bound of each tile, float32 [tiles]."""
        numbers = np.arange(self._grid.count)
        tiles, peak = self.tiles_8bit(numbers.tolist(), time)
        return assemble(tiles, numbers, self._grid), peak

    def _neighbours(self, time: float) -> tuple[int, int, float]:
        if not np.isfinite(time):
            raise WlmError(f"time: expected a finite number, got {time}")
        return self._axis.neighbours(time)

    def _bounds(self, time: float) -> np.ndarray:
        """Bound of each mapped tile; between two times the larger, since a texel may follow either."""
        before, after, share = self._neighbours(time)
        return self._peak[:, before] if share == 0 else np.maximum(self._peak[:, before], self._peak[:, after])

    def look(self, time: float) -> lightmap_decode.Look:
        """The kernel's view of a time; its arrays cover the mapped tiles in order of their numbers."""
        before, after, share = self._neighbours(time)
        bounds = self._bounds(time)
        inverse = np.divide(1.0, bounds, out=np.zeros_like(bounds), where=bounds > 0)
        scale = (1.0 - share) * self._scale[:, before] + share * self._scale[:, after]
        affine = self.model.affine.astype(np.float32)
        look = lightmap_decode.Look()
        look.tau = self._axis.place(time)
        look.encoding = wp.vec4(*self._axis.encode(time))
        look.gamma = self.model.profile.gamma
        look.scale = wp.array(scale.astype(np.float32), dtype=wp.vec3, device=self.device)
        look.inverse_peak = wp.array(inverse, dtype=float, device=self.device)
        look.shift = wp.array(np.ascontiguousarray(affine[:, 0]), dtype=wp.vec3, device=self.device)
        look.spread = wp.array(np.ascontiguousarray(affine[:, 1]), dtype=wp.vec3, device=self.device)
        return look

    def _decode(self, numbers: Sequence[int], time: float, out: np.ndarray, as_bytes: bool) -> None:
        if not self._groups:
            return
        look = self.look(time)
        for group in self._groups.values():
            wanted = [i for i, number in enumerate(numbers) if number in group.place]
            if wanted:
                out[wanted] = group.decode([group.place[numbers[i]] for i in wanted], look, as_bytes)


class _Group:
    """The stored tiles of one kind on a device."""

    def __init__(self, model: LightmapModel, kind: TileKind, numbers, rows, device: str, gelu: str):
        """``numbers``: of the tiles in the grid; ``rows``: their places among the mapped tiles."""
        self.rows, self.device = rows, device
        self.place = {int(number): i for i, number in enumerate(numbers)}
        self.stored, self.hidden, self.output = upload(model, kind, rows, device)
        dynamic = kind == TileKind.DYNAMIC
        maps = ("uv", "uvt", "ut", "vt") if dynamic else ("uv",)
        self.arrays = [*(getattr(self.stored, name) for name in maps), self.hidden, self.output]
        self._kernels = lightmap_decode.exact_kernels(dynamic, model.profile.hidden, gelu)

    def decode(self, places: list[int], look: lightmap_decode.Look, as_bytes: bool) -> np.ndarray:
        tiles = wp.array(np.array(places, np.int32), dtype=int, device=self.device)
        rows = wp.array(self.rows.astype(np.int32), dtype=int, device=self.device)
        out = wp.empty((len(places), TILE, TILE), dtype=wp.vec4ub if as_bytes else wp.vec3, device=self.device)
        wp.launch(
            self._kernels[int(as_bytes)],
            out.shape,
            inputs=[self.stored, self.hidden, self.output, look, rows, tiles],
            outputs=[out],
            device=self.device,
        )
        return out.numpy()


def upload(model: LightmapModel, kind: TileKind, rows: np.ndarray, device: str):
    """Puts the tiles of one kind on a device.

    Args:
        model: The model.
        kind: DYNAMIC or STATIC.
        rows: The tiles' places among the mapped ones, all of that kind.
        device: The device.

    Returns:
        ``Stored``, hidden vecH [N, I + H + 2] and output vec3 [N, H + 1].
    """
    profile = model.profile
    dynamic = kind == TileKind.DYNAMIC
    stored = lightmap_decode.Stored()
    stored.slices, stored.periodic = profile.uvt_slices, int(model.axis.periodic)

    def blocks(values: np.ndarray) -> wp.array:
        words = np.ascontiguousarray(values).view("<u8")
        return wp.array(words.reshape(-1, *words.shape[-3:]), dtype=wp.uint64, device=device)

    stored.uv = blocks(model.uv[rows])
    if dynamic:
        stored.uvt = blocks(model.uvt)
        stored.ut = wp.array(np.ascontiguousarray(model.ut), dtype=wp.vec2ub, device=device)
        stored.vt = wp.array(np.ascontiguousarray(model.vt), dtype=wp.vec2ub, device=device)
    net = (model.net if dynamic else model.net_static).astype(np.float32)
    split = (profile.inputs(dynamic) + profile.hidden + 2) * profile.hidden
    vec_hidden = wp.types.vector(profile.hidden, float)
    hidden = np.ascontiguousarray(net[:, :split]).reshape(len(net), -1, profile.hidden)
    output = np.ascontiguousarray(net[:, split:]).reshape(len(net), -1, 3)
    return (
        stored,
        wp.array(hidden, dtype=vec_hidden, device=device),
        wp.array(output, dtype=wp.vec3, device=device),
    )
