"""`VirtualTexture`: the lightmaps of a model as a renderer reads them, of which only what is seen is decoded.

It implements neural-dynamic-gi, sections 3.5 and 9; docs/run-time.md describes the data flow and the departures. The
kernels of a frame are described in `wlm_kernels.lightmap.virtual` and `pages`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple, Self

import numpy as np
import warp as wp

from wlm import interop
from wlm.errors import WlmError
from wlm.lightmap.decode import device_of, gelu_of
from wlm.lightmap.groups import Weight, changed_weights
from wlm.lightmap.model import LightmapModel
from wlm.lightmap.tiles import TILE
from wlm.lightmap.virtual.clock import Clock
from wlm.lightmap.virtual.layout import Layout
from wlm.lightmap.virtual.store import TileStore, page_changes
from wlm_kernels.lightmap import pages as page_kernels
from wlm_kernels.lightmap import virtual as kernels
from wlm_kernels.lightmap.matrix_pages import GROUP

BUDGET = 64 << 20
"""Bytes of the physical texture."""

DECODES = 8
"""Largest number of pages that are decoded in a frame."""

TOLERANCE = 0.02
"""Relative change of a page's light from which on it is stale."""

STRIDE = 8
"""Distance between the pixels that are read in a frame to find the pages that a view needs, a power of two."""

_TURN = 27  # order in which the pixels of a square of STRIDE x STRIDE take turns: any odd number reaches all
_MOST_DECODES = 1024
_TABLE_ROW = 1024  # pages in a row of the page table, as a texture


@dataclass(frozen=True, eq=False)
class Reading:
    """The light that a virtual texture shows at points.

    Attributes:
        light: float32 [..., 3]; 0 at points on no sheet, and where a coordinate is NaN or infinite.
        coarser: int32 [...], levels by which the page that is shown is coarser than the page that is needed; -1 where
            there is no light.
        change: float32 [...], relative change of the page's light since the time for which it was decoded.
    """

    light: np.ndarray
    coarser: np.ndarray
    change: np.ndarray


class State(NamedTuple):
    """Copies in host memory of what a shader reads: the physical texture, RGB9E5 [slots, side, side], and the page
    table [pages]; of each slot's page, last frame in which it was needed, and decoded parts; and of each page's slots
    and parent."""

    texture: np.ndarray
    table: np.ndarray
    owner: np.ndarray
    stamp: np.ndarray
    parts: np.ndarray
    slot: np.ndarray
    ahead: np.ndarray
    parent: np.ndarray


class VirtualTexture:
    """A physical texture and a page table for all sheets of a model. Call `frame` once per frame, then `sample`.

    It may be used in a `with` statement, which closes it. The model stays open.

    Attributes:
        model: The model.
        device: "cpu" or "cuda:N".
        layout: The tiles and pages of the sheets.
        weights: float32 [3] by light group, the factors of red, green and blue; initially 1. Changed by `set_weights`.
        slots: Number of pages that the physical texture holds.
        decodes: Largest number of pages that are decoded in a frame.
        tolerance: Relative change of light from which on a page is stale.
        texture: `wp.array` uint32 [slots, side + 2 border, side + 2 border], the physical texture, RGB9E5: an array of
            textures, one layer for each slot.
        table: `wp.array` int [n * 1024], the page table as a texture whose rows have 1,024 pages; see
            `wlm.lightmap.virtual.shader` for how shaders read both.
    """

    def __init__(
        self,
        model: LightmapModel,
        device: str = "cpu",
        *,
        budget: int = BUDGET,
        decodes: int = DECODES,
        tolerance: float = TOLERANCE,
        tiles: int | None = None,
        gelu: str | None = None,
        side: int = TILE,
        border: int = 4,
    ) -> None:
        """Reads all tiles once, and decodes the coarsest page of each sheet at the first stored time.

        Args:
            model: The model.
            device: "cpu", "cuda" or "cuda:N".
            budget: Bytes of the physical texture. More than the pages of all levels need is not allocated.
            decodes: Largest number of pages that are decoded in a frame, 1 to 1024. A page of the first mip counts as
                one, of the second as four, since its texels are means of 16; and so does a quarter of a page of the
                third, of which a frame decodes one.
            tolerance: Relative change of a page's light (RMS) from which on it is stale, above 0. A frame that has no
                missing or stale page decodes pages from 0.3 of it on.
            tiles: Bytes for the tiles on the device. If not all fit, a thread loads those that are needed. None: all.
            gelu: GELU variant of the networks; None: the model's, or on CUDA the instruction for its approximation.
            side: Texels along a side of a page without its border: 8, 16, 32, 64 or 128.
            border: Texels of a page's border, 1 to 16, for a renderer's filter.

        Raises:
            WlmError: There is no such device, a setting is out of its range, `budget` or `tiles` is too small, or the
                model has more than 8 light groups.
        """
        self.device = device_of(device)
        _check(decodes, tolerance, side, border)
        if len(model.groups) > kernels.GROUPS:
            raise WlmError(f"{model.name}: expected at most {kernels.GROUPS} light groups, got {len(model.groups)}")
        if gelu is None and self.device != "cpu" and model.light.profile.gelu == "tanh":
            gelu = "fast"
        self.model, self.decodes, self.tolerance = model, decodes, tolerance
        self.layout = layout = Layout.of(model, side, border)
        edge = side + 2 * border
        whole, count = layout.whole, len(layout.parent)
        self.slots = min(budget // (4 * edge * edge), 2 * count + decodes)
        if self.slots < len(whole) + decodes:
            needed = (len(whole) + decodes) * 4 * edge * edge
            raise WlmError(
                f"budget: expected at least {needed} bytes, for {len(whole)} pages that always stay and the {decodes} "
                f"that a frame decodes, got {budget}"
            )
        self.weights = {group: np.ones(3, np.float32) for group in model.groups}
        with interop.stream(self.device):
            self._make_stores(gelu_of(model.light, gelu), tiles)
            self._make(edge)
            self._fill_whole(whole)
        self._step = interop.StepGraph(self._work, self.device)
        # The copy of what pages wait for, whether it was queued, and on CUDA the event of its arrival.
        cuda = self.device != "cpu"
        self._host = wp.zeros(self._frame_work.asked.shape, dtype=int, device="cpu", pinned=cuda)
        self._asked, self._arrival = False, wp.Event(self.device) if cuda else None

    def _make_stores(self, gelu: str, room: int | None) -> None:
        """Makes the clock and the tiles of each light group; each gets room in proportion to its tiles."""
        model, layout = self.model, self.layout
        self._clocks: list[Clock] = []
        self._stores: list[TileStore] = []
        first = 0
        for group in model.groups:
            sheets = {sheet: own for sheet, own in model.sheets.items() if sheet.group == group}
            part = LightmapModel(model.name, model.source, model.profile, sheets)
            share = None if room is None else int(room * part.memory_bytes / model.memory_bytes)
            clock = Clock(part.light.axis)
            own = Layout.of(part, layout.side, layout.border)
            self._stores.append(TileStore(part, own, first, self.device, gelu, share, clock))
            self._clocks.append(clock)
            first += len(sheets)
        # The pages of each group among all pages.
        self._parts = np.cumsum([0, *(len(store.layout.parent) for store in self._stores)])

    def _make(self, edge: int) -> None:
        layout, count = self.layout, len(self.layout.parent)
        self._arrays: list[wp.array] = []

        def struct(kind: Any, **contents: Any) -> Any:
            """Makes a Warp struct of arrays, shapes with a value behind that fills them, and numbers."""
            made = kind()
            for name, content in contents.items():
                if not isinstance(content, int):
                    values = np.full(content[:-1], content[-1]) if isinstance(content, tuple) else content
                    content = wp.array(values, dtype=kind.vars[name].type.dtype, device=self.device)
                    self._arrays.append(content)
                setattr(made, name, content)
            return made

        sizes = np.array([(own.height, own.width) for own in layout.models], np.int32)
        fixed = {name: getattr(layout, name) for name in ("first", "columns", "levels", "place", "parent")}
        missing = dict.fromkeys(("slot", "ahead", "seen"), (count, -1))
        fresh = dict.fromkeys(("need", "area"), (count, 0)) | {"table": (-(-count // _TABLE_ROW) * _TABLE_ROW, 0)}
        changes = [page_changes(store.layout, store.change) for store in self._stores]
        longest = max(change.shape[1] for change in changes)
        changes = [np.pad(change, ((0, 0), (0, longest - change.shape[1])), mode="edge") for change in changes]
        periodic = any(clock.axis.period is not None for clock in self._clocks)
        numbers = {"side": layout.side, "border": layout.border, "periodic": int(periodic)}
        self._pages = struct(
            kernels.Pages,
            sheets=layout.surfaces,
            group=np.array([layout.groups.index(sheet.group) for sheet in layout.sheets], np.int32),
            weights=np.ones((len(layout.groups), 3), np.float32),
            size=sizes,
            change=np.concatenate(changes),
            ready=self._ready(),
            **fixed,
            **missing,
            **fresh,
            **numbers,
        )
        empty = dict.fromkeys(("owner", "stamp"), (self.slots, -1)) | dict.fromkeys(("mark", "parts"), (self.slots, 0))
        self._slots = struct(kernels.Slots, **empty)
        most = {
            "gathered": (kernels.MOST, 0),
            "priority": (kernels.MOST, 0),
            "cost": (kernels.MOST, 0),
            "chosen": (self.decodes, -1),
        }
        groups = len(layout.groups)
        frame = {"clock": (2 * groups, page_kernels.CLOCK, 0), "switches": (groups, 4, 0), "frame": (1, 0)}
        self._frame_work = struct(kernels.Work, counters=(7, 0), asked=(2, count, 0), **frame, **most)
        each = (self.decodes, 0)
        jobs = {"place": (self.decodes, 4, 0), "slot": (self.decodes, -1), "first": (self.decodes + 1, 0)}
        self._jobs = struct(page_kernels.Jobs, target=each, part=each, lead=each, **jobs)
        self.texture = wp.zeros((self.slots, edge, edge), dtype=wp.uint32, device=self.device)
        self.table = self._pages.table
        self._look = kernels.Look(self._frame_work)
        # Slots that were never needed are older than any frame.
        self._frame = kernels.KEEP

    def _fill_whole(self, whole: np.ndarray) -> None:
        """Gives the page of each whole sheet a slot, and decodes it at the first stored time."""
        layout, jobs = self.layout, self._jobs
        rows = np.stack([clock.row(float(clock.axis.times[0])) for clock in self._clocks] * 2)
        self._frame_work.clock.assign(rows)
        slot, owner = np.full(len(layout.parent), -1, np.int32), np.full(self.slots, -1, np.int32)
        slot[whole], owner[: len(whole)] = np.arange(len(whole)), whole
        stamp, parts = np.where(owner >= 0, self._frame, -1), np.where(owner >= 0, page_kernels.PARTS, 0)
        for array, values in (
            (self._pages.slot, slot),
            (self._slots.owner, owner),
            (self._slots.stamp, stamp),
            (self._slots.parts, parts),
        ):
            array.assign(values.astype(np.int32))
        # One after another: together they may take more samples than a frame.
        blocks = -(-GROUP * math.prod(self.texture.shape[1:]) // page_kernels.BLOCK)
        first = np.full(self.decodes + 1, blocks, np.int32)
        first[0] = 0
        jobs.first.assign(first)
        for page in whole.tolist():
            place, slots = np.zeros((self.decodes, 4), np.int32), np.full(self.decodes, -1, np.int32)
            place[0], slots[0] = layout.place[page], slot[page]
            place[0, 2:] = -layout.border
            jobs.place.assign(place)
            jobs.target.assign(np.full(self.decodes, self._pages.group.numpy()[place[0, 0]], np.int32))
            jobs.slot.assign(slots)
            for part in range(page_kernels.PARTS if place[0, 1] == page_kernels.COARSE_LEVEL - 1 else 1):
                jobs.part.assign(np.full(self.decodes, part, np.int32))
                self._decode()
        kernels.refer(self._pages, self._slots)

    def set_weights(self, weights: Mapping[str, Weight]) -> None:
        """Sets the weights of some light groups for the following frames; the others keep theirs.

        No page is decoded for it: the weights are factors when light is read. Pages of a group whose weight is 0 are
        decoded, too, after all others, so that a lamp that is switched on is there at once.

        Args:
            weights: By group a factor of its light, or one each of red, green and blue, from 0 to 65,504.

        Raises:
            WlmError: The model has no such group, or a weight is wrong; no weight is changed.
        """
        self.weights = changed_weights(self.model.name, self.weights, weights)
        with interop.stream(self.device):
            self._pages.weights.assign(np.stack(list(self.weights.values())))

    # ---- frames ----

    def frame(self, time: float, sheet: Any, uv: Any, derivatives: Any) -> None:
        """Decodes the pages that a view needs, at most `decodes` of them, for a time.

        On CUDA it only queues launches: two small ones, and a graph that is captured once. Nothing is read back in a
        frame; what earlier frames asked the loader for is read when it has arrived.

        Args:
            time: In the unit of the set's times, stored or between; see `wlm.lightmap.decode.SheetDecoder`.
            sheet: int [H, W], index of the sheet at each pixel in `model.sheets`, or of a model of several light groups
                of the surface in `layout.surfaces`; negative at pixels without one.
            uv: float [H, W, 2] (or `wp.vec2` [H, W]), texture coordinates, row 0 of the map at v = 0; clamped to [0,
                1]. Pixels with NaN or infinity are ignored.
            derivatives: float [H, W, 4] (or `wp.vec4`), du/dx, du/dy, dv/dx, dv/dy per pixel.

        Raises:
            WlmError: The time is not finite.
            ValueError: The shapes do not match.
        """
        with interop.stream(self.device):
            points = self._points(sheet, uv, derivatives, 2)
            moved = [clock.frame(time) for clock in self._clocks]
            self._load()
            self._frame += 1
            now, after = (np.stack([times[i] for times, _ in moved]) for i in range(2))
            self._look(np.concatenate([now, after]), np.array([switches for _, switches in moved]), self._frame)
            turn = self._frame * _TURN % STRIDE**2
            kernels.mark(*points, (turn // STRIDE, turn % STRIDE), STRIDE, self._pages)
            self._step()
            self._ask()

    @property
    def stages(self) -> dict[str, Callable[[], None]]:
        """The parts of a frame that one CUDA graph contains, in order, by name, for measurements."""
        return {
            "select": self._select,
            "decode": self._decode,
            "table": partial(kernels.refer, self._pages, self._slots),
        }

    def _work(self) -> None:
        for stage in self.stages.values():
            stage()

    def _select(self) -> None:
        kernels.select(self._pages, self._slots, self.tolerance, self._frame_work, self._jobs)

    def _decode(self) -> None:
        if self.device == "cpu" and not (self._jobs.slot.numpy() >= 0).any():
            return
        for store in self._stores:
            store.decode(self._frame_work.clock, store.offsets, self._jobs, False, self.texture)

    def _points(self, sheet: Any, uv: Any, derivatives: Any, axes: int) -> tuple[wp.array, wp.array, wp.array]:
        """Converts the arguments to arrays on the device: those that are there already are not copied."""
        dtypes = (int, wp.vec2, wp.vec4)
        made = tuple(
            part if isinstance(part, wp.array) else wp.array(np.asarray(part), dtype=dtype, device=self.device)
            for part, dtype in zip((sheet, uv, derivatives), dtypes, strict=True)
        )
        if any(part.ndim != axes or part.shape != made[0].shape for part in made):
            shapes = ", ".join(str(list(part.shape)) for part in made)
            raise ValueError(f"sheet, uv, derivatives: expected {axes} equal axes and vectors of 2 and 4, got {shapes}")
        return made

    def _load(self) -> None:
        """Passes on what an earlier frame asked for to the loader, if its copy has arrived, and uploads tiles."""
        if not self._asked or (self._arrival is not None and not self._arrival.is_complete):
            return
        self._asked = False
        changed = [
            store.stream(*self._host.numpy()[:, first:last], self._frame)
            for store, (first, last) in zip(self._stores, pairwise(self._parts), strict=True)
        ]
        if any(changed):
            self._pages.ready.assign(self._ready())

    def _ready(self) -> np.ndarray:
        return np.concatenate([store.ready() for store in self._stores])

    def _ask(self) -> None:
        """Starts to copy what the pages need to the host in every second frame, unless a copy is on its way."""
        if self._frame % 2 or self._asked or all(store.complete for store in self._stores):
            return
        wp.copy(self._host, self._frame_work.asked)
        if self._arrival is not None:
            wp.get_stream(self.device).record_event(self._arrival)
        self._asked = True

    # ---- reading ----

    def sample(self, sheet: Any, uv: Any, derivatives: Any) -> Reading:
        """Reads light as a shader does: trilinearly, through the page table, from coarser pages where one is missing.

        Args:
            sheet, uv, derivatives: As for `frame`, with any number of axes.

        Returns:
            The light at the time of the last frame, up to the changes that `tolerance` allows.
        """
        shape = np.shape(sheet) if not isinstance(sheet, wp.array) else sheet.shape
        flat = [np.asarray(part.numpy() if isinstance(part, wp.array) else part) for part in (sheet, uv, derivatives)]
        with interop.stream(self.device):
            light, coarser, change = self.read(flat[0].reshape(-1), flat[1].reshape(-1, 2), flat[2].reshape(-1, 4))
            return Reading(
                light.numpy().reshape(*shape, 3), coarser.numpy().reshape(shape), change.numpy().reshape(shape)
            )

    def read(self, sheet: Any, uv: Any, derivatives: Any) -> tuple[wp.array, wp.array, wp.array]:
        """Reads light as `sample` does, without a copy to the host: the fields of a `Reading` on the device.

        Args:
            sheet, uv, derivatives: As for `frame`, but with one axis, of n points.

        Returns:
            `wp.vec3` [n], int [n] and float [n].
        """
        with interop.stream(self.device):
            points = self._points(sheet, uv, derivatives, 1)
            light, coarser, change = (
                wp.empty(len(points[0]), dtype=dtype, device=self.device) for dtype in (wp.vec3, int, float)
            )
            clock = self._frame_work.clock
            kernels.sample(self.texture, self._pages, self._slots, clock, points, light, coarser, change)
            return light, coarser, change

    def state(self) -> State:
        """Copies the physical texture and the tables from the device to the host."""
        pages, slots = self._pages, self._slots
        count = len(self.layout.parent)
        parts = (pages.table[:count], slots.owner, slots.stamp, slots.parts, pages.slot, pages.ahead, pages.parent)
        with interop.stream(self.device):
            return State(self.texture.numpy(), *(part.numpy() for part in parts))

    def report(self) -> dict[str, Any]:
        """Returns JSON values about the last frame and the memory; it waits for the device.

        - `visible`, the pages that a view needed in the last 16 frames, and of these before the frame's decode:
          `missing`, pages without a slot; `stale`, pages whose light has changed by more than `tolerance`; `ahead`,
          pages that are not ready for the coming switch; `waiting`, pages that wait for tiles.
        - `decoded`, the pages or parts of pages that the frame decoded.
        - `slots`, and `used`, those that hold a page.
        - `memory`, bytes on the device by part: `texture`, `pages` (page table, feedback and selection), `tiles`,
          `coarse`, `masks`, `tables`.
        - `warnings`, a line for each damaged tile.
        """
        names = ("visible", "missing", "stale", "ahead", "waiting", "decoded")
        with interop.stream(self.device):
            counters = dict(zip(names, self._frame_work.counters.numpy().tolist(), strict=False))
            used = int((self._slots.owner.numpy() >= 0).sum())
        memory = {"texture": self.texture.capacity, "pages": sum(array.capacity for array in self._arrays)}
        each = [store.memory for store in self._stores]
        return {
            **counters,
            "slots": self.slots,
            "used": used,
            "memory": memory | {name: sum(own[name] for own in each) for name in each[0]},
            "warnings": self.warnings,
        }

    @property
    def warnings(self) -> list[str]:
        """A line for each tile of the file that is damaged; the light around it is shown instead."""
        return [line for store in self._stores for line in store.warnings]

    def wait(self, seconds: float) -> bool:
        """Waits until the loader has a tile, at most some seconds; returns whether it has one. For pictures that must
        be complete; a renderer does not wait."""
        return max(store.wait(seconds) for store in self._stores)

    def close(self) -> None:
        """Ends the thread that loads tiles, if there is one. A second call does nothing."""
        for store in self._stores:
            store.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _check(decodes: int, tolerance: float, side: int, border: int) -> None:
    """Checks that the settings are in their ranges."""
    if not 1 <= decodes <= _MOST_DECODES:
        raise WlmError(f"decodes: expected 1 to {_MOST_DECODES} pages a frame, got {decodes}")
    if not 0.0 < tolerance < math.inf:
        raise WlmError(f"tolerance: expected a number above 0, got {tolerance}")
    if side not in (8, 16, 32, 64, TILE):
        raise WlmError(f"side: expected 8, 16, 32, 64 or {TILE} texels, got {side}")
    if not 1 <= border <= 16:
        raise WlmError(f"border: expected 1 to 16 texels, got {border}")
