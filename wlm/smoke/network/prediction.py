"""Predicts six-way lightmaps of smoke, also by a trained network: guiding map, network, gate and decoding in one call.

A network may be worse than its guiding map: for smoke that is smoother, coarser or finer than in its training, the map
has little noise to remove. Each image therefore has a gate, which is computed from a second guiding map with a ninth of
the pixels and different noise. For guide A, network N and second guide B, the share s for which A + s (N - A) is
nearest to B is also nearest to the truth, since neither A nor N contains the noise of B: s = <N - A, B - A> / |N -
A|^2. This is the principle of Noise2Noise (Lehtinen et al. 2018) at run time.
"""

import os
from dataclasses import replace

import torch

from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume
from wlm.interop import check_device, device_name, moved, stream
from wlm.smoke.camera import Camera
from wlm.smoke.codec import open_network
from wlm.smoke.decode import Decoder
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.six_way import bake_coarse, coarse_march
from wlm.smoke.model import SmokeModel
from wlm.smoke.network.planes import GUIDES, PLANES, decode_lightmaps, render_guide
from wlm_kernels.smoke.settings import March

_GROUPS = ((0, 6), (6, 7), (7, 8))  # ranges of planes that share a gate: lightmaps, opacity, emission
_APART = 3  # distance of the second guide's pixels in pixels of the image
_OTHER = 32  # offset of the second guide's seed; 64 seeds differ
_HALF = 0.5
_SIZES = 4  # number of image sizes whose buffers are kept


class SmokePredictor:
    """Predicts lightmaps by a trained network, from guiding maps that are made as in its training.

    Buffers for the last four image sizes are kept.

    Attributes:
        device: Device on which it runs.
        share: Weight of the network in the last image's lightmaps, a tensor of one number from 0 (only the guiding map)
            to 1 (only the network). None: there was no image yet, or the guiding map has no lightmaps to blend with.
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
        self._model = model if isinstance(model, SmokeModel) else open_network(model)
        self._settings = self._model.dataset
        self.share: torch.Tensor | None = None
        self._decoders: dict[tuple[int, int], Decoder] = {}

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
        if device_name(smoke.device) != self.device:
            smoke = moved(smoke, self.device)
        size = (camera.height, camera.width)
        if size not in self._decoders:
            if len(self._decoders) == _SIZES:
                del self._decoders[next(iter(self._decoders))]
            self._decoders[size] = Decoder(self._model, self.device, height=size[0], width=size[1])
        decoder = self._decoders[size]
        march = self._settings.look(smoke.shape, seed)
        guide = render_guide(smoke, camera, decoder.guide, march)
        planes = decoder(guide)
        if decoder.guide == "six":
            with stream(self.device):
                planes = self._gated(_as_planes(guide), planes, smoke, camera, march)
        if not torch.isfinite(planes).all():
            raise WlmError(
                "the network predicts NaN or infinite light: its weights are too large; take another network"
            )
        return decode_lightmaps(planes, hot=smoke.temperature is not None, camera=camera)

    def _gated(
        self, guide: torch.Tensor, planes: torch.Tensor, smoke: DensityVolume, camera: Camera, march: March
    ) -> torch.Tensor:
        """Blends predicted planes [8, H, W] with the guide, by weights from a second guide with different noise."""
        size = [n // _APART - (n - n // _APART) % 2 for n in (camera.height, camera.width)]
        if min(size) < 1:
            self.share = torch.zeros((), device=guide.device)
            return guide
        # The centres of these pixels are centres of pixels of the image.
        small = replace(camera, height=size[0], width=size[1], extent=_APART * size[0] * camera.pitch)
        second = _as_planes(render_guide(smoke, small, "six", replace(march, seed=march.seed + _OTHER, jitter=1.0)))
        first = [(n - _APART * few) // 2 + _APART // 2 for n, few in zip(planes.shape[1:], size, strict=True)]
        rows, columns = (slice(at, at + _APART * n, _APART) for at, n in zip(first, size, strict=True))
        known, change = guide[:, rows, columns], planes[:, rows, columns] - guide[:, rows, columns]
        shares = []
        for low, high in _GROUPS:
            power = change[low:high].square().sum().clamp(min=1e-30)
            share = (change[low:high] * (second[low:high] - known[low:high])).sum() / power
            shares.append(share.clamp(0.0, 1.0).expand(high - low))
        self.share = shares[0][0]
        return torch.lerp(guide, planes, torch.cat(shares)[:, None, None])

    def note(self) -> str | None:
        """Returns a message if the network had a weight below a half in the last image, otherwise None."""
        if self.share is None or (share := float(self.share)) >= _HALF:
            return None
        return f"the network has a weight of {share:.0%}: on this smoke its guide, the coarse march, is as accurate"


def _as_planes(guide: torch.Tensor) -> torch.Tensor:
    """Returns the planes of a guiding map of kind "six" in the order of `PLANES`, without its depth."""
    of = dict(zip(GUIDES["six"], guide, strict=True))
    return torch.stack([of[name] for name in PLANES])


def predict(
    smoke: DensityVolume,
    camera: Camera,
    model: SmokePredictor | SmokeModel | str | os.PathLike[str] | None = None,
    device: str | None = None,
    seed: int = 0,
) -> SixWay:
    """Predicts six-way lightmaps of smoke faster than `bake`: by a coarse march, or by a network.

    Args:
        smoke: The smoke, on any device.
        camera: Orthographic.
        model: A network, its file, "fast" (the network that ships with wlm), or a `SmokePredictor` for many frames;
            None: the coarse march of `coarse_march`, which in the same time is as accurate as the network.
        device: Device on which to work; None: that of the smoke. A `SmokePredictor` has its own.
        seed: Seed of the jitter of the march, or of that of the guiding map.

    Returns:
        The lightmaps, with emission if the smoke has a temperature.

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
    return bake_coarse(smoke, camera, coarse_march(smoke, seed))
