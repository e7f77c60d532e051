"""The bundle of a model: buffers, shader, document and reference."""

import numpy as np

from wlm.bundle import Bundle
from wlm.errors import WlmError
from wlm.probe.conventions import CANONICAL
from wlm.probe.model import ProbeModel
from wlm.probe.sphere import sh_count

_ABOUT = {
    "values": "A probe has `outputs` numbers. Spherical harmonics: coefficient after coefficient, each red, green and "
    "blue; orthonormal real basis in the order 1; y, z, x; xy, yz, 3z2-1, xz, x2-y2; all signs plus, of radiance.",
    "dead": "Probes that are zero, by index from 0 in the order of compression: engines leave them inside walls.",
    "positions": "If the buffer positions exists: 3 unsigned 16-bit codes per probe, position = origin + extent * size "
    "* code / 65535.",
}


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
        WlmError: The device does not exist, the light is not finite, or a number does not fit floats.
    """
    form = model.content.gpu_form(model, model.decoder(device))
    if not np.isfinite(form.reference["values"]).all():
        raise WlmError(f"{model.name}: cannot export: the model decodes to NaN or infinity")
    document = {
        "about": form.about | _ABOUT,
        "source": model.source,
        "method": model.method,
        "probes": model.probes,
        "outputs": model.outputs,
        "coefficients": sh_count(model.outputs),
        "convention": CANONICAL,
        "origin": model.origin.tolist(),
        "extent": model.extent,
        "size": model.size.tolist(),
        "dead": np.flatnonzero(model.dead).tolist(),
    }
    buffers = dict(form.buffers)
    if model.has_positions:
        buffers["positions"] = np.ascontiguousarray(model.positions, "<u2")
    return Bundle(
        system=ProbeModel.SYSTEM,
        name=model.name,
        shader=form.shader,
        document=document | form.document,
        buffers=buffers,
        reference=form.reference,
    )
