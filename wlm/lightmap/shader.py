"""Generates the GLSL that decodes a lightmap from the textures and buffers of its bundle (`wlm.lightmap.bundle`)."""

from wlm.bundle import filled, sampler
from wlm.lightmap.encodings.base import columns
from wlm.lightmap.encodings.maps import fours
from wlm.lightmap.model import SheetModel
from wlm.lightmap.tiles import TILE
from wlm.texels import REACH

EXACT = "WLM_LIGHTMAP_EXACT"
"""Macro that makes the shader interpolate texels in float32 instead of with the GPU's texture filter."""

GROUP_SIZE = (32, 4)
"""Columns and rows of a group of invocations of the compute shader, each of which decodes two texels; both divide a
tile's side."""

HEAD = 2
"""Groups of four floats before the records of the tiles in the table of an hour."""

_DRAWN = """\
// For each stored hour that is needed: bind the table of the hour, draw the map into a texture of linear light with
// {last}(texel), and draw that one into another, each texel from wlm_source(texel), which fills the gaps between
// charts that a filter reads at their edges. Materials mix two of these by the time between both hours (eq. 2).
"""
_COMPUTED = """\
// A compute shader for GLSL 4.30 and GLSL ES 3.10 and later. For each stored hour that is needed: bind the table of the
// hour, and dispatch a group of {columns} x {rows} invocations for each {columns} x {tall} texels of the map.
// A group keeps the network of its tile in {kilobytes} KB of shared memory.
"""

_TEXTURES = {
    "hour": ("sampler2D", "the hour's floats of hours.bin, RGBA32F, 1024 a row; fetched"),
    "networks": ("sampler2D", "networks.bin, RGBA32F, 1024 a row; fetched"),
    "uv": ("sampler2D", "uv.dds, BC7, {TILE} x {TILE} texels a tile; fetched"),
    "uvt": ("sampler2D", "uvt.dds, BC7, {side} x {side} texels for each of {slices} slices of a tile; filtered"),
    "planes": ("sampler2D", "planes.dds, RG8, {plane_columns} x {plane_rows} texels twice a tile; filtered"),
    "frames": ("sampler2DArray", "frames.dds, BC7, a layer for each stored time; fetched"),
    "valid": ("sampler2D", "valid.png, R8, {width} x {height}, white inside charts; fetched"),
}

_UNITS = {
    "biases": "    b[{j}] = wlm_lightmap_four(third - WLM_LIGHTMAP_FOURS + {j});\n",
    "products": "        b[{j}] = wlm_lightmap_add(b[{j}], a, w + {j}, WLM_LIGHTMAP_FOURS);\n",
    "outputs": "    y = wlm_lightmap_add(y, wlm_gelu(b[{j}]), third + {at}, 1);\n",
}
"""Lines of the network for each four units of the second layer."""


def record_fours(model: SheetModel) -> int:
    """Returns the number of groups of four floats in a tile's record, see `wlm.lightmap.bundle.hour_tables`."""
    return 3 + max(fours(model.profile), 2)


def texture_names(model: SheetModel) -> list[str]:
    """Returns the names of the textures that the shader of a sheet reads, in the order of their declarations."""
    needed = dict.fromkeys(("networks", "uv", "uvt", "planes"), len(model.uv)) | {"frames": len(model.frames)}
    return [name for name in _TEXTURES if needed.get(name, True)]


def decode_glsl(model: SheetModel, values: tuple[float, float] | None = None, *, pairs: bool = False) -> str:
    """Returns the shader of a sheet: functions to be included below `#version`.

    Args:
        model: The sheet; the shader depends on its settings and on the kinds of its tiles.
        values: Range to which decoded levels from 0 to 1 are mapped if the sheet is not light; None: it is radiance.
        pairs: Whether the functions are for a compute shader, whose invocations decode two texels each; only for a
            sheet with networks.

    Returns:
        Source for GLSL 3.30 and GLSL ES 3.00; it also compiles for Vulkan if the bindings are defined.
    """
    profile, names = model.profile, texture_names(model)
    gelu = filled(__package__, f"gelu_{profile.gelu}.glsl")
    dynamic = len(model.uv)
    side, slices = profile.uvt_resolution, profile.uvt_slices
    across = {
        "uv": columns(dynamic, TILE, TILE),
        "uvt": columns(dynamic * slices, side, side),
        "planes": columns(2 * dynamic, profile.plane_rows, profile.plane_columns),
        "frames": columns(len(model.frames), TILE, TILE),
    }
    wide = fours(profile)
    second = 17 * wide  # fours of a network before the weights of its second layer
    third = second + (4 * wide + 1) * wide
    gamma, inverse = (", ".join([repr(float(number))] * 3) for number in (profile.gamma, 1.0 / profile.gamma))
    words = {
        "TILE": TILE,
        "width": model.width,
        "height": model.height,
        "columns": model.grid.cols,
        "record": record_fours(model),
        "head": HEAD,
        "fours": wide,
        "hidden": profile.hidden,
        "side": side,
        "slices": slices,
        "plane_columns": profile.plane_columns,
        "plane_rows": profile.plane_rows,
        "uv_columns": across["uv"],
        "uvt_columns": across["uvt"],
        "plane_across": across["planes"],
        "frames_columns": across["frames"],
        "uvt_width": across["uvt"] * side,
        "uvt_height": -(-dynamic * slices // across["uvt"]) * side,
        "planes_width": across["planes"] * profile.plane_columns,
        "planes_height": -(-2 * dynamic // across["planes"]) * profile.plane_rows,
        "reach": REACH,
        "beyond": 2 * REACH * REACH + 1,
        "second": second,
        "last": third + 4 * wide,
        "weights": third + 4 * wide + 1,
        "below": GROUP_SIZE[1],
        "invocations": GROUP_SIZE[0] * GROUP_SIZE[1],
        # repr gives the shortest decimals that are the number again, and always a point or an exponent.
        "gamma": f"vec3({gamma})",
        "inverse": f"vec3({inverse})",
    }
    kind = "radiance" if values is None else "value"
    least, span = (0.0, 1.0) if values is None else (values[0], values[1] - values[0])
    linear = filled(__package__, f"linear_{kind}.glsl", least=repr(least), span=repr(span), **words)
    has_frames = "frames" in names
    frames = filled(__package__, "frames_kind.glsl", **words) if has_frames else ""
    unmapped = filled(__package__, "unmapped.glsl", frames=frames)
    unmapped = (filled(__package__, "frames.glsl", **words) if has_frames else "") + unmapped
    maps = filled(__package__, "maps.glsl", **words) if dynamic else ""
    if pairs:
        names.remove("valid")
        group, rows = GROUP_SIZE
        use = _COMPUTED.format(columns=group, rows=rows, tall=2 * rows, kilobytes=f"{words['weights'] / 64:.0f}")
        text = _head(names, words | {"use": use}) + maps + unmapped + linear
        text += filled(__package__, "pair.glsl", gelu=gelu, **_pair_lines(wide, third), **words)
        return text + filled(__package__, "pair_colours.glsl", **words)
    text, kinds = _head(names, words | {"use": _DRAWN.format(last=f"wlm_{kind}")}) + maps, ""
    if dynamic:
        units = {name: "".join(line.format(j=j, at=4 * j) for j in range(wide)) for name, line in _UNITS.items()}
        text += filled(__package__, "network.glsl", gelu=gelu, **units, **words)
        kinds = filled(__package__, "mapped_kind.glsl")
    text += (
        unmapped
        + filled(__package__, "colour.glsl", kinds=kinds, **words)
        + filled(__package__, "source.glsl", **words)
    )
    return text + linear + filled(__package__, "last.glsl", kind=kind)


def _pair_lines(wide: int, third: int) -> dict[str, str]:
    """Returns the lines of two texels' network that repeat for each four units, each with its number."""

    def reads(first: str, at: int, apart: int) -> str:
        return "".join(f"    w{k} = wlm_lightmap_weights[{first}{at + k * apart}];\n" for k in range(4))

    def add(total: str, x: str) -> str:
        return f"    {total} = {total} + {' + '.join(f'{x}.{axis} * w{k}' for k, axis in enumerate('xyzw'))};\n"

    made = {"biases": "", "sums": "", "products": "", "outputs": ""}
    for k, name in enumerate(("uv", "uvt", "planes")):
        made["sums"] += reads("i + ", 4 * k * wide, wide) + add("a0", f"{name}0") + add("a1", f"{name}1")
    for j in range(wide):
        two = (f"b[{2 * j}]", f"b[{2 * j + 1}]")
        made["biases"] += f"    {two[0]} = wlm_lightmap_weights[{third - wide + j}];\n    {two[1]} = {two[0]};\n"
        made["products"] += reads("w + ", j, wide) + add(two[0], "a0") + add(two[1], "a1")
        made["outputs"] += reads("", third + 4 * j, 1)
        for t in range(2):
            made["outputs"] += f"    a{t} = wlm_gelu({two[t]});\n" + add(f"y{t}", f"a{t}")
    for name in ("sums", "products"):
        made[name] = "".join(f"    {line}\n" for line in made[name].splitlines())
    return made


def _head(names: list[str], words: dict[str, object]) -> str:
    lines = [f"//   wlm_lightmap_{name}: {_TEXTURES[name][1].format(**words)}.\n" for name in names]
    reads = "".join(
        filled(__package__, "entry.glsl", macro=macro, function=function, texture=f"WLM_LIGHTMAP_{name.upper()}")
        for macro, function, name in (
            ("WLM_LIGHTMAP_HOUR_AT", "wlm_lightmap_entry", "hour"),
            ("WLM_LIGHTMAP_NET", "wlm_lightmap_four", "networks"),
        )
        if name in names
    )
    return filled(
        __package__,
        "head.glsl",
        textures="".join(lines),
        samplers="".join(sampler(f"wlm_lightmap_{name}", _TEXTURES[name][0]) for name in names),
        reads=reads,
        **words,
    )
