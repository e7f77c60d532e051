"""Six-way lightmaps of smoke by a trained network: guiding map, network and decoded planes in one call."""

import functools
import os
from dataclasses import replace

from wlm.fluid.volume import DensityVolume
from wlm.interop import check_device, device_name
from wlm.smoke.camera import Camera
from wlm.smoke.codec import open_network
from wlm.smoke.decode import Decoder
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.model import SmokeModel
from wlm.smoke.planes import decode_lightmaps, render_guide

_SLACK = 1.25  # the factor by which images may be larger or smaller than those of the training
_SIZES = 4  # of images whose buffers are kept


class SmokePredictor:
    """A network at run time, which marches its guiding maps as those that it was trained with.

    The buffers for an image's size are made once, for the last few sizes.

    Attributes:
        device: Where it runs.
    """

    def __init__(self, model: SmokeModel | str | os.PathLike[str] | None = None, device: str = "cpu") -> None:
        """Loads the network.

        Args:
            model: A network or its file; None: the network that comes with wlm.
            device: "cpu", "cuda" or "cuda:N".

        Raises:
            WlmError: No such device; the file is missing or damaged, or lacks the settings of its guiding maps.
        """
        self.device = check_device(device)
        self._model = model if isinstance(model, SmokeModel) else open_network(model)
        self._settings = self._model.dataset
        self._decoders: dict[tuple[int, int], Decoder] = {}

    def __call__(self, smoke: DensityVolume, camera: Camera, seed: int = 0) -> SixWay:
        """Makes lightmaps.

        Args:
            smoke: On any device.
            camera: Orthographic.
            seed: Of the guiding map's jitter.

        Returns:
            The lightmaps on the network's device, with emission if the smoke has a temperature and the network makes
            it.

        Raises:
            ValueError: The camera is in perspective.
        """
        if device_name(smoke.device) != self.device:
            hot = None if smoke.temperature is None else smoke.temperature.to(self.device)
            smoke = replace(smoke, density=smoke.density.to(self.device), temperature=hot)
        size = (camera.height, camera.width)
        if size not in self._decoders:
            if len(self._decoders) == _SIZES:
                del self._decoders[next(iter(self._decoders))]
            self._decoders[size] = Decoder(self._model, self.device, height=size[0], width=size[1])
        decoder = self._decoders[size]
        march = self._settings.look(smoke.shape, seed)
        planes = decoder(render_guide(smoke, camera, decoder.guide, march))
        return decode_lightmaps(planes, hot=decoder.emission and smoke.temperature is not None, camera=camera)

    def warning(self, smoke: DensityVolume, camera: Camera) -> str | None:
        """A line where the image shows the smoke by far more or fewer pixels than the network was trained with."""
        pixels = camera.height * smoke.voxel * max(smoke.shape) / camera.extent
        fewest, most = self._settings.pixels
        if fewest / _SLACK <= pixels <= most * _SLACK:
            return None
        trained = f"the network was trained with {fewest:.0f} to {most:.0f}"
        return f"{pixels:.0f} pixels show the smoke's longest edge, {trained}: the coarse march may be nearer"


def predict(
    smoke: DensityVolume,
    camera: Camera,
    model: SmokePredictor | SmokeModel | str | os.PathLike[str] | None = None,
    device: str | None = None,
    seed: int = 0,
) -> SixWay:
    """Makes six-way lightmaps of smoke by a network: what `bake` makes, sooner.

    Args:
        smoke: On any device.
        camera: Orthographic.
        model: A network, its file, or a `SmokePredictor` for many frames; None: the network that comes with wlm,
            which is loaded once for each device.
        device: Where a network that isn't loaded runs; None: where the smoke is.
        seed: Of the guiding map's jitter.

    Returns:
        The lightmaps, with emission if the smoke has a temperature and the network makes it.

    Raises:
        ValueError: The camera is in perspective.
        WlmError: As `SmokePredictor`.
    """
    if not isinstance(model, SmokePredictor):
        device = check_device(device_name(smoke.device) if device is None else device)
        model = _shipped(device) if model is None else SmokePredictor(model, device)
    return model(smoke, camera, seed)


@functools.cache
def _shipped(device: str) -> SmokePredictor:
    return SmokePredictor(None, device)
