"""The module for three.js that fills a cascaded volume of light probes with the compute shaders of its update."""

from wlm.export.engines.kit import filled
from wlm.export.shading.pointers import wgsl_with_pointers


def volume_module(shader: str) -> dict[str, bytes]:
    """Returns the files beside the WGSL of `wlm.probe.volume.update`, by name: `volume.js`, whose head explains its
    use, and `read.wgsl`, for node materials. `shader` is GLSL that reads the volume
    (`wlm.probe.volume.shader.volume_glsl`)."""
    return {"volume.js": filled("volume.js").encode(), "read.wgsl": wgsl_with_pointers(shader).encode()}
