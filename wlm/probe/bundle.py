"""Makes the bundle of a model for GPUs: buffers, shader, description and reference values."""

from dataclasses import replace
from pkgutil import resolve_name

import numpy as np

from wlm.bundle import Bundle
from wlm.errors import WlmError
from wlm.probe.conventions import CANONICAL
from wlm.probe.model import ProbeModel
from wlm.probe.sphere import sh_count

_ABOUT = {
    "values": "A probe has `outputs` numbers. Spherical harmonics: coefficient after coefficient, each red, green and "
    "blue; orthonormal real basis in the order 1; y, z, x; xy, yz, 3z2-1, xz, x2-y2; all signs plus, of radiance.",
    "dead": "Indices from 0, in the order of compression, of the probes whose light is zero, such as those in walls.",
    "hours": "If there are `times`, hours of the day, the light is that of the first of them. The buffer hours has "
    "`hour.words` words for each of them, half floats, two in a word. For the light at another time, mix those of the "
    "times before and after it linearly (the first time follows the last one), and write them into the buffer "
    "`hour.buffer` from `hour.first_word` on. If magnitude is true, the bias b of the last output is rounded to a half "
    "h: multiply gain, word 7 of gaussians, by exp(b - h), or light flickers by a hundredth as time passes. `mixed` of "
    "the reference is the light half-way between the first two times.",
    "positions": "If the buffer positions exists: 3 unsigned 16-bit codes per probe, position = origin + extent * size "
    "* code / 65535.",
}


def bundle(model: ProbeModel, *, device: str = "cpu") -> Bundle:
    """Returns a model's buffers, shader and description for a GPU; the layout depends on the compression method.

    Args:
        model: The model.
        device: Where the reference values are decoded, "cpu" or "cuda:N".

    Returns:
        The buffers `gaussians` and `network` for Gaussians, or `probes` for principal components; `positions` if the
        model stores them; and `hours` if it has several. `reference` has M decoded examples, to test a shader with:
        `values`, float32 [M, D], and for Gaussians their points `position`, float64 [M, 3], or for principal
        components their indices `live` among the live probes, int32 [M]; and of several hours `mixed`, float32 [M, D].

    Raises:
        WlmError: The device does not exist, the decoded light is not finite, or a number exceeds float32.
    """
    decoder, make = model.decoder(device), resolve_name(model.content.BUNDLE)
    forms = [make(model.at(time), decoder) for time in (model.times if len(model.times) else [None])]
    form, hours, times = forms[0], {}, {}
    if len(forms) > 1:
        times, place = {"times": model.times.tolist()}, form.document["hour"]
        words = slice(place["first_word"], place["first_word"] + place["words"])
        hours = {"hours": np.concatenate([each.buffers[place["buffer"]][words] for each in forms])}
        decoder.set_time(float(model.times[:2].mean()))
        mixed = make(model.at(model.times[0]), decoder).reference["values"]
        form = replace(form, reference=form.reference | {"mixed": mixed})
    if not np.isfinite(form.reference["values"]).all():
        raise WlmError(f"{model.name}: cannot export: the model decodes to NaN or infinity")
    document = {
        "about": form.document["about"] | _ABOUT,
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
        **times,
    }
    positions = {"positions": np.ascontiguousarray(model.positions, "<u2")} if model.has_positions else {}
    return replace(form, document=form.document | document, buffers=form.buffers | positions | hours)
