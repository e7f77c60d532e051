"""What fits batches of tiles, in this process or in another one (`wlm.workers`)."""

import functools
import time
from dataclasses import dataclass

import numpy as np
import warp as wp

from wlm import interop
from wlm.lightmap.model import Profile, TimeAxis
from wlm.lightmap.targets import Targets
from wlm.lightmap.tiles import TileCut
from wlm.lightmap.trainer import Trainer
from wlm_kernels.lightmap import blocks

_CHUNK = {"cpu": 5, "cuda": 50}  # steps after which the clock is looked at


@dataclass(frozen=True, eq=False)
class Piece:
    """N tiles as they are sent to a worker, which makes targets of them: the costly part of it is the worker's.

    Attributes:
        tiles: As they are in their set.
        scale, affine, gamma, metric_weight, peak: As `Targets` takes them.
        keep: Whether targets are made once and kept, for several fits in this process.
    """

    tiles: TileCut
    scale: np.ndarray
    affine: np.ndarray
    gamma: float
    metric_weight: float
    peak: float | None
    keep: bool = False

    def targets(self) -> Targets:
        """What the tiles are fitted to."""
        return self._targets if self.keep else self._made()

    @functools.cached_property
    def _targets(self) -> Targets:
        return self._made()

    def _made(self) -> Targets:
        tiles = self.tiles.encoded(self.gamma)
        weights = self.metric_weight, self.peak
        return Targets(tiles.index, tiles.colour, tiles.mask, self.scale, self.affine, self.gamma, *weights)


@dataclass(frozen=True, eq=False)
class Advance:
    """How far a batch is.

    Attributes:
        step: Steps done.
        loss, psnr: Mean over its tiles, see `Trainer`, of the latest samples; NaN where nothing was asked or done. Once
            it is done these were taken with its maps as the file holds them.
        parts: Its maps and networks as the file holds them, once it is done.
    """

    step: int
    loss: float = float("nan")
    psnr: float = float("nan")
    parts: dict[str, np.ndarray] | None = None


class Fitter:
    """Fits batches of tiles, one after another."""

    def __init__(self, profile: Profile, axis: TimeAxis, seed: int, device: str, track: bool) -> None:
        """Takes what all batches share.

        Args:
            profile: The settings.
            axis: The time axis.
            seed: Of the fit.
            device: "cpu", "cuda" or "cuda:N".
            track: Whether to say how good the fit is as it goes.

        Raises:
            WlmError: No such device.
        """
        self._profile, self._axis, self._seed, self._track = profile, axis, seed, track
        self._device = interop.check_device(device)
        self._trainer: Trainer | None = None

    def start(self, piece: Piece, dynamic: bool, state: dict[str, np.ndarray] | None) -> Advance:
        """Begins a batch, or goes on with it.

        Args:
            piece: Its tiles.
            dynamic: Whether they are dynamic rather than static.
            state: Of the batch at an earlier step; None: from the first.

        Raises:
            ValueError: The state isn't one of this batch.
        """
        self.close()
        targets = piece.targets()
        self._trainer = Trainer(self._profile, self._axis, targets, dynamic, self._seed, self._device, self._track)
        # All that is compiled for a batch is by its first steps.
        wp.load_module(blocks, self._device)
        if state is not None:
            self._trainer.load(state)
        return Advance(self._trainer.step)

    def advance(self, seconds: float) -> Advance:
        """Trains for so long, a few steps at least, or to the end of the batch.

        Raises:
            WlmError: The fit diverged.
        """
        trainer, steps = self._trainer, self._profile.steps
        chunk, frozen = _CHUNK["cpu" if self._device == "cpu" else "cuda"], trainer.frozen
        step, end = trainer.step, time.monotonic() + seconds
        while step < steps:
            count = min(chunk, steps - step)
            trainer.run(count)
            step += count
            if time.monotonic() >= end:
                break
            if self._track and step - count < frozen <= step < steps:
                trainer.psnr()  # what was sampled until now isn't of the result
        figures = (float(trainer.losses().mean()), trainer.psnr()) if self._track else ()
        if step < steps:
            return Advance(step, *figures)
        trainer.check()
        parts = trainer.quantised()
        self.close()
        return Advance(step, *(figures or (float("nan"),) * 2), parts)

    def state(self) -> dict[str, np.ndarray]:
        """Everything that later steps of the batch depend on.

        Raises:
            WlmError: The fit diverged.
        """
        return self._trainer.state()

    def close(self) -> None:
        """Drops the batch."""
        if self._trainer is not None:
            self._trainer.close()
            self._trainer = None
