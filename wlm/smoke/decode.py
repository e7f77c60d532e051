"""Runs a trained network on one image at a time: on a GPU in half floats as a CUDA graph, on a CPU in float32."""

import torch

from wlm.interop import StepGraph, check_device
from wlm.smoke.camera import DIRECTIONS
from wlm.smoke.model import SmokeModel
from wlm.smoke.network.planes import GUIDES, PLANES
from wlm.smoke.network.unet import SixWayNetwork

_WARMUP = 2


class Decoder:
    """A trained network for images of one size: predicts encoded lightmaps from an encoded guiding map.

    Attributes:
        height, width: Size of the images in pixels, H and W.
        device: Device on which it runs.
        guide: Kind of guiding map that it reads, a key of `planes.GUIDES`.
        half: Whether the network computes in half floats.
    """

    def __init__(self, model: SmokeModel, device: str = "cpu", *, height: int, width: int, half: bool = True) -> None:
        """Copies the network, with its current weights, and allocates buffers.

        Args:
            model: The network; it is not changed.
            device: "cpu", "cuda" or "cuda:N".
            height, width: Size of the images in pixels, H and W, at least 1.
            half: Whether a GPU computes in half floats; a CPU always computes in float32.

        Raises:
            ValueError: A size is below 1.
            WlmError: The device does not exist.
        """
        if height < 1 or width < 1:
            raise ValueError(f"height, width: expected at least 1 pixel, got {height}, {width}")
        settings = model.settings
        self.device = check_device(device)
        self.height, self.width, self.guide = height, width, settings.guide
        self.half = half and self.device != "cpu"
        dtype = torch.float16 if self.half else torch.float32
        # Convolutions and norms are fastest with the channels of a pixel beside each other.
        layout = torch.channels_last if self.device != "cpu" else torch.contiguous_format
        network = SixWayNetwork(settings)
        network.load_state_dict(model.network.state_dict())
        self._network = network.requires_grad_(False).eval().to(self.device, dtype, memory_format=layout)
        self._guide = torch.zeros(1, len(GUIDES[self.guide]), height, width, device=self.device, dtype=dtype)
        self._planes = torch.zeros(len(PLANES), height, width, device=self.device)
        self._run = StepGraph(self._work, self.device, warmup=_WARMUP)

    def __call__(self, encoded: torch.Tensor) -> torch.Tensor:
        """Predicts lightmaps, opacity and emission of one image; on CUDA it returns before the GPU has finished.

        Args:
            encoded: [C, H, W] on the device, a guiding map of the kind `guide` from `planes.render_guide`.

        Returns:
            float32 [8, H, W], encoded, in the order of `PLANES`, clamped to their ranges. The next call overwrites it.

        Raises:
            ValueError: The size or the device is wrong.
        """
        if encoded.shape != self._guide.shape[1:] or encoded.device != self._guide.device:
            expected = f"{list(self._guide.shape[1:])} on {self.device}"
            raise ValueError(
                f"encoded: expected a guiding map {expected}, got {list(encoded.shape)} on {encoded.device}"
            )
        self._guide[0].copy_(encoded)
        self._run()
        return self._planes

    @torch.no_grad()
    def _work(self) -> None:
        # cuDNN benchmarks its algorithms before the graph is captured; TF32 is used only with half floats.
        with torch.backends.cudnn.flags(enabled=True, benchmark=True, deterministic=False, allow_tf32=self.half):
            planes = self._network(self._guide)[0]
        lights = len(DIRECTIONS)
        self._planes[:lights] = planes[:lights].clamp(min=0.0)
        self._planes[lights:] = planes[lights:].clamp(0.0, 1.0)
