"""Decoding to 8 bits at runtime: everything stays on the device, and a decode is launches alone.

``wlm.lightmap.decode.Decoder`` answers questions from the host; these two are for a renderer's loop. Each holds the
tiles of one kind: a whole map is a ``StripDecoder``, an ``ExactDecoder`` of the static tiles if there are any, and
``Decoder.tiles_8bit`` for the constant tiles, one colour each, which need no launch.
"""

import numpy as np
import warp as wp

from wlm import interop
from wlm.errors import WlmError
from wlm.lightmap.decode import Decoder, upload
from wlm.lightmap.model import TILE, LightmapModel
from wlm.lightmap.tiles import TileKind
from wlm_kernels.lightmap import decode as lightmap_decode

__all__ = ["ExactDecoder", "StripDecoder"]


class _TileDecoder:
    """The tiles of one kind on a device, and the time that they are decoded at."""

    def __init__(self, model: LightmapModel, device: str, gelu: str | None, kind: TileKind):
        self.model, self.device = model, interop.check_device(device)
        # On the host, where it only has to say what a time looks like (and to check the GELU).
        self._host = Decoder(model, "cpu", gelu)
        self.gelu = self._host.gelu
        mapped = np.flatnonzero(model.kind >= TileKind.STATIC)
        rows = np.flatnonzero(model.kind[mapped] == kind)
        if not len(rows):
            raise WlmError(f"{model.name}: expected at least one {kind.name.lower()} tile, found none")
        self.numbers = mapped[rows]
        self._rows = rows
        self._stored, self._hidden, self._output = upload(model, kind, rows, self.device)
        self._places = wp.array(rows.astype(np.int32), dtype=int, device=self.device)
        self._tiles = wp.array(np.arange(len(rows), dtype=np.int32), dtype=int, device=self.device)
        self._look = lightmap_decode.Look()
        self._look.gamma = model.profile.gamma
        for field, dtype in _LOOK_ARRAYS.items():
            setattr(self._look, field, wp.empty(len(mapped), dtype=dtype, device=self.device))
        self.set_time(float(model.times[0]))

    def set_time(self, time: float) -> None:
        """Sets the time of the decodes that follow.

        The arrays of the old time are overwritten in place, but its place on the time axis is an argument of the
        launches: a CUDA graph captured before is out of date and must be captured again.

        Args:
            time: In the unit of the set's times, stored or between; see ``Decoder``.

        Raises:
            WlmError: It isn't finite.
        """
        look = self._host.look(time)
        for field in _LOOK_ARRAYS:
            wp.copy(getattr(self._look, field), getattr(look, field))
        self._look.tau, self._look.encoding = look.tau, look.encoding
        inverse = look.inverse_peak.numpy()[self._rows]
        self._bounds = np.divide(1.0, inverse, out=np.zeros_like(inverse), where=inverse > 0)

    @property
    def bounds(self) -> np.ndarray:
        """What 255 stands for in gamma space, float32 [n]: radiance = (byte / 255 * bound) ** gamma."""
        return self._bounds.copy()


_LOOK_ARRAYS = {"scale": wp.vec3, "inverse_peak": float, "shift": wp.vec3, "spread": wp.vec3}


class StripDecoder(_TileDecoder):
    """The fast path of dynamic tiles: a thread decodes four texels (section 3.5).

    Attributes:
        numbers: int [n], numbers of the dynamic tiles in the grid, in the order of ``out``.
        out: ``wp.array`` uint32 [n, 128, 128], RGBA from the lowest byte, alpha 255; written by ``decode``.
        gelu: The GELU in use.
    """

    def __init__(self, model: LightmapModel, device: str = "cpu", gelu: str | None = None):
        """Uploads the model's dynamic tiles and allocates everything; the time is the first stored one.

        Args:
            model: From ``codec.read`` or ``fit.compress``.
            device: "cpu" or "cuda:0".
            gelu: Another GELU than the model's own, see ``wlm_kernels.mlp``; None: its own.

        Raises:
            WlmError: On a device or a GELU that isn't there, or a model without dynamic tiles.
        """
        super().__init__(model, device, gelu, TileKind.DYNAMIC)
        n, resolution = len(self.numbers), model.profile.uvt_resolution
        self._kernels = lightmap_decode.strip_kernels(model.profile.hidden, self.gelu)
        self._volume = wp.empty((n, resolution, resolution), dtype=wp.vec4, device=self.device)
        self._columns = wp.empty((n, model.profile.hidden, TILE), dtype=float, device=self.device)
        self._lines = wp.empty((n, TILE), dtype=wp.vec2, device=self.device)
        self.out = wp.zeros((n, TILE, TILE), dtype=wp.uint32, device=self.device)

    def decode(self) -> None:
        """Decodes all tiles into ``out``: three launches, no allocation, nothing awaited; can be captured."""
        self._kernels.decode(
            self._stored,
            self._hidden,
            self._output,
            self._look,
            self._volume,
            self._columns,
            self._lines,
            self._places,
            self._tiles,
            self.out,
        )

    def numpy(self) -> np.ndarray:
        """The last decode on the host, uint8 [n, 128, 128, 4]."""
        words = np.ascontiguousarray(self.out.numpy().astype("<u4"))
        return words.view(np.uint8).reshape(*words.shape, 4)


class ExactDecoder(_TileDecoder):
    """The plain path of static or dynamic tiles: a thread decodes one texel, in training's order of operations.

    Attributes:
        numbers: int [n], numbers of the tiles of that kind in the grid, in the order of ``out``.
        out: ``wp.array`` vec4ub [n, 128, 128], RGBA, alpha 255; written by ``decode``.
        gelu: The GELU in use.
    """

    def __init__(
        self,
        model: LightmapModel,
        device: str = "cpu",
        gelu: str | None = None,
        kind: TileKind = TileKind.DYNAMIC,
    ):
        """Uploads the model's tiles of one kind; the other arguments and errors are those of ``StripDecoder``.

        Args:
            kind: STATIC or DYNAMIC.
        """
        super().__init__(model, device, gelu, kind)
        dynamic = kind == TileKind.DYNAMIC
        self._kernel = lightmap_decode.exact_kernels(dynamic, model.profile.hidden, self.gelu)[1]
        self.out = wp.zeros((len(self.numbers), TILE, TILE), dtype=wp.vec4ub, device=self.device)

    def decode(self) -> None:
        """Decodes all tiles into ``out``: one launch, no allocation, nothing awaited; can be captured."""
        wp.launch(
            self._kernel,
            self.out.shape,
            inputs=[self._stored, self._hidden, self._output, self._look, self._places, self._tiles],
            outputs=[self.out],
            device=self.device,
        )

    def numpy(self) -> np.ndarray:
        """The last decode on the host, uint8 [n, 128, 128, 4]."""
        return self.out.numpy()
