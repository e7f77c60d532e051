"""Loads tiles of a lightmap file in a thread of its own, for a renderer whose frames must not wait for a disk."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import islice
from typing import Any, Self

from wlm.errors import WlmError
from wlm.lightmap.model import LightmapModel, SheetModel
from wlm.lightmap.sheet import Sheet


@dataclass(frozen=True, eq=False)
class Loaded:
    """A tile that was loaded, by sheet and number, or the line of the error of a damaged file.

    `tile` is the sheet with this tile alone: its arrays have one row, as they are uploaded. `prepared` is the result of
    the loader's `prepare`, None without it.
    """

    sheet: Sheet
    number: int
    tile: SheetModel | None
    error: WlmError | None
    prepared: Any = None


class TileLoader:
    """Reads and unpacks tiles in a thread, those of the highest priority first.

    The waiting requests and the results that nobody has taken are bounded: with `most` results the thread pauses, and
    a request beyond `most` takes the place of the least important one, which a renderer asks for again in a later frame
    if it is still needed. The methods may be called by any thread and never wait for a tile, except `close`.

    The loader may be used in a `with` statement, which closes it. The model stays open.
    """

    def __init__(
        self, model: LightmapModel, most: int = 64, prepare: Callable[[Sheet, int, SheetModel], Any] | None = None
    ) -> None:
        """Starts the thread for a model, usually from `wlm.load`.

        `most`, at least 1, is the largest number of waiting requests, and of results that nobody has taken. `prepare`
        is called in the thread with the sheet, the number and the content of each tile, for work that no frame should
        wait for.
        """
        if most < 1:
            raise WlmError(f"most: expected at least 1, got {most}")
        self._model, self._most, self._prepare = model, most, prepare
        self._waiting: dict[tuple[Sheet, int], float] = {}
        self._results: deque[Loaded] = deque()
        self._change = threading.Condition()
        self._current: tuple[Sheet, int] | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="wlm tile loader", daemon=True)
        self._thread.start()

    def request(self, sheet: Sheet, number: int, priority: float = 0.0) -> bool:
        """Asks for a tile, or changes the priority of a tile that waits: higher ones come first, equal ones in the
        order of their requests. Returns False if the request was dropped, since `most` requests wait that are at least
        as important."""
        self._check(sheet, number)
        with self._change:
            self._check_open()
            tile = (sheet, number)
            if tile == self._current:
                return True
            if tile not in self._waiting and len(self._waiting) >= self._most:
                # Of equally unimportant requests the latest goes.
                least = min(reversed(self._waiting), key=self._waiting.__getitem__)
                if self._waiting[least] >= priority:
                    return False
                del self._waiting[least]
            self._waiting[tile] = priority
            self._change.notify_all()
            return True

    def replace(self, requests: Iterable[tuple[Sheet, int, float]]) -> None:
        """Drops all waiting requests and asks for other tiles: sheet, number and priority of each. Of more than `most`
        the first ones count."""
        asked = list(islice(requests, self._most))
        for sheet, number, _ in asked:
            self._check(sheet, number)
        with self._change:
            self._check_open()
            self._waiting = {(sheet, number): priority for sheet, number, priority in asked}
            if self._current is not None:
                self._waiting.pop(self._current, None)
            self._change.notify_all()

    def _check(self, sheet: Sheet, number: int) -> None:
        if sheet not in self._model.sheets or not 0 <= number < len(self._model.sheets[sheet].kind):
            raise WlmError(f"{self._model.name}: expected a tile of one of its sheets, got tile {number} of {sheet}")

    def _check_open(self) -> None:
        if self._closed:
            raise WlmError(f"{self._model.name}: expected an open loader, got one that was closed")

    def cancel(self, sheet: Sheet | None = None, number: int | None = None) -> int:
        """Drops waiting requests, of one tile, of all tiles of a sheet, or all, and returns their number. A tile that
        is being read, and results that nobody has taken, are not affected."""
        with self._change:
            dropped = [tile for tile in self._waiting if sheet in (None, tile[0]) and number in (None, tile[1])]
            for tile in dropped:
                del self._waiting[tile]
            return len(dropped)

    def take(self, most: int | None = None) -> list[Loaded]:
        """Returns finished tiles in the order in which they were read, at most `most`; it does not wait for any."""
        with self._change:
            count = len(self._results) if most is None else min(most, len(self._results))
            taken = [self._results.popleft() for _ in range(count)]
            self._change.notify_all()
            return taken

    def wait(self, seconds: float | None = None) -> bool:
        """Waits until a result can be taken, or nothing waits any more, at most some seconds. Returns whether a result
        can be taken."""
        with self._change:
            self._change.wait_for(lambda: self._results or not (self._waiting or self._current), seconds)
            return bool(self._results)

    def close(self) -> None:
        """Drops all requests and ends the thread after the tile that it reads. A second call does nothing."""
        with self._change:
            self._closed = True
            self._waiting.clear()
            self._change.notify_all()
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _run(self) -> None:
        while (tile := self._next()) is not None:
            sheet, number = tile
            try:
                content = self._model.sheets[sheet].only([number])
                prepared = None if self._prepare is None else self._prepare(sheet, number, content)
                result = Loaded(sheet, number, content, None, prepared)
            except WlmError as error:
                result = Loaded(sheet, number, None, error)
            except MemoryError as error:
                line = f"{self._model.name}: tile {number}: it does not fit into memory"
                result = Loaded(sheet, number, None, WlmError(f"{line} {error}".rstrip()))
            with self._change:
                self._current = None
                if not self._closed:
                    self._results.append(result)
                self._change.notify_all()
            time.sleep(0.0)  # a frame that waits for Python's lock goes on now, not after Python's 5 ms

    def _next(self) -> tuple[Sheet, int] | None:
        """Waits for the most important request and takes it; None if the loader was closed."""
        with self._change:
            self._change.wait_for(lambda: self._closed or (self._waiting and len(self._results) < self._most))
            if self._closed:
                return None
            self._current = max(self._waiting, key=self._waiting.__getitem__)
            del self._waiting[self._current]
            return self._current
