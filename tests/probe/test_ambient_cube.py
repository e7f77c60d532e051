"""Bevy's irradiance volumes: the layout that its shader reads, the light between, and what is refused."""

import json
import struct

import numpy as np
from builders.checks import error_of
from builders.probe_models import random_model
from builders.probe_sets import synthetic

from wlm.export import export
from wlm.formats.ktx2 import read_ktx2, write_ktx2
from wlm.formats.shared_exponent import unpack_rgb9e5
from wlm.inspection.files import file_system, inspect_file
from wlm.probe.ambient_cube import write_irradiance_volume
from wlm.probe.data import load, load_positions
from wlm.probe.sphere import fibonacci_sphere, irradiance

COUNT = np.array([3, 2, 4])
AXES = np.repeat(np.eye(3), 2, 0) * np.tile([[1.0], [-1.0]], (3, 1))


def shown(texels: np.ndarray, voxel: tuple[int, int, int], normal: np.ndarray) -> np.ndarray:
    """What Bevy shows at a voxel of texels [3 Z, 2 Y, X, 3]: a texel of each axis, by the squares of the normal."""
    x, y, z = voxel
    stack, half = texels.shape[0] // 3, texels.shape[1] // 2
    texel = [texels[z + axis * stack, y + (half if normal[axis] < 0 else 0), x] for axis in range(3)]
    return np.square(normal) @ np.array(texel)


def _write(path, texels: np.ndarray) -> None:
    depth, height, width, _ = texels.shape
    padded = np.concatenate([texels, np.ones((depth, height, width, 1))], -1).astype("<f2")
    write_ktx2(path, padded.tobytes(), width, height, "R16G16B16A16_SFLOAT", depth)


def test_the_light_is_that_of_the_texels(tmp_path):
    path = tmp_path / "a.vxgi.ktx2"
    texels = np.random.default_rng(0).random((12, 4, 3, 3)).astype("<f2").astype(float)
    _write(path, texels)
    probes = load(path)
    assert probes.probes == 24 and probes.warnings == () and "irradiance volume of Bevy" in probes.reading
    places = [[-2 / 6, -0.25, -0.375], [0, -0.25, -0.375], [-2 / 6, 0.25, -0.375], [-2 / 6, -0.25, -0.125]]
    np.testing.assert_allclose(probes.position[[0, 1, 3, 6]], places)
    np.testing.assert_array_equal(load_positions(path), probes.position)
    light = irradiance(probes.values.reshape(-1, 9, 3), AXES) / np.pi
    even = fibonacci_sphere(50)
    both = [irradiance(probes.values.reshape(-1, 9, 3), sign * even) / np.pi for sign in (1.0, -1.0)]
    for i, voxel in enumerate(np.ndindex(4, 2, 3)):
        np.testing.assert_allclose(light[i], [shown(texels, voxel[::-1], normal) for normal in AXES], atol=1e-6)
        expected = [shown(texels, voxel[::-1], n) + shown(texels, voxel[::-1], -n) for n in even]
        np.testing.assert_allclose(both[0][i] + both[1][i], expected, atol=1e-5)
    found = inspect_file(path)
    assert found.what.startswith("24 light probes of 9") and found.command == f"wlm compress {path} -o OUT.wlm"
    assert file_system(path) == "probe" and "pixelDepth: expected 0" in error_of(read_ktx2, path)
    assert "no meaning" in error_of(load, path, order="channel")
    assert "no meaning" in error_of(load, path, convention="unity")


def test_what_is_read_is_written_again(tmp_path):
    light = synthetic(24).values.reshape(24, 9, 3)
    assert write_irradiance_volume(tmp_path / "a.ktx2", light, COUNT) == 0.0
    again = load(tmp_path / "a.ktx2").values.reshape(24, 9, 3)
    largest = np.abs(light).max()
    np.testing.assert_allclose(irradiance(again, AXES), irradiance(light, AXES), atol=largest / 100.0)
    write_irradiance_volume(tmp_path / "b.ktx2", again, COUNT)
    assert (tmp_path / "a.ktx2").read_bytes() == (tmp_path / "b.ktx2").read_bytes()
    light[3, 0] = -1.0
    assert 0.0 < write_irradiance_volume(tmp_path / "c.ktx2", light, COUNT) <= 1.0
    assert "irradiance of at most 65408" in error_of(write_irradiance_volume, tmp_path / "d.ktx2", light * 1e6, COUNT)


def test_a_model_is_exported(tmp_path):
    model = random_model()
    export(model, tmp_path / "out", "bevy", cells=6)
    info = json.loads((tmp_path / "out" / "light.json").read_text())
    nx, ny, nz = info["resolution"]
    assert (nx, ny, nz) == (6, 3, 5)
    words = np.frombuffer((tmp_path / "out" / info["volume"]).read_bytes()[-nx * ny * nz * 24 :], "<u4")
    texels = unpack_rgb9e5(words.reshape(3 * nz, 2 * ny, nx))
    for voxel in [(0, 0, 0), (5, 2, 4), (3, 1, 2)]:
        unit = (np.array(voxel) + 0.5) / info["resolution"] - 0.5
        place = unit * info["scale"] + info["translation"]
        light = irradiance(model.decoder().decode(place[None]).reshape(9, 3), AXES) / np.pi
        for normal, expected in zip(AXES, light, strict=True):
            got = shown(texels, voxel, normal)
            np.testing.assert_allclose(got, np.maximum(expected, 0.0), atol=np.abs(light).max() / 200.0)
    assert inspect_file(tmp_path / "out" / "light.json").what == "an irradiance volume for Bevy"
    assert "27 numbers" in error_of(export, random_model(outputs=12), tmp_path / "no", "bevy")
    assert "cells: expected" in error_of(export, model, tmp_path / "no", "bevy", cells=513)
    assert not (tmp_path / "no").exists()


def test_volumes_that_are_refused(tmp_path):
    path = tmp_path / "a.ktx2"
    for shape in ((3, 3, 2), (4, 2, 2), (2, 2, 2)):
        _write(path, np.ones((*shape, 3)))
        assert "expected an irradiance volume, X x 2Y x 3Z texels" in error_of(load, path)
    _write(path, np.full((3, 2, 2, 3), -1.0))
    assert "found negative numbers" in error_of(load, path)
    texels = np.ones((3, 2, 2, 3))
    texels[0, 0, 0], texels[1, 0, 1, 0] = np.nan, np.inf
    _write(path, texels)
    assert "every probe is zero, not finite" in error_of(load, path)
    texels = np.ones((6, 2, 2, 3))
    texels[0, 0, 0, 1] = np.inf
    _write(path, texels)
    probes = load(path)
    assert probes.live.tolist() == [False, True, True, True] and "1 probe with a NaN or infinite" in probes.warnings[0]
    # Depth counts for the limits: 16384 slices of 4096 x 4096 texels in a small file.
    data = bytearray(path.read_bytes())
    struct.pack_into("<3I", data, 20, 4096, 4096, 16383)
    path.write_bytes(data)
    assert "expected at most 2048 times" in error_of(load, path)
    # Blocks end with the slices.
    write_ktx2(path, bytes(16 * 4), 8, 8, "BC6H_UFLOAT_BLOCK")
    data = bytearray(path.read_bytes())
    struct.pack_into("<3I", data, 20, 4, 2, 3)
    path.write_bytes(data)
    assert "pixelHeight: expected a multiple of 4 in a volume, found 2" in error_of(load, path)
