"""The stages of a compression: they are reported as they begin, timed, and the long ones kept in a checkpoint."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from wlm.formats.checkpoint import Checkpoint
from wlm.system import Meter, OnProgress


class Stages:
    """Reports and times stages.

    A checkpoint keeps the long stages of a method as batches, numbered in their order.

    Attributes:
        device: "cpu" or "cuda:N".
        progress: The callback, which a stage of many steps calls too; or None.
        checkpoint: The checkpoint, or None.
        seconds: Seconds of the finished stages, by name.
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
    """Keeps torch to one thread on the CPU.

    Its calls are short: on a busy machine a second thread makes an evaluation ten times slower, while on an idle one it
    gains little.
    """
    threads = torch.get_num_threads()
    try:
        if device == "cpu":
            torch.set_num_threads(1)
        yield
    finally:
        torch.set_num_threads(threads)
