"""Time and memory of one case, held by the system: nothing that the case does in C or Python gets round them."""

import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Limits:
    """The limits of a case."""

    seconds: float = 5.0
    wait: float = 60.0
    memory: int = 2 << 30

    @contextmanager
    def held(self) -> Iterator[None]:
        """Holds this process to the time and the memory."""
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (_address_space() + self.memory, hard))
        signal.setitimer(signal.ITIMER_PROF, self.seconds)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY if hard < 0 else hard, hard))


def _address_space() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()


def out_of_memory(error: BaseException | None) -> bool:
    """Whether an error, or one that it was made of, says that memory could not be had."""
    while error is not None:
        if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "alloc" in str(error).lower()):
            return True
        error = error.__cause__ or error.__context__
    return False
