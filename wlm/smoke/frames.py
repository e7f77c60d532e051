"""Makes the six-way lightmaps of frames by a ray march or a network, in this process or in other ones."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from wlm.dispatch import Whole
from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume
from wlm.interop import check_device, moved
from wlm.smoke.camera import Camera
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.six_way import bake, with_surface
from wlm.smoke.network.prediction import SmokePredictor, predict
from wlm.smoke.scene import Looks
from wlm.smoke.transport.sphere import bake_sphere

_METHODS: dict[str, Callable[..., SixWay]] = {"bake": bake, "sphere": bake_sphere, "coarse": predict}


class FrameMaker(Whole):
    """Makes the six-way lightmaps of frames by "bake", "sphere", "coarse" or a network with these settings."""

    def __init__(self, device: str, method: Any, settings: Mapping[str, Any]) -> None:
        self._device = check_device(device)
        make = _METHODS[method] if method in _METHODS else SmokePredictor(method, self._device)
        self._make = partial(make, **settings)

    def run(self, job: tuple[str, DensityVolume, Camera, Looks | None]) -> tuple[SixWay, Looks | None]:
        """Returns the lightmaps of a frame, in the host's memory, and its looks."""
        name, volume, camera, looks = job
        volume = moved(volume, self._device)
        try:
            six = with_surface(self._make(volume, camera), volume, looks)
        except WlmError as error:
            raise WlmError(f"{name}: {error}") from error
        return moved(six, "cpu"), looks
