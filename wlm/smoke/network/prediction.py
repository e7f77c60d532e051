"""Predicts six-way lightmaps of smoke, also by a trained network: guiding map, network and decoding in one call."""

import math
import os
from dataclasses import replace
from functools import lru_cache, partial

import torch

from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume
from wlm.interop import check_device, device_name, moved
from wlm.smoke.camera import Camera
from wlm.smoke.codec import open_network
from wlm.smoke.decode import Decoder
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.six_way import bake, bake_coarse, coarse_march
from wlm.smoke.model import SmokeModel
from wlm.smoke.network.planes import decode_lightmaps, render_guide

_SIZES = 4  # number of image sizes whose buffers are kept
# On a CPU the fine march with this step is faster than to fill a lattice of optical depths, up to so many voxels along
# the rays of all pixels for each of its nodes.
_STEP, _PER_NODE = 2.0, 4.0


class SmokePredictor:
    """Predicts lightmaps by a trained network, from guiding maps that are made as in its training.

    Buffers for the last four image sizes are kept.

    Attributes:
        device: Device on which it runs.
    """

    def __init__(self, model: SmokeModel | str | os.PathLike[str] | None = None, device: str = "cpu") -> None:
        """Loads the network.

        Args:
            model: A network or its file; None: the network that ships with wlm.
            device: "cpu", "cuda" or "cuda:N".

        Raises:
            WlmError: The device does not exist; the file is missing or damaged, or lacks the settings of its guiding
                maps.
        """
        self.device = check_device(device)
        model = model if isinstance(model, SmokeModel) else open_network(model)
        self._settings = model.dataset
        self._decoder = lru_cache(_SIZES)(partial(Decoder, model, self.device))

    def __call__(self, smoke: DensityVolume, camera: Camera, seed: int = 0) -> SixWay:
        """Predicts six-way lightmaps of smoke.

        Args:
            smoke: The smoke, on any device.
            camera: Orthographic.
            seed: Seed of the guiding map's jitter.

        Returns:
            The lightmaps on the network's device, with emission if the smoke has a temperature.

        Raises:
            ValueError: The camera is in perspective.
            WlmError: The network predicts NaN or infinity.
        """
        smoke = moved(smoke, self.device)
        decoder = self._decoder(height=camera.height, width=camera.width)
        planes = decoder(render_guide(smoke, camera, decoder.guide, self._settings.look(smoke.shape, seed)))
        if not torch.isfinite(planes).all():
            raise WlmError(
                "the network predicts NaN or infinite light: its weights are too large; take another network"
            )
        six = decode_lightmaps(planes, hot=smoke.temperature is not None, camera=camera)
        return replace(six, method="network")


def predict(
    smoke: DensityVolume,
    camera: Camera,
    model: SmokePredictor | SmokeModel | str | os.PathLike[str] | None = None,
    device: str | None = None,
    seed: int = 0,
) -> SixWay:
    """Predicts six-way lightmaps of smoke faster than `bake`: by a march in larger steps, or by a network.

    A network is made for smoke as in its training, "fast" for 128 to 400 voxels along an edge. Of smaller or smoother
    smoke it makes worse lightmaps than the march.

    Args:
        smoke: The smoke, on any device.
        camera: Orthographic.
        model: A network, its file, "fast" (the network that ships with wlm), or a `SmokePredictor` for many frames;
            None: the coarse march of `coarse_march`, which in the same time is as accurate as the network; on a CPU,
            for images of few pixels beside the voxels, `bake` with a step of 2 voxels, which then is faster.
        device: Device on which to work; None: that of the smoke. A `SmokePredictor` has its own.
        seed: Seed of the jitter of the march, or of that of the guiding map.

    Returns:
        The lightmaps, with emission if the smoke has a temperature; their `method` says how they were made.

    Raises:
        ValueError: The camera is in perspective.
        WlmError: As for `SmokePredictor`.
    """
    if isinstance(model, SmokePredictor):
        return model(smoke, camera, seed)
    device = check_device(device_name(smoke.device) if device is None else device)
    if model is not None:
        return SmokePredictor(model, device)(smoke, camera, seed)
    smoke = moved(smoke, device)
    march = coarse_march(smoke, seed)
    nodes = math.prod(smoke.shape) / march.step**3
    if device == "cpu" and camera.height * camera.width * max(smoke.shape) <= _PER_NODE * nodes:
        return bake(smoke, camera, step=_STEP, estimate=False)
    return bake_coarse(smoke, camera, march)
