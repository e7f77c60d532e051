"""Lightmaps for engines: DDS textures of all tiles, tables of floats and a shader, usable without this package."""

import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from wlm.errors import WlmError
from wlm.export.shading import ENDINGS, check_language, translate
from wlm.formats.atomic import atomic_path
from wlm.formats.dds import MOST_SIDE, write_dds
from wlm.formats.exr import write_exr
from wlm.formats.folder import compact_json, made_parents, rounded, staged
from wlm.lightmap import packed
from wlm.lightmap.decode import Decoder
from wlm.lightmap.model import TILE, LightmapModel, decode_scale, encode_time
from wlm.lightmap.page import MapDecoder
from wlm.lightmap.shader import EXACT, decode_glsl
from wlm.lightmap.tiles import UNPACKED, TileKind

FORMAT = "wlm-lightmap-export"
_VERSION = 2
WEIGHTS_FILE = "weights.json"
NETWORKS_FILE = "networks.bin"
HOURS_FILE = "hours.bin"
FRAME_FILE = "frame.exr"
VALID_FILE = "valid.png"
TEXTURES = ("uv", "uvt", "planes", "frames", "video")
SHADER_STEM = "decode"

_FILES = {WEIGHTS_FILE, NETWORKS_FILE, HOURS_FILE, FRAME_FILE, VALID_FILE}
_FILES |= {SHADER_STEM + ending for ending in ENDINGS.values()}
_FILES |= {f"{name}.dds" for name in TEXTURES}
_OF_VERSION_1 = re.compile(r"tile_\d{4,}_(uv|uvt|ut|vt|frame_\d{4,})\.dds")

_ABOUT = {
    "tiles": "Tiles of tile_size texels at (column, row) of the grid. A tile that is not listed is empty: 0.",
    "textures": "Each has images of all its tiles from left to right, across of them in a row. uv.dds: image row of a "
    "tile. uvt.dds: slice s of a tile is image row * slices + s. planes.dds: F_ut is image 2 * row, F_vt 2 * row + 1, "
    "time down the rows. frames.dds and video.dds are arrays: layer i has image row of each tile at stored time i.",
    "time": "Wrap t modulo the period (without one clamp it to the stored times) and find the stored times around it; "
    "with a period the last and the first are neighbours. share is where t lies between the two, 0 to 1.",
    "interpolation": "Of light between two stored times. radiance: decode both and mix their linear radiance by share "
    "(eq. 2). network: decode once, with tau and scale interpolated.",
    "tau": "Place on the textures' time axis: tau[i] of stored time i. Between two, tau[i] + share * (step), the step "
    "to the next one; for the rule 'frames' it is 1/T, and tau is taken modulo 1 if time_axis.repeats. For the rule "
    "'paper' with a period tau is t / period.",
    "hours": "hours.bin has a table for each stored time, hour_fours times four floats, which the shader reads. Fours "
    "0 and 1: of F_uvt, and of F_ut and F_vt, the slices or rows before and after tau, and the share of the later one. "
    "Then record fours for each tile of the grid, in order: code (0 empty or constant, 1 static, 2 dynamic, 3 frames, "
    "4 video), row, network_four, share of the later image. Code 0: colour. 1 and 2: shift * scale, spread * scale, "
    "then b1, in which of code 2 the encoded time is: b1 + its four rows of W1 times sin, cos(turn * tau), sin, cos(2 "
    "turn * tau). 3 and 4: least and layer, greatest, of the earlier, then of the later image. Between two stored "
    "times, where interpolation is network, a table is computed so.",
    "colour": "(shift + spread * y) * scale, not below 0, is the colour in gamma space; y is the network's answer "
    "(the shader). radiance = colour ** gamma, linear RGB. scale is interpolated linearly between stored times.",
    "peak": "A bound of the tile's colour in gamma space: what 255 stands for where colour is kept in 8 bits. Between "
    "two stored times the larger holds.",
    "network": "h1 = gelu(x W1 + b1), h2 = gelu(h1 W2 + b2), y = h2 W3 + b3, a row of W for each input. x is uv[4], "
    "uvt[4], ut[2], vt[2] as sampled, in [0, 1], then the encoded time[4]; of a static tile uv[4] alone. networks.bin "
    "has float32 W1 b1 W2 b2 W3 b3 of each tile, the rows filled up with zeros to fours, and rows of zeros added for "
    "those; a tile's begin at four network_four.",
    "radiance": "Of a constant tile, linear RGB at each stored time, interpolated linearly.",
    "frames": "A tile of frames or video has an image of each stored time and no network: colour is least[i] + level * "
    "(greatest[i] - least[i]). Between two stored times their radiance is mixed, whatever interpolation says.",
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
    shader: str = "glsl",
    exact: bool = False,
) -> list[Path]:
    """Writes a model as textures, tables, a shader and a frame to compare with.

    `uv.dds` (BC7), `uvt.dds` (BC7) and `planes.dds` (R8G8_UNORM) are F_uv, F_uvt and F_ut beside F_vt of all tiles
    (neural-dynamic-gi, Table 1), image by image; `frames.dds` (BC7) and `video.dds` (R10G10B10A2_UNORM, unpacked) are
    arrays with a layer for each stored time. Those that a model has no tiles for are left out. The blocks are the
    model's own bytes. `networks.bin` and `hours.bin` are floats, see `wlm.lightmap.packed`; `decode.glsl` is the
    decoder (or `.hlsl`, `.metal`, `.wgsl`); `valid.png` is white inside charts, for the pass that fills the gaps;
    `frame.exr` is the map at the first stored time, as the shader should show it; `weights.json` explains itself under
    "about".

    The files are written beside the folder and moved in together, `weights.json` last. An earlier export is replaced;
    other files stay.

    Args:
        model: The model.
        directory: The folder; made if it isn't there.
        device: Where the frame is decoded.
        values: What the levels 0 and 1 of a model without gamma stand for: `frame.exr` and the shader have values, and
            `weights.json` says so. None: the model is of radiance.
        shader: Its language, one of `wlm.export.shading.LANGUAGES`.
        exact: Texels are fetched and mixed in floats where the filter unit would do.

    Returns:
        The files written.

    Raises:
        WlmError: The folder holds something other than an earlier export, or can't be written; no such device or
            language; a number of the model isn't finite; or a texture is larger than GPUs take.
    """
    check_language(shader)
    folder, name = Path(directory), SHADER_STEM + ENDINGS[shader]
    frame = Decoder(model, device).frame(float(model.times[0]))
    if values is not None:
        frame = np.float32(values[0]) + np.float32(values[1] - values[0]) * frame
    with made_parents(folder), staged(folder, WEIGHTS_FILE, FORMAT, is_exported) as staging:
        write_exr(staging / FRAME_FILE, frame, half=False)
        text = translate(decode_glsl(model, values), shader, [EXACT] if exact else [])
        (staging / name).write_bytes(text.encode())
        names = write_parts(model, staging, values)
    return [folder / name for name in (FRAME_FILE, name, *names)]


def write_parts(
    model: LightmapModel, folder: Path, values: tuple[float, float] | None = None, form: str = FORMAT
) -> list[str]:
    """Writes what every engine reads: textures, floats, the mask, and `weights.json` last.

    Args:
        model, values: As of `export`.
        folder: Where; it must exist.
        form: `format` of `weights.json`: whose folder it is.

    Returns:
        The files' names.

    Raises:
        WlmError: As `export`.
    """
    tables, nets = packed.hour_tables(model), packed.networks(model)
    textures = packed.textures(model)
    content = document(model, textures, nets[1]) | {"format": form, "hour_fours": tables.shape[1]}
    if values is not None:
        content |= {"values": list(values), "about": _ABOUT | {"values": _VALUES}}
    try:
        text = compact_json(content)
    except ValueError as error:
        raise WlmError(f"{model.name}: cannot export: a number is NaN or infinite") from error
    for name, texture in textures.items():
        size = texture.width, texture.height
        write_dds(folder / f"{name}.dds", texture.data.tobytes(), *size, fmt=texture.fmt, layers=texture.layers)
    (folder / HOURS_FILE).write_bytes(tables.astype("<f4").tobytes())
    names = [f"{name}.dds" for name in textures] + [HOURS_FILE]
    if len(nets[0]):
        (folder / NETWORKS_FILE).write_bytes(nets[0].astype("<f4").tobytes())
        names.append(NETWORKS_FILE)
    Image.fromarray(model.mask).save(folder / VALID_FILE)
    (folder / WEIGHTS_FILE).write_bytes(text.encode())
    return [*names, VALID_FILE, WEIGHTS_FILE]


def is_exported(name: str) -> bool:
    """Whether a file's name is one that an export has or, of an earlier version, had."""
    return name in _FILES or bool(_OF_VERSION_1.fullmatch(name))


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


def _tiles(model: LightmapModel, starts: np.ndarray) -> list[dict[str, Any]]:
    """Describes the tiles in the order of their numbers."""
    scales, peaks = model.scales, decode_scale(model.peak, model.profile.gamma)
    places, mapped = packed.rows_of(model), {number: i for i, number in enumerate(model.mapped.tolist())}
    tiles = []
    rows = dict.fromkeys(TileKind, 0)  # the next tile's place among those of its kind
    for number in np.flatnonzero(model.kind != TileKind.EMPTY).tolist():
        kind = TileKind(int(model.kind[number]))
        row, rows[kind] = rows[kind], rows[kind] + 1
        place = divmod(number, model.tile_columns)
        tile = {"number": number, "kind": kind.name.lower(), "column": place[1], "row": place[0]}
        if kind != TileKind.CONSTANT:
            tile["image"] = int(places[number])
        if kind == TileKind.CONSTANT:
            tile["radiance"] = rounded(model.constant[row])
        elif kind == TileKind.FRAMES:
            least, greatest = model.ranges[row].swapaxes(0, 1)
            tile |= {"least": rounded(least), "greatest": rounded(greatest), "peak": rounded(greatest.max(1))}
        elif kind in UNPACKED:
            at = int(places[number])
            least, greatest = model.word_ranges[at].swapaxes(0, 1)
            peak = rounded(model.word_peaks[at])
            # One texture, and to an engine one kind.
            tile |= {"kind": "video", "least": rounded(least), "greatest": rounded(greatest), "peak": peak}
        else:
            at = mapped[number]
            shift, spread = model.affine[at]
            tile |= {"shift": rounded(shift), "spread": rounded(spread), "scale": rounded(scales[at])}
            tile |= {"peak": rounded(peaks[at]), "network_four": int(starts[places[number]])}
        tiles.append(tile)
    return tiles


def document(model: LightmapModel, textures: dict[str, packed.Texture], starts: np.ndarray) -> dict[str, Any]:
    """What `weights.json` holds: textures, scales and bounds by tile, and how to read them ("about").

    Args:
        model: The model.
        textures: What `wlm.lightmap.packed.textures` gives.
        starts: Where each network begins, see `wlm.lightmap.packed.networks`.
    """
    profile, axis = model.profile, model.axis
    sides = {
        "uvt": (profile.uvt_resolution, profile.uvt_resolution),
        "planes": (profile.plane_columns, profile.plane_rows),
    }
    described = {}
    for name, texture in textures.items():
        width, height = sides.get(name, (TILE, TILE))
        described[name] = {
            "format": texture.fmt,
            "size": [texture.width, texture.height],
            "layers": texture.layers,
            "image": [width, height],
            "across": texture.width // width,
        }
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
        "times": model.times.tolist(),
        "interpolation": profile.interpolation,
        "period": model.period,
        "time_axis": {"rule": axis.kind, "repeats": axis.periodic, "turn": axis.turn},
        "tau": rounded(encode_time(axis)[0]),
        "slices": profile.uvt_slices,
        "record": packed.record(model),
        "textures": described,
        "tiles": _tiles(model, starts),
    }
