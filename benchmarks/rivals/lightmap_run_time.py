"""Rivals of the virtual texture at run time: they keep whole lightmaps ready, decoded or as blocks of a GPU's format.

Each has two parts: `prepare(hour)` returns the work of a frame on the device, or None if there is none; `light(hour)`
returns the map that a renderer then reads, float32 [H, W, 3]. Gaps between charts show the nearest light inside, and
the light before the switch of a lamp is held until the switch, as the virtual texture does.
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import warp as wp

from benchmarks.rivals.lightmap import RIVALS
from benchmarks.rivals.rival import need_bc
from benchmarks.rivals.whole_map import WholeMap
from wlm import interop
from wlm.formats.shared_exponent import unpack_rgb9e5
from wlm.lightmap.data import SheetFrames
from wlm.lightmap.model import LightmapModel
from wlm.lightmap.tiles import TILE
from wlm.texels import nearest_valid
from wlm.workers import cores

_BLOCK_BYTES, _RANGE_BYTES = 16, 12  # of a block of 4 x 4 texels; of the range of a tile of BC7


def neighbours(times: np.ndarray, hour: float) -> tuple[int, int, float]:
    """Returns the stored times around an hour, of a day, and the weight of the later one. A lamp's switch is held.

    Args:
        times: Stored times in hours, rising.
        hour: From 0 to 24.

    Returns:
        Indices of the times before and after the hour, and the weight of the time after it, from 0 to 1.
    """
    after = int(np.searchsorted(times, hour, side="right"))
    before, after = (after - 1) % len(times), after % len(times)
    gap = (times[after] - times[before]) % 24.0
    held = gap <= np.median(np.diff(times)) / 4
    return before, after, 0.0 if held else float((hour - times[before]) % 24.0 / gap)


class EveryFrame:
    """All maps of a model with all their mips, decoded to RGB9E5 in every frame; two stored times are interpolated.

    The model has no light groups.

    Attributes:
        title: Name of the method.
        memory: Bytes on the GPU by part, without the decoder's scratch memory.
    """

    title = "all decoded each frame"
    _buffers = 1

    def __init__(self, model: LightmapModel, device: str) -> None:
        """Uploads all tiles and allocates the textures."""
        self._device = interop.check_device(device)
        with interop.stream(self._device):
            self._decoders = [WholeMap(own, self._device) for own in model.sheets.values()]
        self._times, self._mask = model.times, model.light.mask
        texels = sum(level.size for decoder in self._decoders for level in decoder.levels)
        self.memory = {"tiles": model.memory_bytes, "texture": self._buffers * 4 * texels}

    def prepare(self, hour: float) -> Callable[[], None] | None:
        """Sets the hour of the next frame, which is not part of its work, and returns the launches that decode it."""
        before, _, share = neighbours(self._times, hour)
        self._set_time(hour if share else float(self._times[before]))
        return self._decode

    def light(self, hour: float) -> np.ndarray:
        work = self.prepare(hour)
        with interop.stream(self._device):
            if work is not None:
                work()
            return self._mixed(neighbours(self._times, hour)[2])[nearest_valid(self._mask)]

    def _mixed(self, share: float) -> np.ndarray:
        """Returns the decoded map; `share` is the weight of the stored time after the hour."""
        return self._decoders[0].numpy()

    def _set_time(self, hour: float) -> None:
        with interop.stream(self._device):  # the stream of the frames
            for decoder in self._decoders:
                decoder.set_time(hour)

    def _decode(self) -> None:
        for decoder in self._decoders:
            decoder.decode()


class EveryTime(EveryFrame):
    """All maps decoded once for each stored time; a renderer reads those before and after the hour and interpolates."""

    title = "all decoded each stored time"
    _buffers = 2

    def __init__(self, model: LightmapModel, device: str) -> None:
        super().__init__(model, device)
        with interop.stream(self._device):
            self._late = [
                [wp.zeros(level.shape, dtype=level.dtype, device=level.device) for level in decoder.levels]
                for decoder in self._decoders
            ]
        self._held: list[int] = []

    def prepare(self, hour: float) -> Callable[[], None] | None:
        """Returns the launches that decode the times that the hour needs and that are not there yet; None if none."""
        wanted = list(neighbours(self._times, hour)[:2])
        if wanted == self._held:
            return None
        if self._held[1:] != wanted[:1]:  # the clock jumped
            self._set_time(float(self._times[wanted[0]]))
            with interop.stream(self._device):
                self._decode()
            self._swap()
        self._set_time(float(self._times[wanted[1]]))
        self._held = wanted

        def work() -> None:
            self._decode()
            self._swap()

        return work

    def _mixed(self, share: float) -> np.ndarray:
        early, late = (unpack_rgb9e5(level.numpy()) for level in (self._decoders[0].levels[0], self._late[0][0]))
        return np.float32(1.0 - share) * early + np.float32(share) * late

    def _swap(self) -> None:
        """Makes the maps that were just decoded the later ones; the next decode overwrites the earlier ones."""
        for i, decoder in enumerate(self._decoders):
            decoder.levels, self._late[i] = self._late[i], decoder.levels


class Blocks:
    """The lightmaps of all stored times as blocks with mips on the GPU; a renderer reads two of them and interpolates.

    Only the times that views need are encoded: the memory of the others is known.
    """

    def __init__(self, name: str, sheet: SheetFrames, hours: Iterable[float]) -> None:
        """Encodes the lightmaps around the hours.

        Args:
            name: "bc6h" or "bc7"; colours of BC7 are relative to the range of a tile, with gamma.
            sheet: The uncompressed lightmaps.
            hours: Times at which `light` will be called.

        Raises:
            WlmError: A package of the extra `baselines` is missing.
        """
        need_bc()
        self.title, self._sheet = f"{RIVALS[name].title} resident", sheet
        wanted = sorted({i for hour in hours for i in neighbours(sheet.times, hour)[:2]})
        with ThreadPoolExecutor(cores()) as pool:
            encoded = pool.map(lambda i: RIVALS[name].encode(sheet.frames[i], sheet.mask).decoded, wanted)
            self._decoded = dict(zip(wanted, encoded, strict=True))
        height, width = sheet.mask.shape
        size = -(-height // TILE) * -(-width // TILE) * _RANGE_BYTES if name == "bc7" else 0
        while True:
            size += _BLOCK_BYTES * -(-height // 4) * -(-width // 4)
            if height == width == 1:
                break
            height, width = max(height // 2, 1), max(width // 2, 1)
        self.memory = {"texture": size * len(sheet.times)}

    def prepare(self, hour: float) -> None:
        """Returns None: a frame has no work."""

    def light(self, hour: float) -> np.ndarray:
        before, after, share = neighbours(self._sheet.times, hour)
        mixed = (1 - np.float32(share)) * self._decoded[before] + np.float32(share) * self._decoded[after]
        return mixed[nearest_valid(self._sheet.mask)]
