"""Files made to harm: each ends in one line, and none makes a reader take memory that the file doesn't account for.

`tests/files/hostile` has the two that can't be made in a few lines: a NanoVDB grid whose root claims 700^3 voxels, and
an EXR of 4.5 KB whose header claims 268 million texels in a row.
"""

from __future__ import annotations

import base64
import gzip
import itertools
import json
import os
import struct
import tracemalloc
import zlib
from contextlib import contextmanager, nullcontext
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from PIL import Image
from rich.markup import escape

from benchmarks.rows import read_runs
from tests.fuzz.bench import Limits
from wlm import atlas, lightmap
from wlm.atlas.stored import with_uvs
from wlm.bake.geometry import read_geometry
from wlm.cli.console import note, show, show_text, table
from wlm.config import load_settings
from wlm.errors import WlmError, printable
from wlm.fluid.volume import load_volume
from wlm.formats.artifact import read_artifact
from wlm.formats.exr import read_exr, write_exr
from wlm.formats.folder import read_index, staged, write_index
from wlm.formats.gltf import read_gltf
from wlm.formats.godot import read_lmbake
from wlm.formats.light import read_light
from wlm.formats.mask import read_mask
from wlm.formats.meshes import read_mesh
from wlm.formats.reading import named_file, read_file
from wlm.lightmap import reading
from wlm.lightmap.model import Profile
from wlm.probe import load as load_probes
from wlm.probe import load_positions
from wlm.smoke.flipbook.reading import read_flipbook
from wlm.smoke.scene import load_scene

FILES = Path(__file__).resolve().parents[1] / "files" / "hostile"
CORPUS = Path(__file__).resolve().parents[1] / "fuzz" / "corpus"
MOST = 400 << 20  # bytes that a refusal may take at its height
TRIANGLE = struct.pack("<15f", 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1)  # positions, then UVs
PNG = b"\x89PNG\r\n\x1a\n" + b"secret" * 20


@contextmanager
def little_memory():
    """Checks what a block takes at its height; it slows Python down."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < MOST
    finally:
        tracemalloc.stop()


def refused(function, *args, **options) -> str:
    """The one line that a call ends in."""
    with pytest.raises(WlmError) as error:
        function(*args, **options)
    text = str(error.value)
    assert text and "\n" not in text and text.isprintable()
    return text


def write(path: Path, content: object) -> Path:
    """Writes bytes, text, or anything else as JSON."""
    content = content if isinstance(content, bytes | str) else json.dumps(content)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize(
    ("read", "suffix"),
    [
        (lambda path: load_settings(Profile, path), ".yaml"),
        (read_artifact, ".wlm"),
        (read_exr, ".exr"),
        (read_gltf, ".gltf"),
        (read_mesh, ".obj"),
        (read_lmbake, ".lmbake"),
        (read_runs, ".json"),
        (load_probes, ".json"),
        (load_probes, ".npz"),
        (load_positions, ".npz"),
        (load_positions, ".json"),
        (load_volume, ".npz"),
        (load_volume, ".nvdb"),
        (load_volume, ".vdb"),
        (read_light, ".hdr"),
        (read_light, ".ktx2"),
        (read_light, ".dds"),
        (lambda path: read_flipbook((path, path), "unity", rows=2, columns=2), ".tga"),
        (lambda path: read_mask(path, "a.exr", (4, 4)), ".png"),
    ],
)
def test_pipes_devices_folders_and_impossible_names(tmp_path, read, suffix):
    places = [tmp_path / f"{name}{suffix}" for name in ("pipe", "zero", "folder", "absent", "\ud800", "\0")]
    os.mkfifo(places[0])
    places[1].symlink_to("/dev/zero")
    places[2].mkdir()
    for path in places:
        assert "cannot read" in refused(read, path)


def test_an_index_that_is_no_file_is_none(tmp_path):
    os.mkfifo(tmp_path / "index.json")
    assert read_index(tmp_path / "index.json") == {}


def test_a_file_above_its_limit_is_not_read(tmp_path):
    path = write(tmp_path / "a", b"12345")
    assert read_file(path, 5, "it") == b"12345" and read_file(path, 5, "it", first=2) == b"12"
    assert "expected at most 4 bytes, found 5" in refused(read_file, path, 4, "it")
    assert "expected 6 bytes, found 5" in refused(read_file, path, 9, "it", first=6)
    with open(tmp_path / "sparse.obj", "wb") as file:
        file.truncate(1 << 40)
    assert "expected at most" in refused(read_mesh, tmp_path / "sparse.obj")


def test_a_name_stays_in_its_folder(tmp_path):
    folder, outside = tmp_path / "in", write(tmp_path / "out.bin", b"x")
    (folder / "deeper").mkdir(parents=True)
    (folder / "link.bin").symlink_to(outside)
    (folder / "circle").symlink_to(folder / "circle")
    write(folder / "deeper" / "a.bin", b"x")
    (folder / "inner.bin").symlink_to(folder / "deeper" / "a.bin")
    document = folder / "set.json"
    for name in ("deeper/a.bin", "deeper/../inner.bin", "absent.bin"):
        assert named_file(document, name, "here") == folder / name
    for name in ("../out.bin", str(outside), "link.bin", "..", "deeper/../../out.bin"):
        assert "expected a file within" in refused(named_file, document, name, "here")
        assert named_file(document, name, "here", trust=True) == folder / name
    # The folder itself may be reached by a link.
    (tmp_path / "way").symlink_to(folder)
    assert named_file(tmp_path / "way" / "set.json", "deeper/a.bin", "here").is_file()


# YAML.

LETTERS = "abcdefghi"
BOMB = "".join(f"- &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in itertools.pairwise(LETTERS))
MERGES = "".join(f"{b}: &{b} {{<<: [{','.join([f'*{a}'] * 9)}]}}\n" for a, b in itertools.pairwise(LETTERS))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("- &a [x,x,x,x,x,x,x,x,x]\n" + BOMB, "found the anchor or alias 'a' (line 1, column 3)"),
        ("a: &a {k: 1}\n" + MERGES, "found the anchor or alias 'a'"),
        ("&a [*a]\n", "found the anchor or alias 'a'"),
        ("name: x\n<<: {steps: 1}\n", "expected keys of settings, found '<<'"),
        ("!!timestamp x\n", "expected YAML"),
        ("name: x\nsteps: 0x" + "f" * 5000, "expected an integer within 64 bits"),
        ("name: x\nsteps: " + "9" * 5000, "expected an integer within 64 bits"),
        ("name: x\nsteps: " + "1" + ":59" * 3000, "expected an integer within 64 bits"),
        (f"name: {2**63 - 1}", "name: expected a valid string, got 9223372036854775807"),
        ("[" * 20_000, "expected values at most 50 deep in others (line 1, column 52)"),
        ("- " * 20_000, "expected values at most 50 deep"),
        ("name: " + "[" * 40 + "]" * 40, "name: expected a valid string, got [[[[...]]]]"),
        ("name: [" + "x, " * 5_000 + "x]", "name: expected a valid string, got ['x', 'x', "),
        ("#" * (64 << 10) + "\n", "expected at most 65536 bytes"),
        ('name: x\n"\\e[31mX": 1\n', "unknown key '\\x1b[31mX'"),
    ],
)
def test_yaml(tmp_path, text, expected):
    assert expected in refused(load_settings, Profile, write(tmp_path / "a.yaml", text))


def test_an_honest_yaml_integer_of_any_notation(tmp_path):
    for text, steps in (("0x1F4", 500), ("0b111110100", 500), ("5_00", 500), ("8:20", 500)):
        assert load_settings(Profile, write(tmp_path / "a.yaml", f"name: x\nsteps: {text}\n")).steps == steps


SCENE = """
name: tiny
grid: {cells: [12, 12, 12], cell: CELL}
air: {lattice_speed: SPEED}
inlets: [{face: "-y", velocity: [0.0, VELOCITY, 0.0]}]
rate: RATE
"""


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"VELOCITY": "1.0e+12"}, "expected at most 1,000,000 steps per frame, found 5e+12, for a speed of 1e+12 m/s"),
        ({"CELL": "1.0e-300"}, "grid.cell: expected greater than or equal to 0.000000001"),
        ({"RATE": "1.0e-9"}, "rate: expected greater than or equal to 0.000001"),
        ({"SPEED": "1.0e-300"}, "expected at most 1,000,000 steps per frame"),
    ],
)
def test_scenes(tmp_path, changes, expected):
    text = SCENE
    for name, value in ({"CELL": "0.08", "SPEED": "0.1", "VELOCITY": "1.0", "RATE": "25.0"} | changes).items():
        text = text.replace(name, value)
    assert expected in refused(load_scene, write(tmp_path / "a.yaml", text))


def tree(**changes: object) -> dict:
    """Makes a triangle with UVs in a data URI, with changes to the lists of the document."""
    uri = "data:;base64," + base64.b64encode(TRIANGLE).decode()
    return {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 24}],
        "buffers": [{"byteLength": 60, "uri": uri}],
    } | changes


def accessor(count: int, **more: object) -> dict:
    return {"componentType": 5126, "count": count, "type": "VEC3", **more}


BARE = [{"primitives": [{"attributes": {"POSITION": 0}}]}]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"meshes": BARE, "accessors": [accessor(3 * 10**8)]}, "at most 4194304 drawn corners"),
        ({"meshes": BARE, "accessors": [accessor(3 * 10**5)], "nodes": [{"mesh": 0}] * 1000}, "4194304 drawn corners"),
        ({"meshes": [{"primitives": BARE[0]["primitives"] * 500}], "nodes": [{"mesh": 0}] * 500}, "4194304 drawn corn"),
        # A stride of nothing, one that isn't of fours, one beyond 252, and one shorter than an element.
        *(
            ({"bufferViews": [{"buffer": 0, "byteLength": 60, "byteStride": stride}] * 2}, "byteStride")
            for stride in (0, -4, 14, 256, 8)
        ),
        ({"buffers": [{"byteLength": 60, "uri": "../out.bin"}]}, "buffers[0].uri: expected a file within"),
        ({"buffers": [{"byteLength": 60, "uri": "%2e%2e/out.bin"}]}, "buffers[0].uri: expected a file within"),
        ({"buffers": [{"byteLength": 60, "uri": "link.bin"}]}, "buffers[0].uri: expected a file within"),
        ({"buffers": [{"byteLength": 60, "uri": "../" * 9 + "dev/zero"}]}, "buffers[0].uri: expected a file within"),
        ({"buffers": [{"byteLength": 60, "uri": "pipe"}]}, "expected a file, found a folder, a device or a pipe"),
        ({"buffers": [{"byteLength": 61, "uri": "in.bin"}]}, "expected 61 bytes, found 60"),
        (
            {"buffers": [{"byteLength": 60, "uri": f"{'./' * i}in.bin"} for i in range(99)]},
            "expected another file, since buffers[0] already names",
        ),
        ({"buffers": [{"byteLength": 60, "uri": "\ud800"}]}, "a.gltf: "),
        (
            {
                "accessors": [
                    accessor(
                        3,
                        bufferView=0,
                        sparse={"count": 1, "indices": {"bufferView": 1, "componentType": 5120}, "values": {}},
                    ),
                    tree()["accessors"][1],
                ]
            },
            "accessors[0].sparse.indices: expected unsigned integers, found int8",
        ),
    ],
)
def test_gltf(tmp_path, changes, expected):
    folder = tmp_path / "in"
    folder.mkdir()
    os.mkfifo(folder / "pipe")
    write(folder / "in.bin", TRIANGLE)
    (folder / "link.bin").symlink_to(write(tmp_path / "out.bin", TRIANGLE))
    # Thousands of small primitives take long to be traced.
    with little_memory() if "accessors" in changes else nullcontext():
        assert expected in refused(read_gltf, write(folder / "a.gltf", tree(**changes)))


def test_a_trusted_gltf_names_any_file(tmp_path):
    write(tmp_path / "out.bin", TRIANGLE + b"more than it needs")
    (tmp_path / "in").mkdir()
    path = write(tmp_path / "in" / "a.gltf", tree(buffers=[{"byteLength": 60, "uri": "../out.bin"}]))
    document, primitives = read_gltf(path, trust=True)
    assert document.buffers == (TRIANGLE,) and len(primitives) == 1


def test_an_accessor_that_is_not_drawn_is_bounded_where_it_is_copied(tmp_path):
    attributes = {"POSITION": 0, "TEXCOORD_0": 1, "NORMAL": 2}
    accessors = [*tree()["accessors"], accessor(3 * 10**8)]
    path = write(tmp_path / "a.gltf", tree(meshes=[{"primitives": [{"attributes": attributes}]}], accessors=accessors))
    write_exr(tmp_path / "a.exr", np.ones((8, 8, 3), np.float32))
    mesh = atlas.load(path, tmp_path / "a.exr")
    expected = "accessors[2]: count: expected at most 4194304 without a bufferView"
    assert expected in refused(with_uvs, mesh, mesh.sheets[0].uv[mesh.sheets[0].triangle])


def test_normals_without_data_are_bounded_together(tmp_path):
    """Each mesh has normals of its own, of 4 million zeros, to the positions that all share."""
    meshes = [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 2 + i}}]} for i in range(3)]
    accessors = [*tree()["accessors"][:2], *([accessor(2**22)] * 3)]
    nodes = [{"mesh": i} for i in range(3)]
    changes = {"meshes": meshes, "nodes": nodes, "accessors": accessors, "scenes": [{"nodes": [0, 1, 2]}], "scene": 0}
    expected = "expected at most 4194304 stored normals for the size of the file"
    assert expected in refused(lambda path: read_geometry(path, None), write(tmp_path / "a.gltf", tree(**changes)))


@pytest.mark.parametrize("trust", [False, True])
def test_images_outside_the_folder_and_what_is_no_image_are_not_copied(tmp_path, trust):
    (tmp_path / "in").mkdir()
    write(tmp_path / "secret.png", PNG)
    write(tmp_path / "in" / "inside.png", PNG.replace(b"secret", b"public"))
    write(tmp_path / "in" / "passwords.png", b"root:x:0:0" * 9)
    names = ["../secret.png", "inside.png", "passwords.png", "\ud800.png"]
    path = write(tmp_path / "in" / "a.gltf", tree(images=[{"uri": name} for name in names], extras="\udfff"))
    write_exr(tmp_path / "a.exr", np.ones((8, 8, 3), np.float32))
    mesh = atlas.load(path, tmp_path / "a.exr", trust=trust)
    (tmp_path / "out.glb").write_bytes(with_uvs(mesh, mesh.sheets[0].uv[mesh.sheets[0].triangle])[0])
    content = (tmp_path / "out.glb").read_bytes()
    assert (b"secretsecret" in content) == trust and b"publicpublic" in content and b"root:x" not in content
    # Half characters come back as they were.
    again = read_gltf(tmp_path / "out.glb")[0].content
    assert again["extras"] == "\udfff" and again["images"][3] == {"uri": "\ud800.png"}


def lightmap_set(folder: Path, entries: list | None = None, **changes: object) -> Path:
    folder.mkdir(exist_ok=True)
    write_exr(folder / "a.exr", np.ones((256, 128, 3), np.float32))
    entries = [{"time_hours": 0, "file": "a.exr"}] if entries is None else entries
    return write(folder / "set.json", {"width": 128, "height": 256, "lightmaps": entries} | changes)


def test_a_set_that_lists_one_file_without_end(tmp_path):
    entries = [{"time_hours": i / 6000, "file": "a.exr"} for i in range(100_001)]
    assert "expected at most 100000 entries, found 100001" in refused(lightmap.load, lightmap_set(tmp_path, entries))
    # 1.2 GB of frames.
    with little_memory():
        assert "expected at most 2048 times its" in refused(lightmap.load, lightmap_set(tmp_path, entries[:3000]))


def test_equal_times_are_found_before_the_files_are_read(tmp_path):
    entries = [{"time_hours": i % 9, "file": f"absent_{i}.exr"} for i in range(10)]
    assert "absent_0.exr and absent_9.exr have the same time" in refused(lightmap.load, lightmap_set(tmp_path, entries))


def test_a_set_names_files_of_its_folder(tmp_path):
    Image.fromarray(np.full((256, 128), 255, np.uint8)).save(tmp_path / "mask.png")
    write_exr(tmp_path / "b.exr", np.ones((256, 128, 3), np.float32))
    for changes in (
        {"entries": [{"time_hours": 0, "file": "../b.exr"}]},
        {"entries": [{"time_hours": 0, "file": str(tmp_path / "b.exr")}]},
        {"mask": "../mask.png"},
        {"mask": str(tmp_path / "mask.png")},
    ):
        path = lightmap_set(tmp_path / "set", **changes)
        assert "expected a file within" in refused(lightmap.load, path)
        assert lightmap.load(path, trust=True).light.mask.all()


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"mask": "x" * 5000}, "mask: expected a name of at most 1024 characters, found 5000"),
        ({"mask": "\ud800"}, "cannot read the mask"),
        ({"entries": [{"time_hours": 0, "file": "\ud800"}]}, "cannot read the lightmap: the name has"),
        (
            {"entries": [{"time_hours": 0, "file": "set.json"}]},
            "expected a lightmap, EXR, Radiance (.hdr), PFM, TIFF of floats, KTX2 or DDS, found other",
        ),
    ],
)
def test_set_fields(tmp_path, changes, expected):
    assert expected in refused(lightmap.load, lightmap_set(tmp_path, **changes))


@pytest.mark.parametrize("kind", ["BMP", "TIFF", "GIF", "JPEG", "TGA", "PPM", "DDS", "EPS"])
def test_a_mask_is_a_png_whatever_else_its_name_hides(tmp_path, kind):
    Image.fromarray(np.full((4, 4), 255, np.uint8)).convert("RGB").save(tmp_path / "a.png", format=kind)
    assert "cannot read the mask: expected a PNG" in refused(read_mask, tmp_path / "a.png", "a.exr", (4, 4))


def test_pictures_that_claim_more_than_they_hold(tmp_path):
    assert "at most 268435456 texels" in refused(read_exr, FILES / "b44-wide.exr")
    write_exr(tmp_path / "a.exr", np.ones((4, 4, 3), np.float32))
    content = (tmp_path / "a.exr").read_bytes()
    at = content.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    for width, height, expected in (
        (16384, 16384, "expected at most 2048 times its"),
        (70_000, 4, "65536 along a side"),
        # These the library refuses itself.
        (16385, 16384, ""),
        (2**31 - 1, 2**31 - 1, ""),
        (0, 0, ""),
    ):
        window = struct.pack("<4i", 0, 0, width - 1, height - 1)
        write(tmp_path / "b.exr", content[:at] + window + content[at + 16 :])
        with little_memory():
            assert expected in refused(read_exr, tmp_path / "b.exr")


def test_textures_that_claim_more_than_they_hold(tmp_path):
    """The stated size, the unpacked texels or the file itself would take far more memory than there is."""

    def sparse(head: bytes, size: int = 1 << 40) -> Path:
        path = write(tmp_path / "a", bytes(head))
        os.truncate(path, size)
        return path

    def ktx2(side: int, texels: bytes, stored: int | None = None) -> Path:
        content = bytearray((CORPUS / "packed-zstd.ktx2").read_bytes())
        packed = imagecodecs.zstd_encode(texels)
        struct.pack_into("<2I", content, 20, side, side)
        struct.pack_into("<3Q", content, 80, len(content), stored or len(packed), 4 * side * side)
        return sparse(content + packed, len(content) + (stored or len(packed)))

    dds = bytearray((CORPUS / "shared.dds").read_bytes())
    struct.pack_into("<2I", dds, 12, 1 << 16, 1 << 16)
    wide = b"#?RADIANCE\n\n-Y 16384 +X 16384\n" + b"abcd\1\1\1\x7f\1\1\1\x7f" * 16384
    for make in (
        lambda: ktx2(16384, b"\0" * 16),
        lambda: ktx2(64, bytes(64 << 20)),
        lambda: ktx2(4096, b"", 1 << 40),
        lambda: write(tmp_path / "a", wide),
        lambda: sparse(b"#?RADIANCE\n"),
        lambda: sparse(dds),
    ):
        path = make()
        with little_memory():
            assert refused(read_light, path).startswith(f"{path}: ")


def test_alpha_that_is_no_number_is_told_and_not_valid(tmp_path):
    pixels = np.ones((256, 128, 4), np.float32)
    pixels[0, :2, 3], pixels[1, 0, 3] = np.inf, np.nan
    path = lightmap_set(tmp_path, mask="alpha")
    write_exr(tmp_path / "a.exr", pixels, half=False)
    loaded = lightmap.load(path)
    assert np.argwhere(~loaded.light.mask).tolist() == [[0, 0], [0, 1], [1, 0]]
    assert loaded.warnings == ("a.exr: 3 texels are not valid: alpha is NaN or infinite",)


def test_what_a_terminal_obeys_is_escaped(capsys):
    text = "\x1b]0;title\x07\x1b[2J \x9b31m \x7f \u202egnp.exe \u2066 \ud800 é 漢"
    shown = "\\x1b]0;title\\x07\\x1b[2J \\x9b31m \\x7f \\u202egnp.exe \\u2066 \\ud800 é 漢"
    assert printable(text) == shown and str(WlmError(text)) == shown
    rows = table(text, ["name"])
    rows.add_row(escape(text))
    show(rows)
    show_text(f"{text}\nsecond")
    note(text)
    out, err = capsys.readouterr()
    assert out.count(shown) == 3 and out.endswith("\nsecond\n") and err == f"{shown}\n"


def test_a_link_planted_in_an_export_is_replaced_and_not_followed(tmp_path):
    folder, victim = tmp_path / "out", write(tmp_path / "victim", b"precious")
    for _ in range(2):
        with staged(folder, "index.json", "test") as temporary:
            write(temporary / "tile.dds", b"texels")
            write_index(temporary / "index.json", {"format": "test"})
        assert victim.read_bytes() == b"precious"
        assert (folder / "tile.dds").read_bytes() == b"texels" and not (folder / "tile.dds").is_symlink()
        (folder / "tile.dds").unlink()
        (folder / "tile.dds").symlink_to(victim)
    with staged(folder, "index.json", "test") as temporary:
        write_index(temporary / "index.json", {"format": "test"})
    assert sorted(path.name for path in folder.iterdir()) == ["index.json"] and victim.read_bytes() == b"precious"


def test_a_grid_whose_box_is_far_larger_than_what_it_stores(tmp_path):
    path = write(tmp_path / "a.nvdb", gzip.decompress((FILES / "bbox-700.nvdb.gz").read_bytes()))
    with little_memory():
        message = refused(load_volume, path)
    assert "expected a box of at most 20623360 voxels, found [[0, 0, 0], [699, 699, 699]]" in message


def test_a_compressed_grid_that_unpacks_to_far_more(tmp_path):
    packed = zlib.compress(bytes(1 << 20))
    body = struct.pack("<Q", len(packed)) + packed
    header = struct.pack("<QIHH", 0x304244566F6E614E, 32 << 21, 1, 1)
    grid = bytearray(176)
    struct.pack_into("<2Q", grid, 0, 200 << 20, 200 * len(body))
    struct.pack_into("<I", grid, 32, 1)  # a grid of floats
    struct.pack_into("<I", grid, 136, 1)  # of the name, which is empty
    path = write(tmp_path / "a.nvdb", header + grid + b"\0" + 200 * body)
    with little_memory():
        assert "expected at most 256 times its" in refused(load_volume, path)


def test_alpha_that_differs_by_time_is_filled_in_linear_time(tmp_path):
    """Two files serve 4,000 times, and each is read once."""
    for name, alpha in (("a.exr", [[0.0, 1.0]]), ("b.exr", [[1.0, 0.0]])):
        write_exr(tmp_path / name, np.dstack([np.full((1, 2, 3), 0.5), alpha]))
    entries = [{"time_hours": i / 1000, "file": "ab"[i > 1000] + ".exr"} for i in range(4000)]
    write(tmp_path / "set.json", {"width": 2, "height": 1, "mask": "alpha", "lightmaps": entries})
    with Limits().held():
        frames = lightmap.load(tmp_path).light
    assert (frames.frames == 0.5).all() and frames.covered.sum() == 4000


def test_slices_of_one_file_are_decoded_once(tmp_path, monkeypatch):
    write_exr(tmp_path / "a.exr", np.arange(24, dtype=np.float32).reshape(8, 1, 3))
    slices = [{"file": "a.exr", "slice": i, "slices": 8} for i in range(8)]
    layers = {"light": "radiance", "more": "unit"}
    lightmaps = [{"time_hours": i, "files": {"0": dict.fromkeys(layers, each)}} for i, each in enumerate(slices)]
    content = {"layers": layers, "atlases": {"0": {"mask": "all"}}, "lightmaps": lightmaps}
    write(tmp_path / "set.json", content)
    frames = lightmap.load(tmp_path).light.frames
    np.testing.assert_array_equal(frames.reshape(8, 3), np.arange(24).reshape(8, 3))
    # All layers together may decode so many bytes: the light fits, the other layer does not.
    monkeypatch.setattr(reading, "FRAMES", frames.nbytes)
    monkeypatch.setattr(reading, "PICTURE_GROWTH", 0)
    assert "decoded bytes for the size of the file" in refused(lightmap.load, tmp_path)
    assert lightmap.load(tmp_path, layers=["light"]).times.size == 8


# JSON and YAML, before their values take memory.


@pytest.mark.parametrize("text", ["[" + "{}," * 1_200_000 + "{}]", "[" + "[]," * 3_100_000 + "[]]"])
def test_json_whose_values_take_far_more_than_its_text(tmp_path, text):
    with little_memory():
        line = refused(load_probes, write(tmp_path / "a.json", text))
    assert line.endswith("bytes of values in JSON for the size of the file, found more")


@pytest.mark.parametrize("number", ["1" + "0" * 400, str(2**64), str(-(2**63) - 1)])
def test_integers_of_json_fit_arrays(tmp_path, number):
    text = f'{{"lightmaps": [{{"time_hours": {number}, "file": "a.exr"}}]}}'
    for read in (lightmap.load, load_probes, read_gltf, read_runs):
        assert "expected integers within 64 bits" in refused(read, write(tmp_path / "set.json", text))
