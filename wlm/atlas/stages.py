"""The stages of a compression: reported as they begin, timed, and what takes long in them kept."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from wlm.formats.checkpoint import Checkpoint
from wlm.system import Meter, OnProgress


class Stages:
    """Reports and times stages.

    A checkpoint has the stages that take long as batches, by number: 0 is the first of the method's, 1 the second.

    Attributes:
        device: "cpu" or "cuda:N".
        progress: The callback, which a stage of many steps calls on its own; or None.
        checkpoint: What is kept of an interrupted compression; or None.
        seconds: By name, of the stages that are over.
    """

    def __init__(self, device: str, progress: OnProgress | None = None, checkpoint: Checkpoint | None = None) -> None:
        self.device, self.progress, self.checkpoint = device, progress, checkpoint
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Runs a stage inside the block; on CUDA its time includes what it has queued."""
        meter = Meter(self.progress, name, 0)
        meter.report(0)
        yield
        if self.device != "cpu":
            torch.cuda.synchronize(self.device)
        self.seconds[name] = meter.seconds


@contextmanager
def one_thread(device: str) -> Iterator[None]:
    """Keeps torch to one thread on the CPU: its calls are short, and on a busy machine a second thread makes an
    evaluation ten times slower, while on a free machine it gains little."""
    threads = torch.get_num_threads()
    try:
        if device == "cpu":
            torch.set_num_threads(1)
        yield
    finally:
        torch.set_num_threads(threads)
