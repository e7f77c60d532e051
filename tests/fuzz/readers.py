"""The table of readers: of what each case is made, how it is read, and what an accepted file must be.

A new reader is a row: its good files (in `corpus/`, or made here), how to change one with some knowledge of the
format, and a function that reads it as users do and asserts what the format's page forbids.
"""

import base64
import functools
import gzip
import json
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from builders.vdb_files import ACTIVE_MASK, ZIP, scaled, tree, vdb_file

import wlm
from benchmarks.rows import read_json
from wlm.atlas.listing import read_listing
from wlm.bake.geometry import read_geometry
from wlm.bake.settings import LightmapSettings
from wlm.config import load_settings
from wlm.errors import WlmError
from wlm.fluid.volume import load_volume
from wlm.formats.channels import read_channels, read_encoded
from wlm.formats.exr import read_exr
from wlm.formats.gltf import read_gltf
from wlm.formats.gltf_writer import write_glb
from wlm.formats.light import read_light
from wlm.formats.mask import read_mask
from wlm.formats.meshes import read_mesh
from wlm.inspection import inspect
from wlm.inspection.finding import UNREADABLE
from wlm.probe.data import load_positions
from wlm.scene.file import SceneFile
from wlm.scene.mesh import read_mesh as read_coloured
from wlm.smoke.data import load_frames, read_shaded
from wlm.smoke.flipbook.reading import read_flipbook
from wlm.smoke.network.settings import DatasetSettings
from wlm.smoke.scene import Scene

from . import models, used
from .containers import vary_exr, vary_glb, vary_gltf, vary_npz, vary_png
from .mutate import NAMES, corrupt, vary_json, vary_numbers, vary_text
from .reader import Reader, check_finite, corpus
from .textures import vary_dds, vary_ktx2, vary_radiance

_PROFILES = Path(__file__).resolve().parents[2] / "configs"


def _json(draw: Random, data: bytes) -> bytes:
    """Changes a JSON value; now and then its text is nested deeper than any stack."""
    text = json.dumps(vary_json(draw, json.loads(data))).encode()
    if draw.random() < 0.1:
        # Any of its texts that might be a name.
        names = re.findall(rb'"[^"]*\\.[a-z0-9]+"', text)
        text = text.replace(draw.choice(names), json.dumps(draw.choice(NAMES)).encode()) if names else text
    if draw.random() > 0.03:
        return text
    at = draw.randrange(len(text))
    return text[:at] + draw.choice((b"[", b'{"a":')) * 100_000 + text[at:]


def _exr(path: Path) -> None:
    pixels, names = read_exr(path)
    assert pixels.dtype == np.float32 and pixels.shape[2] == len(names), f"accepted as {pixels.dtype} {pixels.shape}"


def _layered(path: Path) -> None:
    pixels, names, _ = read_channels(path, light=True)
    assert pixels.dtype == np.float32 and pixels.shape[2] == len(names), f"accepted as {pixels.dtype} {pixels.shape}"


def _inspect(path: Path) -> None:
    for each in inspect(path.parent):
        assert not any("\n" in line for line in (each.what, *each.problems))
        if each.what.endswith(UNREADABLE):
            raise WlmError(f"{path}: {each.problems[0]}")


def _light_file(path: Path) -> None:
    pixels, names = read_light(path)
    assert pixels.dtype == np.float32 and pixels.shape[2] == len(names), f"accepted as {pixels.dtype} {pixels.shape}"
    assert pixels.size, "accepted without a texel"


def _levels(path: Path) -> None:
    light = read_encoded(path, "srgb")
    check_finite(light=light)
    assert light.ndim == 3 and light.shape[2] == 3 and light.size, f"accepted as {light.shape}"


def _tags(draw: Random, data: bytes) -> bytes:
    """Changes values of a TIFF's tags, or any bytes."""
    order = "<" if data[:2] == b"II" else ">"
    (at,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, at)
    entries = range(at + 2, at + 2 + 12 * count, 12)
    fields = [(entry + shift, width) for entry in entries for shift, width in ((0, 2), (2, 2), (4, 4), (8, 2), (8, 4))]
    return vary_numbers(draw, data, fields) if draw.random() < 0.7 else corrupt(draw, data)


def _six_way(path: Path) -> None:
    six, looks = read_shaded(path)
    assert looks is None or looks.ramp is None or len(looks.ramp.stops) > 1, "accepted with a glow of one colour"
    check_finite(lightmaps=six.lightmaps, transparency=six.transparency, axes=six.camera.axes)
    assert six.lightmaps.shape[1:] == (six.camera.height, six.camera.width), "accepted with another size"


def _light_lists() -> Sequence[bytes]:
    """Lists of a scene's lightmaps, in each convention."""
    sheets = [{"files": ["day.exr", "night.exr"], "name": "wall", "flip": True}]
    rectangle = {"x": 0.5, "y": 0.5, "z": 0.0, "w": 0.5}
    objects = {
        "gltf": {"node": "a", "sheet": 0, "scale_offset": [0.5, 0.5, 0.0, 0.5]},
        "unity": {"node": "a", "lightmapIndex": 0, "lightmapScaleOffset": rectangle},
        "godot": {"path": "Level/a", "slice_index": 0, "uv_scale": [0.0, 0.5, 0.5, 0.5]},
    }
    head = {"states": ["day", "night"], "sheets": sheets, "uv_set": 1}
    lists = [head | {"convention": name, "objects": [each]} for name, each in objects.items()]
    return [json.dumps(each).encode() for each in (*lists, {"lightmaps": [{"time_hours": 6.5, "file": "a.exr"}]})]


def _mask(path: Path) -> None:
    mask = read_mask(path, "light.exr", (12, 10))
    assert mask.shape == (12, 10) and mask.dtype == bool, f"accepted as {mask.dtype} {mask.shape}"
    assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n", "accepted a file that isn't a PNG"


def _flipbook(path: Path) -> None:
    for frame in read_flipbook((path, path), "unity", rows=2, columns=2):
        check_finite(lightmaps=frame.lightmaps)


def _tga(draw: Random, data: bytes) -> bytes:
    # Lengths, kinds, colour map, origin, size, depth, flags.
    head = [(0, 1), (1, 1), (2, 1), (3, 2), (5, 2), (7, 1), (8, 2), (10, 2), (12, 2), (14, 2), (16, 1), (17, 1)]
    return vary_numbers(draw, data, head)


def _mesh(path: Path) -> None:
    document, primitives = read_gltf(path)
    again = path.with_name("again.glb")
    try:
        write_glb(again, document, [], 1)
        assert len(read_gltf(again)[1]) == len(primitives), "written again with other primitives"
    finally:
        again.unlink(missing_ok=True)
    _lit(path)


def _own_lights() -> Sequence[bytes]:
    """glTF files that name their lightmaps, by each kind of extension; the picture is inside."""
    plain, *pictures = corpus("mesh.gltf", "mask-rgba.png", "plain.hdr")()
    png, radiance = (base64.b64encode(each).decode() for each in pictures)
    turned = {"KHR_texture_transform": {"scale": [0.5, 0.5], "offset": [0.25, 0.5], "rotation": 0.1, "texCoord": 1}}
    info = {"index": 0, "texCoord": 1}
    renderer = {"lightmapIndex": 0, "lightmapScaleOffset": {"x": 0.5, "y": 0.5, "z": 0.0, "w": 0.5}}
    needle = {"textures": [{"pointer": "textures/0", "type": 0, "index": 0}]}
    place = {"texture": info, "coordinateScaleBias": [0.5, 0.5, 0.0, 0.25]}
    scenes = []
    for material, node, root in (
        ({"MOZ_lightmap": {"index": 0, "intensity": 2.0, "extensions": turned}}, {}, {}),
        ({"FB_materials_lightmap": {"lightmapTexture": info, "lightmapFactor": [1.0, 2.0, 3.0]}}, {}, {}),
        ({}, {"MX_lightmap": {"lightMapTexture": info, "scale": [0.5, 0.5], "offset": [0.5, 0.0]}}, {}),
        ({}, {"EPIC_lightmap_textures": {"lightmap": 0}}, {"EPIC_lightmap_textures": {"lightmaps": [place]}}),
        ({}, {"NEEDLE_components": {"builtin_components": [renderer]}}, {"NEEDLE_lightmaps": needle}),
    ):
        content = json.loads(plain)
        picture = radiance if root or "FB_materials_lightmap" in material else png
        content["images"] = [{"uri": f"data:image/png;base64,{picture}"}]
        content["materials"] = [{"extensions": material}]
        content["nodes"][1]["extensions"], content["extensions"] = node, root
        scenes.append(json.dumps(content).encode())
    return scenes


def _coloured() -> Sequence[bytes]:
    """A glTF file whose positions are its normals and its base colours, too."""
    (plain,) = corpus("mesh.gltf")()
    content = json.loads(plain)
    content["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [0.5, 1.0, 0.25, 1.0]}}]
    for primitive in (each for mesh in content["meshes"] for each in mesh["primitives"]):
        attributes = primitive["attributes"]
        attributes["NORMAL"] = attributes["COLOR_0"] = attributes["POSITION"]
        primitive["material"] = 0
    return [json.dumps(content).encode()]


def _colours(path: Path) -> None:
    check_finite(**vars(read_coloured(path, with_uv=True)))


def _own_lit(path: Path) -> None:
    for sheet in wlm.atlas.load(path).sheets:
        check_finite(position=sheet.position, uv=sheet.uv, lightmap=sheet.lightmap)
        assert sheet.triangle.max() < len(sheet.position), "a corner beyond the vertices"


def _obj(path: Path) -> None:
    mesh = read_mesh(path)
    assert not len(mesh.triangle) or mesh.triangle.max() < len(mesh.position), "a corner beyond the vertices"
    _lit(path)


def _lit(path: Path) -> None:
    (sheet,) = wlm.atlas.load(path, path.with_name("light.exr")).sheets
    check_finite(position=sheet.position, uv=sheet.uv, lightmap=sheet.lightmap)
    assert sheet.triangle.max() < len(sheet.position), "a corner beyond the vertices"


def _obj_lines(draw: Random, data: bytes) -> bytes:
    return vary_text(draw, data.decode(), ("f", "v"))


def _beside(names: Mapping[str, str]) -> Callable[[], Mapping[str, bytes]]:
    """Makes the files beside a case's: their names, and which of the corpus they are."""
    return lambda: {name: corpus(source)()[0] for name, source in names.items()}


_light = _beside({"light.exr": "light.exr", "image.png": "mask-grey.png"})


def _probes(path: Path) -> None:
    probes = wlm.probe.load(path)
    check_finite(position=probes.position, values=probes.values)
    assert probes.values.shape[0] == len(probes.position) > 0, "accepted without probes"


def _positions(path: Path) -> None:
    position = load_positions(path)
    check_finite(position=position)
    assert position.ndim == 2 and position.shape[1] == 3 and len(position), f"accepted as {position.shape}"


def _volume(path: Path) -> None:
    volume = load_volume(path)
    check_finite(density=volume.density, voxel=volume.voxel, origin=np.array(volume.origin))
    assert volume.voxel > 0 and bool((volume.density >= 0).all()), "accepted below 0"


@functools.cache
def _grids() -> Sequence[bytes]:
    return tuple(gzip.decompress(data) for data in corpus("cloud.nvdb.gz")())


@functools.cache
def _vdbs() -> Sequence[bytes]:
    """Makes a grid packed by zlib, and reads a file of several grids packed by Blosc that OpenVDB wrote."""
    random = np.random.default_rng(0)
    values = (random.random((16, 8, 24)) * (random.random((16, 8, 24)) < 0.5)).astype(np.float32)
    nodes = tree(values, values > 0, ZIP | ACTIVE_MASK)
    made = gzip.decompress((Path(__file__).resolve().parents[1] / "files" / "openvdb.vdb.gz").read_bytes())
    return vdb_file({"density": (scaled(0.5, 0.5, 0.6), nodes, ZIP | ACTIVE_MASK, False)}), made


@functools.cache
def _grid_fields(data: bytes) -> list[tuple[int, int]]:
    """The headers of file, grid, tree and root, and the 64-bit words of the nodes that aren't 0: offsets and masks."""
    headers = [(at, width) for width in (4, 8) for at in range(0, 1100 - width, 4)]
    words = np.frombuffer(data, "<u8", (len(data) - 1) // 8, 1)
    return headers + [(1 + 8 * int(at), 8) for at in np.flatnonzero(words)]


def _grid(draw: Random, data: bytes) -> bytes:
    return vary_numbers(draw, data, _grid_fields(data))


def _tiles(draw: Random, data: bytes) -> bytes:
    """A tree with several nodes and tiles at its root, many of which overlap; or other numbers in a file."""
    if draw.random() < 0.7:
        return _grid(draw, data)
    random = np.random.default_rng(draw.getrandbits(32))
    blocks = random.choice([0.0, 0.5, 2.0, 1e30, np.nan, -1.0], (4, 2, 3)).astype(np.float32)
    values = np.kron(blocks, np.ones((8, 8, 8), np.float32))
    node = tree(values, np.ones(values.shape, bool), ACTIVE_MASK)[
        28:
    ]  # of tiles, without the root's head and its place
    nodes = draw.choice(((1, 0), (2, 0), (1, 40), (6, 3), (0, 2000)))
    tiles = (0, 8, -8, 1, 100, 4095, 4096, -4096, 1 << 20)
    root = struct.pack("<If2I", 1, draw.choice((0.0, 1.0, -1.0)), nodes[1], nodes[0])
    for _ in range(nodes[1]):
        root += struct.pack("<3if?", *draw.choices(tiles, k=3), draw.choice((0.0, 0.5, 1e30)), draw.random() < 0.9)
    for _ in range(nodes[0]):
        root += struct.pack("<3i", *draw.choices(tiles, k=3)) + node
    return vdb_file({"density": (scaled(0.5, 0.5, 0.5), root, ACTIVE_MASK, False)})


def _table(draw: Random, data: bytes) -> bytes:
    return vary_text(draw, data.decode(), (",", ";", "r0", "x", "sh", "#", "\t", "1e999", "nan"))


def _asset_text(draw: Random, data: bytes) -> bytes:
    words = ("  m_Positions:", "- {x: ", "sh[ 0]: ", "--- !u!258 &1", "    ", "{", "LightProbes:")
    return vary_text(draw, data.decode(), words)


def _godot(draw: Random, data: bytes) -> bytes:
    """Changes a plain resource, or the content of one in compressed blocks, which are compressed again."""
    import imagecodecs

    changed = corrupt(draw, data)
    if draw.random() < 0.5:
        return changed
    size = draw.choice((64, 4096, 1 << 20))
    blocks = [imagecodecs.zstd_encode(changed[at : at + size]) for at in range(0, len(changed) + 1, size)]
    head = struct.pack("<3I", 2, size, len(changed)) + struct.pack(f"<{len(blocks)}I", *map(len, blocks))
    return b"RSCC" + head + b"".join(blocks) + b"RSCC"


# Folders with an index.


def _set(draw: Random, data: bytes) -> bytes:
    content = vary_json(draw, json.loads(data))
    entries = content.get("lightmaps") if isinstance(content, dict) else None
    if isinstance(entries, list) and entries and isinstance(entries[0], dict) and draw.random() < 0.3:
        entries[0]["file"] = draw.choice(NAMES)
    if isinstance(entries, list) and entries and isinstance(entries[0], dict) and draw.random() < 0.1:
        # Many times of files whose alpha is the mask.
        content["mask"], content["lightmaps"] = (
            "alpha",
            [
                entries[0] | {"time_hours": 0.01 * i, "file": draw.choice(("b.exr", "b.exr", "a.exr"))}
                for i in range(draw.choice((2, 100, 2000)))
            ],
        )
    if isinstance(content, dict) and draw.random() < 0.2:
        content["mask"] = draw.choice(NAMES)
    return json.dumps(content).encode()


def _lightmap_set(path: Path) -> None:
    lightmaps = wlm.lightmap.load(path.parent)
    for sheet, own in lightmaps.sheets.items():
        check_finite(frames=own.frames, times=own.times)
        assert (own.frames >= 0).all() and (np.diff(own.times) > 0).all(), "negative, or times out of order"
        assert not sheet.linear or (own.frames <= 1).all(), "levels beyond their range"


def _groups() -> Sequence[bytes]:
    """Light groups of one size, one of them with a mask of its own."""
    sky = {"name": "sky", "lightmaps": [{"time_hours": 2.5 * i, "file": "a.exr"} for i in range(2)]}
    lamp = {"name": "lamp", "lightmaps": [{"file": "a.exr"}], "mask": "mask.png"}
    return (json.dumps({"name": "day", "period_hours": 24, "groups": [sky, lamp]}).encode(),)


def _layers() -> Sequence[bytes]:
    """Light of two atlases, directions in a PNG, and a layer of an EXR's rows."""
    files = {
        "0": {"light": "a.exr", "dir": "c.png", "L1": {"file": "a.exr", "slice": 0, "slices": 1}},
        "1": {"light": {"file": "b.exr", "slice": 1, "slices": 2}, "dir": "c.png", "L1": "b.exr"},
    }
    layers = {"light": "radiance", "dir": {"encoding": "signed", "channels": ["G", "R", "A"]}, "L1": "unit"}
    lightmaps = [{"time_hours": 2.5 * i, "files": {"0": files["0"]}} for i in range(2)]
    one = {"name": "day", "layers": layers, "period_hours": 24, "lightmaps": lightmaps}
    two = {"layers": {"light": "radiance"}, "lightmaps": [{"time_hours": 0.0, "files": files}]}
    atlas = {"width": 10, "height": 12, "mask": "mask.png"}
    contents = one | {"atlases": {"0": atlas}}, two | {"atlases": {"0": {"mask": "all"}, "1": {}}}
    return tuple(json.dumps(content).encode() for content in contents)


def _frames(path: Path) -> None:
    _scene_figures(load_frames(path.parent).scene)


# Settings.

# What YAML does with words, one a line.
_FRAGMENTS = [
    *r"""
!!python/object/apply:os.system ['id']
!!python/name:os.system
!<tag:yaml.org,2002:x> {}
!!timestamp x
!!timestamp 2001-13-45
!!binary aGk=
!!float x
!!int x
!!set {a, b}
!!omap [a: 1]
&a [*a]
*a
&a 1
{<<: {steps: 1}}
<<: *a
? [1, 2]
2001-99-99
1:99:99:99
1e999
.nan
.inf
-.inf
0b2
0o9
1_000
59:59.9
-190:20:30.15
1:2:3:4:5:6:7:8:9.9
9:99999999999999999999.5
1e-999
-0.0
1_0:2_0.5
.5e+5000
4.9e-324
1.7976931348623157e+308
[1e308, -1e308, .inf]
"\x1b[31m"
"\uD800"
yes
~
'
"
%YAML 9.9
---
...
[1, 2
{a: 1
:
""".strip().split("\n"),
    *("0x" + "f" * 5000, "1" * 5000, "1" * 400 + ".5", "9:" * 300 + "9.5", "0b" + "1" * 5000, "\0", "\t"),
    *(each * 300 for each in ("[", "{", "- ")),
]


def _surfaces(path: Path) -> None:
    for surface in read_geometry(path, LightmapSettings()).surfaces:
        check_finite(position=surface.position, normal=surface.normal)
        assert len(surface.triangle) and surface.triangle.max() < len(surface.position), "accepted without triangles"


def _settings(name: str, model: Callable[[], type], files: str, check: Callable[[Any], None] | None = None) -> Reader:
    """The reader of a settings model's YAML."""

    @functools.cache
    def seeds() -> Sequence[bytes]:
        paths = sorted(_PROFILES.glob(f"{files}.yaml"))
        if model() is Scene:
            paths = [path for path in paths if not path.name.startswith("smoke-network")]
        # The meshes of scenes stay where they are.
        texts = (path.read_text().replace("meshes/", f"{_PROFILES}/meshes/") for path in paths)
        return tuple(text.encode() for text in texts) or corpus(f"{files}.yaml")()

    def read(path: Path) -> None:
        settings = load_settings(model(), path)
        if check is not None:
            check(settings)

    def vary(draw: Random, data: bytes) -> bytes:
        return vary_text(draw, data.decode(), _FRAGMENTS)

    return Reader(name, "a.yaml", seeds, vary, read)


def _scene_figures(scene: Scene) -> None:
    """Fails where numbers derived from an accepted scene are not usable."""
    check_finite(fastest=scene.fastest, step=scene.step)
    assert scene.steps >= 1, f"accepted with {scene.steps} steps a frame"


_KTX2 = ("packed-zstd.ktx2", "bc6h-zlib.ktx2", "half-mips.ktx2", "astc.ktx2")
_SET = {"a.exr": "light.exr", "b.exr": "zip.exr", "c.png": "mask-rgba.png", "mask.png": "mask-grey.png"}
_FRAME = {"frame_0001.npz": "volume.npz"}

_ALL = (
    *models.READERS,
    *used.READERS,
    Reader("exr", "a.exr", corpus("zip.exr", "piz.exr", "b44.exr", "dwaa.exr", "tiled.exr"), vary_exr, _exr),
    Reader("exr-layers", "a.exr", corpus("layers.exr", "parts.exr"), corrupt, _layered),
    Reader("radiance", "a.hdr", corpus("runs.hdr", "plain.hdr"), vary_radiance, _light_file),
    Reader("pfm", "a.pfm", corpus("light.pfm"), corrupt, _light_file),
    Reader("tiff", "a.tif", corpus("strips.tif", "tiles.tif"), _tags, _light_file),
    Reader("jpeg", "a.jpg", corpus("levels.jpg"), corrupt, _levels),
    Reader("webp", "a.webp", corpus("levels.webp"), corrupt, _levels),
    Reader("ktx2", "a.ktx2", corpus(*_KTX2), vary_ktx2, _light_file),
    Reader("inspect", "a.json", corpus("set.json", "probes.json", "positions.json"), _json, _inspect),
    Reader("dds", "a.dds", corpus("shared.dds", "bc6h.dds", "float-legacy.dds"), vary_dds, _light_file),
    Reader("exr-six-way", "a.exr", corpus("six-way.exr"), functools.partial(vary_exr, note="wlm"), _six_way),
    Reader("png-mask", "mask.png", corpus("mask-grey.png", "mask-palette.png", "mask-rgba.png"), vary_png, _mask),
    Reader("png-flipbook", "a.png", corpus("flipbook.png"), vary_png, _flipbook),
    Reader("tga-flipbook", "a.tga", corpus("flipbook.tga"), _tga, _flipbook),
    Reader("gltf", "a.gltf", corpus("mesh.gltf"), vary_gltf, _mesh, _light, cost=2),
    Reader("glb", "a.glb", corpus("mesh.glb"), vary_glb, _mesh, _light, cost=2),
    Reader("gltf-lights", "a.gltf", _own_lights, vary_gltf, _own_lit, cost=2),
    Reader("gltf-bake", "a.gltf", corpus("mesh.gltf"), vary_gltf, _surfaces, _light, cost=2),
    Reader("gltf-colours", "a.gltf", _coloured, vary_gltf, _colours, cost=2),
    Reader("obj", "a.obj", corpus("mesh.obj"), _obj_lines, _obj, _light),
    Reader("atlas-lights", "lights.json", _light_lists, _json, read_listing),
    Reader("probes-npz", "a.npz", corpus("probes.npz", "probes-known.npz"), vary_npz, _probes),
    Reader("probes-json", "a.json", corpus("probes.json", "probes-list.json", "probes-known.json"), _json, _probes),
    Reader("probes-json-forms", "a.json", corpus("probes-vci.json", "probes-scene.json"), _json, _probes),
    Reader("probes-table", "a.csv", corpus("probes.csv"), _table, _probes),
    Reader("probes-ktx2", "a.ktx2", corpus("volume.ktx2"), vary_ktx2, _probes),
    Reader("probes-asset-text", "a.asset", corpus("probes.asset"), _asset_text, _probes),
    Reader("probes-lmbake", "a.lmbake", corpus("probes.lmbake"), _godot, _probes),
    Reader("positions-npz", "a.npz", corpus("positions.npz"), vary_npz, _positions),
    Reader("positions-json", "a.json", corpus("positions.json"), _json, _positions),
    Reader("volume-npz", "a.npz", corpus("volume.npz", "volume-bricks.npz"), vary_npz, _volume),
    Reader("volume-nvdb", "a.nvdb", _grids, _grid, _volume, cost=2),
    Reader("volume-vdb", "a.vdb", _vdbs, _tiles, _volume, cost=2),
    Reader("lightmap-layers-set", "set.json", _layers, _json, _lightmap_set, _beside(_SET)),
    Reader("lightmap-set", "set.json", corpus("set.json"), _set, _lightmap_set, _beside(_SET)),
    Reader("lightmap-groups-set", "set.json", _groups, _json, _lightmap_set, _beside(_SET)),
    Reader("smoke-frames", "scene.json", corpus("scene.json"), _json, _frames, _beside(_FRAME)),
    Reader("bench-rows", "a.json", corpus("rows.json"), _json, read_json),
    _settings("yaml-lightmap", lambda: wlm.lightmap.Profile, "lightmap-*"),
    _settings("yaml-probe", lambda: wlm.probe.Profile, "probe-*"),
    _settings("yaml-atlas", lambda: wlm.atlas.Profile, "atlas-*"),
    _settings("yaml-smoke-network", lambda: wlm.smoke.Profile, "smoke-network-*"),
    _settings("yaml-scene", lambda: Scene, "smoke-*", _scene_figures),
    _settings("yaml-dataset", lambda: DatasetSettings, "dataset"),
    _settings("yaml-day", lambda: SceneFile, "day"),
)

READERS: dict[str, Reader] = {reader.name: reader for reader in _ALL}
"""The readers by name."""
