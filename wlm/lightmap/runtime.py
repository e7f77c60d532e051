"""Decoding to 32 bits a texel at runtime: everything stays on the device, and a decode is launches alone.

`wlm.lightmap.Decoder` returns arrays on the host; these are for a renderer's loop. Each holds the tiles of one kind,
gaps unfilled: a `StripDecoder`, or on CUDA a `MatrixDecoder` where networks are wide, an `ExactDecoder` of the static
tiles and a `FrameDecoder` each of frames and of video and levels. `wlm.lightmap.page` puts them together to a texture
of the map.
"""

import numpy as np
import warp as wp

from wlm import interop
from wlm.errors import WlmError
from wlm.formats.shared_exponent import unpack_rgb9e5
from wlm.lightmap.decode import StoredTiles, TimeTable, gelu_of, rgba
from wlm.lightmap.frame_decode import IMAGE_TILES, inverse_of
from wlm.lightmap.model import TILE, LightmapModel
from wlm.lightmap.tiles import TileKind
from wlm_kernels.lightmap import decode as lightmap_decode
from wlm_kernels.lightmap import matrix_decode, output


class _TileDecoder:
    """The tiles of one kind on a device, and the time at which they are decoded."""

    def __init__(self, model: LightmapModel, device: str, gelu: str | None, kind: TileKind, shared: bool) -> None:
        self.shared = shared
        self.model, self.device, self.gelu = model, interop.check_device(device), gelu_of(model, gelu)
        self._stored = StoredTiles(model, kind, self.device)
        self.numbers = self._stored.numbers
        self._tiles = wp.array(np.arange(len(self.numbers), dtype=np.int32), dtype=int, device=self.device)
        self._times = TimeTable(model, self.device)
        self.out, self._early, self._late = (self._empty() for _ in range(3))
        self._states = [None, None]
        self.set_time(float(model.times[0]))

    def _empty(self) -> wp.array:
        return wp.zeros((len(self.numbers), TILE, TILE), dtype=wp.uint32, device=self.device)

    def set_time(self, time: float) -> None:
        """Sets the time of the decodes that follow.

        The arrays of the old time are overwritten in place, but its place on the time axis is an argument of the
        launches: a CUDA graph captured before is out of date and must be captured again. Between two stored times both
        are decoded and mixed: a renderer that keeps the two and mixes them itself decodes once for each stored time.

        Args:
            time: In the unit of the set's times, stored or between; see `Decoder`.

        Raises:
            WlmError: It isn't finite.
        """
        self._reads = self._times.reads(time)
        for i, (stamp, _) in enumerate(self._reads):
            self._states[i] = self._times.at(stamp, self._states[i])
        self._bounds = self._times.bounds(time)[self._stored.rows]

    def decode(self) -> None:
        """Decodes all tiles into `out`: launches alone, no allocation, no wait; can be captured."""
        if len(self._reads) == 1:
            self._launch(self._states[0], self.out)
        else:
            early, late = self._states
            self._launch(early, self._early)
            self._launch(late, self._late)
            share, arrays = self._reads[1][1], (self._early, self._late, self.out)
            if self.shared:
                *both, out = (array.flatten() for array in arrays)
                output.blend_shared(*both, share, out)
            else:
                *both, out = (array.reshape((len(self.numbers), -1)) for array in arrays)
                inverse = early.inverse_peak, late.inverse_peak
                output.blend(*both, *inverse, self._stored.places, share, self.model.profile.gamma, out)

    def numpy(self) -> np.ndarray:
        """The last decode on the host, uint8 [n, 128, 128, 4]; of RGB9E5 linear radiance, float32 [n, 128, 128, 3]."""
        return unpack_rgb9e5(self.out.numpy()) if self.shared else rgba(self.out)

    @property
    def bounds(self) -> np.ndarray:
        """What 255 stands for in gamma space where texels have 8 bits, float32 [n]: radiance = (byte / 255 * bound) **
        gamma."""
        return self._bounds.copy()


class StripDecoder(_TileDecoder):
    """The fast path of dynamic tiles: one thread decodes four texels (section 3.5).

    Attributes:
        numbers: int [n], numbers of the dynamic tiles in the grid, in the order of `out`.
        out: `wp.array` uint32 [n, 128, 128], RGBA from the lowest byte, alpha 255, or RGB9E5; written by `decode`.
        gelu: The GELU in use.
    """

    def __init__(
        self, model: LightmapModel, device: str = "cpu", gelu: str | None = None, shared: bool = False
    ) -> None:
        """Uploads the model's dynamic tiles and allocates all buffers; the time is the first stored one.

        Args:
            model: The model.
            device: "cpu", "cuda" or "cuda:N".
            gelu: Another GELU than the model's, see `wlm_kernels.mlp`; None: the model's.
            shared: Texels are linear radiance with a shared exponent (RGB9E5) rather than 8 bits over a bound.

        Raises:
            WlmError: No such device or GELU, or a model without dynamic tiles.
        """
        super().__init__(model, device, gelu, TileKind.DYNAMIC, shared)
        n, resolution = len(self.numbers), model.profile.uvt_resolution
        self._kernels = lightmap_decode.strip_kernels(model.profile.hidden, self.gelu, shared)
        self._scratch = (
            wp.empty((n, resolution, resolution), dtype=wp.vec4, device=self.device),
            wp.empty((n, model.profile.hidden, TILE), dtype=float, device=self.device),
            wp.empty((n, TILE), dtype=wp.vec2, device=self.device),
        )

    def _launch(self, state: lightmap_decode.TimeState, out: wp.array) -> None:
        stored = self._stored
        self._kernels.decode(*stored.arguments, state, *self._scratch, stored.places, self._tiles, out)


class MatrixDecoder(_TileDecoder):
    """The fast path of dynamic tiles with wide networks, on a GPU's matrix units, in half floats.

    Attributes:
        numbers, out: As of `StripDecoder`.
        gelu: "fast".
    """

    def __init__(self, model: LightmapModel, device: str = "cuda", shared: bool = False) -> None:
        """Uploads the model's dynamic tiles and allocates all buffers; the time is the first stored one.

        Args:
            model: The model, of a hidden width that is a multiple of 16.
            device: "cuda" or "cuda:N".
            shared: As of `StripDecoder`.

        Raises:
            WlmError: No such device, another width, or a model without dynamic tiles.
        """
        name, hidden = interop.check_device(device), model.profile.hidden
        if name == "cpu":
            raise WlmError("device: expected cuda for the matrix path, got cpu")
        if hidden % 16:
            raise WlmError(f"hidden: expected a multiple of 16 for the matrix path, got {hidden}")
        super().__init__(model, name, "fast", TileKind.DYNAMIC, shared)
        n, resolution = len(self.numbers), model.profile.uvt_resolution
        self._kernels = matrix_decode.matrix_kernels(hidden, shared)
        self._scratch = (
            wp.empty((n, resolution, resolution), dtype=wp.vec4, device=self.device),
            *(wp.empty((n, TILE), dtype=wp.vec2, device=self.device) for _ in range(2)),
        )

    def _launch(self, state: lightmap_decode.TimeState, out: wp.array) -> None:
        stored = self._stored
        self._kernels.decode(*stored.arguments, state, *self._scratch, stored.places, self._tiles, out)


class ExactDecoder(_TileDecoder):
    """The plain path of static or dynamic tiles: one thread decodes one texel, in training's order of operations.

    Attributes:
        numbers: int [n], numbers of the tiles of that kind in the grid, in the order of `out`.
        out: `wp.array` uint32 [n, 128, 128], RGBA from the lowest byte, alpha 255, or RGB9E5; written by `decode`.
        gelu: The GELU in use.
    """

    def __init__(
        self,
        model: LightmapModel,
        device: str = "cpu",
        gelu: str | None = None,
        kind: TileKind = TileKind.DYNAMIC,
        shared: bool = False,
    ) -> None:
        """Uploads the model's tiles of one kind; the other arguments and errors are those of `StripDecoder`.

        Args:
            kind: STATIC or DYNAMIC.
        """
        super().__init__(model, device, gelu, kind, shared)
        kernels = lightmap_decode.exact_kernels(kind == TileKind.DYNAMIC, model.profile.hidden, self.gelu)
        self._kernel = kernels[1 + shared]

    def _launch(self, state: lightmap_decode.TimeState, out: wp.array) -> None:
        stored = self._stored
        wp.launch(
            self._kernel,
            out.shape,
            inputs=[*stored.arguments, state, stored.places, self._tiles],
            outputs=[out],
            device=self.device,
        )


class FrameDecoder:
    """The tiles that are stored as frames, or as video and levels: one thread reads one texel of one or two images.

    Attributes:
        numbers: int [n], numbers of these tiles in the grid, in the order of `out`.
        out: `wp.array` uint32 [n, 128, 128], RGBA from the lowest byte, alpha 255, or RGB9E5; written by `decode`.
    """

    def __init__(
        self, model: LightmapModel, device: str = "cpu", kind: TileKind = TileKind.FRAMES, shared: bool = False
    ) -> None:
        """Uploads the images, video and levels unpacked, and allocates all buffers; the time is the first stored one.

        Args:
            model: The model.
            device: "cpu", "cuda" or "cuda:N".
            kind: FRAMES, or VIDEO of all that is unpacked, levels too.
            shared: As of `StripDecoder`.

        Raises:
            WlmError: No such device, or a model without such tiles.
        """
        self.model, self.device, self.shared = model, interop.check_device(device), shared
        self._tiles = IMAGE_TILES[kind](model, self.device)
        self.numbers = self._tiles.numbers
        count = len(self.numbers)
        self._rows = wp.array(np.arange(count, dtype=np.int32), dtype=int, device=self.device)
        self.out = wp.zeros((count, TILE, TILE), dtype=wp.uint32, device=self.device)
        self._inverse = wp.empty(count, dtype=float, device=self.device)
        self.set_time(float(model.times[0]))

    def set_time(self, time: float) -> None:
        """Sets the time of the decodes that follow; a graph captured before is out of date, as of `StripDecoder`.

        Args:
            time: In the unit of the set's times, stored or between: there the radiance of both is mixed.

        Raises:
            WlmError: It isn't finite.
        """
        if not np.isfinite(time):
            raise WlmError(f"time: expected a finite number, got {time}")
        self._time, self._bounds = time, self._tiles.bounds(time)
        self._inverse.assign(inverse_of(self._bounds))

    def decode(self) -> None:
        """Decodes all tiles into `out`: launches alone, no allocation, no wait; can be captured."""
        self._tiles.decode(self._time, self._rows, self.out, None if self.shared else self._inverse)

    def numpy(self) -> np.ndarray:
        """The last decode on the host, uint8 [n, 128, 128, 4]; of RGB9E5 linear radiance, float32 [n, 128, 128, 3]."""
        return unpack_rgb9e5(self.out.numpy()) if self.shared else rgba(self.out)

    @property
    def bounds(self) -> np.ndarray:
        """What 255 stands for in gamma space where texels have 8 bits, float32 [n]: radiance = (byte / 255 * bound) **
        gamma."""
        return self._bounds.copy()


def fast_decoder(model: LightmapModel, device: str = "cpu", shared: bool = False) -> StripDecoder | MatrixDecoder:
    """The fastest decoder of a model's dynamic tiles: on CUDA a `MatrixDecoder`, where its width and GELU allow it.

    Args:
        model, device, shared: As of `StripDecoder`.

    Raises:
        WlmError: As `StripDecoder`.
    """
    device = interop.check_device(device)
    tanh = device != "cpu" and model.profile.gelu == "tanh"
    if tanh and model.profile.hidden % 16 == 0:
        return MatrixDecoder(model, device, shared)
    return StripDecoder(model, device, "fast" if tanh else None, shared)
