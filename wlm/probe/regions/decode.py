"""Decodes a model in regions, of which those are on the device that were needed last."""

from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import warp as wp

from wlm.errors import WlmError
from wlm.formats.hours import DAY
from wlm.probe.gaussian.decode import GaussianDecoder, PointDecoder, Points
from wlm.probe.gaussian.model import CUT, check_outputs
from wlm.probe.hours import check_time
from wlm.probe.model import ProbeModel, check_points
from wlm.probe.regions.model import Regions
from wlm.probe.sphere import ambient_numbers
from wlm.probe.volume.light import ABSENT, Light
from wlm_kernels.probe import volume_frame as frame_kernels
from wlm_kernels.probe.decode import Region, decode_kernels

MEMORY = 256 << 20
"""Bytes of regions that stay on the device by default; a million probes take about a tenth."""


class RegionDecoder(PointDecoder):
    """A model in regions on a device. Regions are read from the file when they are needed first, and leave the device
    when others need their memory, the least recently needed ones first."""

    def __init__(
        self, model: ProbeModel, device: str = "cpu", *, position: np.ndarray | None = None, most_bytes: int = MEMORY
    ) -> None:
        """Prepares an empty decoder. `model`, `device` and `position` are as for `wlm.probe.decode.Decoder`.
        `most_bytes` are bytes of device memory for regions. Regions that are needed at once may take more. Errors are
        those of `wlm.probe.decode.Decoder`."""
        super().__init__(model, device, position=position)
        assert isinstance(model.content, Regions)
        self._content = content = model.content
        profile, relative = content.profile, content.profile.error == "relative"
        check_outputs(model.name, profile.latent, profile.hidden, model.outputs, relative, self.device)
        sizes = profile.latent, profile.hidden, model.outputs, relative, ambient_numbers(model.outputs)
        self._kernels = decode_kernels(*sizes, "cpu" if self.device == "cpu" else "cuda")
        self._most = most_bytes
        self._loaded: dict[int, GaussianDecoder] = {}  # the most recently needed ones last
        self._coming: dict[int, Future[ProbeModel]] = {}
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="wlm regions")
        self._entries = [_absent(ABSENT) for _ in range(content.tree.count)]
        self._table = wp.array(self._entries, dtype=Region, device=self.device)
        self._asked = wp.zeros(content.tree.count, dtype=int, device=self.device)

    @property
    def loaded(self) -> tuple[int, ...]:
        """The regions on the device, the most recently needed ones last."""
        return tuple(self._loaded)

    @property
    def device_bytes(self) -> int:
        return self._table.capacity + sum(each.device_bytes for each in self._loaded.values())

    def set_time(self, time: float) -> None:
        check_time(time)
        self.time = None if self.time is None else time % DAY
        for each in self._loaded.values():
            each.set_time(time)

    def load(self, regions: np.ndarray) -> None:
        """Brings regions, int [M], onto the device, in place of others if there is no room. Raises a WlmError if a
        region is damaged; those before it are loaded."""
        missing = [number for number in regions.tolist() if not self._touch(number)]
        try:
            for number in missing:
                self._put_region(number, self._content.region(number), regions)
        finally:
            if missing:
                self._table.assign(self._entries)

    def _touch(self, number: int) -> bool:
        """Returns whether a region is loaded, and makes it the most recent one."""
        if number not in self._loaded:
            return False
        self._loaded[number] = self._loaded.pop(number)
        return True

    def _put_region(self, number: int, model: ProbeModel, needed: np.ndarray) -> None:
        self._loaded[number] = made = GaussianDecoder(model, self.device)
        made.set_time(self.time or 0.0)
        self._entries[number] = made.region()
        for old in [each for each in self._loaded if each not in needed]:
            if self.device_bytes <= self._most:
                break
            del self._loaded[old]
            self._entries[old] = _absent(ABSENT)

    def points(self, position: np.ndarray) -> Points:
        """Uploads points and loads their regions; see `PointDecoder.points`."""
        region, x = self._content.place(self._inside(position))
        order = np.argsort(region, kind="stable")
        numbers, first = np.unique(region[order], return_index=True)
        self.load(numbers)
        cube = np.zeros(len(x), np.uint64)
        for number, own in zip(numbers.tolist(), np.split(order, first)[1:], strict=True):
            cube[own] = self._loaded[number].cubes_of(x[own])
        return Points(x, cube, self.model.outputs, self.device, region)

    def run(self, points: Points) -> None:
        """Decodes uploaded points into `Points.out`: -infinity where others took the place of their region. On CUDA the
        work is queued, not awaited."""
        self.launch(points.x, points.region, points.out)

    def launch(self, x: wp.array, region: wp.array, out: wp.array) -> None:
        """Decodes points as `wlm_kernels.probe.decode.DecodeKernels.launch_regions` does."""
        if x.shape[0]:
            self._kernels.launch_regions(self._table, region, CUT, x, self._asked, out)

    def light(self, position: np.ndarray) -> "RegionLight":
        return RegionLight(self, *self._content.place(self._inside(position)))

    @property
    def waiting(self) -> bool:
        """Whether regions are being read for a volume."""
        return bool(self._coming)

    def request(self) -> None:
        """Has a thread read the regions that launches since the last call needed, and moves at most one that was read
        to the device. If it is damaged, its light is 0 from now on. Raises a WlmError if the region is damaged; it is
        only told once."""
        asked = np.flatnonzero(self._asked.numpy())
        if len(asked):
            self._asked.zero_()
        for number in asked.tolist():
            if not (self._touch(number) or number in self._coming or np.isfinite(self._entries[number].gain)):
                self._coming[number] = self._pool.submit(self._content.region, number)
        for number in [each for each, coming in self._coming.items() if coming.done()][:1]:
            coming = self._coming.pop(number)
            try:
                self._put_region(number, coming.result(), asked)
            except WlmError:
                self._entries[number] = _absent(0.0)
                raise
            finally:
                self._table.assign(self._entries)

    def _inside(self, position: np.ndarray) -> np.ndarray:
        model = self.model
        return np.clip(check_points(position), model.origin, model.origin + model.extent * model.size)


class RegionLight(Light):
    """Decodes the light at positions that a volume requests; those of a region that is not on the device yet wait."""

    def __init__(self, decoder: RegionDecoder, region: np.ndarray, x: np.ndarray) -> None:
        """Uploads positions in the coordinates of their regions, [N] and [N, 3]; see `Regions.place`."""
        self._decoder, self.device = decoder, decoder.device
        self.channels, self.count = decoder.model.outputs, len(x)
        self._regions, self._region = region, wp.array(region, dtype=int, device=self.device)
        self._x = wp.array(x, dtype=wp.vec3, device=self.device)
        self._taken: dict[int, tuple[wp.array, wp.array]] = {}

    @property
    def time(self) -> float | None:
        return self._decoder.time

    @property
    def waiting(self) -> bool:
        return self._decoder.waiting

    def prepare(self, numbers: np.ndarray | None = None) -> None:
        if numbers is None:
            self._decoder.request()
        else:
            self._decoder.load(np.unique(self._regions[numbers]))

    def read(self, numbers: wp.array, values: wp.array) -> None:
        count = numbers.shape[0]
        if count not in self._taken:
            x, region = (wp.zeros(count, dtype=dtype, device=self.device) for dtype in (wp.vec3, int))
            self._taken[count] = x, region
        x, region = self._taken[count]
        frame_kernels.take_points(self._x, self._region, numbers, x, region)
        self._decoder.launch(x, region, values)


def _absent(light: float) -> Region:
    """Returns the entry of a region that is not on the device: each number at its points is `light`."""
    made = Region()
    made.gain = light
    return made
