"""Reading volumes: arrays, .npz, NanoVDB and OpenVDB files, repairs and refusals."""

import gzip
import itertools
import re
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp
from builders.checks import error_of
from builders.nvdb_files import nvdb_file, raw_grid
from builders.vdb_files import ACTIVE_MASK, BLOSC, ZIP, affine, scaled, tree, vdb_file

from wlm.errors import WlmError
from wlm.fluid.volume import from_array, load_volume, save_volume
from wlm.formats.vdb import VdbFile
from wlm.inspection import inspect
from wlm.smoke.data import load_frames


def _nvdb(path: Path, density: np.ndarray) -> None:
    empty = 0.0 if density.ndim == 3 else (0.0,) * 3
    volume = wp.Volume.load_from_numpy(density, min_world=(1, 2, 3), voxel_size=0.5, bg_value=empty, device="cpu")
    volume.save_to_nvdb(path)


def test_npz(tmp_path: Path, device: str):
    path = tmp_path / "a.npz"
    density = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    np.savez(path, density=density, temperature=density / 24, voxel=0.25, origin=[1.0, 2.0, 3.0])
    volume = load_volume(path, extinction=2.0, device=device)
    assert volume.shape == (2, 3, 4) and volume.voxel == 0.25 and volume.origin == (1.0, 2.0, 3.0)
    np.testing.assert_array_equal(volume.density.cpu(), density)
    np.testing.assert_array_equal(volume.temperature.cpu(), density / 24)
    np.testing.assert_allclose(volume.centre, [1.25, 2.375, 3.5])
    assert volume.warnings == () and volume.device.type == device[:4].rstrip(":")
    scaled = load_volume(path, voxel=1.0)
    assert scaled.voxel == 1.0 and scaled.origin == (4.0, 8.0, 12.0)
    chosen = load_volume(path, density="temperature")
    assert chosen.temperature is None and float(chosen.density.max()) == pytest.approx(23 / 24)
    assert torch.equal(load_volume(path, temperature="density").temperature, load_volume(path).density)


def test_bricks(tmp_path: Path, device: str):
    """What is empty is left out; all else comes back, of any shape, in its type."""
    values = np.zeros((13, 24, 9), np.float16)
    values[3:5, 9:12, 8], heat = 0.3, np.zeros_like(values)
    heat[12, 23, 0] = 7
    made = from_array(values, temperature=heat, voxel=0.25, origin=(1.0, 2.0, 3.0), device=device)
    save_volume(tmp_path / "a.npz", made, bricks=True)
    with np.load(tmp_path / "a.npz") as arrays:
        assert arrays["bricks"].tolist() == [3, 10] and arrays["shape"].tolist() == [13, 24, 9]
        parts = dict(arrays)
    back = load_volume(tmp_path / "a.npz", device=device)
    assert back.density.dtype == torch.float16 and (back.voxel, back.origin) == (0.25, (1.0, 2.0, 3.0))
    np.testing.assert_array_equal(back.density.cpu(), values)
    np.testing.assert_array_equal(back.temperature.cpu(), heat)
    for name, value, message in (
        ("bricks", [3, 3], "bricks: expected rising int32"),
        ("bricks", [3, 12], "bricks: expected numbers from 0 to 11"),
        ("bricks", [-1, 3], "bricks: expected numbers from 0 to 11"),
        ("bricks", [3, 4, 5], "density_bricks: expected floats [3, 8, 8, 8]"),
        ("shape", [13, 0, 9], "shape: expected 3 whole numbers from 1"),
        ("shape", [1024, 1024, 1024], "shape: expected at most 256 times its"),
        ("shape", [4096, 4096, 4096], "shape: expected at most 1073741824 voxels"),
    ):
        kind = parts[name].dtype
        np.savez(tmp_path / "b.npz", **parts | {name: np.array(value, kind)})
        assert f"b.npz: {message}" in error_of(load_volume, tmp_path / "b.npz")
    del parts["density_bricks"]
    np.savez(tmp_path / "b.npz", **parts)
    assert "b.npz: density is missing; found voxel, origin, temperature" in error_of(load_volume, tmp_path / "b.npz")


def test_types():
    """Half stays half, all else is float; temperature follows the density."""
    values = np.ones((2, 2, 2))
    for dtype, expected in ((np.float16, torch.float16), (np.float64, torch.float32), (np.uint8, torch.float32)):
        volume = from_array(values.astype(dtype), temperature=values)
        assert volume.density.dtype == volume.temperature.dtype == expected
    source = np.ones((2, 2, 2), np.float32)
    volume = from_array(source)
    source[:] = 5
    assert (volume.density == 1).all()


def test_repairs(device: str):
    """NaN, infinite and negative voxels become zero, with a line that counts them and names the first."""
    density = np.ones((3, 3, 3))
    density[0, 1, 2] = np.nan
    density[2, 0, 0] = np.inf
    density[1, 1, 1] = -0.5
    density[2, 2, 2] = 1e300
    volume = from_array(density, device=device, name="smoke")
    assert volume.warnings == (
        "smoke: density: 3 NaN or infinite voxels count as 0, the first is (0, 1, 2)",
        "smoke: density: 1 negative voxels count as 0, the first is (1, 1, 1)",
    )
    assert float(volume.density.sum()) == 23.0
    hot = from_array(np.ones((1, 1, 1)), temperature=np.full((1, 1, 1), np.nan))
    assert float(hot.temperature) == 0 and len(hot.warnings) == 1


def test_nvdb(tmp_path: Path, device: str):
    """Voxels lie where NanoVDB has them: its coordinates are centres."""
    density = np.random.default_rng(0).uniform(0.1, 1, (9, 5, 3)).astype(np.float32)
    path = tmp_path / "a.nvdb"
    _nvdb(path, density)
    volume = load_volume(path, device=device)
    assert volume.voxel == 0.5 and volume.origin == (0.75, 1.75, 2.75)
    got = volume.density.cpu().numpy()
    np.testing.assert_array_equal(got[:9, :5, :3], density)
    # Warp's writer fills whole leaves.
    assert got.shape == (16, 8, 8) and got.sum() == pytest.approx(density.sum(), rel=1e-5)


def test_smoke_that_may_lie_on_its_side(tmp_path: Path):
    """What is longest along z is asked about, until it is said which axis is up."""
    path = tmp_path / "a.nvdb"
    _nvdb(path, np.ones((8, 8, 24), np.float32))
    (warning,) = load_volume(path).warnings
    assert "longest along z" in warning and "--volume up=z" in warning
    turned = load_volume(path, up="z")
    assert not turned.warnings and turned.shape[1] == 24 and not load_volume(path, up="y").warnings
    (finding,) = inspect(path)
    assert " --volume up=z -o" in finding.command and len(finding.problems) == 1
    _nvdb(path, np.ones((8, 24, 8), np.float32))
    assert not load_volume(path).warnings and "--volume" not in inspect(path)[0].command


def test_nvdb_of_two_grids(tmp_path: Path):
    """The grid named density needn't be the first; temperature is read too."""
    random = np.random.default_rng(1)
    density, hot = (random.uniform(0.1, 1, (8, 8, 8)).astype(np.float32) for _ in range(2))
    grids = [raw_grid(hot, name="temperature"), raw_grid(density)]
    (tmp_path / "both.nvdb").write_bytes(nvdb_file(*grids))
    volume = load_volume(tmp_path / "both.nvdb")
    np.testing.assert_array_equal(volume.density, density)
    np.testing.assert_array_equal(volume.temperature, hot)
    by_name = load_volume(tmp_path / "both.nvdb", density="temperature")
    np.testing.assert_array_equal(by_name.density, hot)
    assert by_name.temperature is None
    with pytest.raises(WlmError, match="both.nvdb: heat: expected the name of one of .* floats, found temperature"):
        load_volume(tmp_path / "both.nvdb", temperature="heat")
    # Each in a segment of its own, as converters append them; and the temperature in finer voxels, further on.
    finer = raw_grid(np.ones_like(hot), name="temperature", voxel=0.25, origin=(2.875, 2, 3))
    (tmp_path / "both.nvdb").write_bytes(nvdb_file(grids[1]) + nvdb_file(finer))
    volume = load_volume(tmp_path / "both.nvdb")
    np.testing.assert_array_equal(volume.density[:8], density)
    assert volume.origin == (0.75, 1.75, 2.75) and volume.shape == (9, 8, 8) and not volume.density[8].any()
    # Voxel 4's centre is at 3, the first of the temperature's at 2.875; its last at 4.625.
    np.testing.assert_allclose(volume.temperature[:, 1, 1], [0, 0, 0, 0, 1, 1, 1, 1, 0.0], atol=1e-5)


def test_wrong_nvdb(tmp_path: Path):
    """Files cut short, other files, grids of vectors, and voxels that have no volume: one line."""
    path = tmp_path / "a.nvdb"
    _nvdb(path, np.ones((8, 8, 8, 3), np.float32))
    whole = path.read_bytes()
    for content, message in (
        (whole[:193], "cannot read the NanoVDB file"),
        (b"no volume at all" * 100, "cannot read the NanoVDB file"),
        (whole, "expected a grid of floats"),
        (raw_grid(np.ones((8, 8, 8)), voxel=0.0), "expected an invertible transform to the world"),
    ):
        path.write_bytes(content)
        assert re.search(rf"a\.nvdb: .*{message}", error_of(load_volume, path))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"smoke": np.ones((2, 2, 2))}, "the array density is missing; found smoke"),
        ({"density": np.ones((2, 2))}, r"density: expected \[X, Y, Z\], 1 to 2147483647 voxels, found \(2, 2\)"),
        ({"density": np.ones((2, 2, 2)), "temperature": np.ones((2, 2, 1))}, "temperature: expected"),
        ({"density": np.ones((1, 1, 1)), "origin": [0.0, np.nan, 0.0]}, "origin: expected 3 finite numbers"),
    ],
)
def test_wrong_npz(tmp_path: Path, arrays: dict, message: str):
    np.savez(tmp_path / "a.npz", **arrays)
    assert re.search(rf"a\.npz: {message}", error_of(load_volume, tmp_path / "a.npz"))


def test_wrong_files(tmp_path: Path):
    (tmp_path / "b.npz").write_bytes(b"PK\x03\x04 cut")
    np.save(tmp_path / "c.npy", np.ones(3))
    (tmp_path / "c.npy").rename(tmp_path / "c.npz")
    for name, message in (
        ("a.abc", "expected a name that ends in .npz, .nvdb, .vdb, found .abc"),
        ("a.npz", "No such file"),
        ("b.npz", "cannot read the arrays"),
        ("c.npz", "expected a .npz file, which names its arrays"),
    ):
        assert re.search(message, error_of(load_volume, tmp_path / name))


def test_emission_beyond_what_pictures_hold_is_lowered(device: str):
    heat = np.ones((2, 3, 4), np.float32)
    heat[1, 2, 3] = heat[0, 1, 2] = 1e30
    volume = from_array(np.ones_like(heat), temperature=heat, emission=1e30, voxel=0.5, device=device)
    light = volume.temperature.double().cpu() * volume.emission * volume.voxel
    assert light.max() <= 65504 * (1 + 1e-6)
    assert volume.warnings == (
        "array: temperature: 24 voxels that each emit more light than 65,504, the largest half float, are lowered to "
        "it, the first is (0, 0, 0)",
    )
    # Bright, but no brighter than a picture can be.
    assert from_array(np.ones_like(heat), temperature=np.full_like(heat, 65504), voxel=0.999).warnings == ()
    assert from_array(np.ones_like(heat), temperature=heat, emission=0.0).warnings == ()


def test_a_temperature_beyond_half_beside_half_density_is_told():
    heat = np.array([[[1.0, 1e5]]], np.float32)
    volume = from_array(np.ones((1, 1, 2), np.float16), temperature=heat)
    assert volume.temperature.tolist() == [[[1.0, 0.0]]]
    assert volume.warnings == ("array: temperature: 1 NaN or infinite voxels count as 0, the first is (0, 0, 1)",)


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
    assert [str(head) for head in file.heads] == ["heat", "velocity (vec3s)", "density"]
    for name, expected in (("density", density), ("heat", heat)):
        grid = file.read(name, False)
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
@pytest.mark.parametrize("kind", ["float", "double"])
def test_each_way_of_storing(kind: str, packing: int, masked: int, half: bool):
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
        nodes = tree(values, active, packing | masked, half, background, kind[0])
        file = VdbFile(vdb_file({f"a|fog volume|{kind}": (scaled(1, 1, 1), nodes, packing | masked, half)}), "a")
        grid = file.read("a", False)
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
    assert re.search(r"one sequence of volumes.*found fire_\*\.vdb, smoke_v2\.\*\.vdb", error_of(load_frames, tmp_path))


def test_damage(tmp_path: Path):
    path = tmp_path / "a.vdb"
    write(path, ZIP | ACTIVE_MASK)
    whole = path.read_bytes()
    for size in (0, 10, 45, 100, 300, 5000, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        assert re.search(r"a\.vdb: (density: )?(cannot read the OpenVDB file|expected)", error_of(load_volume, path))
    path.write_bytes(whole[:8] + struct.pack("<I", 221) + whole[12:])
    assert "expected version 222 to 224 of OpenVDB's files, found 221" in error_of(load_volume, path)
    path.write_bytes(whole.replace(b"ScaleMap", b"OtherMap"))
    assert "a.vdb: density: expected a linear transform, found a OtherMap" in error_of(load_volume, path)
    path.write_bytes(whole.replace(b"Tree_float_5_4_3", b"Tree_vec3s_5_4_3"))
    assert "a.vdb: expected a grid of floats named density, found density (vec3s): col" in error_of(load_volume, path)
    nodes = tree(*smoke(), 0)
    both = vdb_file({name: (scaled(1, 1, 1), nodes, 0, False) for name in ("density", "heat")})
    path.write_bytes(both.replace(b"Tree_float_5_4_3", b"Tree_vec3s_5_4_3", 1))
    assert "a grid of floats named density, found density (vec3s), heat: coloured" in error_of(load_volume, path)
    assert load_volume(path, density="heat").shape == (24, 16, 32)
    write(path, placed=scaled(1, 1, 1e-7))
    assert "a.vdb: density: expected at most 16777216 cubic voxels" in error_of(load_volume, path)


def test_blosc_without_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    values = write(tmp_path / "a.vdb", BLOSC)
    np.testing.assert_array_equal(load_volume(tmp_path / "a.vdb").density, values)
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    with pytest.raises(WlmError, match=r"imagecodecs is missing; needs the extra: pip install 'wlm\[smoke\]'"):
        load_volume(tmp_path / "a.vdb")
