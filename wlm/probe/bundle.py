"""Makes the bundle of a model for GPUs: buffers, shader, description and reference values."""

from dataclasses import replace
from pkgutil import resolve_name
from typing import Any

import numpy as np

from wlm.bundle import Bundle
from wlm.errors import WlmError
from wlm.probe.conventions import CANONICAL
from wlm.probe.model import ProbeModel
from wlm.probe.regions.model import Regions
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

_ABOUT_REGIONS = {
    "regions": "The folders region-0, region-1 and so on are models of their own, with the same shader. The region of "
    "a position, which is clamped to origin ... origin + extent * size: from node n = 0 on, n = child[n][1 if "
    "position[axis[n]] >= plane[n] else 0] while n >= 0; the region is -1 - n.",
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
        A model in regions has them in `parts`, one for each region.

    Raises:
        WlmError: The device does not exist, the decoded light is not finite, or a number exceeds float32.
    """
    positions = {"positions": np.ascontiguousarray(model.positions, "<u2")} if model.has_positions else {}
    if isinstance(content := model.content, Regions):
        parts = {
            f"region-{number}": bundle(content.region(number), device=device) for number in range(content.tree.count)
        }
        tree = {name: part.tolist() for name, part in content.tree.parts().items()}
        document = {"about": _ABOUT | _ABOUT_REGIONS, "tree": tree} | _described(model)
        return Bundle("probe", model.name, "", document, buffers=positions, parts=parts)
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
    document = form.document | {"about": form.document["about"] | _ABOUT} | times | _described(model)
    return replace(form, document=document, buffers=form.buffers | positions | hours)


def _described(model: ProbeModel) -> dict[str, Any]:
    return {
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
