"""Decoding to 8 bits at runtime: everything stays on the device, and a decode is launches alone.

`wlm.lightmap.Decoder` returns arrays on the host; these two are for a renderer's loop. Each holds the tiles of one
kind: a whole map is a `StripDecoder`, an `ExactDecoder` of the static tiles if there are any, and
`Decoder.tiles_8bit` for the constant tiles, one colour each, which need no launch.
"""

import numpy as np
import warp as wp

from wlm import interop
from wlm.lightmap.decode import StoredTiles, TimeTable, gelu_of
from wlm.lightmap.model import TILE, LightmapModel
from wlm.lightmap.tiles import TileKind
from wlm_kernels.lightmap import decode as lightmap_decode


class _TileDecoder:
    """The tiles of one kind on a device, and the time at which they are decoded."""

    def __init__(self, model: LightmapModel, device: str, gelu: str | None, kind: TileKind) -> None:
        self.model, self.device, self.gelu = model, interop.check_device(device), gelu_of(model, gelu)
        self._stored = StoredTiles(model, kind, self.device)
        self.numbers = self._stored.numbers
        self._tiles = wp.array(np.arange(len(self.numbers), dtype=np.int32), dtype=int, device=self.device)
        self._times = TimeTable(model, self.device)
        self._state = None
        self.set_time(float(model.times[0]))

    def set_time(self, time: float) -> None:
        """Sets the time of the decodes that follow.

        The arrays of the old time are overwritten in place, but its place on the time axis is an argument of the
        launches: a CUDA graph captured before is out of date and must be captured again.

        Args:
            time: In the unit of the set's times, stored or between; see `Decoder`.

        Raises:
            WlmError: It isn't finite.
        """
        self._state = self._times.at(time, self._state)
        self._bounds = self._times.bounds(time)[self._stored.rows]

    @property
    def bounds(self) -> np.ndarray:
        """What 255 stands for in gamma space, float32 [n]: radiance = (byte / 255 * bound) ** gamma."""
        return self._bounds.copy()


class StripDecoder(_TileDecoder):
    """The fast path of dynamic tiles: one thread decodes four texels (section 3.5).

    Attributes:
        numbers: int [n], numbers of the dynamic tiles in the grid, in the order of `out`.
        out: `wp.array` uint32 [n, 128, 128], RGBA from the lowest byte, alpha 255; written by `decode`.
        gelu: The GELU in use.
    """

    def __init__(self, model: LightmapModel, device: str = "cpu", gelu: str | None = None) -> None:
        """Uploads the model's dynamic tiles and allocates all buffers; the time is the first stored one.

        Args:
            model: The model.
            device: "cpu", "cuda" or "cuda:N".
            gelu: Another GELU than the model's, see `wlm_kernels.mlp`; None: the model's.

        Raises:
            WlmError: No such device or GELU, or a model without dynamic tiles.
        """
        super().__init__(model, device, gelu, TileKind.DYNAMIC)
        n, resolution = len(self.numbers), model.profile.uvt_resolution
        self._kernels = lightmap_decode.strip_kernels(model.profile.hidden, self.gelu)
        self._scratch = (
            wp.empty((n, resolution, resolution), dtype=wp.vec4, device=self.device),
            wp.empty((n, model.profile.hidden, TILE), dtype=float, device=self.device),
            wp.empty((n, TILE), dtype=wp.vec2, device=self.device),
        )
        self.out = wp.zeros((n, TILE, TILE), dtype=wp.uint32, device=self.device)

    def decode(self) -> None:
        """Decodes all tiles into `out`: three launches, no allocation, no wait; can be captured."""
        stored = self._stored
        self._kernels.decode(*stored.arguments, self._state, *self._scratch, stored.places, self._tiles, self.out)

    def numpy(self) -> np.ndarray:
        """The last decode on the host, uint8 [n, 128, 128, 4]."""
        words = np.ascontiguousarray(self.out.numpy().astype("<u4"))
        return words.view(np.uint8).reshape(*words.shape, 4)


class ExactDecoder(_TileDecoder):
    """The plain path of static or dynamic tiles: one thread decodes one texel, in training's order of operations.

    Attributes:
        numbers: int [n], numbers of the tiles of that kind in the grid, in the order of `out`.
        out: `wp.array` vec4ub [n, 128, 128], RGBA, alpha 255; written by `decode`.
        gelu: The GELU in use.
    """

    def __init__(
        self,
        model: LightmapModel,
        device: str = "cpu",
        gelu: str | None = None,
        kind: TileKind = TileKind.DYNAMIC,
    ) -> None:
        """Uploads the model's tiles of one kind; the other arguments and errors are those of `StripDecoder`.

        Args:
            kind: STATIC or DYNAMIC.
        """
        super().__init__(model, device, gelu, kind)
        self._kernel = lightmap_decode.exact_kernels(kind == TileKind.DYNAMIC, model.profile.hidden, self.gelu)[1]
        self.out = wp.zeros((len(self.numbers), TILE, TILE), dtype=wp.vec4ub, device=self.device)

    def decode(self) -> None:
        """Decodes all tiles into `out`: one launch, no allocation, no wait; can be captured."""
        stored = self._stored
        wp.launch(
            self._kernel,
            self.out.shape,
            inputs=[*stored.arguments, self._state, stored.places, self._tiles],
            outputs=[self.out],
            device=self.device,
        )

    def numpy(self) -> np.ndarray:
        """The last decode on the host, uint8 [n, 128, 128, 4]."""
        return self.out.numpy()
