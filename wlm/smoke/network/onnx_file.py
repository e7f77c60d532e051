"""Export of a trained network as ONNX."""

import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from wlm.formats.atomic import atomic_path
from wlm.formats.hdr_blocks import need
from wlm.smoke.model import SmokeModel
from wlm.smoke.network.planes import GUIDES
from wlm.smoke.network.unet import SixWayNetwork

_OPSET = 20


def export_onnx(model: SmokeModel, path: str | os.PathLike[str], *, height: int = 512, width: int = 512) -> int:
    """Writes a network as ONNX for one image size: `guide` [1, C, H, W] to `lightmaps` [1, 8, H, W], float32.

    Guide and lightmaps are encoded as in `wlm.smoke.network.planes`; the lightmaps are not clamped to their ranges.

    Args:
        model: The network.
        path: The file, which is written atomically.
        height, width: Size of the images in pixels, H and W.

    Returns:
        The size of the file in bytes.

    Raises:
        ValueError: A size is below 1.
        WlmError: The extra `onnx` is not installed, or the file cannot be written.
    """
    if height < 1 or width < 1:
        raise ValueError(f"height, width: expected at least 1 pixel, got {height}, {width}")
    for package in ("onnx", "onnxscript"):
        need(package, "onnx")
    # A copy: the exporter modifies the network that it traces.
    network = SixWayNetwork(model.settings)
    network.load_state_dict(model.network.state_dict())
    guide = torch.zeros(1, len(GUIDES[model.settings.guide]), height, width)
    with atomic_path(path) as temporary, warnings.catch_warnings(), _quiet(), torch.no_grad():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network.eval(),
            (guide,),
            temporary,
            input_names=["guide"],
            output_names=["lightmaps"],
            opset_version=_OPSET,
            dynamo=True,
            external_data=False,
            verbose=False,
        )
        return temporary.stat().st_size


@contextmanager
def _quiet() -> Iterator[None]:
    """Silences the exporter's messages about packages that these networks do not need."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)
