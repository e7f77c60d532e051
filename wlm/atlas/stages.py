"""Stages of a compression: each is timed and reported as it begins, and long stages are saved in a checkpoint."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch

from wlm.dispatch import Place
from wlm.formats.checkpoint import Checkpoint
from wlm.formats.parts import Part
from wlm.system import Meter, OnProgress


class Stages:
    """Reports and times the stages of a compression: `seconds` of the finished ones, by name. `place` is where tasks of
    long stages run, and `device` that of all other work.

    A checkpoint saves the results of long stages as batches, numbered in order. The progress callback is also called
    within stages of many steps.
    """

    def __init__(self, device: str, progress: OnProgress | None = None, checkpoint: Checkpoint | None = None) -> None:
        self.device, self.progress, self.checkpoint = device, progress, checkpoint
        self.place = Place(device)
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Runs the code of a `with` block as a stage; on CUDA the time includes the kernels that it has queued."""
        meter = Meter(self.progress, name, 0)
        meter.report(0)
        yield
        if self.device != "cpu":
            torch.cuda.synchronize(self.device)
        self.seconds[name] = meter.seconds

    def batch(self, number: int, table: Mapping[str, Part], make: Callable[[], Mapping[str, Any]]) -> Mapping[str, Any]:
        """Returns the arrays of a batch by name: from the checkpoint if it has them, checked against `table`, or else
        from `make`, and then saves them. Tensors stay on their device, without a copy, if there is no checkpoint."""
        if self.checkpoint is None:
            return make()
        if (kept := self.checkpoint.finished(number, table)) is None:
            made = make().items()
            kept = {name: each.cpu().numpy() if isinstance(each, torch.Tensor) else each for name, each in made}
            self.checkpoint.add_finished(number, kept)
        return kept
