"""Godot's lightmap bakes, by a little writer of their container."""

import struct

import numpy as np

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
        """Writes a value of each type, containers last."""
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


def with_users(writer, points, sh, users, slices=False):
    """The properties of a bake whose texture some meshes read: (names of the path, rectangle, slice) each."""
    values = []
    for names, rectangle, number in users:
        path = b"".join(writer.text(name, 0x80000000) for name in names)
        values += [
            writer.u32(22) + writer.numbers("H", len(names), 0) + path,
            writer.u32(11) + writer.reals(*rectangle),
            writer.u32(3, number),
            writer.u32(40) + writer.numbers("q", -1),
        ]
    rest = dict(bake(writer, points, sh))
    return [
        ("lightmap_textures", writer.array(writer.u32(24, 3, 0))),
        ("uses_spherical_harmonics", writer.u32(2, int(slices))),
        ("user_data", writer.array(*values)),
        ("probe_data", rest["probe_data"]),
    ]
