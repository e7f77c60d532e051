"""Files that once took the machine, left their folder or ended in a traceback, and the readers that must refuse them.

Those of `tests/files/hostile` lie there; bombs are made here, since what they would become is large and they are not.
"""

from __future__ import annotations

import functools
import gzip
import itertools
import json
import os
import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np

from wlm.formats.exr import write_exr

from .containers import edit_artifact, edit_compact
from .reader import corpus, stored

_FILES = Path(__file__).resolve().parents[1] / "files" / "hostile"

Write = Callable[[Path], None]
"""Writes a file at a path, and what it needs beside it."""


def _copy(name: str) -> Write:
    return lambda path: path.write_bytes((_FILES / name).read_bytes())


def _text(text: str) -> Write:
    return lambda path: path.write_text(text)


def _artifact(name: str, change: Callable[[Any, dict[str, np.ndarray]], Any]) -> Write:
    """A stored model's file with other settings or parts, and a digest that fits."""
    return lambda path: path.write_bytes(edit_artifact(stored(name)()[0], change))


def _compact(name: str, change: Callable[[Any, bytes], tuple[Any, bytes]]) -> Write:
    """A stored model's compact file with another header or parts, and a digest that fits."""
    return lambda path: path.write_bytes(edit_compact(stored(name)()[0], change))


def _with(**settings: Any) -> Callable[[Any, dict[str, np.ndarray]], Any]:
    return lambda old, parts: old | settings


# Artifacts.


def _of_size(*size: float) -> Callable[[Any, dict[str, np.ndarray]], Any]:
    return lambda old, parts: old | {"sheets": [old["sheets"][0] | {"size": size}]}


def _empty_tiles(settings: Any, parts: dict[str, np.ndarray]) -> Any:
    parts |= {name: np.zeros(0, np.uint8) for name in parts if name not in ("0.kind", "times")}
    parts["0.kind"] = np.zeros(1 << 16, np.uint8)
    return _of_size(1 << 15, 1 << 15)(settings, parts)


def _kind_2d(settings: Any, parts: dict[str, np.ndarray]) -> Any:
    parts["0.kind"] = parts["0.kind"][None]
    return settings


def _times_2d(settings: Any, parts: dict[str, np.ndarray]) -> Any:
    parts["times"] = parts["times"][:, None]
    return settings


def _affine_nan(settings: Any, parts: dict[str, np.ndarray]) -> Any:
    parts["0.affine"] = np.full_like(parts["0.affine"], np.nan)
    return settings


def _infinite_probes(settings: Any, parts: bytes) -> tuple[Any, bytes]:
    return settings | {"probes": float("inf")}, parts


def _many_outputs(settings: Any, parts: bytes) -> tuple[Any, bytes]:
    latent, hidden, outputs = settings["profile"]["latent"], settings["profile"]["hidden"], 20_000
    # The network comes last, in four bytes a weight.
    old, new = (4 * ((latent + 4) * hidden + (hidden + 1) * (hidden + count)) for count in (27, outputs))
    return settings | {"outputs": outputs}, parts[:-old] + bytes(new)


def _large_plain(settings: Any, parts: dict[str, np.ndarray]) -> Any:
    parts["colour"] = np.ones((1, 1, 1, 3), np.float16)
    return settings | {"sizes": [[1 << 16, 1 << 16]], "texels": [1, 1]}


def _no_weights(settings: Any, parts: dict[str, np.ndarray]) -> Any:
    parts.clear()
    return settings | {"network": settings["network"] | {"width": 64, "levels": 6}}


# glTF.


def _gltf(count: int, nodes: int = 1, view: dict[str, Any] | None = None, **buffer: Any) -> Write:
    """A triangle mesh of so many vertices, drawn by so many nodes."""
    accessor = {"componentType": 5126, "count": count}
    content: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}] * nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}}]}],
        "accessors": [accessor | {"type": "VEC3"}, accessor | {"type": "VEC2"}],
    }
    if buffer:
        for each in content["accessors"]:
            each["bufferView"] = 0
        content |= {"buffers": [buffer], "bufferViews": [{"buffer": 0, "byteLength": 64} | (view or {})]}
    return lambda path: path.write_text(json.dumps(content))


def _fifo_beside(path: Path) -> None:
    os.mkfifo(path.with_name("fifo"))
    _gltf(3, byteLength=64, uri="fifo")(path)


# Archives, sets and YAML.


def _sparse(head: bytes, size: int = 1 << 40) -> Write:
    """A file that begins so and has zeros up to a size, which take no room on the disk."""

    def write(path: Path) -> None:
        path.write_bytes(head)
        os.truncate(path, size)

    return write


def _wide_dds() -> bytes:
    content = bytearray(corpus("shared.dds")()[0])
    struct.pack_into("<2I", content, 12, 1 << 16, 1 << 16)
    return content


def _ktx2(side: int, texels: bytes, stored: int | None = None) -> Write:
    """A square of 11-11-10 under zstd, of other texels than its header states."""
    content = bytearray(corpus("packed-zstd.ktx2")()[0])
    packed = imagecodecs.zstd_encode(texels)
    struct.pack_into("<2I", content, 20, side, side)
    struct.pack_into("<3Q", content, 80, len(content), stored or len(packed), 4 * side * side)
    return _sparse(content + packed, len(content) + (stored or len(packed)))


def _zip_bomb(name: str, header: str, size: int, **others: np.ndarray) -> Write:
    """A `.npz` with a member of `size` zeros behind a header: a deflated megabyte of them, again and again."""

    def write(path: Path) -> None:
        np.savez(path, **others)
        packer = zlib.compressobj(9, zlib.DEFLATED, -15)
        start = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode()
        first = packer.compress(start) + packer.flush(zlib.Z_FULL_FLUSH)
        zeros = packer.compress(bytes(1 << 20)) + packer.flush(zlib.Z_FULL_FLUSH)
        body = first + zeros * (size >> 20) + packer.flush()
        data = path.read_bytes()
        directory = data.index(b"PK\x01\x02") if others else 0
        end = struct.unpack("<4s4H2IH", data[-22:])
        # Its CRC is left 0: whoever comes to look at it has unpacked the whole.
        common = struct.pack("<5H3I2H", 20, 0, 8, 0, 33, 0, len(body), len(start) + size, len(name), 0)
        member = b"PK\x03\x04" + common + name.encode() + body
        entry = b"PK\x01\x02" + struct.pack("<H", 20) + common + struct.pack("<3H2I", 0, 0, 0, 0, directory)
        entries = data[directory:-22] + entry + name.encode()
        tail = struct.pack("<4s4H2IH", *end[:3], end[3] + 1, end[4] + 1, len(entries), directory + len(member), 0)
        path.write_bytes(data[:directory] + member + entries + tail)

    return write


def _header(shape: tuple[int, ...], kind: str) -> str:
    return f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n"


def _set(change: Callable[[dict[str, Any]], None]) -> Write:
    """A set of one lightmap, with something changed."""

    def write(path: Path) -> None:
        content = {"width": 10, "height": 12, "lightmaps": [{"time_hours": 0.0, "file": "a.exr"}]}
        change(content)
        path.write_text(json.dumps(content))
        for place in (path.with_name("a.exr"), path.parent.parent / "b.exr"):
            place.write_bytes(corpus("light.exr")()[0])

    return write


def _same_again(path: Path) -> None:
    """One lightmap of 3 MB, which black has in some kilobytes, at 40,000 times."""
    entries = [{"time_hours": i / 2000, "file": "a.exr"} for i in range(40_000)]
    path.write_text(json.dumps({"width": 512, "height": 512, "lightmaps": entries}))
    write_exr(path.with_name("a.exr"), np.zeros((512, 512, 3)))


def _file(name: str) -> Callable[[dict[str, Any]], None]:
    return lambda content: content["lightmaps"][0].update(file=name)


def _mask(name: str, data: bytes = b"") -> Write:
    def write(path: Path) -> None:
        _set(lambda content: content.update(mask=name))(path)
        if data:
            path.with_name(name).write_bytes(data)

    return write


def _merges(depth: int = 8) -> str:
    names = "abcdefghi"[:depth]
    lines = ["a: &a {" + ", ".join(f"k{i}: 1" for i in range(9)) + "}"]
    lines += [f"{b}: &{b} {{<<: [{', '.join([f'*{a}'] * 9)}]}}" for a, b in itertools.pairwise(names)]
    return "\n".join(lines) + "\n"


_EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 12\n%%EndComments\nshowpage\n%%EOF\n"
_BMP = b"BM" + struct.pack("<3I", 54 + 3 * 12 * 10, 0, 54) + struct.pack("<3I2H6I", 40, 10, 12, 1, 24, *[0] * 6)
_BMP += bytes(54 + 32 * 12 - len(_BMP))

_YAMLS = ("yaml-lightmap", "yaml-probe", "yaml-atlas", "yaml-smoke-network", "yaml-scene", "yaml-dataset")
_ARCHIVES = ("volume-npz", "probes-npz", "positions-npz")
_POINTS = {"position": np.zeros((4, 3), np.float32)}

HOSTILE: dict[str, tuple[Sequence[str], Write]] = {
    "size-infinity.wlm": (["lightmap"], _artifact("lightmap.wlm", _of_size(float("inf"), 1))),
    "empty-tiles.wlm": (["lightmap"], _artifact("lightmap.wlm", _empty_tiles)),
    "kind-2d.wlm": (["lightmap"], _artifact("lightmap.wlm", _kind_2d)),
    "times-2d.wlm": (["lightmap"], _artifact("lightmap.wlm", _times_2d)),
    "affine-nan.wlm": (["lightmap"], _artifact("lightmap.wlm", _affine_nan)),
    **{
        f"period-{period}.wlm": (["lightmap"], _artifact("lightmap.wlm", _with(period=period)))
        for period in (0, -5, float("nan"), float("inf"), "24")
    },
    "probes-infinity.wlm": (["probe"], _compact("probe.wlm", _infinite_probes)),
    "many-outputs.wlm": (["probe"], _compact("probe.wlm", _many_outputs)),
    "large-plain.wlm": (["atlas"], _artifact("atlas-plain.wlm", _large_plain)),
    "no-weights.wlm": (["smoke-network"], _artifact("smoke.wlm", _no_weights)),
    **{f"{name}.npz": (_ARCHIVES, _copy(f"{name}.npz")) for name in ("paren", "huge", "huge-mem", "indent")},
    **{f"{name}.npz": (_ARCHIVES, _copy(f"{name}.npz")) for name in ("member-not-npy", "encrypted", "bytes-key")},
    "zeros-volume.npz": (
        ["volume-npz"],
        _zip_bomb("density.npy", _header((1 << 10, 1 << 10, 1000), "<f4"), 4000 << 20),
    ),
    "zeros-probes.npz": (["probes-npz"], _zip_bomb("sh.npy", _header((1 << 25, 9, 3), "<f4"), 3456 << 20, **_POINTS)),
    "zeros-points.npz": (["positions-npz"], _zip_bomb("position.npy", _header((1 << 24, 3), "<f8"), 384 << 20)),
    "count.gltf": (["gltf"], _gltf(300_000_000)),
    "stride-0.gltf": (["gltf"], _gltf(300_000_000, 1, {"byteStride": 0}, byteLength=64, uri="data:," + "a" * 64)),
    "instances.gltf": (["gltf"], _gltf(300_000, nodes=1000)),
    "device.gltf": (["gltf"], _gltf(3, byteLength=64, uri="../" * 30 + "dev/zero")),
    "fifo-beside.gltf": (["gltf"], _fifo_beside),
    "b44-wide.exr": (["exr"], _copy("b44-wide.exr")),
    "bbox-700.nvdb": (
        ["volume-nvdb"],
        lambda path: path.write_bytes(gzip.decompress((_FILES / "bbox-700.nvdb.gz").read_bytes())),
    ),
    "wide.ktx2": (["ktx2"], _ktx2(16384, b"\0" * 16)),
    "more.ktx2": (["ktx2"], _ktx2(64, bytes(64 << 20))),
    "sparse.ktx2": (["ktx2"], _ktx2(4096, b"", 1 << 40)),
    "wide.hdr": (["radiance"], _text("#?RADIANCE\n\n-Y 16384 +X 16384\n" + "abcd\1\1\1\x7f\1\1\1\x7f" * 16384)),
    "header.hdr": (["radiance"], _sparse(b"#?RADIANCE\n")),
    "wide.dds": (["dds"], _sparse(_wide_dds())),
    "many/set.json": (["lightmap-set"], _same_again),
    "above/set.json": (["lightmap-set"], _set(_file("../b.exr"))),
    "device/set.json": (["lightmap-set"], _set(_file("/dev/zero"))),
    "surrogate/set.json": (["lightmap-set"], _set(_file("\ud800"))),
    "long-mask/set.json": (["lightmap-set"], _mask("x" * 5000)),
    "eps-mask/set.json": (["lightmap-set"], _mask("mask.png", _EPS)),
    "bmp-mask/set.json": (["lightmap-set"], _mask("mask.png", _BMP)),
    "alias-bomb.yaml": (_YAMLS, _copy("alias-bomb.yaml")),
    "merge-bomb.yaml": (_YAMLS, _text(_merges())),
    "digits.yaml": (_YAMLS, _text("steps: 0x" + "f" * 5000 + "\n")),
    "deep.yaml": (_YAMLS, _text("[" * 20_000)),
    "timestamp.yaml": (_YAMLS, _text("!!timestamp x\n")),
    "inlet-1e300.yaml": (["yaml-scene"], _copy("inlet-1e300.yaml")),
    **{
        f"{kind}{suffix}": ([reader], functools.partial(make, target))
        for kind, make, target in (("zero", os.symlink, "/dev/zero"), ("fifo", lambda _, path: os.mkfifo(path), ""))
        for suffix, reader in (
            (".wlm", "lightmap"),
            (".partial", "probe-checkpoint"),
            (".safetensors", "smoke-network"),
            (".exr", "exr"),
            (".hdr", "radiance"),
            (".ktx2", "ktx2"),
            (".dds", "dds"),
            (".gltf", "gltf"),
            (".obj", "obj"),
            (".npz", "volume-npz"),
            (".json", "probes-json"),
            (".lmbake", "probes-lmbake"),
            (".nvdb", "volume-nvdb"),
            (".vdb", "volume-vdb"),
            (".png", "png-mask"),
            (".tga", "tga-flipbook"),
            (".yaml", "yaml-scene"),
        )
    },
}
"""By name: the readers, and what writes the file."""
