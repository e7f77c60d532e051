"""OpenVDB files: each way of storing values, maps to the world, grids by name; and damage."""

import gzip
import itertools
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from builders.vdb_files import ACTIVE_MASK, BLOSC, ZIP, affine, scaled, tree, vdb_file

from wlm.errors import WlmError
from wlm.fluid.volume import load_volume
from wlm.formats.vdb import VdbFile
from wlm.smoke.data import load_frames

OPENVDB = Path(__file__).resolve().parents[1] / "files" / "openvdb.vdb.gz"


def smoke(shape: tuple[int, int, int] = (24, 16, 32)) -> tuple[np.ndarray, np.ndarray]:
    """Values that half floats hold, and which of them are active; a leaf of one value, and an empty one."""
    random = np.random.default_rng(4)
    values = random.integers(1, 1000, shape).astype(np.float32) / 256
    active = random.random(shape) < 0.6
    values[~active] = 0
    values[:8, :8, :8], active[:8, :8, :8] = 0.5, True
    values[:8, :8, 8:16], active[:8, :8, 8:16] = 0, False
    return values, active


def write(path: Path, flags: int = ACTIVE_MASK, placed: bytes | None = None) -> np.ndarray:
    values, active = smoke()
    path.write_bytes(vdb_file({"density": (placed or scaled(1, 1, 1), tree(values, active, flags), flags, False)}))
    return values


def test_what_openvdb_writes(tmp_path: Path):
    """A file of OpenVDB 10.0.1: halves, active voxels, Blosc, tiles, three grids, voxels twice as long as wide."""
    path = tmp_path / "a.vdb"
    path.write_bytes(gzip.decompress(OPENVDB.read_bytes()))
    x, y, z = np.meshgrid(*map(np.arange, (12, 9, 20)), indexing="ij")
    density, heat = ((x + 2 * y + 3 * z) % 17 / 16).astype(np.float32), ((x * y + z) % 5 / 4).astype(np.float32)
    density[x + y < 4], density[:, :, 16:] = 0, 0.5
    file = VdbFile(path.read_bytes(), "a.vdb")
    assert file.names == ("heat", "density") and file.others == ("velocity (Tree_vec3s_5_4_3)",)
    for name, expected in (("density", density), ("heat", heat)):
        grid = file.read(name, 1 << 20)
        assert grid.low == (-5, 3, -20)
        np.testing.assert_array_equal(grid.values, expected)
        np.testing.assert_allclose(grid.matrix[:3], [[0.1, 0, 0, 1], [0, 0.1, 0, 2], [0, 0, 0.2, 3]])
    volume = load_volume(path, temperature="heat")
    # Cubes of the shorter edge, with a border into which the smoke fades: along x and y they are the grid's own.
    assert volume.voxel == pytest.approx(0.1) and volume.shape == (14, 11, 42) and volume.temperature is not None
    np.testing.assert_allclose(volume.origin, [1 - 0.65, 2 + 0.15, 3 - 4.2], atol=1e-6)
    got, around = volume.density.numpy()[1:-1, 1:-1], np.pad(density, [(0, 0), (0, 0), (1, 1)])
    np.testing.assert_allclose(got[:, :, 1::2], 0.25 * around[:, :, :-1] + 0.75 * around[:, :, 1:], atol=1e-5)
    np.testing.assert_allclose(got[:, :, 0::2], 0.75 * around[:, :, :-1] + 0.25 * around[:, :, 1:], atol=1e-5)


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("packing", [0, ZIP, BLOSC])
@pytest.mark.parametrize("masked", [0, ACTIVE_MASK])
def test_each_way_of_storing(packing: int, masked: int, half: bool):
    """What isn't active has none, one or two values, the background, its negative or others."""
    values, active = smoke()
    ways = [(), (0.0,), (0.25,), (-0.25,), (0.25, -0.25), (0.25, 7.0), (3.0, 7.0), (3.0, 7.0, 9.0)]
    for leaf, (x, y) in zip(ways, itertools.product((8, 16), (0, 8)), strict=False):
        part = (slice(x, x + 8), slice(y, y + 8), slice(8, 16))
        if leaf:
            values[part][~active[part]] = np.resize(np.float32(leaf), int((~active[part]).sum()))
        else:
            active[part] = True
    for background in (0.25, 0.0):
        nodes = tree(values, active, packing | masked, half, background)
        file = VdbFile(vdb_file({"a": (scaled(1, 1, 1), nodes, packing | masked, half)}), "a")
        grid = file.read("a", 1 << 20)
        assert grid.low == (0, 0, 0)
        np.testing.assert_array_equal(grid.values, values)


def test_maps_to_the_world(tmp_path: Path):
    """Axes in another order and direction cost no value; all else is resampled."""
    path, turn = tmp_path / "a.vdb", np.zeros((4, 4))
    turn[0, 1], turn[1, 2], turn[2, 0], turn[3, 3] = -0.5, 0.5, 0.5, 1
    turn[:3, 3] = 10, 20, 30
    values = write(path, placed=affine(turn))
    volume = load_volume(path)
    np.testing.assert_array_equal(volume.density, values.transpose(1, 2, 0)[::-1])
    assert volume.voxel == 0.5 and volume.origin == (10 - 0.5 * 15.5, 19.75, 29.75)
    up = load_volume(path, up="z")  # x stays, y becomes -z, z becomes y
    np.testing.assert_array_equal(up.density, values.transpose(1, 0, 2)[::-1, :, ::-1])
    assert up.origin == (10 - 0.5 * 15.5, 29.75, -20 - 0.5 * 31.5)
    np.savez(tmp_path / "a.npz", density=volume.density, voxel=volume.voxel, origin=volume.origin)
    np.testing.assert_array_equal(load_volume(tmp_path / "a.npz", up="z").density, up.density)
    assert load_volume(tmp_path / "a.npz", up="z").origin == up.origin
    # A ramp along a slanted direction is linear, so that any voxels of it are right but at its borders.
    x, y, z = np.meshgrid(*map(np.arange, (24, 16, 32)), indexing="ij")
    ramp = (1 + x + 2 * y + 3 * z).astype(np.float32)
    bend = np.array([[0.5, 0.1, 0, 1], [-0.1, 0.6, 0, 2], [0, 0.05, 0.7, 3], [0, 0, 0, 1]])
    nodes = tree(ramp, ramp > 0, ACTIVE_MASK)
    path.write_bytes(vdb_file({"density": (affine(bend), nodes, ACTIVE_MASK, False)}))
    volume = load_volume(path)
    assert volume.voxel == pytest.approx(np.hypot(0.5, 0.1))
    centres = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in volume.shape), indexing="ij"), -1)
    place = (np.asarray(volume.origin) + volume.voxel * centres - bend[:3, 3]) @ np.linalg.inv(bend[:3, :3]).T
    inside = ((place >= 0) & (place <= np.array(ramp.shape) - 1)).all(-1)
    outside = ((place <= -1) | (place >= np.array(ramp.shape))).any(-1)
    assert inside.sum() > 10_000
    np.testing.assert_allclose(volume.density.numpy()[inside], 1 + place[inside] @ [1, 2, 3], rtol=1e-4)
    assert not volume.density.numpy()[outside].any()


def test_a_folder_of_another_programs_frames(tmp_path: Path):
    """One camera sees them all; what hasn't begun has no voxel."""
    values, active = smoke((8, 8, 8))
    for number, edge in ((3, 1.0), (12, 2.0)):
        nodes = tree(values, active, ACTIVE_MASK)
        data = vdb_file({"density": (scaled(edge, edge, edge), nodes, ACTIVE_MASK, False)})
        (tmp_path / f"smoke_v2.{number:04d}.vdb").write_bytes(data)
    nothing = tree(0 * values, active & False, ACTIVE_MASK)
    (tmp_path / "smoke_v2.0001.vdb").write_bytes(vdb_file({"density": (scaled(9, 9, 9), nothing, ACTIVE_MASK, False)}))
    frames = load_frames(tmp_path, extinction=3.0)
    assert frames.numbers == (1, 3, 12) and not frames.single and frames.scene is None
    assert frames.load(12).voxel == 2.0 and frames.load(12).extinction == 3.0 and not frames.load(1).density.any()
    views = [frames.view(frames.camera, frames.load(number)) for number in frames.numbers]
    assert views[0] == views[1] == views[2] and views[0].position[:2] == (7.0, 7.0)
    (tmp_path / "fire_0001.vdb").write_bytes(b"")
    with pytest.raises(WlmError, match=r"one sequence of volumes.*found fire_\*\.vdb, smoke_v2\.\*\.vdb"):
        load_frames(tmp_path)


def test_damage(tmp_path: Path):
    path = tmp_path / "a.vdb"
    write(path, ZIP | ACTIVE_MASK)
    whole = path.read_bytes()
    for size in (0, 10, 45, 100, 300, 5000, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(WlmError, match=r"a\.vdb: (density: )?(cannot read the OpenVDB file|expected)"):
            load_volume(path)
    path.write_bytes(whole[:8] + struct.pack("<I", 221) + whole[12:])
    with pytest.raises(WlmError, match="expected version 222 to 224 of OpenVDB's files, found 221"):
        load_volume(path)
    path.write_bytes(whole.replace(b"ScaleMap", b"OtherMap"))
    with pytest.raises(WlmError, match="a.vdb: density: expected a linear transform, found a OtherMap"):
        load_volume(path)
    path.write_bytes(whole.replace(b"Tree_float_5_4_3", b"Tree_vec3s_5_4_3"))
    with pytest.raises(WlmError, match=r"a.vdb: expected a grid of floats, found density \(Tree_vec3s_5_4_3\)"):
        load_volume(path)
    nodes = tree(*smoke(), 0)
    both = vdb_file({name: (scaled(1, 1, 1), nodes, 0, False) for name in ("density", "heat")})
    path.write_bytes(both.replace(b"Tree_float_5_4_3", b"Tree_vec3s_5_4_3", 1))
    with pytest.raises(WlmError, match=r"a.vdb: expected a grid of floats for the density, found density \(Tree_vec3s"):
        load_volume(path)
    assert load_volume(path, density="heat").shape == (24, 16, 32)
    write(path, placed=scaled(1, 1, 1e-7))
    with pytest.raises(WlmError, match="a.vdb: density: expected at most 134217728 cubic voxels"):
        load_volume(path)


def test_blosc_without_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    values = write(tmp_path / "a.vdb", BLOSC)
    np.testing.assert_array_equal(load_volume(tmp_path / "a.vdb").density, values)
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    with pytest.raises(WlmError, match=r"imagecodecs is missing; needs the extra: pip install 'wlm\[smoke\]'"):
        load_volume(tmp_path / "a.vdb")
