"""Decodes whole tiles to RGB9E5: all data stays on the device, and a decode only launches kernels.

Each decoder decodes the tiles of one kind of one sheet, without filling gaps between charts: an `ExactDecoder`, on CUDA
a `MatrixDecoder`, and a `FrameDecoder`.
"""

import numpy as np
import warp as wp

from benchmarks.matrix_tiles import matrix_kernels
from wlm.errors import WlmError
from wlm.formats.shared_exponent import unpack_rgb9e5
from wlm.lightmap.decode import device_of, gelu_of
from wlm.lightmap.encodings.frames import FrameTiles
from wlm.lightmap.encodings.maps import MapTiles, split_networks
from wlm.lightmap.model import SheetModel
from wlm.lightmap.tiles import TILE
from wlm_kernels.lightmap.matrix_network import pack_networks
from wlm_kernels.shared_exponent import pack_rgb9e5

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _mix_kernel(
    # in:
    early: wp.array3d[wp.vec3],
    late: wp.array3d[wp.vec3],
    share: float,
    # out:
    out: wp.array3d[wp.uint32],
):
    i, y, x = wp.tid()
    light = early[i, y, x]
    if share > 0.0:
        light = (1.0 - share) * light + share * late[i, y, x]
    out[i, y, x] = pack_rgb9e5(light)


def _mix(early: wp.array, late: wp.array, share: float, out: wp.array) -> None:
    """Interpolates linear radiance between two times, vec3 [n, h, w] each, and packs it into `out`, uint32 [n, h, w].
    `share` is the weight of the later time, 0 to 1."""
    wp.launch(_mix_kernel, out.shape, inputs=[early, late, share], outputs=[out], device=out.device)


class TileDecoder:
    """Base class: decodes all tiles of one kind on a device at a time that `set_time` chooses.

    `decode` writes `out`, `wp.array` uint32 [n, 128, 128], in the order of the tiles' `numbers`: linear radiance as
    RGB9E5.
    """

    def __init__(self, model: SheetModel, tiles: MapTiles | FrameTiles, device: str) -> None:
        """Allocates the output. The time is initially the first stored one."""
        self.model, self.numbers, self.device = model, tiles.numbers, device
        self._rows = wp.array(np.arange(len(self.numbers), dtype=np.int32), dtype=int, device=device)
        self.out = self._empty(wp.uint32)
        self.set_time(float(model.times[0]))

    def _empty(self, dtype: type) -> wp.array:
        return wp.zeros((len(self.numbers), TILE, TILE), dtype=dtype, device=self.device)

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
        """Returns the radiance of the decoded tiles, float32 [n, 128, 128, 3]."""
        return unpack_rgb9e5(self.out.numpy())


class _MapDecoder(TileDecoder):
    """Base class of the decoders of dynamic tiles."""

    def __init__(self, model: SheetModel, device: str = "cpu", gelu: str | None = None) -> None:
        """Uploads the dynamic tiles and allocates all buffers; the time is initially the first stored one. `gelu` is a
        variant to use instead of the model's, see `wlm_kernels.mlp`."""
        device = device_of(device)
        self._tiles = MapTiles(model, device, gelu_of(model, gelu))
        super().__init__(model, self._tiles, device)

    def set_time(self, time: float) -> None:
        self._reads = self.model.axis.reads(time)
        self._states = [self._tiles.state(stamp) for stamp, _ in self._reads]
        self._share = self._reads[1][1] if len(self._reads) == 2 else 0.0


class MatrixDecoder(_MapDecoder):
    """Fast decoder of dynamic tiles on a GPU's matrix units (tensor cores), in half floats, with GELU by its tanh form.

    A decode is one launch, also between two stored times.
    """

    def __init__(self, model: SheetModel, device: str = "cuda") -> None:
        """Uploads the dynamic tiles of a sheet; for the arguments see `ExactDecoder`."""
        name, profile = device_of(device), model.profile
        if name == "cpu":
            raise WlmError("device: expected cuda for MatrixDecoder, got cpu")
        if profile.hidden % 16:
            raise WlmError(f"model: expected networks whose hidden width is a multiple of 16, got {profile.hidden}")
        super().__init__(model, name, "fast")
        self._kernels = matrix_kernels(profile.hidden, profile.uvt_resolution)
        packed = pack_networks(*split_networks(model.net.astype(np.float32), profile.hidden))
        self._packed = wp.array(packed, dtype=wp.uint32, device=self.device)

    def decode(self) -> None:
        stored, hidden, _ = self._tiles.arguments
        self._kernels.decode(stored, self._packed, hidden, self._states, self._share, self._rows, self.out)


class ExactDecoder(_MapDecoder):
    """Plain decoder of dynamic tiles: a thread decodes a texel, in the training's order of operations."""

    def __init__(self, model: SheetModel, device: str = "cpu", gelu: str | None = None) -> None:
        super().__init__(model, device, gelu)
        self._light = self._empty(wp.vec3), self._empty(wp.vec3)

    def decode(self) -> None:
        for state, light in zip(self._states, self._light, strict=False):
            self._tiles.launch(state, self._rows, light)
        _mix(*self._light, self._share, self.out)


class FrameDecoder(TileDecoder):
    """Decoder of tiles that are stored as frames: one thread reads one texel of one frame, or of two to interpolate."""

    def __init__(self, model: SheetModel, device: str = "cpu") -> None:
        """Uploads the frames of a sheet and allocates all buffers; for the arguments see `ExactDecoder`."""
        device = device_of(device)
        self._tiles = FrameTiles(model, device)
        super().__init__(model, self._tiles, device)
        self._light = self._empty(wp.vec3)

    def set_time(self, time: float) -> None:
        self._time = time

    def decode(self) -> None:
        self._tiles.decode(self._time, self._rows, self._light)
        _mix(self._light, self._light, 0.0, self.out)


def fast_decoder(model: SheetModel, device: str = "cpu") -> ExactDecoder | MatrixDecoder:
    """Makes the fastest decoder of dynamic tiles: on CUDA a `MatrixDecoder` if network width and GELU allow it."""
    device = device_of(device)
    tanh = device != "cpu" and model.profile.gelu == "tanh"
    if tanh and model.profile.hidden % 16 == 0:
        return MatrixDecoder(model, device)
    return ExactDecoder(model, device, "fast" if tanh else None)
