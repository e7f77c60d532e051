"""Lightmaps for engines: DDS textures, weights in JSON and a shader, which together need nothing of this package."""

import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_write
from wlm.formats.dds import write_dds
from wlm.lightmap.exact import SQRT_12
from wlm.lightmap.model import TILE, LightmapModel, decode_scale, encode_time
from wlm.lightmap.shader import decode_glsl
from wlm.lightmap.tiles import TileKind

__all__ = ["FORMAT", "SHADER_FILE", "WEIGHTS_FILE", "export"]

FORMAT = "wlm-lightmap-export"
_VERSION = 1
WEIGHTS_FILE = "weights.json"
SHADER_FILE = "decode.glsl"

_TEXTURE = re.compile(r"tile_\d{4,}_(uv|uvt|ut|vt)\.dds")
_LIST_OF_NUMBERS = re.compile(r"\[\n([^\[\]{}\"]*)\]")
_CENTRED_DYNAMIC, _CENTRED_STATIC = 12, 4  # inputs that come from textures; the encoded time is fed as it is

_ABOUT = {
    "tiles": "Tiles of tile_size texels at (column, row) of the grid. A tile that is not listed is empty: 0.",
    "time": "Wrap t modulo the period (without one clamp it to the stored times) and find the stored times around it; "
    "with a period the last and the first are neighbours. share is where t lies between the two, 0 to 1.",
    "tau": "Place on the textures' time axis: tau[i] of stored time i. Between two, tau[i] + share * (step), the step "
    "to the next one; for the rule 'frames' it is 1/T, and tau is taken modulo 1 if time_axis.repeats. For the rule "
    "'paper' with a period tau is t / period.",
    "colour": "(shift + spread * y) * scale, not below 0, is the colour in gamma space; y is the network's answer "
    "(decode.glsl). radiance = colour ** gamma, linear RGB. scale is interpolated linearly between stored times.",
    "peak": "A bound of the tile's colour in gamma space: what 255 stands for where colour is kept in 8 bits. Between "
    "two stored times the larger holds.",
    "network": "h1 = gelu(x W1 + b1), h2 = gelu(h1 W2 + b2), y = h2 W3 + b3, a row of W for each input. x is uv[4], "
    "uvt[4], ut[2], vt[2] as sampled, in [0, 1], then the encoded time[4]; of a static tile uv[4] alone. "
    "network_offset counts floats in the array of all networks, W1 b1 W2 b2 W3 b3 of each tile in this order.",
    "radiance": "Of a constant tile, linear RGB at each stored time, interpolated linearly.",
}


def export(model: LightmapModel, directory: str | os.PathLike[str]) -> list[Path]:
    """Writes a model as textures, weights and a shader.

    For tile N of the grid, with four digits: ``tile_N_uv.dds``, F_uv in BC7, and of a dynamic tile also
    ``tile_N_uvt.dds``, F_uvt as a BC7 volume whose depth is time, and ``tile_N_ut.dds`` and ``tile_N_vt.dds``,
    F_ut and F_vt in R8G8_UNORM with time down the rows (neural-dynamic-gi, Table 1). The blocks are the model's
    own bytes. ``weights.json`` explains itself under "about"; ``decode.glsl`` is the decoder.

    Each file is written whole or not at all, ``weights.json`` last. Into a folder of an earlier export the new one is
    written over the old, and textures of tiles that are no more are removed; other files there stay.

    Args:
        model: From ``codec.read`` or ``fit.compress``.
        directory: The folder; made if it isn't there.

    Returns:
        The files written, in the order of writing.

    Raises:
        WlmError: The folder holds something other than an earlier export, or can't be written; or a number of the
            model isn't finite.
    """
    folder = Path(directory)
    text = _document(model)
    _claim(folder)
    mapped = np.flatnonzero(model.kind >= TileKind.STATIC).tolist()
    dynamic = np.flatnonzero(model.kind == TileKind.DYNAMIC).tolist()
    written = []
    for place, number in enumerate(mapped):
        row = dynamic.index(number) if model.kind[number] == TileKind.DYNAMIC else None
        written += _write_maps(folder, number, model, place, row)
    written += [folder / SHADER_FILE, folder / WEIGHTS_FILE]
    atomic_write(written[-2], decode_glsl(model).encode())
    atomic_write(written[-1], text.encode())
    try:
        for path in folder.iterdir():
            if _TEXTURE.fullmatch(path.name) and path not in written:
                path.unlink()
    except OSError as error:
        raise WlmError(f"{folder}: cannot remove the old export: {error.strerror or error}") from error
    return written


def _claim(folder: Path) -> None:
    """Makes the folder, or checks that it is empty or of an earlier export."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        empty = not any(folder.iterdir())
    except OSError as error:
        raise WlmError(f"{folder}: cannot export there: {error.strerror or error}") from error
    if empty:
        return
    try:
        found = json.loads((folder / WEIGHTS_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        found = None
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise WlmError(f"{folder}: expected an empty folder or one of an earlier export, found other files")


def _write_maps(folder: Path, number: int, model: LightmapModel, place: int, row: int | None) -> list[Path]:
    """Writes the textures of one tile; ``row`` is its place among the dynamic ones, None for a static one."""
    profile = model.profile

    def put(part: str, values: np.ndarray, *size: int, **options: Any) -> Path:
        path = folder / f"tile_{number:04d}_{part}.dds"
        write_dds(path, np.ascontiguousarray(values).tobytes(), *size, **options)
        return path

    written = [put("uv", model.uv[place], TILE, TILE)]
    if row is not None:
        side, plane = profile.uvt_resolution, (profile.plane_columns, profile.plane_rows)
        written.append(put("uvt", model.uvt[row], side, side, profile.uvt_slices, volume=True))
        written.append(put("ut", model.ut[row], *plane, fmt="R8G8_UNORM"))
        written.append(put("vt", model.vt[row], *plane, fmt="R8G8_UNORM"))
    return written


def _finish(model: LightmapModel, place: int) -> dict[str, Any]:
    shift, spread = model.affine[place]
    return {
        "shift": _numbers(shift),
        "spread": _numbers(spread),
        "scale": _numbers(model.scales[place]),
        "peak": _numbers(decode_scale(model.peak[place], model.profile.gamma)),
    }


def _network(net: np.ndarray, hidden: int, temporal: bool) -> dict[str, Any]:
    """Weights by layer, the centring of the textures' features folded into the first."""
    centred = _CENTRED_DYNAMIC if temporal else _CENTRED_STATIC
    count = len(net) - 3 * (hidden + 1)
    layers, output = net[:count].astype(np.float64).reshape(-1, hidden), net[count:].reshape(-1, 3)
    inputs = len(layers) - hidden - 2
    first, bias = layers[:inputs].copy(), layers[inputs].copy()
    # W (f - 1/2) sqrt(12) + b = (sqrt(12) W) f + (b - sqrt(12)/2 W 1).
    first[:centred] *= SQRT_12
    bias -= 0.5 * first[:centred].sum(0)
    return {
        "W1": _numbers(first),
        "b1": _numbers(bias),
        "W2": _numbers(layers[inputs + 1 : -1]),
        "b2": _numbers(layers[-1]),
        "W3": _numbers(output[:-1]),
        "b3": _numbers(output[-1]),
    }


def _tiles(model: LightmapModel) -> tuple[list[dict[str, Any]], int]:
    """Describes the tiles in the order of their numbers, and counts the floats of their networks."""
    tiles, offset = [], 0
    next_of = dict.fromkeys(TileKind, 0)
    for number in np.flatnonzero(model.kind != TileKind.EMPTY).tolist():
        kind = TileKind(int(model.kind[number]))
        row, next_of[kind] = next_of[kind], next_of[kind] + 1
        place = divmod(number, model.tile_columns)
        tile = {"number": number, "kind": kind.name.lower(), "column": place[1], "row": place[0]}
        if kind == TileKind.CONSTANT:
            tile["radiance"] = _numbers(model.constant[row])
        else:
            temporal = kind == TileKind.DYNAMIC
            net = (model.net if temporal else model.net_static)[row]
            mapped = int((model.kind[:number] >= TileKind.STATIC).sum())
            tile |= _finish(model, mapped) | {"network_offset": offset}
            tile |= _network(net, model.profile.hidden, temporal)
            offset += len(net)
        tiles.append(tile)
    return tiles, offset


def _document(model: LightmapModel) -> str:
    profile, axis = model.profile, model.axis
    tiles, floats = _tiles(model)
    document = {
        "format": FORMAT,
        "version": _VERSION,
        "about": _ABOUT,
        "name": model.name,
        "source": model.source,
        "width": model.width,
        "height": model.height,
        "tile_size": TILE,
        "tile_columns": model.tile_columns,
        "gamma": profile.gamma,
        "hidden": profile.hidden,
        "gelu": "exact" if profile.gelu == "exact" else "tanh",
        "network_floats": floats,
        "times": model.times.tolist(),
        "period": model.period,
        "time_axis": {"rule": axis.kind, "repeats": axis.periodic},
        "tau": _numbers(encode_time(axis)[0]),
        "tiles": tiles,
    }
    try:
        text = json.dumps(document, indent=1, allow_nan=False)
    except ValueError as error:
        raise WlmError(f"{model.name}: cannot export: a weight is NaN or infinite") from error
    # One number a line would be most of the file. Strings hold no raw line break, so that none is touched.
    return _LIST_OF_NUMBERS.sub(lambda found: "[" + " ".join(found[1].split()) + "]", text) + "\n"


def _numbers(values: np.ndarray) -> list[Any]:
    """As lists, with the 9 digits that tell every float32 from its neighbours."""
    values = np.asarray(values, np.float64)
    if values.ndim == 1:
        return [float(f"{value:.9g}") for value in values]
    return [_numbers(row) for row in values]
