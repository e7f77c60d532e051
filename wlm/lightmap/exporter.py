"""Lightmaps for engines: DDS textures, weights in JSON and a shader, usable without this package."""

import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path
from wlm.formats.dds import MOST_SIDE, write_dds
from wlm.formats.exr import write_exr
from wlm.formats.folder import compact_json, make_parents, rounded, staged
from wlm.lightmap.decode import Decoder
from wlm.lightmap.exact import SQRT_12
from wlm.lightmap.model import TILE, LightmapModel, decode_scale, encode_time
from wlm.lightmap.page import MapDecoder
from wlm.lightmap.shader import decode_glsl
from wlm.lightmap.tiles import TileKind

FORMAT = "wlm-lightmap-export"
_VERSION = 1
WEIGHTS_FILE = "weights.json"
SHADER_FILE = "decode.glsl"
FRAME_FILE = "frame.exr"
VALID_FILE = "valid.png"

_TEXTURE = re.compile(r"tile_\d{4,}_(uv|uvt|ut|vt|frame_\d{4,})\.dds")
_CENTRED_DYNAMIC, _CENTRED_STATIC = 12, 4  # inputs that come from textures; the encoded time is not centred

_ABOUT = {
    "tiles": "Tiles of tile_size texels at (column, row) of the grid. A tile that is not listed is empty: 0.",
    "time": "Wrap t modulo the period (without one clamp it to the stored times) and find the stored times around it; "
    "with a period the last and the first are neighbours. share is where t lies between the two, 0 to 1.",
    "interpolation": "Of light between two stored times. radiance: decode both and mix their linear radiance by share "
    "(eq. 2). network: decode once, with tau and scale interpolated.",
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
    "frames": "A tile of frames or video has a texture of each stored time i, tile_N_frame_i.dds, and no network: "
    "colour is least[i] + level * (greatest[i] - least[i]). Between two stored times their radiance is mixed, whatever "
    "interpolation says.",
}

_VALUES = (
    "What the colours 0 and 1 stand for: these are values, not light. Where radiance is said above, read values[0] + "
    "colour * (values[1] - values[0]); gamma is 1."
)


def export(
    model: LightmapModel,
    directory: str | os.PathLike[str],
    *,
    device: str = "cpu",
    values: tuple[float, float] | None = None,
) -> list[Path]:
    """Writes a model as textures, weights and a shader, and a frame to compare with.

    For tile N of the grid, with four digits: `tile_N_uv.dds`, F_uv in BC7, and of a dynamic tile also
    `tile_N_uvt.dds`, F_uvt as a BC7 volume whose depth is time, and `tile_N_ut.dds` and `tile_N_vt.dds`,
    F_ut and F_vt in R8G8_UNORM with time down the rows (neural-dynamic-gi, Table 1); of a tile of frames
    `tile_N_frame_I.dds` in BC7 for each stored time I, of a tile of video the same in R10G10B10A2_UNORM, unpacked. The
    blocks are the model's own bytes. `decode.glsl` is the decoder; `valid.png` is white inside charts, for the pass
    that fills the gaps; `frame.exr` is the map at the first stored time, as the shader should show it; `weights.json`
    explains itself under "about".

    The files are written beside the folder and moved in together, `weights.json` last. An earlier export is replaced,
    and textures of tiles that are no longer there are removed; other files stay.

    Args:
        model: The model.
        directory: The folder; made if it isn't there.
        device: Where the frame is decoded.
        values: What the levels 0 and 1 of a model without gamma stand for: `frame.exr` and the shader have values, and
            `weights.json` says so. None: the model is of radiance.

    Returns:
        The files written.

    Raises:
        WlmError: The folder holds something other than an earlier export, or can't be written; no such device; or a
            number of the model isn't finite.
    """
    folder = Path(directory)
    frame = Decoder(model, device).frame(float(model.times[0]))
    content = document(model)
    if values is not None:
        frame = np.float32(values[0]) + np.float32(values[1] - values[0]) * frame
        content |= {"values": list(values), "about": _ABOUT | {"values": _VALUES}}
    try:
        text = compact_json(content)
    except ValueError as error:
        raise WlmError(f"{model.name}: cannot export: a weight is NaN or infinite") from error
    make_parents(folder)
    dynamic = np.flatnonzero(model.kind == TileKind.DYNAMIC).tolist()
    with staged(folder, WEIGHTS_FILE, FORMAT, lambda name: bool(_TEXTURE.fullmatch(name))) as staging:
        written = []
        for place, number in enumerate(model.mapped.tolist()):
            row = dynamic.index(number) if number in dynamic else None
            written += _write_maps(staging, number, model, place, row)
        for row, number in enumerate(np.flatnonzero(model.kind == TileKind.FRAMES).tolist()):
            for i, blocks in enumerate(model.frames[row]):
                path = staging / f"tile_{number:04d}_frame_{i:04d}.dds"
                write_dds(path, np.ascontiguousarray(blocks).tobytes(), TILE, TILE)
                written.append(path)
        for row, number in enumerate(np.flatnonzero(model.kind == TileKind.VIDEO).tolist()):
            for i, words in enumerate(model.video_levels[row]):
                path = staging / f"tile_{number:04d}_frame_{i:04d}.dds"
                write_dds(path, words.astype("<u4").tobytes(), TILE, TILE, fmt="R10G10B10A2_UNORM")
                written.append(path)
        (staging / SHADER_FILE).write_bytes(decode_glsl(model, values).encode())
        write_exr(staging / FRAME_FILE, frame, half=False)
        Image.fromarray(model.mask).save(staging / VALID_FILE)
        (staging / WEIGHTS_FILE).write_bytes(text.encode())
        written += [staging / name for name in (SHADER_FILE, FRAME_FILE, VALID_FILE, WEIGHTS_FILE)]
    return [folder / path.name for path in written]


def is_exported(name: str) -> bool:
    """Whether a file's name is one that an export may have."""
    return name in (WEIGHTS_FILE, SHADER_FILE, FRAME_FILE, VALID_FILE) or bool(_TEXTURE.fullmatch(name))


def write_8bit(
    path: str | os.PathLike[str], decoder: Decoder, time: float, values: tuple[float, float] | None = None
) -> None:
    """Writes a frame as a texture cache holds it: a PNG of 8 bits, with gamma and each tile's bound in its text "wlm".

    Args:
        path: The PNG.
        decoder: The decoder.
        time: In the unit of the set's times.
        values: As for `export`; the text has them too.

    Raises:
        WlmError: The time isn't finite, or the file can't be written.
    """
    pixels, bounds = decoder.frame_8bit(time)
    text = PngInfo()
    facts = {"gamma": decoder.model.profile.gamma, "bounds": bounds.tolist()}
    text.add_text("wlm", json.dumps(facts if values is None else facts | {"values": list(values)}))
    with atomic_path(path) as temporary:
        Image.fromarray(pixels).save(temporary, "PNG", pnginfo=text)


def write_texture(path: str | os.PathLike[str], model: LightmapModel, time: float, device: str = "cpu") -> None:
    """Writes the map at one time as a renderer samples it: a DDS of RGB9E5 texels with all mips.

    Args:
        path: The DDS.
        model: The model.
        time: In the unit of the set's times.
        device: Where it is decoded.

    Raises:
        WlmError: No such device, the time isn't finite, the map is larger than a DDS may be, or the file can't be
            written.
    """
    if max(model.height, model.width) > MOST_SIDE:
        size = f"{model.width}x{model.height}"
        raise WlmError(f"{model.name}: expected at most {MOST_SIDE} texels along a side for a DDS, found {size}")
    decoder = MapDecoder(model, device)
    decoder.set_time(time)
    decoder.decode()
    texels = b"".join(level.numpy().astype("<u4").tobytes() for level in decoder.levels)
    mips = len(decoder.levels) - 1
    write_dds(path, texels, model.width, model.height, fmt="R9G9B9E5_SHAREDEXP", mips=mips)


def _write_maps(folder: Path, number: int, model: LightmapModel, place: int, row: int | None) -> list[Path]:
    """Writes the textures of one tile; `row` is its place among the dynamic ones, None for a static one."""
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
        "W1": rounded(first),
        "b1": rounded(bias),
        "W2": rounded(layers[inputs + 1 : -1]),
        "b2": rounded(layers[-1]),
        "W3": rounded(output[:-1]),
        "b3": rounded(output[-1]),
    }


def _tiles(model: LightmapModel) -> tuple[list[dict[str, Any]], int]:
    """Describes the tiles in the order of their numbers, and counts the floats of their networks."""
    scales, peaks = model.scales, decode_scale(model.peak, model.profile.gamma)
    tiles, offset, mapped = [], 0, 0
    rows = dict.fromkeys(TileKind, 0)  # the next tile's place among those of its kind
    for number in np.flatnonzero(model.kind != TileKind.EMPTY).tolist():
        kind = TileKind(int(model.kind[number]))
        row, rows[kind] = rows[kind], rows[kind] + 1
        place = divmod(number, model.tile_columns)
        tile = {"number": number, "kind": kind.name.lower(), "column": place[1], "row": place[0]}
        if kind == TileKind.CONSTANT:
            tile["radiance"] = rounded(model.constant[row])
        elif kind == TileKind.FRAMES:
            least, greatest = model.ranges[row].swapaxes(0, 1)
            tile |= {"least": rounded(least), "greatest": rounded(greatest), "peak": rounded(greatest.max(1))}
        elif kind == TileKind.VIDEO:
            least, greatest = model.video_ranges[row].repeat(3, 1).reshape(-1, 2, 3).swapaxes(0, 1)
            peak = rounded(model.video_peaks[row])
            tile |= {"least": rounded(least), "greatest": rounded(greatest), "peak": peak}
        else:
            temporal = kind == TileKind.DYNAMIC
            net = (model.net if temporal else model.net_static)[row]
            shift, spread = model.affine[mapped]
            tile |= {"shift": rounded(shift), "spread": rounded(spread)}
            tile |= {"scale": rounded(scales[mapped]), "peak": rounded(peaks[mapped]), "network_offset": offset}
            tile |= _network(net, model.profile.hidden, temporal)
            mapped, offset = mapped + 1, offset + len(net)
        tiles.append(tile)
    return tiles, offset


def document(model: LightmapModel) -> dict[str, Any]:
    """What `weights.json` holds: networks, scales and bounds by tile, and how to read them ("about")."""
    profile, axis = model.profile, model.axis
    tiles, floats = _tiles(model)
    return {
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
        "interpolation": profile.interpolation,
        "period": model.period,
        "time_axis": {"rule": axis.kind, "repeats": axis.periodic},
        "tau": rounded(encode_time(axis)[0]),
        "tiles": tiles,
    }
