"""Loads tiles of a lightmap file in a thread of its own, for a renderer whose frames must not wait for a disk."""

import threading
from collections import deque
from dataclasses import dataclass
from typing import Self

from wlm.errors import WlmError
from wlm.lightmap.model import LightmapModel, SheetModel
from wlm.lightmap.sheet import Sheet


@dataclass(frozen=True, eq=False)
class Loaded:
    """A tile that was loaded, or the reason why it was not.

    Attributes:
        sheet, number: The sheet and the number of the tile in its grid.
        tile: The sheet with this tile alone: its arrays have one row, as they are uploaded. None after an error.
        error: The error of a damaged file in one line; None of a tile.
    """

    sheet: Sheet
    number: int
    tile: SheetModel | None
    error: WlmError | None


class TileLoader:
    """Reads and unpacks tiles in a thread, those of the highest priority first.

    The waiting requests and the results that nobody has taken are bounded: with `most` results the thread pauses, and
    a request beyond `most` takes the place of the least important one, which a renderer asks for again in a later frame
    if it is still needed. The methods may be called by any thread and never wait for a tile, except `close`.

    The loader may be used in a `with` statement, which closes it. The model stays open.
    """

    def __init__(self, model: LightmapModel, most: int = 64) -> None:
        """Starts the thread.

        Args:
            model: The model, usually from `wlm.load`.
            most: Largest number of waiting requests, and of results that nobody has taken; at least 1.
        """
        if most < 1:
            raise WlmError(f"most: expected at least 1, got {most}")
        self._model, self._most = model, most
        self._waiting: dict[tuple[Sheet, int], float] = {}
        self._results: deque[Loaded] = deque()
        self._change = threading.Condition()
        self._current: tuple[Sheet, int] | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="wlm tile loader", daemon=True)
        self._thread.start()

    def request(self, sheet: Sheet, number: int, priority: float = 0.0) -> bool:
        """Asks for a tile, or changes the priority of a tile that waits.

        Args:
            sheet: The sheet.
            number: Number of the tile in the sheet's grid.
            priority: Tiles of higher priority come first, and of equal priority in the order of their requests.

        Returns:
            False if the request was dropped, since `most` requests wait that are at least as important.

        Raises:
            WlmError: The model has no such tile, or the loader is closed.
        """
        if sheet not in self._model.sheets or not 0 <= number < len(self._model.sheets[sheet].kind):
            raise WlmError(f"{self._model.name}: expected a tile of one of its sheets, got tile {number} of {sheet}")
        with self._change:
            if self._closed:
                raise WlmError(f"{self._model.name}: expected an open loader, got one that was closed")
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

    def cancel(self, sheet: Sheet | None = None, number: int | None = None) -> int:
        """Drops waiting requests: of one tile, of all tiles of a sheet, or all.

        A tile that is being read, and results that nobody has taken, are not affected.

        Returns:
            The number of requests that were dropped.
        """
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
        """Waits until a result can be taken, or nothing waits any more, at most some seconds.

        Returns:
            Whether a result can be taken.
        """
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
                result = Loaded(sheet, number, self._model.sheets[sheet].only([number]), None)
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

    def _next(self) -> tuple[Sheet, int] | None:
        """Waits for the most important request and takes it; None if the loader was closed."""
        with self._change:
            self._change.wait_for(lambda: self._closed or (self._waiting and len(self._results) < self._most))
            if self._closed:
                return None
            self._current = max(self._waiting, key=self._waiting.__getitem__)
            del self._waiting[self._current]
            return self._current
