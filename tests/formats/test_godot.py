"""Godot's lightmap bakes, and what is wrong with damaged ones."""

import struct
import tracemalloc

import numpy as np
import pytest
from builders.checks import error_of
from builders.godot_bakes import Writer, bake, colours, probes, with_users

from wlm.atlas.listing import read_listing
from wlm.formats.exr import write_exr
from wlm.formats.godot import read_lmbake, read_users
from wlm.inspection import inspect


def message(tmp_path, data, name="a.lmbake"):
    """The error of reading these bytes; it names the file and is one line."""
    path = tmp_path / name
    path.write_bytes(data)
    text = error_of(read_lmbake, path)
    assert text.startswith(f"{path}: ")
    return text


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize(
    "options",
    [{}, {"version": (4, 0, 4), "flags": 1}, {"version": (4, 2, 5), "script": "Baked"}, {"inner": ("one", "two")}],
)
def test_probes_are_found_among_everything_else(tmp_path, order, double, options):
    writer = Writer(order, double)
    points, sh = probes()
    path = tmp_path / "a.lmbake"
    path.write_bytes(writer.file(bake(writer, points, sh), **options))
    position, found = read_lmbake(str(path))
    assert position.dtype == np.float64 and found.dtype == np.float32 and found.flags.c_contiguous
    np.testing.assert_array_equal(position, points if double else points.astype(np.float32))
    np.testing.assert_array_equal(found, sh)


@pytest.mark.parametrize(("order", "double"), [("<", False), (">", True)])
def test_who_reads_which_part_of_the_lightmap(tmp_path, order, double):
    writer, path = Writer(order, double), tmp_path / "bake.lmbake"
    users = [(["..", "House", "Wall"], (0.5, 0.25, 0.125, 0.375), 0), (["Floor"], (0.0, 0.0, 0.5, 0.25), 0)]
    points, sh = probes()
    light = np.abs(sh) * 0.01
    light[:, 0] += 1.0
    path.write_bytes(writer.file(with_users(writer, points, light, users)))
    found = read_users(path)
    assert found.textures == ("res://bake.exr",) and not found.directional
    assert [(user.node, user.rectangle, user.slice) for user in found.users] == [
        ("../House/Wall", (0.5, 0.25, 0.125, 0.375), 0),
        ("Floor", (0.0, 0.0, 0.5, 0.25), 0),
    ]
    scene = read_listing(path)
    assert [each.files for each in scene.sheets] == [["bake.exr"]]
    placed = {each.node: each.scale_offset for each in scene.objects}
    assert placed == {"Wall": [0.125, 0.375, 0.5, 0.25], "Floor": [0.5, 0.25, 0.0, 0.0]}
    write_exr(tmp_path / "bake.exr", np.ones((8, 8, 3), np.float32))
    (found,) = inspect(tmp_path)
    assert "2 meshes with rectangles in bake.exr" in found.what and not found.problems
    users[1] = (["Floor"], (0.0, 0.0, 0.5, 0.25), 1)
    for options in ({"slices": False}, {"slices": True}):
        path.write_bytes(writer.file(with_users(writer, points, sh, users, **options)))
        assert "one texture of one slice without directions" in error_of(read_listing, path)
    # What stands in their place is refused, and the probes are read all the same.
    path.write_bytes(writer.file(bake(writer, points, sh)))
    assert "user_data" in error_of(read_users, path) and len(read_lmbake(path)[0]) == 5
    assert "user_data" in inspect(path)[0].problems[-1]


def test_one_probe_and_keys_that_are_string_names_or_no_text(tmp_path):
    writer = Writer()
    points, sh = probes(1)
    entries = [writer.u32(3, 1) + writer.u32(1), writer.string("sh", 44) + writer.colours(colours(sh))]
    entries.append(writer.string("points", 44) + writer.vectors(points))
    data = writer.u32(26, len(entries)) + b"".join(entries)
    (tmp_path / "a.lmbake").write_bytes(writer.file([("probe_data", data)]))
    position, found = read_lmbake(tmp_path / "a.lmbake")
    assert position.shape == (1, 3)
    np.testing.assert_array_equal(found, sh)


def compress(data, block=4096, mode=2):
    """Godot's compressed file: the resource without its magic, in Zstandard blocks, the last maybe empty."""
    codecs = pytest.importorskip("imagecodecs")
    data = data[4:]
    pieces = [codecs.zstd_encode(data[i : i + block]) for i in range(0, len(data) + 1, block)]
    assert len(pieces) == len(data) // block + 1
    sizes = struct.pack(f"<{len(pieces)}I", *map(len, pieces))
    return b"RSCC" + struct.pack("<3I", mode, block, len(data)) + sizes + b"".join(pieces) + b"RSCC"


def compressible(points, sh):
    """A file whose offsets count from behind the magic, as those of a compressed one do."""
    writer = Writer()
    return b"RSRC" + writer.file(bake(writer, points, sh), magic=b"")


@pytest.mark.parametrize("block", [4096, 1000, 1 << 20, None])
def test_compressed(tmp_path, block):
    points, sh = probes(300)
    data = compressible(points, sh)
    (tmp_path / "a.lmbake").write_bytes(compress(data, block or len(data) - 4))
    position, found = read_lmbake(tmp_path / "a.lmbake")
    np.testing.assert_array_equal(position, points.astype(np.float32))
    np.testing.assert_array_equal(found, sh)


def test_damaged_compressed_files(tmp_path):
    data = compress(compressible(*probes(300)))
    assert "found 0; save it without" in message(tmp_path, compress(compressible(*probes()), mode=0))
    for size in (0, (1 << 20) + 1, 0xFFFFFFFF):
        damaged = data[:8] + struct.pack("<I", size) + data[12:]
        assert f"expected blocks of 1 to 1048576 bytes, found {size}" in message(tmp_path, damaged)
    # Far more blocks than the file has bytes for, then one block of another length, then other bytes in it.
    assert "cut short or damaged" in message(tmp_path, data[:12] + b"\xff" * 4 + data[16:])
    total = struct.unpack_from("<I", data, 12)[0]
    shorter = data[:12] + struct.pack("<I", total - 1) + data[16:]
    assert "compressed block" in message(tmp_path, shorter)
    longer = data[:12] + struct.pack("<I", total + 1) + data[16:]
    assert "compressed block" in message(tmp_path, longer)
    first = 16 + 4 * (total // 4096 + 1)
    assert "compressed block 0: " in message(tmp_path, data[:first] + b"\0" * 8 + data[first + 8 :])


def test_what_is_no_lightmap_bake_of_godot_4(tmp_path):
    writer = Writer()
    properties = bake(writer, *probes())
    assert "expected a Godot binary resource (RSRC or RSCC), found b'[gd_'" in message(tmp_path, b'[gd_resource type="')
    assert "expected a resource of the type LightmapGIData, found 'Mesh'" in message(
        tmp_path, writer.file(properties, kind="Mesh")
    )
    for version in ((3, 5, 3), (4, 9, 7), (5, 0, 6), (4, 0, 3)):
        found = message(tmp_path, writer.file(properties, version=version))
        assert f"format 4 to 6, found Godot {version[0]}.{version[1]}, format {version[2]}" in found
    data = writer.file(properties)
    assert "byte order" in message(tmp_path, data[:4] + b"\2" + data[5:])


def test_bakes_without_probes_or_with_too_few_colours(tmp_path):
    writer = Writer()
    points, sh = probes()
    none = "probe_data has no probes: bake with LightmapProbe nodes"
    assert none in message(tmp_path, writer.file([("x", writer.u32(1))]))
    assert none in message(tmp_path, writer.file(bake(writer, points[:0], sh[:0])))
    assert "9 colours for each of 5 points, found 36" in message(tmp_path, writer.file(bake(writer, points, sh[:4])))
    assert "probe_data: expected a dictionary" in message(tmp_path, writer.file([("probe_data", writer.u32(1))]))


def test_a_file_cut_short_anywhere_is_one_line(tmp_path):
    writer = Writer()
    data = writer.file(bake(writer, *probes(2)))
    # A step that is odd comes by every place in a number. The magic at the end is not needed.
    for end in range(4, len(data) - 4, 11):
        assert "cut short or damaged" in message(tmp_path, data[:end])


def test_lengths_are_not_believed(tmp_path):
    writer = Writer()
    points, sh = probes(2)
    data = writer.file(bake(writer, points, sh))
    tracemalloc.start()
    try:
        for packed in (writer.vectors(points), writer.colours(colours(sh)), writer.u32(32, 4, 0, 1, 2, 3)):
            at = data.index(packed) + 4
            assert "cut short or damaged" in message(tmp_path, data[:at] + b"\xff" * 4 + data[at + 4 :])
        # Names, and entries of containers.
        at = data.index(writer.text("uses_spherical_harmonics")) - 4
        assert "cut short or damaged" in message(tmp_path, data[:at] + b"\xff" * 4 + data[at + 4 :])
        endless = writer.file([("x", writer.u32(30, 0x7FFFFFFF) + writer.u32(1) * 50)])
        assert "expected a value of a known type" in message(tmp_path, endless)
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()


def test_other_damage_has_its_own_line(tmp_path):
    writer = Writer()
    deep = writer.u32(30, 1) * 500 + writer.u32(1)
    assert "more than 32 deep" in message(tmp_path, writer.file([("x", deep)]))
    assert "expected a value of a known type, found type 99" in message(tmp_path, writer.file([("x", writer.u32(99))]))
    assert "expected a reference of kind 0 to 3, found 4" in message(tmp_path, writer.file([("x", writer.u32(24, 4))]))
    data = writer.file([("x", writer.u32(3, 1234))])
    at = data.index(writer.u32(3, 1234)) - 4
    assert "an index of a name below 3, found 3" in message(tmp_path, data[:at] + writer.u32(3) + data[at + 4 :])
    table = data.index(b"local://0\0") + len(b"local://0\0")
    assert "cut short or damaged" in message(tmp_path, data[:table] + b"\xff" * 8 + data[table + 8 :])
    at = data.index(writer.u32(1) + writer.text("local://0"))
    assert "no resource: expected at least one" in message(tmp_path, data[:at] + writer.u32(0) + data[at + 4 :])


def test_a_long_name_counts_at_each_use(tmp_path):
    """A path of 65,535 names of 2 MB each: 131 GB from a kilobyte."""
    writer = Writer()
    path = writer.u32(22) + writer.numbers("H", 65_535, 0) + writer.u32(0) * 65_535
    user = [path, writer.u32(11) + writer.reals(0, 0, 1, 1), writer.u32(3, 0), writer.u32(3, -1 & 0xFFFFFFFF)]
    content = writer.file([("user_data", writer.array(*user))], magic=b"")
    name = writer.text("uses_spherical_harmonics")
    long = writer.text("n" * (2 << 20))
    at = content.index(name)
    # The main resource starts that much later.
    place = struct.unpack_from("<Q", content, content.index(b"local://0\0") + 10)[0]
    moved = content.replace(struct.pack("<Q", place), struct.pack("<Q", place + len(long) - len(name)), 1)
    data = compress(b"RSRC" + moved[:at] + long + moved[at + len(name) :], 1 << 20)
    (tmp_path / "a.lmbake").write_bytes(data)
    assert len(data) < 10_000
    tracemalloc.start()
    assert "bytes of names and values for the size of the file" in error_of(read_users, tmp_path / "a.lmbake")
    assert tracemalloc.get_traced_memory()[1] < 100 << 20
    tracemalloc.stop()


@pytest.mark.parametrize("value", [b"\1\0\0\0", b"\x05\0\0\0\1\0\0\0\0"])
def test_many_small_values_in_few_bytes(tmp_path, value, monkeypatch):
    """4 MB of nothing, in blocks that are packed together."""
    monkeypatch.setattr("wlm.formats.godot._SURE", 2 << 20)
    writer = Writer()
    many = 250_000
    content = writer.file([("x", writer.u32(30, many) + value * many)], magic=b"")
    (tmp_path / "a.lmbake").write_bytes(compress(b"RSRC" + content, 1 << 20))
    assert "bytes of names and values for the size of the file" in error_of(read_lmbake, tmp_path / "a.lmbake")
