"""The runtime path: any tile at any time, or a whole frame, from the stored bytes alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from wlm import interop
from wlm.errors import WlmError
from wlm.lightmap.frame_decode import HeldTiles, image_tiles, inverse_of
from wlm.lightmap.gaps import Gaps
from wlm.lightmap.model import TILE, LightmapModel, decode_scale
from wlm.lightmap.tiles import TileGrid, TileKind, place
from wlm_kernels.lightmap import decode as lightmap_decode
from wlm_kernels.mlp import GELUS

_PIECE = 1024  # tiles that are decoded at once: 192 MiB


class Decoder:
    """Holds a model's stored bytes on a device and decodes from them.

    Between two stored times light is the mix of their radiance (eq. 2), or what the network makes of features that are
    interpolated, see `Profile.interpolation`; frames and video are always mixed. Times outside the day wrap round, or
    stop at the first and last where the set isn't periodic. Texels of the gaps within two of a chart have the light of
    the nearest valid texel, so that a map can be filtered.
    """

    def __init__(self, model: LightmapModel, device: str = "cpu", gelu: str | None = None) -> None:
        """Uploads a model.

        Args:
            model: The model.
            device: "cpu", "cuda" or "cuda:N".
            gelu: Another GELU than the one that the model was trained with, for speed; None: the model's.

        Raises:
            WlmError: No such device or GELU.
        """
        self.model, self.device, self.gelu = model, interop.check_device(device), gelu_of(model, gelu)
        self._grid = TileGrid.of(model.height, model.width)
        self._times = TimeTable(model, self.device)
        self._groups = []
        for kind in (TileKind.DYNAMIC, TileKind.STATIC):
            if (model.kind == kind).any():
                tiles = StoredTiles(model, kind, self.device)
                kernels = lightmap_decode.exact_kernels(kind == TileKind.DYNAMIC, model.profile.hidden, self.gelu)
                self._groups.append((tiles, kernels))
        self._images = image_tiles(model, self.device)
        self._constants = {int(tile): i for i, tile in enumerate(np.flatnonzero(model.kind == TileKind.CONSTANT))}
        self._gaps = Gaps.of(model.mask)

    @property
    def device_bytes(self) -> int:
        """Memory that the maps, networks and images take up on the device, in bytes: what a runtime keeps resident."""
        return sum(tiles.device_bytes for tiles in [*(tiles for tiles, _ in self._groups), *self._images])

    def tile(self, number: int, time: float, border: int = 0) -> np.ndarray:
        """Decodes one tile.

        Args:
            number: Of the tile in the grid, row-major.
            time: In the unit of the set's times.
            border: Texels added on each side from the neighbouring tiles, so that a texture of tiles can be filtered;
                past the map's ends its last texels are mirrored (section 9).

        Returns:
            Linear radiance, float32 [128 + 2 border, 128 + 2 border, 3].

        Raises:
            WlmError: There is no such tile, the time isn't finite, or the border isn't in 0..128.
        """
        y, x = self._grid.origin(number)
        if not 0 <= border <= TILE:
            raise WlmError(f"border: expected 0 to {TILE} texels, got {border}")
        window = tuple(slice(max(at - border, 0), at + TILE + border) for at in (y, x))
        gaps = self._gaps.within(window)
        # The rows and columns that are needed: the border's, and those of the gaps' sources.
        needed = np.concatenate([[[part.start for part in window], [part.stop - 1 for part in window]], gaps.source])
        rows, columns = (
            range(max(low // TILE, 0), min(high // TILE, last - 1) + 1)
            for low, high, last in zip(needed.min(0), needed.max(0), (self._grid.rows, self._grid.cols), strict=True)
        )
        numbers = [row * self._grid.cols + column for row in rows for column in columns]
        light = self.tiles(numbers, time).reshape(len(rows), len(columns), TILE, TILE, 3).swapaxes(1, 2)
        light = light.reshape(len(rows) * TILE, len(columns) * TILE, 3)
        first = np.array([rows[0], columns[0]]) * TILE
        Gaps(gaps.target - first, gaps.source - first).fill(light)
        corner = np.array([y, x]) - border - first
        before = np.maximum(-corner, 0)
        after = np.maximum(corner + TILE + 2 * border - light.shape[:2], 0)
        light = np.pad(light, (*zip(before, after, strict=True), (0, 0)), mode="symmetric")
        top, left = corner + before
        return np.ascontiguousarray(light[top : top + TILE + 2 * border, left : left + TILE + 2 * border])

    def tiles(self, numbers: Sequence[int], time: float) -> np.ndarray:
        """Decodes tiles, gaps unfilled, to linear radiance, float32 [n, 128, 128, 3]; empty ones are 0.

        Raises:
            WlmError: The time isn't finite.
        """
        out = np.zeros((len(numbers), TILE, TILE, 3), np.float32)
        for stamp, share in self._times.reads(time):
            light = np.zeros_like(out) if share < 1.0 else out
            for i, radiance in self._constant(numbers, stamp):
                light[i] = radiance
            self._decode(numbers, stamp, light, as_bytes=False)
            if share < 1.0:
                out += np.float32(share) * light
        self._decode_images(numbers, time, out, as_bytes=False)
        return out

    def tiles_8bit(self, numbers: Sequence[int], time: float) -> tuple[np.ndarray, np.ndarray]:
        """Decodes tiles, gaps unfilled, to what a texture cache holds.

        Returns:
            uint8 [n, 128, 128, 4] and the bound b, float32 [n]: radiance = (byte / 255 * b) ** gamma. Alpha is 255,
            0 in empty tiles.

        Raises:
            WlmError: The time isn't finite.
        """
        out = np.zeros((len(numbers), TILE, TILE, 4), np.uint8)
        peak = np.zeros(len(numbers), np.float32)
        exponent = 1.0 / self.model.profile.gamma
        constant = self._constant(numbers, time)
        for i, radiance in constant:
            peak[i] = (radiance**exponent).max()
        bounds = self._times.bounds(time)
        for tiles, _ in self._groups:
            for i, row in tiles.among(numbers):
                peak[i] = bounds[tiles.rows[row]]
                out[i, ..., 3] = 255
        for tiles in self._images:
            highest = tiles.bounds(time)
            for i, row in tiles.among(numbers):
                peak[i] = highest[row]
                out[i, ..., 3] = 255
        if len(self._times.reads(time)) == 1:
            self._decode(numbers, time, out, as_bytes=True)
            self._decode_images(numbers, time, out, as_bytes=True)
        else:
            factor = inverse_of(peak)[:, None, None, None]
            out[..., :3] = np.clip(self.tiles(numbers, time) ** exponent * factor, 0.0, 1.0) * 255.0 + 0.5
        for i, radiance in constant:
            out[i, ..., :3] = np.floor(radiance**exponent / (peak[i] or 1.0) * 255.0 + 0.5)
            out[i, ..., 3] = 255
        return out, peak

    def frame(self, time: float) -> np.ndarray:
        """Decodes the whole map to linear radiance, float32 [H, W, 3]; texels of empty tiles are 0."""
        image = np.zeros((self._grid.height, self._grid.width, 3), np.float32)
        for numbers in self._held():
            place(image, self.tiles(numbers.tolist(), time), numbers, self._grid)
        self._gaps.fill(image)
        return image

    def frame_8bit(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Decodes the whole map to 8 bits: uint8 [H, W, 4], and the bound of each tile, float32 [tiles]."""
        image = np.zeros((self._grid.height, self._grid.width, 4), np.uint8)
        bounds = np.zeros(self._grid.count, np.float32)
        for numbers in self._held():
            tiles, bounds[numbers] = self.tiles_8bit(numbers.tolist(), time)
            place(image, tiles, numbers, self._grid)
        # Tiles have bounds of their own.
        target, source = (bounds[self._tile_of(at)] for at in (self._gaps.target, self._gaps.source))
        factor = np.divide(source, target, out=np.zeros_like(source), where=target > 0)
        light = image[tuple(self._gaps.source.T)][:, :3] * factor[:, None]
        image[tuple(self._gaps.target.T)] = 255
        image[..., :3][tuple(self._gaps.target.T)] = np.minimum(light, 255.0) + 0.5
        return image, bounds

    def _tile_of(self, at: np.ndarray) -> np.ndarray:
        """Numbers of the tiles of texels, rows and columns [G, 2]."""
        return at[:, 0] // TILE * self._grid.cols + at[:, 1] // TILE

    def _held(self) -> list[np.ndarray]:
        """Numbers of the tiles that aren't empty, in pieces: a large map isn't in memory twice."""
        held = np.flatnonzero(self.model.kind != TileKind.EMPTY)
        return np.split(held, range(_PIECE, len(held), _PIECE))

    def _constant(self, numbers: Sequence[int], time: float) -> list[tuple[int, np.ndarray]]:
        """The constant tiles among `numbers`: their places there and their radiance [3]."""
        before, after, share = self._times.neighbours(time)
        rows = self.model.constant.astype(np.float32)
        return [
            (i, (1.0 - share) * rows[k, before] + share * rows[k, after])
            for i, k in enumerate(map(self._constants.get, numbers))
            if k is not None
        ]

    def _decode(self, numbers: Sequence[int], time: float, out: np.ndarray, as_bytes: bool) -> None:
        if not self._groups:
            return
        state = self._times.at(time)
        for tiles, kernels in self._groups:
            chosen = tiles.among(numbers)
            if not chosen:
                continue
            places, rows = (np.array(values, np.int32) for values in zip(*chosen, strict=True))
            decoded = wp.empty((len(rows), TILE, TILE), dtype=wp.uint32 if as_bytes else wp.vec3, device=self.device)
            wp.launch(
                kernels[int(as_bytes)],
                decoded.shape,
                inputs=[*tiles.arguments, state, tiles.places, wp.array(rows, device=self.device)],
                outputs=[decoded],
                device=self.device,
            )
            out[places] = rgba(decoded) if as_bytes else decoded.numpy()

    def _decode_images(self, numbers: Sequence[int], time: float, out: np.ndarray, as_bytes: bool) -> None:
        for tiles in self._images:
            chosen = tiles.among(numbers)
            if not chosen:
                continue
            places, rows = (np.array(values, np.int32) for values in zip(*chosen, strict=True))
            decoded = wp.empty((len(rows), TILE, TILE), dtype=wp.uint32 if as_bytes else wp.vec3, device=self.device)
            inverse = None
            if as_bytes:
                inverse = wp.array(inverse_of(tiles.bounds(time)), dtype=float, device=self.device)
            tiles.decode(time, wp.array(rows, device=self.device), decoded, inverse)
            out[places] = rgba(decoded) if as_bytes else decoded.numpy()


def rgba(words: wp.array) -> np.ndarray:
    """Words of a decode to 8 bits, uint32 [...], on the host as uint8 [..., 4]."""
    host = np.ascontiguousarray(words.numpy().astype("<u4"))
    return host.view(np.uint8).reshape(*host.shape, 4)


def gelu_of(model: LightmapModel, gelu: str | None) -> str:
    """The GELU to decode with: `gelu`, or the model's for None.

    Raises:
        WlmError: There is no such GELU.
    """
    gelu = gelu or model.profile.gelu
    if gelu not in GELUS:
        raise WlmError(f"gelu: expected one of {', '.join(GELUS)}, got {gelu!r}")
    return gelu


class TimeTable:
    """What a decode takes from the time: the scales and bounds of a model's mapped tiles, and gamma(t)."""

    def __init__(self, model: LightmapModel, device: str) -> None:
        """Uploads shift and spread, which are the same at all times."""
        self._axis, self._scale, self._gamma = model.axis, model.scales, model.profile.gamma
        self._peak = decode_scale(model.peak, model.profile.gamma)
        affine = np.ascontiguousarray(model.affine.astype(np.float32).swapaxes(0, 1))
        self._shift, self._spread = (wp.array(values, dtype=wp.vec3, device=device) for values in affine)

    def neighbours(self, time: float) -> tuple[int, int, float]:
        """As `TimeAxis.neighbours`.

        Raises:
            WlmError: The time isn't finite.
        """
        if not np.isfinite(time):
            raise WlmError(f"time: expected a finite number, got {time}")
        return self._axis.neighbours(time)

    def reads(self, time: float) -> list[tuple[float, float]]:
        """As `TimeAxis.reads`.

        Raises:
            WlmError: The time isn't finite.
        """
        self.neighbours(time)
        return self._axis.reads(time)

    def bounds(self, time: float) -> np.ndarray:
        """Bound of each mapped tile, float32 [N_m]; between two times the larger, since a texel may follow either."""
        before, after, share = self.neighbours(time)
        return self._peak[:, before] if share == 0 else np.maximum(self._peak[:, before], self._peak[:, after])

    def at(self, time: float, state: lightmap_decode.TimeState | None = None) -> lightmap_decode.TimeState:
        """The state of a time, for kernels.

        Args:
            time: In the unit of the model's times.
            state: From an earlier call, to be overwritten in place; None: a new one.
        """
        before, after, share = self.neighbours(time)
        bounds = self.bounds(time)
        if state is None:
            state = lightmap_decode.TimeState()
            state.gamma, state.shift, state.spread = self._gamma, self._shift, self._spread
            state.scale = wp.empty_like(self._shift)
            state.inverse_peak = wp.empty(len(bounds), dtype=float, device=self._shift.device)
        scale = (1.0 - share) * self._scale[:, before] + share * self._scale[:, after]
        state.scale.assign(scale.astype(np.float32))
        state.inverse_peak.assign(inverse_of(bounds))
        state.tau, state.encoding = self._axis.place(time), wp.vec4(*self._axis.encode(time))
        return state


class StoredTiles(HeldTiles):
    """The stored tiles of one kind on a device.

    Attributes:
        numbers: int [n], their numbers in the grid.
        rows: int [n], their places among the model's mapped tiles.
        places: `rows` on the device.
        arguments: What each decode kernel takes first: `Stored`, hidden vecH [n, I + H + 2], output vec3 [n, H + 1].
        device_bytes: Memory that they take up on the device, bytes.
    """

    def __init__(self, model: LightmapModel, kind: TileKind, device: str) -> None:
        """Uploads the tiles of a kind, DYNAMIC or STATIC.

        Raises:
            WlmError: The model has none.
        """
        profile, dynamic = model.profile, kind == TileKind.DYNAMIC
        self.rows = np.flatnonzero(model.kind[model.mapped] == kind)
        if not len(self.rows):
            raise WlmError(f"{model.name}: expected at least one {kind.name.lower()} tile, found none")
        super().__init__(model.mapped[self.rows])
        self.places = wp.array(self.rows.astype(np.int32), dtype=int, device=device)

        def blocks(values: np.ndarray) -> wp.array:
            words = np.ascontiguousarray(values).view("<u8")
            return wp.array(words.reshape(-1, *words.shape[-3:]), dtype=wp.uint64, device=device)

        stored = lightmap_decode.Stored()
        stored.slices, stored.periodic = profile.uvt_slices, int(model.axis.periodic)
        maps = {"uv": blocks(model.uv[self.rows])}
        if dynamic:
            maps["uvt"] = blocks(model.uvt)
            for name in ("ut", "vt"):
                maps[name] = wp.array(np.ascontiguousarray(getattr(model, name)), dtype=wp.vec2ub, device=device)
        for name, values in maps.items():
            setattr(stored, name, values)
        net = (model.net if dynamic else model.net_static).astype(np.float32)
        split = (profile.inputs(dynamic) + profile.hidden + 2) * profile.hidden
        hidden = np.ascontiguousarray(net[:, :split]).reshape(len(net), -1, profile.hidden)
        output = np.ascontiguousarray(net[:, split:]).reshape(len(net), -1, 3)
        hidden = wp.array(hidden, dtype=wp.types.vector(profile.hidden, float), device=device)
        output = wp.array(output, dtype=wp.vec3, device=device)
        self.arguments = (stored, hidden, output)
        self.device_bytes = sum(array.capacity for array in (*maps.values(), hidden, output))
