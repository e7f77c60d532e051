"""Written OpenVDB files against a reader of their bytes that shares no code with the product's, and against that."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

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
