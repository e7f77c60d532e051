"""Godot's lightmap bakes, written here by a little writer of their container, and what is wrong with damaged ones."""

import struct
import sys
import tracemalloc

import numpy as np
import pytest
from builders.checks import error_of

from wlm.errors import WlmError
from wlm.formats.godot import read_lmbake

MAIN = "LightmapGIData"


class Writer:
    """Values of Godot's binary resources, as the engine stores them."""

    def __init__(self, order="<", double=False):
        self.order, self.real = order, "d" if double else "f"

    def numbers(self, kind, *values):
        return struct.pack(f"{self.order}{len(values)}{kind}", *values)

    def u32(self, *values):
        return self.numbers("I", *values)

    def reals(self, *values):
        return self.numbers(self.real, *values)

    def text(self, text, mark=0):
        data = text.encode() + b"\0"
        return self.u32(len(data) | mark) + data

    def string(self, text, kind=5):
        return self.u32(kind) + self.text(text)

    def vectors(self, points):
        points = np.asarray(points)
        return self.u32(35, len(points)) + points.astype(f"{self.order}f{8 if self.real == 'd' else 4}").tobytes()

    def colours(self, colours):
        return self.u32(36, len(colours)) + np.asarray(colours).astype(f"{self.order}f4").tobytes()

    def dictionary(self, **entries):
        shared = 0x80000000
        return self.u32(26, len(entries) | shared) + b"".join(self.string(k) + v for k, v in entries.items())

    def array(self, *values):
        return self.u32(30, len(values)) + b"".join(values)

    def of_every_kind(self):
        """One value of each type that there is, containers last."""
        plain = [
            self.u32(1),
            self.u32(2, 1),
            self.u32(3, 7),
            self.u32(4) + self.reals(1.5),
            self.string("é"),
            *(self.u32(kind) + self.reals(*range(n)) for kind, n in ((10, 2), (11, 4), (12, 3), (13, 4), (14, 4))),
            *(self.u32(kind) + self.reals(*range(n)) for kind, n in ((15, 6), (16, 9), (17, 12), (18, 6))),
            self.u32(20) + self.numbers("f", 1, 2, 3, 4),
            self.u32(22) + self.numbers("H", 2, 0x8001) + self.u32(0) + self.text("child", 0x80000000) + self.u32(1),
            self.u32(23, 5),
            self.u32(24, 0),
            self.u32(24, 1) + self.text("Texture2D") + self.text("res://old.png"),
            self.u32(24, 2, 0),
            self.u32(24, 3, 0),
            *(self.u32(31, n) + bytes(range(n)) + b"\xff" * (-n % 4) for n in range(6)),
            self.u32(32, 2, 8, 9),
            self.u32(33, 2) + self.numbers("f", 1, 2),
            self.u32(34, 2) + self.text("a") + self.text("bcd"),
            self.vectors([[1, 2, 3]]),
            self.colours([[1, 2, 3, 4]]),
            self.u32(37, 2) + self.reals(1, 2, 3, 4),
            self.u32(40) + self.numbers("q", -1),
            self.u32(41) + self.numbers("d", 0.1),
            self.u32(42),
            self.u32(43),
            self.string("name", 44),
            *(self.u32(kind, *range(n)) for kind, n in ((45, 2), (46, 4), (47, 3), (51, 4))),
            self.u32(48, 2) + self.numbers("q", 1, 2),
            self.u32(49, 1) + self.numbers("d", 0.5),
            self.u32(50) + self.reals(1, 2, 3, 4),
            self.u32(52) + self.reals(*range(16)),
            self.u32(53, 1) + self.reals(1, 2, 3, 4),
        ]
        inside = self.dictionary(a=self.array(), b=self.array(*plain))
        return [*plain, inside, self.array(inside, self.u32(26, 1) + self.u32(3, 1) + self.u32(1))]

    def file(self, properties, *, version=(4, 3, 6), kind=MAIN, flags=3, magic=b"RSRC", script="", inner=()):
        """A resource file; `properties` are (name, value), `inner` other resources that come before the main one."""
        flags |= 8 if script else 0
        flags |= 4 if self.real == "d" else 0
        names = ["uses_spherical_harmonics", "x", "probe_data"]
        head = self.u32(0, *version) + self.text(kind) + self.numbers("Q", 0) + self.u32(flags) + self.numbers("Q", 77)
        head = self.u32(self.order == ">") + head if self.order == "<" else struct.pack("<I", 1) + head
        head += self.text(script) if script else b""
        head += self.u32(*[0] * 11) + self.u32(len(names)) + b"".join(map(self.text, names))
        head += self.u32(1) + self.text("Texture2DArray") + self.text("res://bake.exr")
        head += self.numbers("Q", 5) if flags & 2 else b""
        bodies = [("Resource", [("x", self.u32(3, 1))])] * len(inner) + [(kind, properties)]
        head += self.u32(len(bodies))
        paths = [self.text(f"local://{i}") for i in range(len(bodies))]
        at = len(magic) + len(head) + sum(len(path) + 8 for path in paths)
        table, data = b"", b""
        for path, (of, content) in zip(paths, bodies, strict=True):
            table += path + self.numbers("Q", at + len(data))
            data += self.text(of) + self.u32(len(content))
            for name, value in content:
                data += (self.u32(names.index(name)) if name in names else self.text(name, 0x80000000)) + value
        return magic + head + table + data + b"RSRC"


def probes(count=5, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 3)) * 40.0, rng.normal(size=(count, 9, 3)).astype(np.float32)


def colours(sh):
    return np.concatenate([sh, np.full((*sh.shape[:2], 1), 0.25)], 2).reshape(-1, 4)


def bake(writer, points, sh):
    """The properties of a lightmap bake around its probes."""
    data = writer.dictionary(
        bounds=writer.u32(15) + writer.reals(*range(6)),
        points=writer.vectors(points),
        tetrahedra=writer.u32(32, 4, 0, 1, 2, 3),
        bsp=writer.u32(32, 0),
        sh=writer.colours(colours(sh)),
        interior=writer.u32(2, 0),
        baked_exposure=writer.u32(4) + writer.reals(1.0),
        lightprobe_hash=writer.u32(3, 9),
    )
    user = writer.array(*writer.of_every_kind())
    return [("uses_spherical_harmonics", writer.u32(2, 1)), ("user_data", user), ("probe_data", data)]


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
    [
        {},
        {"version": (4, 0, 4), "flags": 1},
        {"version": (4, 2, 5), "script": "Baked"},
        {"inner": ("one", "two")},
    ],
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


def test_one_probe_and_keys_that_are_string_names_or_no_text(tmp_path):
    writer = Writer()
    points, sh = probes(1)
    entries = [
        writer.u32(3, 1) + writer.u32(1),
        writer.string("sh", 44) + writer.colours(colours(sh)),
        writer.string("points", 44) + writer.vectors(points),
    ]
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


def test_damaged_compressed_files(tmp_path, monkeypatch):
    data = compress(compressible(*probes(300)))
    assert "found 0: save it in Godot without" in message(tmp_path, compress(compressible(*probes()), mode=0))
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
    assert "compressed block 0 is damaged" in message(tmp_path, data[:first] + b"\0" * 8 + data[first + 8 :])
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    assert "pip install 'wlm[baselines]'" in message(tmp_path, data)


def test_what_is_no_lightmap_bake_of_godot_4(tmp_path):
    writer = Writer()
    properties = bake(writer, *probes())
    assert "found b''" in message(tmp_path, b"")
    assert "expected a Godot binary resource (RSRC or RSCC), found b'[gd_'" in message(tmp_path, b'[gd_resource type="')
    assert "expected a resource of the type LightmapGIData, found 'Mesh'" in message(
        tmp_path, writer.file(properties, kind="Mesh")
    )
    for version in ((3, 5, 3), (4, 9, 7), (5, 0, 6), (4, 0, 3)):
        found = message(tmp_path, writer.file(properties, version=version))
        assert f"format 4 to 6, found Godot {version[0]}.{version[1]}, format {version[2]}" in found
    data = writer.file(properties)
    assert "byte order" in message(tmp_path, data[:4] + b"\2" + data[5:])
    for path in (tmp_path / "missing.lmbake", tmp_path):
        with pytest.raises(WlmError, match="cannot read"):
            read_lmbake(path)


def test_bakes_without_probes_or_with_too_few_colours(tmp_path):
    writer = Writer()
    points, sh = probes()
    none = "probe_data holds no probes: bake with LightmapProbe nodes"
    assert none in message(tmp_path, writer.file([("x", writer.u32(1))]))
    assert none in message(tmp_path, writer.file([("probe_data", writer.dictionary(points=writer.vectors(points)))]))
    assert none in message(tmp_path, writer.file(bake(writer, points[:0], sh[:0])))
    assert "expected 9 colours for each of 5 points, found 36" in message(
        tmp_path, writer.file(bake(writer, points, sh[:4]))
    )
    for field, wrong in (("points", "packed array of Vector3 (type 35)"), ("sh", "packed array of Color (type 36)")):
        entry = {field: writer.u32(32, 1, 1)}
        found = message(tmp_path, writer.file([("probe_data", writer.dictionary(**entry))]))
        assert f"probe_data.{field}: expected a {wrong}, found type 32" in found
    assert "probe_data: expected a dictionary" in message(tmp_path, writer.file([("probe_data", writer.u32(1))]))


def test_a_file_cut_short_anywhere_is_one_line(tmp_path):
    writer = Writer()
    data = writer.file(bake(writer, *probes(2)))
    # A step that is odd comes by every place in a number. The magic at the end is not needed.
    for end in range(4, len(data) - 4, 5):
        assert "cut short or damaged" in message(tmp_path, data[:end])


def test_any_damaged_byte_is_read_or_is_one_line(tmp_path):
    writer = Writer()
    data = bytearray(writer.file(bake(writer, *probes(2))))
    rng = np.random.default_rng(5)
    path = tmp_path / "a.lmbake"
    failed = 0
    for at in range(0, len(data), 5):
        damaged = data.copy()
        damaged[at] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            position, sh = read_lmbake(path)
            assert sh.shape == (len(position), 9, 3)
        except WlmError as error:
            failed += 1
            assert "\n" not in str(error)
    assert failed > len(data) // 50


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
    assert "expected a name below 3, found 3" in message(tmp_path, data[:at] + writer.u32(3) + data[at + 4 :])
    table = data.index(b"local://0\0") + len(b"local://0\0")
    assert "cut short or damaged" in message(tmp_path, data[:table] + b"\xff" * 8 + data[table + 8 :])
    at = data.index(writer.u32(1) + writer.text("local://0"))
    assert "at least one resource inside" in message(tmp_path, data[:at] + writer.u32(0) + data[at + 4 :])
