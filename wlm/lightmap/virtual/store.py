"""The tiles of a light group on a device: all of them, or as many as memory is given for, loaded when needed.

All tiles are read once, when the store is made, to decode `COARSE` x `COARSE` texels of each tile at each stored time,
means of all valid texels below them.
The coarsest mip levels are read from these texels, and the change of each tile's light between stored times is computed
from them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import warp as wp

from wlm.errors import WlmError
from wlm.formats.shared_exponent import unpack_rgb9e5
from wlm.lightmap.encodings.frames import bc7_tables
from wlm.lightmap.encodings.maps import split_networks
from wlm.lightmap.loading import TileLoader
from wlm.lightmap.model import BLOCKS, PACKED_KINDS, LightmapModel, SheetModel
from wlm.lightmap.sheet import Sheet
from wlm.lightmap.tiles import TILE, TileKind
from wlm.lightmap.virtual.clock import Clock
from wlm.lightmap.virtual.layout import Layout
from wlm.texels import OFFSETS, nearest_valid
from wlm.workers import cores, each
from wlm_kernels.lightmap import decode as decode_kernels
from wlm_kernels.lightmap import frames as frame_kernels
from wlm_kernels.lightmap import matrix_pages
from wlm_kernels.lightmap import pages as kernels
from wlm_kernels.lightmap.features import INPUTS
from wlm_kernels.lightmap.matrix_network import pack_biases, pack_networks, packed_words
from wlm_kernels.lightmap.virtual import KEEP

_CHUNK = 64  # tiles that are read at once
_NOTHING = 1.0 / 1024.0  # weight of a coarse texel without a valid texel
_DARK = 0.01  # of a tile's brightest time: changes of less light than that are not relative to it
_UPLOADS = 16  # most loaded tiles that are copied to the device at once, in every second frame
_ALIGNED = 64  # bytes; the first of an array in a pool
_REQUESTS = 64  # most tiles that wait for the loader


class _Pool:
    """Device memory for tiles of one kind, in slots: `owner`, int [slots], is the tile in each slot, or -1, and
    `arrays` has the tiles' arrays by name, as parts of one memory, so that tiles are uploaded with one copy."""

    def __init__(self, shapes: dict[str, tuple[Any, tuple[int, ...]]], slots: int, device: str) -> None:
        """Allocates the slots; `shapes` has for each array its type, and its shape of one tile, whose first axis is
        that of the tile's rows."""
        self.owner = np.full(slots, -1)
        self._device, self._names = device, list(shapes)
        self._staging: wp.array | None = None
        self._records: wp.array | None = None
        sizes = [math.prod(shape) * wp.types.type_size_in_bytes(dtype) for dtype, shape in shapes.values()]
        starts = np.cumsum([0, *(-(-slots * size // _ALIGNED) * _ALIGNED for size in sizes)])
        if starts[-1] >= 2**31:
            raise WlmError(f"tiles: expected less than 2 GiB of tiles of one kind, got {starts[-1]} bytes")
        self._memory = wp.zeros(int(starts[-1]), dtype=wp.uint8, device=device)
        records = np.cumsum([0, *sizes])[:-1]
        self._parts = wp.array(np.stack([records, sizes, starts[:-1]], 1).astype(np.int32), dtype=int, device=device)
        self.arrays = {
            name: wp.array(
                ptr=(self._memory.ptr or 0) + int(start),
                dtype=dtype,
                shape=(slots * shape[0], *shape[1:]),
                device=device,
            )
            for (name, (dtype, shape)), start in zip(shapes.items(), starts, strict=False)
        }

    @property
    def memory_bytes(self) -> int:
        """Bytes on the device."""
        return self._memory.capacity + (0 if self._staging is None else self._staging.capacity)

    def free_staging(self) -> None:
        """Frees the memory through which tiles are uploaded, which has the size of the largest upload."""
        self._staging = self._records = None

    def records(self, rows: dict[str, np.ndarray]) -> np.ndarray:
        """Returns n tiles, arrays [n, ...] by name, as `put` takes them: uint8 [n, bytes]."""
        parts = [np.ascontiguousarray(rows[name]).view(np.uint8).reshape(len(rows[name]), -1) for name in self._names]
        return np.concatenate(parts, 1)

    def put(self, slots: np.ndarray, records: np.ndarray) -> None:
        """Copies n tiles, see `records`, into slots, int [n]."""
        at = wp.array(slots.astype(np.int32), dtype=int, device=self._device)
        kernels.put(self._upload(records), at, self._parts, self._memory)

    def _upload(self, records: np.ndarray) -> wp.array:
        """Copies records to the device. Host memory that CUDA may read by itself makes no frame wait for the copy."""
        if self._device == "cpu":
            return wp.array(records, dtype=wp.uint8, device="cpu", copy=False)
        if self._staging is None or len(records) > self._staging.shape[0]:
            shape = (max(len(records), _UPLOADS), records.shape[1])
            self._staging = wp.empty(shape, dtype=wp.uint8, device="cpu", pinned=True)
            self._records = wp.empty(shape, dtype=wp.uint8, device=self._device)
            self._copied = wp.Event(self._device)
        else:
            wp.synchronize_event(self._copied)  # that of an earlier frame, which is over
        count = len(records)
        self._staging.numpy()[:count] = records
        wp.copy(self._records, self._staging, count=records.size)
        wp.get_stream(self._device).record_event(self._copied)
        return self._records[:count]


class TileStore:
    """The tiles of a model of one light group on a device.

    Attributes:
        layout: The tiles and pages of the group.
        tiles: The kernels' description of all tiles.
        source: The first arguments of the kernel that decodes pages, see `wlm_kernels.lightmap.pages.decode`.
        kernel: That kernel.
        change: float32 [N, T], RMS change of each tile's light from each stored time to the next, as a share of the RMS
            light of the brighter time; 0 for the last time unless the times are periodic.
        warnings: A line for each damaged tile.
        complete: Whether all tiles are on the device.
    """

    def __init__(
        self, model: LightmapModel, layout: Layout, first: int, device: str, gelu: str, room: int | None, clock: Clock
    ) -> None:
        """Reads all tiles and uploads as many as fit into `room` bytes; for the errors see `VirtualTexture`.

        Args:
            model, layout: The sheets of the group, and their layout.
            first: Number of the group's first sheet among the sheets of all groups.
            device, gelu, room: As for `VirtualTexture`.
            clock: Clock of the group.
        """
        self._first = first
        self._model, self.layout, self._device = model, layout, device
        self.warnings: list[str] = []
        self._loader: TileLoader | None = None
        hidden = layout.models[0].profile.hidden
        # The matrix units have the GELU that is chosen for CUDA.
        self._matrix = device != "cpu" and gelu == "fast" and hidden % 16 == 0
        self.kernel = matrix_pages.page_kernel(hidden) if self._matrix else kernels.page_kernel(hidden, gelu)
        self._kind = np.concatenate([own.kind for own in layout.models]).astype(np.int32)
        self.slot = np.full(len(self._kind), kernels.WAITING, np.int32)
        self.slot[self._kind == TileKind.EMPTY] = 0
        self._pools = self._allocate(room)
        self.complete = all(len(pool.owner) == (self._kind == kind).sum() for kind, pool in self._pools.items())
        self._make_tiles()
        self.offsets = self._array(np.array([(0, 0), *OFFSETS], np.int32), wp.vec2i)
        self._read_all(clock)
        self._used = np.full(len(self.slot), -1)  # last frame in which a page needed each tile
        # The tiles of each page, the pages of each tile, and how many tiles each page lacks.
        pages = np.arange(len(layout.parent) + 1)
        self._reads = np.searchsorted(layout.reader, pages)
        order = np.argsort(layout.read, kind="stable")
        self._readers = layout.reader[order]
        self._readers_of = np.searchsorted(layout.read[order], np.arange(len(self.slot) + 1))
        waits = self.slot[layout.read] == kernels.WAITING
        self._missing = np.bincount(layout.reader[waits], minlength=len(layout.parent))
        if not self.complete:
            self._loader = TileLoader(model, _REQUESTS, self._record)

    def _array(self, values: np.ndarray, dtype: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self._device)

    def _allocate(self, room: int | None) -> dict[int, _Pool]:
        layout, own = self.layout, self.layout.models[0]
        shapes, times = _shapes(own, self._matrix), len(own.times)
        counts = {kind: int((self._kind == kind).sum()) for kind in PACKED_KINDS}
        size = {
            kind: sum(math.prod(shape) * wp.types.type_size_in_bytes(dtype) for dtype, shape in of.values())
            for kind, of in shapes.items()
        }
        total = sum(counts[kind] * size[kind] for kind in counts)
        slots = dict(counts)
        if room is not None and room < total:
            least = {kind: min(count, layout.footprint) for kind, count in counts.items()}
            slots = {kind: max(least[kind], int(count * room / total)) for kind, count in counts.items()}
            if sum(slots[kind] * size[kind] for kind in slots) > room:
                needed = sum(least[kind] * size[kind] for kind in least)
                if needed > room:
                    raise WlmError(f"tiles: expected at least {needed} bytes for the tiles of a page, got {room}")
                slots = least
        pools = {kind: _Pool(shapes[kind], slots[kind], self._device) for kind in PACKED_KINDS}
        maps = pools[TileKind.DYNAMIC].arrays
        frames = frame_kernels.StoredFrames()
        for name, array in pools[TileKind.FRAMES].arrays.items():
            setattr(frames, name, array)
        frames.tables, frames.times, frames.gamma = bc7_tables(self._device), times, 1.0  # the gamma is the sheet's
        self._stored = (self._mapped(own, maps), maps["first"], maps["later"], frames)
        return pools

    def _mapped(self, own: SheetModel, arrays: dict[str, wp.array]) -> kernels.Mapped:
        stored, mapped = decode_kernels.Stored(), kernels.Mapped()
        stored.slices, stored.periodic = own.profile.uvt_slices, int(own.axis.periodic)
        for name in ("uv", "uvt", "ut", "vt"):
            setattr(stored, name, arrays[name])
        mapped.stored = stored
        for name in ("scale", "shift", "spread"):
            setattr(mapped, name, arrays[name])
        return mapped

    def _make_tiles(self) -> None:
        layout, tiles = self.layout, kernels.Tiles()
        tiles.sheet = self._first
        sizes = np.array([(own.height, own.width) for own in layout.models], np.int32)
        tiles.size = self._array(sizes, wp.vec2i)
        tiles.first = self._array(layout.tile_first[:-1].astype(np.int32), int)
        tiles.columns = self._array(np.array([own.grid.cols for own in layout.models], np.int32), int)
        tiles.gamma = self._array(np.array([own.profile.gamma for own in layout.models], np.float32), float)
        tiles.kind = self._array(self._kind, int)
        constant = np.flatnonzero(self._kind == TileKind.CONSTANT)
        self.slot[constant] = np.arange(len(constant))
        colours = np.concatenate([own.constant.astype(np.float32) for own in layout.models])
        tiles.colours = self._array(colours, wp.vec3)
        masks, bits = zip(*(_masks(own) for own in layout.models), strict=True)
        starts = np.cumsum([0, *map(len, bits)])
        mask = [np.where(own >= 0, own + start, own) for own, start in zip(masks, starts, strict=False)]
        tiles.mask = self._array(np.concatenate(mask).astype(np.int32), int)
        tiles.bits = self._array(np.concatenate(bits), wp.uint32)
        shape = (len(self._kind), len(layout.models[0].times), kernels.COARSE**2)
        tiles.coarse = wp.zeros(shape, dtype=wp.uint32, device=self._device)
        tiles.covered = wp.zeros((shape[0], shape[2]), dtype=wp.float16, device=self._device)
        tiles.slot = self._array(self.slot, int)
        self.tiles = tiles

    @property
    def source(self) -> tuple[Any, ...]:
        return self.tiles, *self._stored

    @property
    def memory(self) -> dict[str, int]:
        """Bytes on the device: of the tiles' maps, networks and frames; of coarse texels; of masks; and of the rest."""
        tiles = self.tiles
        rest = (tiles.kind, tiles.slot, tiles.mask, tiles.colours)
        return {
            "tiles": sum(pool.memory_bytes for pool in self._pools.values()),
            "coarse": tiles.coarse.capacity + tiles.covered.capacity,
            "masks": tiles.bits.capacity,
            "tables": sum(array.capacity for array in rest),
        }

    def decode(self, clock: wp.array, offsets: wp.array, jobs: kernels.Jobs, direct: bool, out: wp.array) -> None:
        """Decodes squares of texels; for the arguments see `wlm_kernels.lightmap.pages.decode`."""
        blocks = matrix_pages.BLOCKS if self._matrix else None
        kernels.decode(self.kernel, self.source, clock, offsets, jobs, direct, out, blocks)

    # ---- coarse texels ----

    def _read_all(self, clock: Clock) -> None:
        layout, times = self.layout, len(clock.axis.times)
        rows = self._array(np.stack([clock.row(float(time)) for time in clock.axis.times]), float)
        words = np.zeros((len(self._kind), times, kernels.COARSE, kernels.COARSE), np.uint32)
        for s, own in enumerate(layout.models):
            for kind in (TileKind.CONSTANT, *PACKED_KINDS):
                for numbers in self._chunks(own, kind):
                    read = self._place(s, own, kind, numbers)
                    if len(read):
                        words[layout.tile_first[s] + read] = self._coarse(s, own, read, rows)
        self.change = np.zeros(words.shape[:2], np.float32)
        covered = np.zeros((len(words), kernels.COARSE**2), np.float16)
        for s, own in enumerate(layout.models):
            part = slice(layout.tile_first[s], layout.tile_first[s + 1])
            covered[part] = self._fill(own, words[part], self.slot[part])
            self.change[part] = _changes(words[part], clock.axis.period is not None)
        self.tiles.coarse.assign(words.reshape(self.tiles.coarse.shape))
        self.tiles.covered.assign(covered)
        self.tiles.slot.assign(self.slot)
        for pool in self._pools.values():
            pool.free_staging()

    def _chunks(self, own: SheetModel, kind: TileKind) -> Iterator[np.ndarray]:
        numbers = own.numbers(kind)
        size = min(_CHUNK, len(self._pools[kind].owner) if kind in self._pools else _CHUNK)
        for start in range(0, len(numbers), max(size, 1)):
            yield numbers[start : start + size]

    def _place(self, s: int, own: SheetModel, kind: TileKind, numbers: np.ndarray) -> np.ndarray:
        """Reads tiles of one kind and puts them on the device; returns the numbers of those that are not damaged."""
        if kind not in self._pools:
            return numbers
        try:
            part = own.only(numbers)
        except WlmError:
            good = [number for number in numbers.tolist() if self._is_good(s, own, number)]
            numbers = np.array(good, np.int64)
            part = own.only(numbers)
        if not len(numbers):
            return numbers
        pool, tiles = self._pools[kind], self.layout.tile_first[s] + numbers
        first = int((pool.owner >= 0).sum())
        if first + len(tiles) > len(pool.owner):
            first = 0
        gone = pool.owner[first : first + len(tiles)]
        self.slot[gone[gone >= 0]] = kernels.WAITING
        pool.owner[first : first + len(tiles)] = tiles
        self.slot[tiles] = np.arange(first, first + len(tiles))
        pool.put(self.slot[tiles], pool.records(_rows(part, kind, self._matrix)))
        return numbers

    def _is_good(self, s: int, own: SheetModel, number: int) -> bool:
        try:
            own.only([number])
        except WlmError as error:
            self._break(int(self.layout.tile_first[s]) + number, error)
            return False
        return True

    def _break(self, tile: int, error: WlmError) -> None:
        if self.slot[tile] != kernels.BROKEN:
            self.slot[tile] = kernels.BROKEN
            self.warnings.append(f"{error}; the light around it is shown instead")

    def _coarse(self, s: int, own: SheetModel, numbers: np.ndarray, rows: wp.array) -> np.ndarray:
        """Decodes coarse texels of n tiles at all T stored times, uint32 [n, T, COARSE, COARSE]."""
        count, times, side = len(numbers), rows.shape[0], kernels.COARSE
        self.tiles.slot.assign(self.slot)
        out = wp.zeros((count * times, side, side), dtype=wp.uint32, device=self._device)

        def decode(rank: np.ndarray) -> None:
            place = np.empty((len(rank), 4), np.int32)
            place[:, 0], place[:, 1] = self._first + s, kernels.COARSE_LEVEL
            place[:, 2:] = side * np.stack(np.divmod(numbers[rank], own.grid.cols), 1)
            jobs, most = kernels.Jobs(), len(rank) * times
            jobs.place = self._array(place.repeat(times, 0), wp.vec4i)
            jobs.target = self._array(np.tile(np.arange(times, dtype=np.int32), len(rank)), int)
            jobs.slot = self._array((rank[:, None] * times + np.arange(times)).ravel().astype(np.int32), int)
            jobs.part, jobs.lead = (wp.zeros(most, dtype=dtype, device=self._device) for dtype in (int, float))
            blocks = -(-side * side * matrix_pages.GROUP // kernels.BLOCK)
            jobs.first = self._array(blocks * np.arange(most + 1, dtype=np.int32), int)
            self.decode(rows, self.offsets[:1], jobs, True, out)

        ranks = np.arange(count)
        if self._device == "cpu":  # a launch takes one core
            wp.load_module(self.kernel.module, "cpu", block_dim=kernels.BLOCK)
            list(each(decode, np.array_split(ranks, min(cores(), count))))
        else:
            decode(ranks)
        return out.numpy().reshape(count, times, side, side)

    def _fill(self, own: SheetModel, words: np.ndarray, slot: np.ndarray) -> np.ndarray:
        """Gives the coarse texels of a sheet without a valid texel, or in a damaged tile, the nearest one's light, and
        returns `Tiles.covered` of the sheet's n tiles, [n, COARSE * COARSE]."""
        grid, side, step = own.grid, kernels.COARSE, TILE // kernels.COARSE
        stored = ((own.kind != TileKind.EMPTY) & (slot != kernels.BROKEN)).reshape(grid.rows, grid.cols)
        mask = np.zeros((grid.rows * TILE, grid.cols * TILE), bool)
        mask[: own.height, : own.width] = own.mask
        mask &= stored.repeat(TILE, 0).repeat(TILE, 1)
        valid = mask.reshape(grid.rows * side, step, grid.cols * side, step).sum((1, 3))
        if not valid.all() and valid.any():
            image = words.reshape(grid.rows, grid.cols, -1, side, side).transpose(2, 0, 3, 1, 4)
            image = image.reshape(-1, *valid.shape)
            rows, columns = nearest_valid(valid > 0)
            filled = image[:, rows, columns].reshape(len(image), grid.rows, side, grid.cols, side)
            words[...] = filled.transpose(1, 3, 0, 2, 4).reshape(words.shape)
        by_tile = valid.reshape(grid.rows, side, grid.cols, side).swapaxes(1, 2).reshape(len(words), -1)
        return np.maximum(by_tile, _NOTHING)

    # ---- tiles that are loaded when they are needed ----

    def ready(self) -> np.ndarray:
        """Returns `Pages.ready` of `wlm_kernels.lightmap.virtual`: whether the tiles of each page are here, int32 [P].

        Damaged tiles count as here: pages that read them have coarse texels in their place, but the page of such a tile
        itself is never decoded. The page of a whole sheet is always decoded, with coarse texels for missing tiles.
        """
        broken = (self.layout.own >= 0) & (self.slot[self.layout.own] == kernels.BROKEN)
        return np.where(broken, -1, self._missing == 0).astype(np.int32)

    def stream(self, seen: np.ndarray, priority: np.ndarray, frame: int) -> bool:
        """Asks the loader for tiles and uploads those that it has loaded, some in each frame.

        Args:
            seen: int [P], last frame in which each page was needed.
            priority: int [P], priority of each page that waits for tiles, else 0.
            frame: Number of the frame.

        Returns:
            Whether `ready` has changed.
        """
        if self._loader is None:
            return False
        layout, most = self.layout, {}
        # Of a view's few pages; all pages read tens of thousands of tiles.
        pages = np.flatnonzero(seen > frame - KEEP).tolist()
        reads = {page: layout.read[self._reads[page] : self._reads[page + 1]] for page in pages}
        if pages:
            self._used[np.concatenate(list(reads.values()))] = frame
        for page in pages:
            if priority[page] > 0:
                waiting = reads[page][self.slot[reads[page]] == kernels.WAITING].tolist()
                most |= {tile: max(int(priority[page]), most.get(tile, 0)) for tile in waiting}
        order = sorted(most, key=most.__getitem__, reverse=True)[:_REQUESTS]
        sheets = np.searchsorted(layout.tile_first, order, side="right") - 1
        self._loader.replace(
            (layout.sheets[s], tile - int(layout.tile_first[s]), float(most[tile]))
            for s, tile in zip(sheets.tolist(), order, strict=True)
        )
        taken: dict[int, list[tuple[int, np.ndarray]]] = {}
        changed = False
        for loaded in self._loader.take(_UPLOADS):
            tile = self._tile(loaded.sheet, loaded.number)
            if self.slot[tile] != kernels.WAITING:
                continue
            if loaded.error is not None:
                self._break(tile, loaded.error)
                self._count(tile, -1)
                changed = True
            elif self._room_for(tile, frame):
                changed = True
                taken.setdefault(int(self._kind[tile]), []).append((tile, loaded.prepared))
        for kind, pairs in taken.items():
            records = np.concatenate([record for _, record in pairs])
            self._pools[kind].put(self.slot[[tile for tile, _ in pairs]], records)
        if changed:
            self.tiles.slot.assign(self.slot)
        return changed

    def _tile(self, sheet: Sheet, number: int) -> int:
        return int(self.layout.tile_first[self.layout.sheets.index(sheet)]) + number

    def _record(self, sheet: Sheet, number: int, content: SheetModel) -> np.ndarray:
        """Converts a tile to the bytes that are uploaded."""
        kind = int(self._kind[self._tile(sheet, number)])
        return self._pools[kind].records(_rows(content, kind, self._matrix))

    def _room_for(self, tile: int, frame: int) -> bool:
        """Gives a tile the slot of the tile that was not needed for the longest time; False if all are needed."""
        pool = self._pools[int(self._kind[tile])]
        age = np.where(pool.owner >= 0, self._used[pool.owner], -1)
        slot = int(np.argmin(age))
        if age[slot] > frame - KEEP:
            return False  # the tile is asked for again
        if pool.owner[slot] >= 0:
            self.slot[pool.owner[slot]] = kernels.WAITING
            self._count(int(pool.owner[slot]), 1)
        pool.owner[slot], self.slot[tile], self._used[tile] = tile, slot, frame
        self._count(tile, -1)
        return True

    def _count(self, tile: int, change: int) -> None:
        """Adds to the number of missing tiles of the pages that read a tile."""
        self._missing[self._readers[self._readers_of[tile] : self._readers_of[tile + 1]]] += change

    def wait(self, seconds: float) -> bool:
        """Waits until a requested tile is loaded, at most some seconds; returns whether there is one."""
        return self._loader is not None and self._loader.wait(seconds)

    def close(self) -> None:
        """Ends the loader's thread."""
        if self._loader is not None:
            self._loader.close()


def _shapes(own: SheetModel, matrix: bool) -> dict[int, dict[str, tuple[Any, tuple[int, ...]]]]:
    """Returns the type and shape of each array of a tile on the device, by kind; the first axis counts its rows.
    `first` and `later` are those of the networks, see `wlm_kernels.lightmap.pages.page_kernel`."""
    profile, times = own.profile, len(own.times)
    h, r = profile.hidden, profile.uvt_resolution // 4
    plane = (wp.vec2ub, (1, profile.plane_rows, profile.plane_columns))

    dynamic = {
        "uv": (wp.uint64, (1, BLOCKS, BLOCKS, 2)),
        "first": (wp.types.vector(h, float), (1, 5 if matrix else INPUTS + h + 2)),
        "later": (wp.uint32, (1, packed_words(h))) if matrix else (wp.vec3, (1, h + 1)),
        "scale": (wp.vec3, (1, times)),
        "shift": (wp.vec3, (1,)),
        "spread": (wp.vec3, (1,)),
        "uvt": (wp.uint64, (profile.uvt_slices, r, r, 2)),
        "ut": plane,
        "vt": plane,
    }
    frames = {
        "blocks": (wp.uint64, (times, BLOCKS, BLOCKS, 2)),
        "least": (wp.vec3, (times,)),
        "span": (wp.vec3, (times,)),
    }
    return {TileKind.DYNAMIC: dynamic, TileKind.FRAMES: frames}


def _rows(part: SheetModel, kind: int, matrix: bool) -> dict[str, np.ndarray]:
    """Returns the arrays of n tiles of one kind, [n, ...] each, with the bytes that `_shapes` describes."""
    if kind == TileKind.FRAMES:
        ends = part.ranges.astype(np.float32)
        return {"blocks": part.frames, "least": ends[:, :, 0], "span": ends[:, :, 1] - ends[:, :, 0]}
    first, later = split_networks(part.net.astype(np.float32), part.profile.hidden)
    if matrix:
        first, later = pack_biases(first), pack_networks(first, later)
    affine = part.affine.astype(np.float32)
    return {
        "uv": part.uv,
        "uvt": part.uvt,
        "ut": part.ut,
        "vt": part.vt,
        "first": first,
        "later": later,
        "scale": part.scales,
        "shift": affine[:, 0],
        "spread": affine[:, 1],
    }


def _masks(own: SheetModel) -> tuple[np.ndarray, np.ndarray]:
    """Returns for each tile of a sheet its row in the second array, or that all or none of its texels are valid; and
    the bits of the other tiles, uint32 [M, 128, 4]. Empty tiles have no valid texel."""
    grid = own.grid
    mask = np.zeros((grid.rows * TILE, grid.cols * TILE), bool)
    mask[: own.height, : own.width] = own.mask
    tiles = mask.reshape(grid.rows, TILE, grid.cols, TILE).swapaxes(1, 2).reshape(-1, TILE, TILE)
    full, some = tiles.all((1, 2)), tiles.any((1, 2)) & (own.kind != TileKind.EMPTY)
    partial = some & ~full
    rows = np.where(some, kernels.FULL, kernels.EMPTY)
    rows[partial] = np.arange(partial.sum())
    bits = np.packbits(tiles[partial], axis=2, bitorder="little")
    return rows, np.ascontiguousarray(bits).view("<u4")


def _changes(words: np.ndarray, periodic: bool) -> np.ndarray:
    """Computes `TileStore.change` of n tiles from their coarse texels, uint32 [n, T, COARSE, COARSE]."""
    light = unpack_rgb9e5(words).reshape(*words.shape[:2], -1)
    rms = np.sqrt(np.square(light).mean(2))
    after = np.roll(light, -1, axis=1)
    moved = np.sqrt(np.square(after - light).mean(2))
    least = _DARK * rms.max(1, keepdims=True)
    scale = np.maximum(np.maximum(rms, np.roll(rms, -1, axis=1)), least)
    change = np.divide(moved, scale, out=np.zeros_like(moved), where=scale > 0)
    if not periodic:
        change[:, -1] = 0.0
    return change


def page_changes(layout: Layout, change: np.ndarray) -> np.ndarray:
    """Adds up the changes of the pages' light, see `wlm_kernels.lightmap.virtual.Pages`, from `TileStore.change`.
    Returns float32 [P, T + 1]; a page changes as much as the tile below it that changes most."""
    largest = np.stack([change[layout.below(page)].max(0) for page in range(len(layout.parent))])
    return np.concatenate([np.zeros((len(largest), 1)), np.cumsum(largest, 1)], 1).astype(np.float32)
