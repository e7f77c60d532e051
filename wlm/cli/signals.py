"""Ctrl-C and SIGTERM: the first signal stops a command, long work between two steps; the second ends it at once."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_received: int | None = None  # number of the first signal
_holding = False


def exit_code() -> int:
    """Returns the exit code of an interrupted command, as shells define it: 130 after Ctrl-C, 143 after SIGTERM."""
    return 128 + (signal.SIGINT if _received is None else _received)


@contextmanager
def handled(after: signal.Handlers | None = None) -> Iterator[None]:
    """Makes the first Ctrl-C or SIGTERM raise KeyboardInterrupt, and the second end the process; `after` handles the
    signals after the block, None restores the earlier handlers.

    Only the main thread receives signals; in another thread this changes nothing.
    """
    global _received
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, _handle) for number in _SIGNALS}
    if _handle not in before.values():
        _received = None
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, after or handler or signal.SIG_DFL)


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], None]]:
    """Defers the first Ctrl-C or SIGTERM until the work reports that it is between two steps, or ends.

    An interrupt in the middle of a step would leave half of it done, and a fit that continued from there would differ
    from a fit without the interrupt. Yields a function to call between steps; it raises KeyboardInterrupt if a signal
    has arrived."""
    global _holding

    def check() -> None:
        if _received is not None:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    with handled():
        _holding = True
        try:
            yield check
            check()
        finally:
            _holding = False


def _handle(number: int, _frame: object) -> None:
    global _received
    if _received is not None:
        # A third signal does not wait for Python, which may be in the middle of a long call.
        for each in _SIGNALS:
            signal.signal(each, signal.SIG_DFL)
        # KeyboardInterrupt would be saved as if the work were between two steps.
        raise SystemExit(128 + number)
    _received = number
    if not _holding:
        raise KeyboardInterrupt
