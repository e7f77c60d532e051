"""Volume files of many writers: which grid is the smoke, types of values, sequences, and files that claim too much."""

import gzip
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from builders.checks import error_of
from builders.nvdb_files import LEVEL_SET, nvdb_file, raw_grid
from builders.vdb_files import ACTIVE_MASK, scaled, tree, vdb_file

from wlm.errors import WlmError
from wlm.fluid.black_body import black_body_colour, black_body_luminance
from wlm.fluid.grids import choose
from wlm.fluid.volume import load_volume, save_volume, thickness_hint
from wlm.formats.vdb import GridHead
from wlm.inspection import inspect
from wlm.inspection.folders import input_system
from wlm.smoke.data import load_frames

FILES = Path(__file__).resolve().parents[1] / "files"
SHAPE = (16, 8, 24)


def smoke(shape: tuple[int, int, int] = SHAPE) -> np.ndarray:
    """Smoke that fills its box, with a leaf of one value."""
    values = np.random.default_rng(7).random(shape).astype(np.float32) + 0.25
    values[:8, :8, :8] = 0.5
    return values


def distances(shape: tuple[int, int, int] = (16, 16, 16)) -> np.ndarray:
    """Distances to a ball, cut off at 3."""
    places = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1) - 7.5
    return np.clip(np.linalg.norm(places, axis=-1) - 5, -3, 3).astype(np.float32)


def grid(values: np.ndarray, background: float = 0.0) -> tuple:
    nodes = tree(values, np.ones(values.shape, bool), ACTIVE_MASK, False, background)
    return scaled(0.5, 0.5, 0.5), nodes, ACTIVE_MASK, False


def write(path: Path, *names: str, values: np.ndarray | None = None) -> Path:
    path.write_bytes(vdb_file({name: grid(smoke() if values is None else values) for name in names}))
    return path


@pytest.mark.parametrize(
    ("kind", "bits", "error"),
    [("float", 0, 0), ("double", 0, 0), ("fp4", 4, 0.035), ("fp8", 8, 0.002), ("fp16", 16, 8e-6)]
    + [("fpn", bits, 0.51 / (2**bits - 1)) for bits in (1, 2, 4, 8, 16)],
)
def test_types_of_nanovdb(tmp_path: Path, kind: str, bits: int, error: float):
    """Files and raw buffers, of this and of an early version, hold the same smoke within the quantum."""
    made, values = raw_grid(smoke(), kind, bits=bits or 8), smoke()
    early = made[:7] + b"0" + made[8:]
    for data in (nvdb_file(made), made, early, nvdb_file(made) + nvdb_file(raw_grid(0 * values, name="heat"))):
        (tmp_path / "a.nvdb").write_bytes(data)
        volume = load_volume(tmp_path / "a.nvdb", up="y")
        assert (volume.voxel, volume.origin, volume.warnings) == (0.5, (0.75, 1.75, 2.75), ())
        assert float((volume.density - volume.density.new_tensor(values)).abs().max()) <= error + 1e-7
    packed = struct.pack("<Q", len(zlib.compress(made))) + zlib.compress(made)
    (tmp_path / "a.nvdb").write_bytes(nvdb_file(packed, codec=1, size=len(made)))
    assert load_volume(tmp_path / "a.nvdb", up="y").shape == SHAPE


def test_quantised_files_of_openvdb(tmp_path: Path):
    """Two files that NanoVDB's own writer made hold one smoke."""
    found = []
    for kind in ("fp4", "fpn"):
        (tmp_path / f"{kind}.nvdb").write_bytes(gzip.decompress((FILES / f"smoke-{kind}.nvdb.gz").read_bytes()))
        found.append(load_volume(tmp_path / f"{kind}.nvdb").density)
    assert found[0].shape == (23, 31, 19) and float(found[0].max()) == pytest.approx(1.274, abs=0.01)
    assert float((found[0] - found[1]).abs().max()) < 0.05 and float(found[0].std()) > 0.1


def test_nanovdb_that_claims_too_much(tmp_path: Path):
    """The same nodes many times, sizes beyond the file, compressed pieces beyond the size: one line."""
    whole, path = raw_grid(smoke()), tmp_path / "a.nvdb"
    root = 672 + 64
    upper = root + 64 + 32
    many = bytearray(whole)
    many[upper + 32 + 4096 : upper + 8224] = b"\xff" * 4096  # each child of the upper node is the one lower node
    many[upper + 8256 : upper + 8256 + 8 * 32768] = struct.pack("<q", 8256 + 8 * 32768) * 32768
    many[root + 12 : root + 24] = struct.pack("<3i", 4095, 7, 7)
    leaves = bytearray(whole)
    lower = upper + 8256 + 8 * 32768
    leaves[lower + 32 + 512 : lower + 1056] = b"\xff" * 512
    leaves[lower + 1088 : lower + 1088 + 8 * 4096] = struct.pack("<q", 1088 + 8 * 4096) * 4096
    leaves[root + 12 : root + 24] = struct.pack("<3i", 127, 127, 127)
    outside = bytearray(whole)
    struct.pack_into("<q", outside, root + 64 + 8, 1 << 40)
    tiles = bytearray(whole)
    struct.pack_into("<I", tiles, root + 24, 1 << 30)
    far = bytearray(whole)
    struct.pack_into("<6i", far, root, 0, 0, 0, 1 << 23, 0, 0)  # a line of few voxels, in leaves of many
    old = bytearray(whole)
    struct.pack_into("<I", old, 16, 28 << 21)
    bomb = struct.pack("<Q", 2045) + zlib.compress(bytes(2 << 20), 9)
    bomb = struct.pack("<Q", len(bomb) - 8) + bomb[8:]
    for data, message in (
        (many, "bytes, found 32 nodes of 33856 bytes each"),
        (leaves, "bytes, found 4096 nodes of 2144 bytes each"),
        (outside, "bytes, found one outside"),
        (tiles, "nodes, found 1073741824"),
        (far, "expected a box of at most"),
        (old, "expected version 32 of NanoVDB's grids, found 28"),
        (nvdb_file(bomb * 50, codec=1, size=len(whole)), "after decompression, found "),
        (nvdb_file(whole, codec=9), "expected a codec from 0 to 2, found 9"),
        (raw_grid(smoke(), "float")[:632] + struct.pack("<2I", 2, 6) + whole[640:], r"density \(vec3f\): coloured"),
    ):
        path.write_bytes(bytes(data))
        with pytest.raises(WlmError, match=rf"a\.nvdb: .*{message}"):
            load_volume(path)


def test_tiles_that_overlap(tmp_path: Path):
    """Root tiles at places that are no multiples of 4096 could overlap, which would take the machine."""
    head, nodes, *_ = grid(smoke())
    for shift in (0, 1, 8):
        tiles = [struct.pack("<3if?", 4096 + i * shift, 0, 0, 0.5, False) for i in range(2)]
        moved = nodes[:8] + struct.pack("<I", 2) + nodes[12:16] + b"".join(tiles) + nodes[16:]
        (tmp_path / "a.vdb").write_bytes(vdb_file({"density": (head, moved, ACTIVE_MASK, False)}))
        assert "expected root nodes at different multiples of 4096" in error_of(load_volume, tmp_path / "a.vdb")


@pytest.mark.parametrize(
    ("heads", "chosen"),
    [
        ("flame density", "density"),
        ("collision|level_set dens", "dens"),
        ("flames smoke heat", "smoke"),
        ("density|level_set soot", "soot"),
        ("Density", "Density"),
        ("vel|vec3s fuel_density fog", "fog"),
        ("temperature cd", "cd"),
        ("density_noise shadow", "density_noise"),
        ("temperature", None),
        ("flame heat", None),
        ("surface|level_set", None),
        ("density|vec3s", None),
        ("density|vec3s heat", None),
        ("density color|vec3s", "density"),
        ("scatter soot", "soot"),
        ("smoke fog", None),
        ("a b", None),
        ("points|ptdataidx32", None),
    ],
)
def test_the_grid_of_the_smoke(heads: str, chosen: str | None):
    """By name and class; another name than density is said, and what is not clear is an error that lists the grids."""
    found = []
    for text in heads.split():
        name, _, kind = text.partition("|")
        group = kind.replace("_", " ") if kind == "level_set" else ""
        found.append(GridHead(name, "float" if group or not kind else kind, group))
    if chosen is None:
        said = error_of(choose, "a", found)
        assert f"a: expected a grid of floats named density, found {found[0].name}" in said
        assert ("coloured smoke is not read" in said) == ("vec3s" in heads)
        return
    density, _, warnings = choose("a", found)
    coloured = [name for name in ("color", "scatter") if name in heads]
    coloured = [f"a: colours ({name}) are not read: smoke has one albedo" for name in coloured]
    named = [f"a: the grid {chosen} is read as the density"] * (chosen.lower() != "density")
    assert density == chosen and len(warnings) == len(named + coloured)
    assert all(each.startswith(text) for each, text in zip(warnings, named + coloured, strict=True))


def test_level_sets(tmp_path: Path):
    """A level set is refused by its class or its values; if it is named, its inside is filled."""
    ball = distances()
    for name, path in (("a", tmp_path / "a.vdb"), ("b", tmp_path / "b.nvdb"), ("c", tmp_path / "c.vdb")):
        if path.suffix == ".nvdb":
            data = bytearray(nvdb_file(raw_grid(ball, name="density", group=LEVEL_SET)))
            root = data.index(b"NanoVDB1") + 672 + 64
            struct.pack_into("<f", data, root + 28, 3.0)
            path.write_bytes(data)
        else:
            path.write_bytes(vdb_file({"density" + "|level set|float" * (name == "a"): grid(ball, 3.0)}))
        assert "level set" in error_of(load_volume, path)
        filled = load_volume(path, density="density")
        assert len(filled.warnings) == 1 and "filled with smoke of density 1" in filled.warnings[0]
        np.testing.assert_allclose(filled.density, np.clip(-ball / 3, 0, 1), atol=1e-6)
        assert inspect(path)[0].what == "cannot be read"
    # Negative values alone are no level set: the background of fog is 0.
    path = write(tmp_path / "d.vdb", "density", values=smoke() - 0.3)
    assert "negative voxels count as 0" in load_volume(path, up="y").warnings[0]


def test_two_grids_of_one_name(tmp_path: Path):
    path = write(tmp_path / "a.vdb", "density", "density\x1e1")
    assert load_volume(path, up="y").warnings == (f"{path}: 2 grids are named density: only the first is read",)


def test_temperatures_in_kelvin(tmp_path: Path):
    """Above 250 they are kelvins, whose light is that of black bodies, or what the user says."""
    path, heat = tmp_path / "a.vdb", 1500 * smoke()
    path.write_bytes(vdb_file({"density": grid(smoke()), "temperature": grid(heat)}))
    volume = load_volume(path, up="y", emission=2.0)
    light = black_body_luminance(heat) / black_body_luminance(1500.0)
    np.testing.assert_allclose(volume.temperature, light, rtol=1e-5)
    emitted = 2 * light.max()
    assert volume.kelvin and f"as kelvins: the hottest voxel emits {emitted:.2g} per length" in volume.warnings[0]
    np.testing.assert_array_equal(load_volume(path, up="y", kelvin=True).temperature, volume.temperature)
    raw = load_volume(path, up="y", kelvin=False)
    np.testing.assert_array_equal(raw.temperature, heat)
    assert raw.warnings == () and not raw.kelvin
    with pytest.raises(WlmError, match=r"b\.nvdb: temperature: expected kelvins, found their light: load .* kelvin="):
        save_volume(tmp_path / "b.nvdb", volume)
    save_volume(tmp_path / "b.nvdb", raw)
    np.testing.assert_array_equal(load_volume(tmp_path / "b.nvdb", up="y", kelvin=False).temperature, heat)
    np.savez(tmp_path / "a.npz", density=np.ones((1, 1, 3)), temperature=np.array([[[np.nan, -5.0, 1500.0]]]))
    mended = load_volume(tmp_path / "a.npz")
    assert mended.temperature.tolist() == [[[0.0, 0.0, pytest.approx(1.0)]]] and len(mended.warnings) == 2


def test_black_bodies():
    """The candela was defined by platinum that freezes, 2,042 kelvins: 60 per square centimetre; and Wien's law."""
    assert black_body_luminance(2042.0) == pytest.approx(60e4, rel=0.01)
    wavelengths = np.linspace(380e-9, 780e-9, 2001)
    # The efficiency as Wyman, Sloan and Shirley (2013) fit it, to 2%.
    lobes = ((0.821, 568.8, 0.0213, 0.0247), (0.286, 530.9, 0.0613, 0.0322))
    away = [(share, 1e9 * wavelengths - centre, left, right) for share, centre, left, right in lobes]
    seen = sum(share * np.exp(-0.5 * (d * np.where(d < 0, left, right)) ** 2) for share, d, left, right in away)
    for kelvin in (300.0, 900.0, 3000.0, 20000.0):
        radiance = 2 * 5.9552149e-17 / wavelengths**5 / np.expm1(0.014387769 / (wavelengths * kelvin))
        expected = 683 * np.trapezoid(radiance * seen, wavelengths)
        close = 0.05 if kelvin > 500 else 0.5
        assert black_body_luminance(np.array([[kelvin]]))[0, 0] == pytest.approx(expected, rel=close)
    assert black_body_luminance(np.array([-1.0, 0.0, 100.0])).tolist() == [0.0, 0.0, 0.0]


def test_colours_of_black_bodies():
    """The Planckian locus of the CIE's observer of 1931, x and y, where it is within Rec. 709 or nearly so."""
    locus = {2000: (0.5267, 0.4133), 3000: (0.4369, 0.4041), 4000: (0.3805, 0.3768), 6500: (0.3135, 0.3237)}
    colours = black_body_colour(np.array([*locus], float))
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = colours @ to_xyz.T
    np.testing.assert_allclose(xyz[:, :2] / xyz.sum(1, keepdims=True), [*locus.values()], atol=0.003)
    np.testing.assert_allclose(xyz[:, 1], 1.0, rtol=1e-3)


def test_a_sequence_in_kelvin(tmp_path: Path):
    """One frame tells the unit of all, so that a cold one does not flash."""
    for number, hottest in ((1, 200.0), (2, 1800.0)):
        data = {"density": grid(smoke()), "temperature": grid(hottest * smoke() / smoke().max())}
        (tmp_path / f"s_{number}.vdb").write_bytes(vdb_file(data))
    frames = load_frames(tmp_path, up="y")
    cold = frames.load(1)
    assert float(cold.temperature.max()) < 1e-20 and frames.load(2).temperature.max() > 1
    assert len(cold.warnings) == 1 and "temperatures are read as kelvins" in cold.warnings[0]
    assert float(load_frames(tmp_path, up="y", kelvin=False).load(1).temperature.max()) == 200


def test_kelvin_without_a_temperature(tmp_path: Path):
    for name in ("s_1.vdb", "s_2.vdb"):
        (tmp_path / name).write_bytes(vdb_file({"density": grid(smoke())}))
    with pytest.raises(WlmError, match="kelvin: expected temperatures, whose unit it is, found none"):
        load_frames(tmp_path, up="y", kelvin=True)
    with pytest.raises(WlmError, match=r"s_1\.vdb: kelvin: expected temperatures"):
        load_frames(tmp_path / "s_1.vdb", up="y", kelvin=True).load(1)
    assert load_frames(tmp_path, up="y", kelvin=False).load(2).temperature is None


def test_one_grid_for_a_sequence(tmp_path: Path):
    """Before the smoke begins, a file may have other grids only; none of them stands in for it."""
    write(tmp_path / "s_0001.vdb", "flame")
    write(tmp_path / "s_0002.vdb", "flame", "density", "temperature")
    frames = load_frames(tmp_path, up="y")
    assert frames.warnings[0].startswith(f"{tmp_path}: 1 of 2 frames have no grid density and thus no smoke, the first")
    assert not frames.load(1).density.any() and frames.load(2).density.any() and frames.load(2).temperature is not None
    (finding,) = inspect(tmp_path)
    assert finding.what.startswith("2 frames of smoke")
    assert finding.command == f"wlm smoke bake {tmp_path} --volume up=z -o DIR"
    assert input_system(tmp_path) == "smoke"
    write(tmp_path / "s_0001.vdb", "smoke")
    assert not load_frames(tmp_path, up="y").load(1).density.any()
    assert load_frames(tmp_path, up="y", density="smoke").load(1).density.any()
    assert "fog: expected the name of one of" in error_of(load_frames, tmp_path, density="fog")


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (["s.-2", "s.-1", "s.0", "s.1"], (-2, -1, 0, 1)),
        (["smoke_-0002", "smoke_0003", "smoke_0010"], (-2, 3, 10)),
        (["explosion_0001_low", "explosion_0002_low"], (1, 2)),
        (["frame0009_density", "frame10_density"], (9, 10)),
        (["sim_v2_256.0001", "sim_v2_256.0002"], (1, 2)),
        (["fire_0001_t040", "fire_0002_t080", "fire_0003_t120"], (1, 2, 3)),
        (["fire_0001_0.04", "fire_0002_0.08", "fire_0003_1.00"], None),
        (["s1", "s01", "s2"], (1, 2, 3)),
        (["a_0001", "._a_0001", "notes"], (1,)),
        (["sim_v1_0001", "sim_v1_0002", "sim_v2_0001"], None),
        (["a_0001_low", "a_0001_high"], None),
        (["smoke"], None),
    ],
)
def test_names_of_frames(tmp_path: Path, names: list[str], numbers: tuple[int, ...] | None):
    for name in names:
        write(tmp_path / f"{name}.vdb", "density", values=smoke((8, 8, 8)))
    if numbers is None:
        assert "expected frames of simulate, or one sequence of volumes" in error_of(load_frames, tmp_path)
        return
    frames = load_frames(tmp_path)
    assert frames.numbers == numbers
    if "s01" in names:
        assert [path.name for path in frames.files.values()] == ["s01.vdb", "s1.vdb", "s2.vdb"]
        assert "s01.vdb and s1.vdb have the same number" in frames.warnings[0]
    else:
        assert not frames.warnings and [path.stem for path in frames.files.values()] == names[: len(numbers)]


@pytest.mark.parametrize(("density", "voxel", "better"), [(1.0, 1e-3, 300), (250.0, 1.0, 4e-3), (1.0, 0.1, None)])
def test_smoke_that_cannot_be_seen(tmp_path: Path, density: float, voxel: float, better: float | None):
    np.savez(tmp_path / "a.npz", density=np.full((10, 10, 10), density), voxel=voxel)
    volume = load_volume(tmp_path / "a.npz")
    hint, (finding,) = thickness_hint(volume.thickness, 1.0), inspect(tmp_path / "a.npz")
    assert (hint is None) == (better is None) and finding.problems == (() if hint is None else (hint,))
    if better is not None:
        assert f"--volume extinction={better:g} makes it" in hint
        again = load_volume(tmp_path / "a.npz", extinction=better)
        assert thickness_hint(again.thickness, better) is None
