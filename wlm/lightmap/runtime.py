"""Decodes to 32 bits per texel at run time: all data stays on the device, and a decode only launches kernels.

`wlm.lightmap.Decoder` returns arrays on the host; the decoders of this module are for a renderer's loop. Each decodes
the tiles of one kind of one sheet, without filling gaps between charts: an `ExactDecoder`, on CUDA a `MatrixDecoder`,
and a `FrameDecoder`. `wlm.lightmap.VirtualTexture` fills gaps, adds light groups and has mips.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from wlm.errors import WlmError
from wlm.formats.shared_exponent import unpack_rgb9e5
from wlm.lightmap.decode import device_of, gelu_of
from wlm.lightmap.encodings.base import inverse_of, rgba
from wlm.lightmap.encodings.frames import FrameTiles
from wlm.lightmap.encodings.maps import MapTiles, split_networks
from wlm.lightmap.model import SheetModel
from wlm.lightmap.tiles import TILE
from wlm_kernels.lightmap import decode as decode_kernels
from wlm_kernels.lightmap import matrix_decode, output


class RuntimeDecoder:
    """Base class: decodes all tiles of one kind on a device at a time that `set_time` chooses.

    `decode` writes `out`, `wp.array` uint32 [n, 128, 128], in the order of the tiles' `numbers`: 8-bit RGBA with R in
    the lowest byte and alpha 255; or RGB9E5.
    """

    _tiles: MapTiles | FrameTiles

    def __init__(self, model: SheetModel, device: str, shared: bool) -> None:
        """Allocates the output: RGB9E5 if `shared`, else 8-bit RGBA. The time is initially the first stored one."""
        self.model, self.device, self.shared = model, device, shared
        self.numbers = self._tiles.numbers
        self._rows = wp.array(np.arange(len(self.numbers), dtype=np.int32), dtype=int, device=device)
        self.out = self._empty()
        self.set_time(float(model.times[0]))

    def _empty(self) -> wp.array:
        return wp.zeros((len(self.numbers), TILE, TILE), dtype=wp.uint32, device=self.device)

    def set_time(self, time: float) -> None:
        """Sets the time of the following decodes, in the unit of the set's times, stored or between; see
        `wlm.lightmap.decode.SheetDecoder`.

        A CUDA graph that was captured before must be captured again, because the position on the time axis is an
        argument of the launches. Between two stored times, each decode decodes the light of both times and
        interpolates. A renderer that keeps the light of both and interpolates by itself only has to decode once for
        each stored time.
        """
        raise NotImplementedError

    def decode(self) -> None:
        """Decodes all tiles into `out`. It only launches kernels, so that a CUDA graph can capture it."""
        raise NotImplementedError

    def numpy(self) -> np.ndarray:
        """Returns the decoded tiles: RGBA, uint8 [n, 128, 128, 4]; for RGB9E5 radiance, float32 [n, 128, 128, 3]."""
        return unpack_rgb9e5(self.out.numpy()) if self.shared else rgba(self.out)

    @property
    def bounds(self) -> np.ndarray:
        """Bound of each tile's 8-bit colours, float32 [n]: radiance = (byte / 255 * bound) ** gamma."""
        return self._tiles.bounds(self._time).copy()


class _MapDecoder(RuntimeDecoder):
    """Base class of the decoders of dynamic tiles."""

    def __init__(
        self,
        model: SheetModel,
        device: str = "cpu",
        gelu: str | None = None,
        shared: bool = False,
    ) -> None:
        """Uploads the dynamic tiles and allocates all buffers; the time is initially the first stored one.

        `gelu` is a variant to use instead of the model's, see `wlm_kernels.mlp`; with `shared`, texels are linear
        radiance as RGB9E5 instead of 8-bit colour relative to `bounds`.
        """
        device, self.gelu = device_of(device), gelu_of(model, gelu)
        self._tiles = MapTiles(model, device, self.gelu)
        self._states: list[decode_kernels.TimeState | None] = [None, None]
        super().__init__(model, device, shared)

    def set_time(self, time: float) -> None:
        self._time, self._reads = time, self.model.axis.reads(time)
        for i, (stamp, _) in enumerate(self._reads):
            self._states[i] = self._tiles.state(stamp, self._states[i])


class MatrixDecoder(_MapDecoder):
    """Fast decoder of dynamic tiles on a GPU's matrix units (tensor cores), in half floats, with GELU by its tanh form.

    A decode is one launch, also between two stored times.
    """

    def __init__(self, model: SheetModel, device: str = "cuda", shared: bool = False) -> None:
        """Uploads the dynamic tiles of a sheet; for the arguments see `ExactDecoder`."""
        name, profile = device_of(device), model.profile
        if name == "cpu":
            raise WlmError("device: expected cuda for MatrixDecoder, got cpu")
        if profile.hidden % 16:
            raise WlmError(f"model: expected networks whose hidden width is a multiple of 16, got {profile.hidden}")
        super().__init__(model, name, "fast", shared)
        self._kernels = matrix_decode.matrix_kernels(profile.hidden, profile.uvt_resolution, shared)
        packed = matrix_decode.pack_networks(*split_networks(model.net.astype(np.float32), profile.hidden))
        self._packed = wp.array(packed, dtype=wp.uint32, device=self.device)

    def decode(self) -> None:
        (stored, hidden, _), states = self._tiles.arguments, self._states[: len(self._reads)]
        share = self._reads[1][1] if len(states) == 2 else 0.0
        self._kernels.decode(stored, self._packed, hidden, states, share, self._rows, self.out)


class ExactDecoder(_MapDecoder):
    """Plain decoder of dynamic tiles: a thread decodes a texel, in the training's order of operations.

    Between two stored times, a last kernel interpolates the results of both.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._early, self._late = self._empty(), self._empty()

    def decode(self) -> None:
        early, late = self._states
        if len(self._reads) == 1:
            self._launch(early, self.out)
            return
        self._launch(early, self._early)
        self._launch(late, self._late)
        share, arrays = self._reads[1][1], (self._early, self._late, self.out)
        if self.shared:
            *both, out = (array.flatten() for array in arrays)
            output.blend_shared(*both, share, out)
        else:
            *both, out = (array.reshape((len(self.numbers), -1)) for array in arrays)
            output.blend(*both, early.inverse_peak, late.inverse_peak, share, self.model.profile.gamma, out)

    def _launch(self, state: decode_kernels.TimeState, out: wp.array) -> None:
        self._tiles.launch(state, self._rows, 1 + self.shared, out)


class FrameDecoder(RuntimeDecoder):
    """Decoder of tiles that are stored as frames: one thread reads one texel of one frame, or of two to interpolate."""

    def __init__(self, model: SheetModel, device: str = "cpu", shared: bool = False) -> None:
        """Uploads the frames of a sheet and allocates all buffers; for the arguments see `ExactDecoder`."""
        device = device_of(device)
        self._tiles = FrameTiles(model, device)
        self._inverse = wp.empty(len(self._tiles.numbers), dtype=float, device=device)
        super().__init__(model, device, shared)

    def set_time(self, time: float) -> None:
        self._time = time
        self._inverse.assign(inverse_of(self._tiles.bounds(time)))

    def decode(self) -> None:
        self._tiles.decode(self._time, self._rows, self.out, None if self.shared else self._inverse)


def fast_decoder(model: SheetModel, device: str = "cpu", shared: bool = False) -> ExactDecoder | MatrixDecoder:
    """Makes the fastest decoder of dynamic tiles: on CUDA a `MatrixDecoder` if network width and GELU allow it."""
    device = device_of(device)
    tanh = device != "cpu" and model.profile.gelu == "tanh"
    if tanh and model.profile.hidden % 16 == 0:
        return MatrixDecoder(model, device, shared)
    return ExactDecoder(model, device, "fast" if tanh else None, shared=shared)
