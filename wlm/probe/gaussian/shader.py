"""Generates the GLSL that decodes Gaussians from the buffers of `wlm.probe.gaussian.bundle`."""

from wlm.bundle import filled
from wlm.probe.gaussian.model import LATENT, Gaussians
from wlm.probe.glsl import buffer_glsl, clamp_glsl, sh_glsl
from wlm.probe.sphere import sh_count

HEAD_WORDS = 10  # words of the buffer `gaussians` before the bounds: see assets/gaussians.glsl


def gaussian_words(latent: int) -> int:
    """Returns the number of 32-bit words of a Gaussian with a latent of length L: 10 + L codes of 16 bits, two per
    word."""
    return (LATENT.start + latent + 1) // 2


_REACHED = {
    "ellipsoid": "dot(u, u) < cut * cut",
    # Eq. 6: the radius in every direction is that of the longest axis.
    "sphere": "dot(d, d) < cut * cut * longest * longest",
}

_LONGEST = """
    float longest = max(s.x, max(s.y, s.z));"""


def probe_glsl(content: Gaussians) -> str:
    """Returns the GLSL for models with the sizes of `content`: functions to be included below `#version`. `content` has
    the Gaussians, of which only the latent, the hidden units, the outputs and their form, and the support matter. It is
    GLSL 4.30, which is also valid Vulkan GLSL."""
    latent, hidden = content.latent, content.hidden
    channels = LATENT.start + latent
    sphere = content.support == "sphere"
    fours = -(-(latent + 3) // 4), hidden // 4
    buffers = [buffer_glsl("probe", name, number) for number, name in enumerate(("gaussians", "network"))]
    text = filled(
        __package__,
        "gaussians.glsl",
        buffers="".join(buffers),
        latent=latent,
        hidden=hidden,
        outputs=content.outputs,
        columns=content.columns,
        form=" and their magnitude" if content.relative else "",
        magnitude=filled(__package__, "magnitude.glsl", place=content.outputs % 4) if content.relative else "",
        clamp=clamp_glsl(content.outputs),
        reach="a sphere" if sphere else "an ellipsoid",
        channels=channels,
        head=HEAD_WORDS,
        first=HEAD_WORDS + 2 * channels,
        words=gaussian_words(latent),
        input_fours=fours[0],
        hidden_fours=fours[1],
        most_fours=max(fours),
        longest=_LONGEST if sphere else "",
        reached=_REACHED[content.support],
    )
    coefficients = sh_count(content.outputs)
    if coefficients is None:
        return text
    x = "wlm_probe_place(position)"
    text += sh_glsl("wlm_probe_sh", "vec3 position", f"wlm_probe_values({x}, values)", coefficients)
    call, arguments = f"wlm_probe_values_listed({x}, first, count, values)", "vec3 position, int first, int count"
    return text + f"\n#ifdef WLM_PROBE_LIST{sh_glsl('wlm_probe_sh_listed', arguments, call, coefficients)}#endif\n"
