"""Ctrl-C and SIGTERM: either stops a command, long work between two of its steps; a second one ends it at once."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_received: int | None = None  # the first signal's number
_holding = False


def exit_code() -> int:
    """The exit code of an interrupted command: 130 after Ctrl-C, 143 after SIGTERM, as shells have them."""
    return 128 + (signal.SIGINT if _received is None else _received)


@contextmanager
def handled(after: signal.Handlers | None = None) -> Iterator[None]:
    """Lets the first Ctrl-C or SIGTERM raise KeyboardInterrupt, and the second end the process.

    Only the main thread gets signals: in another one this changes nothing.

    Args:
        after: What becomes of signals after the block; None: what did before it.
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
    """Holds the first Ctrl-C or SIGTERM back until the work says that it is between two steps, or at its end.

    An interrupt in the middle of a step would leave half of it done, and a fit that went on from there would not be
    the fit that was not interrupted.

    Yields:
        A function to call between steps; it raises KeyboardInterrupt if there was a signal.
    """
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
        # A third one doesn't wait for Python, which may be in the middle of a long call.
        for each in _SIGNALS:
            signal.signal(each, signal.SIG_DFL)
        # Not KeyboardInterrupt: that would be saved as if it came between two steps.
        raise SystemExit(128 + number)
    _received = number
    if not _holding:
        raise KeyboardInterrupt
