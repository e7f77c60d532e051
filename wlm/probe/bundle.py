"""Bundles of probes: the buffers, the shader and the reference of a model, and those of a volume."""

from wlm.bundle import Bundle
from wlm.probe.model import ProbeModel


def bundle(model: ProbeModel, *, device: str = "cpu") -> Bundle:
    """Returns what a GPU holds of a model, in the layout of the model's method.

    Args:
        model: The model.
        device: Where the reference is decoded, "cpu" or "cuda:N".

    Returns:
        Gaussians: buffers `gaussians` and `network`; principal components: buffer `probes`; and `positions` if the
        model stores them. The reference has `values` float32 [M, D], at points `position` float64 [M, 3] of
        Gaussians, or of the live probes `live` int32 [M] of components.

    Raises:
        WlmError: The device does not exist, or a number does not fit floats.
    """
    return model.content.bundle(model, model.decoder(device))
