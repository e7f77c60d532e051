"""The stages of a compression: reported as they begin, and timed."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from wlm.system import Meter, OnProgress


class Stages:
    """Reports and times stages.

    Attributes:
        device: "cpu" or "cuda:N".
        progress: The callback, which a stage of many steps calls on its own; or None.
        seconds: By name, of the stages that are over.
    """

    def __init__(self, device: str, progress: OnProgress | None = None) -> None:
        self.device, self.progress = device, progress
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
