"""Writes the compute shader that decodes a lightmap into a texture."""

from wlm.bundle import Bundle, filled
from wlm.export.shading import translate
from wlm.lightmap.shader import GROUP_SIZE


def compute_shader(bundle: Bundle, language: str, exact: bool = False) -> str:
    """Returns a compute shader that decodes a lightmap at the hour of its table into a texture of half floats.

    Dispatch a group for each 32 x 8 texels of the map.

    Args:
        bundle: Bundle of a sheet with networks.
        language: One of `wlm.export.shading.LANGUAGES`; GLSL 4.30 and GLSL ES 3.10 are without `#version`.
        exact: Whether texels are fetched and interpolated in floats, without the texture filter.
    """
    (columns, rows), document = GROUP_SIZE, bundle.document
    size = {"columns": columns, "rows": rows, "width": document["width"], "height": document["height"]}
    main = filled(__package__, f"compute.{language.removesuffix('-es')}", **size)
    return translate(bundle.compute, language, [bundle.exact] if exact else []) + main
