"""Written OpenVDB and NanoVDB files against readers of their bytes that share no code with the product's."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from wlm.errors import WlmError
from wlm.fluid.volume import from_array, load_volume, save_volume


class Bytes:
    """Reads a file in the order in which `File::read`, `Tree::readTopology` and `readBuffers` of OpenVDB do."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at, self.grids = data, 0, {}
        magic, version, _major, _minor, offsets = self.take("<qIII?")
        assert (magic, version, offsets) == (0x56444220, 224, True)
        assert [len(part) for part in self.raw(36).decode().split("-")] == [8, 4, 4, 4, 12] and self.meta() == {}
        for _ in range(*self.take("<I")):
            name, kind, parent = self.raw(), self.raw(), self.raw()
            grid, block, end = self.take("<3q")
            assert (self.at, self.take("<I"), parent) == (grid, (3,), b""), "zip, and only active values"
            meta, half = self.meta(), kind.endswith(b"_HalfFloat")
            assert meta[b"name"] == name and meta[b"is_saved_as_half_float"] == bytes([half])
            assert self.raw() == b"AffineMap"
            matrix, wide = np.array(self.take("<16d")).reshape(4, 4), 3 if b"vec3s" in kind else 1
            self.kind = f"<{wide}{'f2' if half else 'f4'}"
            assert self.take("<I") == (1,) and not any(self.raw(4 * wide)) and self.take("<I") == (0,)
            leaves = []
            for _ in range(*self.take("<I")):
                leaves += self.node(self.take("<3i"), [32, 16, 8], 4096)
            assert self.at == block
            voxels = {}
            for corner, mask in leaves:
                assert self.raw(64) == mask
                places = corner + np.argwhere(self.bits(mask, 8))
                voxels |= zip(map(tuple, places.tolist()), self.values(len(places)).tolist(), strict=True)
            assert self.at == end
            self.grids[name.decode()] = meta[b"class"], matrix, voxels
        assert self.at == len(data)

    def raw(self, size: int | None = None) -> bytes:
        (size,) = self.take("<I") if size is None else (size,)
        self.at += size
        return self.data[self.at - size : self.at]

    def take(self, form: str) -> tuple:
        return struct.unpack(form, self.raw(struct.calcsize(form)))

    def meta(self) -> dict:
        return {self.raw(): (self.raw(), self.raw())[1] for _ in range(*self.take("<I"))}

    def bits(self, mask: bytes, side: int) -> np.ndarray:
        return np.array([mask[i // 8] >> i % 8 & 1 for i in range(side**3)]).reshape(side, side, side)

    def node(self, corner, sides: list[int], edge: int) -> list:
        mask, edge = self.raw(sides[0] ** 3 // 8), edge // sides[0]
        if len(sides) == 1:
            return [(np.array(corner), mask)]
        assert not any(self.raw(len(mask))) and not len(self.values(0)), "no tiles"
        places = np.array(corner) + edge * np.argwhere(self.bits(mask, sides[0]))
        return [leaf for place in places for leaf in self.node(place, sides[1:], edge)]

    def values(self, count: int) -> np.ndarray:
        assert self.raw(1) == b"\0", "inactive values are the background"
        if not count and "f2" in self.kind:
            return np.zeros(0)
        (size,) = self.take("<q")
        data = zlib.decompress(self.raw(size)) if size > 0 else self.raw(-size)
        return np.frombuffer(data, self.kind)


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
@pytest.mark.parametrize("shape", [(21, 140, 9), (4104, 8, 3), (1, 1, 1)])
def test_vdb(shape: tuple, dtype: type, tmp_path: Path):
    random = np.random.default_rng(4)
    density = np.where(random.random(shape) < 0.02, random.random(shape), 0.0).astype(dtype)
    density[-1, -1, -1] = 2.0
    coarse = random.normal(size=(*(-(-n // 3) for n in shape), 3)).astype(np.float32)
    volume = from_array(density, temperature=3 * density, voxel=0.5, origin=(1.0, 2.0, -3.0))
    path = tmp_path / "smoke.vdb"
    save_volume(path, volume, velocity=coarse)
    grids = Bytes(path.read_bytes()).grids
    for name, values, voxel in (("density", density, 0.5), ("temperature", 3 * density, 0.5), ("velocity", coarse, 0)):
        group, matrix, voxels = grids[name]
        voxel = voxel or 0.5 * shape[0] / len(coarse)
        assert group == (b"unknown" if name == "velocity" else b"fog volume")
        np.testing.assert_allclose(matrix, [*np.diag([voxel] * 3 + [0])[:3], [*(np.array([1, 2, -3]) + voxel / 2), 1]])
        places = np.argwhere(values if values.ndim == 3 else values.any(-1))
        assert {tuple(place): np.atleast_1d(values[tuple(place)]).tolist() for place in places.tolist()} == voxels
    back = load_volume(path)
    low = np.argwhere(density).min(0)
    np.testing.assert_array_equal(back.density, density[tuple(slice(n, None) for n in low)])
    np.testing.assert_allclose(back.origin, np.array([1.0, 2.0, -3.0]) + 0.5 * low)
    np.testing.assert_array_equal(back.temperature, (3 * density)[tuple(slice(n, None) for n in low)])


def test_vdb_of_nothing(tmp_path: Path):
    save_volume(tmp_path / "a.vdb", from_array(np.zeros((9, 2, 3), np.float32)))
    assert Bytes((tmp_path / "a.vdb").read_bytes()).grids["density"][2] == {}
    assert not load_volume(tmp_path / "a.vdb").density.any()
    with pytest.raises(WlmError, match=r"ends in .npz, .nvdb, .vdb, found .vdbx"):
        save_volume(tmp_path / "a.vdbx", from_array(np.zeros((1, 1, 1), np.float32)))


# Bytes of a value, of a root, upper, lower and leaf node, of the parts of these before their tables, and of an entry
# of a table, by the type of a grid (1 floats, 6 vectors): rows of `pnanovdb_grid_type_constants` in `PNanoVDB.h`.
ROWS = {1: (4, (64, 270400, 33856, 2144), (64, 8256, 1088, 96), 8)}
ROWS[6] = (12, (96, 532544, 66624, 6272), (96, 8256, 1088, 128), 16)
# Offsets of the range of values, which follows the background in a root, and children along an edge and their size.
LEVELS = ((28, 0, 4096), (8224, 32, 128), (1056, 16, 8), (80, 8, 1))


class Segment:
    """A segment of one grid: `FileHeader`, `FileMetaData`, and a grid whose nodes are followed from the root."""

    def __init__(self, data: bytes, at: int, codec: int) -> None:
        take = struct.unpack_from
        magic, version, *rest = take("<8sI2H", data, at)
        assert (magic, version >> 21, rest) == (b"NanoVDB0", 32, [1, codec])
        size, stored, key, voxels, self.type, self.group = take("<4Q2I", data, at + 16)
        world, self.box, edges = take("<6d", data, at + 56), take("<6i", data, at + 104), take("<3d", data, at + 128)
        letters, *counts = take("<I4I3I2HI", data, at + 152)
        assert key == 0 and counts[3:] == [1, 0, 0, 0, codec, 0, version], "a key of 0 is that of every name"
        name, self.end = data[at + 192 : at + 192 + letters], at + 192 + letters + stored
        self.grid, self.name = data[self.end - stored : self.end], name[:-1].decode()
        if codec:
            assert take("<Q", self.grid) == (stored - 8,)
            self.grid = zlib.decompress(self.grid[8:])
        assert len(self.grid) == size and self.grid[40:296] == name.ljust(256, b"\0")
        flags = 2 | 32 | 4 * (self.type == 1)
        assert self.take("8sq2I2IQ", 0) == (b"NanoVDB0", -1, version, flags, 0, 1, size)
        for form, start, accuracy in (("22f", 296, 1e-6), ("22d", 384, 1e-15)):
            numbers = np.array(self.take(form, start))
            np.testing.assert_allclose(numbers[:9].reshape(3, 3), np.diag(edges), rtol=accuracy)
            np.testing.assert_allclose(numbers[:9:4] * numbers[9:18:4], 1, rtol=accuracy)
            self.shift = numbers[18:21]
        ends = np.array(self.box).reshape(2, 3) + [[0], [1]]
        np.testing.assert_allclose(world, (ends * edges + self.shift).ravel(), rtol=1e-12)
        assert self.take("9d", 560) == (*world, *edges)
        assert self.take("2IqI", 632) == (self.group, self.type, size, 0) and self.grid[664:672] == b"NanoVDB1"
        leaf, lower, upper, root, *numbers = self.take("4Q3I3IQ", 672)
        assert root == 64 and numbers == [*counts[:3], 0, 0, 0, voxels]
        self.edges, self.seen, self.voxels = edges, [[], [], [], []], {}
        found = self.node(672 + 64, 0, None)
        for begin, places, length in zip((root, upper, lower, leaf), self.seen, ROWS[self.type][1], strict=True):
            if places and length > 96:  # breadth first, without gaps
                assert sorted(places) == [672 + begin + i * length for i in range(len(places))]
        assert [len(places) for places in self.seen] == [1, *counts[2::-1]] and len(found) == voxels

    def take(self, form: str, at: int) -> tuple:
        return struct.unpack_from(f"<{form}", self.grid, at)

    def bits(self, at: int, count: int) -> np.ndarray:
        packed = np.frombuffer(self.grid, np.uint8, count // 8, at)
        return np.array([i for i in range(count) if packed[i // 8] >> i % 8 & 1], int)

    def node(self, at: int, level: int, corner: np.ndarray | None) -> np.ndarray:
        """Returns the active voxels of a node and their values, [N, 3 + C]."""
        value, _, tables, entry = ROWS[self.type]
        shift, side, edge = LEVELS[level]
        self.seen[level].append(at)
        low, high, parts = self.take("3i", at), self.take("3i", at + 12), [np.zeros((0, 3 + value // 4))]
        if level == 0:
            shift += value
            assert (*low, *high) == self.box and not any(self.grid[at + 28 : at + shift])
            tiles = [self.take("QqI", at + tables[0] + 32 * i) for i in range(*self.take("I", at + 24))]
            assert [key for key, _, _ in tiles] == sorted({key for key, _, _ in tiles})
            for key, child, _ in tiles:
                place = [(key >> bits & 0x1FFFFF) << 12 for bits in (42, 21, 0)]
                parts.append(self.node(at + child, 1, np.array(place)))
        elif level < 3:
            assert not len(self.bits(at + 32, side**3)), "no tiles"
            for i in self.bits(at + 32 + side**3 // 8, side**3):
                place = corner + edge * np.array(np.unravel_index(i, (side,) * 3))
                parts.append(self.node(at + self.take("q", at + tables[level] + entry * i)[0], level + 1, place))
        else:
            high = tuple(np.add(low, self.take("3B", at + 12)).tolist())
            active, values = self.bits(at + 16, 512), np.frombuffer(self.grid, "<f4", 128 * value, at + tables[3])
            values = values.reshape(512, -1)
            assert self.grid[at + 15] == 2 and not np.delete(values, active, 0).any()
            places = corner + np.stack(np.unravel_index(active, (8, 8, 8)), 1)
            self.voxels |= zip(map(tuple, places.tolist()), values[active].tolist(), strict=True)
            parts.append(np.concatenate([places, values[active]], 1))
        found = np.concatenate(parts)
        if len(found):
            assert (*low, *high) == (*found[:, :3].min(0), *found[:, :3].max(0))
            if self.type == 1:
                assert self.take("2f", at + shift) == (found[:, 3].min(), found[:, 3].max())
        return found


def read(path: Path, codec: str) -> dict[str, Segment]:
    data, at, found = path.read_bytes(), 0, {}
    while at < len(data):
        segment = Segment(data, at, int(codec == "zip"))
        volume = wp.Volume.load_from_nvdb(data[at : segment.end])  # which checks it by NanoVDB's own code
        assert volume.get_grid_info().name == segment.name
        assert volume.get_voxel_count() == 512 * len(segment.seen[3]), "all voxels of its leaves"
        found[segment.name], at = segment, segment.end
    return found


@pytest.mark.parametrize(
    ("shape", "dtype", "codec"),
    [((21, 140, 9), np.float32, "zip"), ((4104, 8, 3), np.float16, "none"), ((1, 1, 1), np.float32, "none")],
)
def test_nanovdb(shape: tuple, dtype: type, codec: str, tmp_path: Path):
    """Every voxel of each grid is read back to the bit, and is where it was, by two other readers and by ours."""
    random = np.random.default_rng(4)
    density = np.where(random.random(shape) < 0.02, random.random(shape), 0.0).astype(dtype)
    density[-1, -1, -1] = 2.0
    coarse = random.normal(size=(*(-(-n // 3) for n in shape), 3)).astype(np.float32)
    coarse[0] = 0.0
    path = tmp_path / "smoke.nvdb"
    volume = from_array(density, temperature=3 * density, voxel=0.5, origin=(1.0, 2.0, -3.0))
    save_volume(path, volume, velocity=coarse, codec=codec)
    segments = read(path, codec)
    assert list(segments) == ["density", "temperature", "velocity"]
    for name, values in (("density", density), ("temperature", 3 * density), ("velocity", coarse)):
        segment, edge = segments[name], 0.5 * shape[0] / len(values)
        assert (segment.type, segment.group) == ((1, 2) if values.ndim == 3 else (6, 0))
        np.testing.assert_allclose([*segment.edges, *segment.shift], [*[edge] * 3, *(np.array([1, 2, -3]) + edge / 2)])
        places = np.argwhere(values if values.ndim == 3 else values.any(-1))
        assert {tuple(p): np.atleast_1d(values[tuple(p)]).tolist() for p in places.tolist()} == segment.voxels
    back, low = load_volume(path, up="y"), np.argwhere(density).min(0)
    np.testing.assert_array_equal(back.density, density[tuple(slice(n, None) for n in low)])
    np.testing.assert_allclose(back.origin, np.array([1.0, 2.0, -3.0]) + 0.5 * low)
    np.testing.assert_array_equal(back.temperature, (3 * density)[tuple(slice(n, None) for n in low)])


def test_nanovdb_of_nothing(tmp_path: Path):
    save_volume(tmp_path / "a.nvdb", from_array(np.zeros((9, 2, 3), np.float32)))
    (segment,) = read(tmp_path / "a.nvdb", "zip").values()
    assert segment.voxels == {} and segment.box == (*[2**31 - 1] * 3, *[-(2**31)] * 3)
    assert load_volume(tmp_path / "a.nvdb").shape == (1, 1, 1) and not load_volume(tmp_path / "a.nvdb").density.any()
