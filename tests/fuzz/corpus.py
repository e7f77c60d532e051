"""The good files in `corpus/`, each made by our own writer of its format and as small as still has every feature."""

import base64
import gzip
import json
from pathlib import Path

import imagecodecs
import numpy as np
import OpenEXR
import tifffile
import warp as wp
from builders import atlas_meshes, bench_rows, probe_layouts, probe_sets, smoke_plumes
from builders.godot_bakes import Writer, bake, probes
from builders.textures import make_dds, make_ktx2
from PIL import Image

from benchmarks import Row, write_json
from wlm.atlas.stored import store
from wlm.fluid.volume import from_array, save_volume
from wlm.formats.exr import write_exr
from wlm.probe.ambient_cube import write_irradiance_volume
from wlm.probe.data import save_probes
from wlm.smoke.data import open_frames, write_six_way
from wlm.smoke.march.six_way import bake as bake_smoke
from wlm.smoke.march.six_way import with_surface
from wlm.smoke.scene import Scene

_HEIGHT, _WIDTH = 12, 10  # of every picture


def write_corpus(folder: Path) -> None:
    """Writes all files; the bytes of some depend on the versions of the libraries that pack them."""
    folder.mkdir(exist_ok=True)
    for write in (_exrs, _pictures, _textures, _meshes, _probe_files, _volumes, _smoke, _settings):
        write(folder)


def _pixels(channels: int) -> np.ndarray:
    """float32 [12, 10, channels], 0 to 1: a gradient with some noise."""
    y, x = np.mgrid[:_HEIGHT, :_WIDTH]
    ramp = (y[..., None] + 2 * x[..., None] + np.arange(channels)) / 40
    return (0.9 * ramp + 0.1 * np.random.default_rng(0).random((_HEIGHT, _WIDTH, channels))).astype(np.float32)


def _exrs(folder: Path) -> None:
    write_exr(folder / "light.exr", _pixels(3))
    planes = dict(zip("RGBA", np.moveaxis(_pixels(4), -1, 0), strict=True))
    for name, compression, kind, dtype in (
        ("zip", OpenEXR.ZIP_COMPRESSION, OpenEXR.scanlineimage, np.float32),
        ("piz", OpenEXR.PIZ_COMPRESSION, OpenEXR.scanlineimage, np.float16),
        ("b44", OpenEXR.B44_COMPRESSION, OpenEXR.scanlineimage, np.float16),
        ("dwaa", OpenEXR.DWAA_COMPRESSION, OpenEXR.scanlineimage, np.float16),
        ("tiled", OpenEXR.RLE_COMPRESSION, OpenEXR.tiledimage, np.float16),
    ):
        header = {"compression": compression, "type": kind}
        if kind == OpenEXR.tiledimage:
            header["tiles"] = OpenEXR.TileDescription()
        content = {channel: np.ascontiguousarray(plane, dtype) for channel, plane in planes.items()}
        OpenEXR.File(header, content).write(str(folder / f"{name}.exr"))
    halves = {channel: np.ascontiguousarray(planes[channel], np.float16) for channel in "RGB"}
    layers = {
        f"{layer}.{channel}": plane for layer in ("View.Combined", "View.Bake") for channel, plane in halves.items()
    }
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, layers).write(str(folder / "layers.exr"))
    header = {"compression": OpenEXR.RLE_COMPRESSION, "dataWindow": ((1, 2), (_WIDTH, _HEIGHT + 1))}
    header["displayWindow"] = (0, 0), (_WIDTH - 1, _HEIGHT - 1)
    parts = [OpenEXR.Part(dict(header), dict(halves), name=name) for name in ("beauty", "second")]
    OpenEXR.File(parts).write(str(folder / "parts.exr"))


def _pictures(folder: Path) -> None:
    image = Image.fromarray(np.uint8(255 * _pixels(4)), "RGBA")
    image.save(folder / "mask-rgba.png")
    image.convert("L").point(lambda value: 255 * (value > 90)).save(folder / "mask-grey.png")
    image.convert("P").save(folder / "mask-palette.png")
    image.convert("RGB").save(folder / "levels.jpg")
    image.save(folder / "levels.webp", lossless=True)
    image.save(folder / "flipbook.png")
    image.save(folder / "flipbook.tga", compression="tga_rle")


def _textures(folder: Path) -> None:
    size = _WIDTH, _HEIGHT
    flat = np.where(_pixels(3) > 0.5, 1.0, 0.25).astype(np.float32)
    (folder / "runs.hdr").write_bytes(imagecodecs.rgbe_encode(flat, header=True))
    row = bytes([200, 100, 50, 128, 50, 150, 250, 129]) * 5
    head = b"#?RADIANCE\nEXPOSURE=2\nCOLORCORR=1 2 1\nFORMAT=32-bit_rle_rgbe\n\n"
    (folder / "plain.hdr").write_bytes(head + b"+X 12 +Y 10\n" + 12 * row)
    head = f"PF\n{_WIDTH} {_HEIGHT}\n-1.0\n".encode()
    (folder / "light.pfm").write_bytes(head + _pixels(3).astype("<f4").tobytes())
    tifffile.imwrite(folder / "strips.tif", _pixels(3), photometric="rgb", compression="zlib", rowsperstrip=4)
    tifffile.imwrite(folder / "tiles.tif", _pixels(1)[..., 0].astype(np.float16), tile=(16, 16), byteorder=">")
    words = np.random.default_rng(1).integers(0, 1 << 32, (4, _HEIGHT, _WIDTH), np.uint32)
    blocks = words.tobytes()[: 9 * 16]
    half = [_pixels(4)[:: 1 << i, :: 1 << i].astype("<f2").tobytes() for i in range(2)]
    for name, content in {
        "packed-zstd.ktx2": make_ktx2(122, *size, [words[0].tobytes()], 2, {"KTXwriter": "wlm"}),
        "bc6h-zlib.ktx2": make_ktx2(143, *size, [blocks], 3, {"KTXorientation": "ru", "KTXswizzle": "rgba"}),
        "half-mips.ktx2": make_ktx2(97, *size, half),
        "astc.ktx2": make_ktx2(1000066000, *size, [blocks]),
        "shared.dds": make_dds(67, *size, words[0].tobytes()),
        "bc6h.dds": make_dds(96, *size, blocks),
        "float-legacy.dds": make_dds(0, *size, _pixels(4).tobytes(), b"\x74\0\0\0"),
    }.items():
        (folder / name).write_bytes(content)


def _meshes(folder: Path) -> None:
    sheet = atlas_meshes.sheet(quads=2)
    (folder / "mesh.glb").write_bytes(store(sheet).glb)
    corners = [(0, 0), (1, 0), (0, 1), (1, 1)]
    lines = ["# a square", "o square"]
    lines += [f"v {x} {y} 0.5" for x, y in corners] + [f"vt {x} {y}" for x, y in corners]
    lines += ["vn 0 0 1", "g all", "usemtl white", "f 1/1/1 2/2/1 4/4/1 \\", "  3/3/1", "f -4/-4 -3/-3 -1/-1", ""]
    (folder / "mesh.obj").write_text("\n".join(lines))
    (folder / "mesh.gltf").write_text(json.dumps(_gltf()))


def _gltf() -> dict:
    """A square twice, below nodes that turn and mirror it; strided, normalised, sparse and absent accessors."""
    corner = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
    vertices = np.zeros(4, [("position", "<3f4"), ("uv", "<2u2")])
    vertices["position"][:, :2], vertices["uv"] = corner, 65535 * corner
    index, at, moved = np.array([0, 1, 3, 0, 3, 2], "<u2"), np.array([1, 3], "<u2"), np.ones((2, 3), "<f4")
    pieces = [vertices.tobytes(), index.tobytes(), at.tobytes(), moved.tobytes()]
    views, start = [], 0
    for number, piece in enumerate(pieces):
        views.append(
            {"buffer": 0, "byteOffset": start, "byteLength": len(piece)} | ({} if number else {"byteStride": 16})
        )
        start += len(piece)
    sparse = {"indices": {"bufferView": 2, "componentType": 5123}, "values": {"bufferView": 3}, "count": 2}
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]},
        {"bufferView": 0, "byteOffset": 12, "componentType": 5123, "normalized": True, "count": 4, "type": "VEC2"},
        {"bufferView": 1, "componentType": 5123, "count": 6, "type": "SCALAR"},
        {"componentType": 5126, "count": 4, "type": "VEC3", "sparse": sparse},
    ]
    attributes = {"POSITION": 0, "TEXCOORD_0": 1, "TEXCOORD_1": 1, "NORMAL": 3}
    primitives = [{"attributes": attributes, "indices": 2, "material": 0}, {"attributes": attributes, "mode": 5}]
    primitives[0]["targets"] = [{"POSITION": 3}]
    body = base64.b64encode(b"".join(pieces)).decode()
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"children": [1, 2], "scale": [2, -1, 1], "rotation": [0, 0, 0.6, 0.8]},
            {"mesh": 0, "translation": [1, 2, 3], "name": "left"},
            {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 4, 5, 6, 1], "extras": {"lit": True}},
        ],
        "meshes": [{"primitives": primitives, "weights": [0.5]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"uri": "image.png"}],
        "animations": [
            {
                "channels": [{"sampler": 0, "target": {"node": 1, "path": "translation"}}],
                "samplers": [{"input": 2, "output": 3}],
            }
        ],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start, "uri": f"data:application/octet-stream;base64,{body}"}],
    }


def _probe_files(folder: Path) -> None:
    room = probe_sets.synthetic(6, coefficients=4)
    for name in ("probes.npz", "probes.json"):
        save_probes(folder / name, room.position, room.values)
    points, sh = probes(4)
    each = [{"position": place, "sh": light} for place, light in zip(points.tolist(), sh.tolist(), strict=True)]
    known = {"normal": np.eye(3)[[0, 1, 2, 0, 1, 2]], "valid": np.arange(6.0) / 5.0}
    np.savez(folder / "probes-known.npz", position=room.position, sh=room.values, **known)
    known = {"position": room.position, "sh": room.values.astype(float), **known}
    (folder / "probes-known.json").write_text(json.dumps({name: array.tolist() for name, array in known.items()}))
    (folder / "probes-list.json").write_text(json.dumps({"convention": "godot", "probes": each}))
    writer = Writer()
    (folder / "probes.lmbake").write_bytes(writer.file(bake(writer, points, sh)))
    light = probe_sets.synthetic(8).values.reshape(8, 9, 3)
    write_irradiance_volume(folder / "volume.ktx2", light, np.array([2, 2, 2]))
    np.savez(folder / "positions.npz", position=room.position)
    vci = [probe_layouts.vci(*row) for row in zip(points, sh.transpose(0, 2, 1), strict=True)]
    (folder / "probes-vci.json").write_text(json.dumps(vci))
    scene = probe_layouts.three_scene()
    for group in scene["object"]["children"][:2]:
        del group["children"][2:]
    (folder / "probes-scene.json").write_text(json.dumps(scene))
    table = probe_layouts.tables()["named.csv"].replace(",", " ").splitlines()[:5]
    (folder / "probes.csv").write_text("\n".join(table))
    (folder / "probes.asset").write_text(probe_layouts.unity_text(count=3))
    (folder / "positions.json").write_text(json.dumps(room.position.round(3).tolist()))


def _volumes(folder: Path) -> None:
    density = np.random.default_rng(0).random((6, 5, 7)).astype(np.float16)
    volume = from_array(density, voxel=0.25, origin=(1.0, 2.0, 3.0), temperature=density**2)
    save_volume(folder / "volume.npz", volume)
    save_volume(folder / "volume-bricks.npz", volume, bricks=True)
    grid = wp.Volume.load_from_numpy(density.astype(np.float32), (1.0, 2.0, 3.0), 0.5, 0.0, device="cpu")
    grid.save_to_nvdb(folder / "cloud.nvdb")
    # A node near the root has room for thousands of children: almost all of the file is zeros.
    (folder / "cloud.nvdb.gz").write_bytes(gzip.compress((folder / "cloud.nvdb").read_bytes(), mtime=0))
    (folder / "cloud.nvdb").unlink()


def _smoke(folder: Path) -> None:
    plume = smoke_plumes.plume(hot=True)
    six = bake_smoke(plume, smoke_plumes.facing(plume, size=12), estimate=False)
    looks = Scene.model_validate(smoke_plumes.SCENE | {"obstacles": [smoke_plumes.SPHERE]}).looks(1)
    write_six_way(folder / "six-way.exr", with_surface(six, plume, looks), looks)
    scene = Scene.model_validate(smoke_plumes.SCENE | {"obstacles": [smoke_plumes.SPHERE], "frames": 1})
    open_frames(folder / "frames", scene)
    (folder / "frames" / "scene.json").rename(folder / "scene.json")
    (folder / "frames").rmdir()


def _settings(folder: Path) -> None:
    lightmaps = [{"time_hours": 2.5 * i, "file": f"{name}.exr"} for i, name in enumerate("ab")]
    content = {"name": "day", "width": _WIDTH, "height": _HEIGHT, "period_hours": 24, "mask": "mask.png"}
    (folder / "set.json").write_text(json.dumps(content | {"lightmaps": lightmaps}))
    (folder / "dataset.yaml").write_text(
        "cells: 20\nguide: six\nzoom: [0.8, 1.2]\nmoving: 0.25\nleast_coverage: 0.01\n"
    )
    (folder / "day.yaml").write_text(
        "title: day\nmesh: a.glb\nlight: a.wlm\nprobes: b.wlm\n"
        "sky: [{hour: 0, colour: [0, 0, 0.1], exposure: 2}, {hour: 12, colour: [1, 1, 1], exposure: -1}]\n"
        "moving: [{mesh: c.glb, path: [[0, 0, 0], [1, 0, 0]], seconds: 8}]\n"
        "smoke: [{files: smoke, position: [0, 1, 0], size: 0.5, rate: 20}]\n"
        "camera: [{second: 0, eye: [0, 1, 5], target: [0, 1, 0], fov: 50}]\n"
        "day: {first: 5, last: 29, seconds: 24}\noriginals: [a_12h.exr]\n"
    )
    row = Row("lightmap", "room", "ours", "M", {"psnr": 41.5, "bpp": 0.7})
    write_json(folder / "rows.json", [row], bench_rows.ENVIRONMENT)
