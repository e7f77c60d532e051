"""Six-way lightmaps of smoke by a trained network: guiding map, network, gate and decoded planes in one call.

A network may be worse than the guiding map that it reads: on smoke that is smoother, coarser or finer than any of its
training the map has little noise to remove. So each image has a gate. A second map of a ninth of the pixels, with other
noise, tells it: of guide A, network N and second guide B the share s of A + s (N - A) that is nearest to B is nearest
to the truth too, since the noise of B is in neither; it is <N - A, B - A> / |N - A|^2. That is what Noise2Noise
(Lehtinen et al. 2018) learns by, at run time.
"""

import functools
import os
from dataclasses import replace

import torch

from wlm.fluid.volume import DensityVolume
from wlm.interop import check_device, device_name, stream
from wlm.smoke.camera import Camera
from wlm.smoke.codec import open_network
from wlm.smoke.decode import Decoder
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.model import SmokeModel
from wlm.smoke.network.planes import GUIDES, PLANES, decode_lightmaps, render_guide
from wlm_kernels.smoke.settings import March

_GROUPS = ((0, 6), (6, 7), (7, 8))  # of planes that share a gate: lightmaps, opacity, emission
_APART = 3  # pixels between those of the second guide
_OTHER = 32  # seeds on, of 64 that differ
_HALF = 0.5
_SIZES = 4  # of images whose buffers are kept


class SmokePredictor:
    """A network at run time, which marches its guiding maps as those that it was trained with.

    The buffers for an image's size are made once, for the last few sizes.

    Attributes:
        device: Where it runs.
        share: Of the last image, a tensor of one number: how much of what the network changes in the lightmaps is
            taken, 0 to 1. None: its guide isn't lightmaps, so that there is nothing to take instead, or no image yet.
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
        self.share: torch.Tensor | None = None
        self._decoders: dict[tuple[int, int], Decoder] = {}

    def __call__(self, smoke: DensityVolume, camera: Camera, seed: int = 0) -> SixWay:
        """Makes lightmaps.

        Args:
            smoke: On any device.
            camera: Orthographic.
            seed: Of the guiding map's jitter.

        Returns:
            The lightmaps on the network's device, with emission if the smoke has a temperature.

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
        guide = render_guide(smoke, camera, decoder.guide, march)
        planes = decoder(guide)
        if decoder.guide == "six":
            with stream(self.device):
                planes = self._gated(_as_planes(guide), planes, smoke, camera, march)
        return decode_lightmaps(planes, hot=smoke.temperature is not None, camera=camera)

    def _gated(
        self, guide: torch.Tensor, planes: torch.Tensor, smoke: DensityVolume, camera: Camera, march: March
    ) -> torch.Tensor:
        """What is taken of planes [8, H, W] and of the guide in their place, both encoded."""
        size = [n // _APART - (n - n // _APART) % 2 for n in (camera.height, camera.width)]
        if min(size) < 1:
            self.share = torch.zeros((), device=guide.device)
            return guide
        # Centres of these pixels are centres of the image's.
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
        """A line where the gate has taken less than half of what the network changed in the last image."""
        if self.share is None or (share := float(self.share)) >= _HALF:
            return None
        return f"{share:.0%} of the network is taken: on this smoke the coarse march that it reads is as near or nearer"


def _as_planes(guide: torch.Tensor) -> torch.Tensor:
    """A guiding map of kind "six" in the order of `PLANES`: without depth, opacity before emission."""
    of = dict(zip(GUIDES["six"], guide, strict=True))
    return torch.stack([of[name] for name in PLANES])


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
        The lightmaps, with emission if the smoke has a temperature.

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
