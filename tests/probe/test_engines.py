"""Probes for three.js and Unity: the layout, the light that the engine shows, and what is refused."""

import json

import numpy as np
import pytest
from builders.probe_models import random_model

from wlm.errors import WlmError
from wlm.export import export
from wlm.probe.sphere import fibonacci_sphere, irradiance


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    """A model and its grid: 6 x 3 x 5 cells of a box of 8 x 3 x 6."""
    model = random_model()
    folder = tmp_path_factory.mktemp("grid") / "out"
    export(model, folder, "three", cells=6)
    return model, folder


def test_texture_as_three_lays_it_out(grid):
    model, folder = grid
    info = json.loads((folder / "grid.json").read_text())
    nx, ny, nz = info["resolution"]
    assert (nx, ny, nz) == (6, 3, 5)
    box = np.array(info["box"])
    np.testing.assert_allclose(box.mean(0), model.origin + model.extent * model.size / 2)
    np.testing.assert_allclose(np.array(info["corners"]) - box, [[2 / 3] * 3, [-2 / 3] * 3])
    texels = np.frombuffer((folder / "grid.ktx2").read_bytes()[-nx * ny * 7 * (nz + 2) * 8 :], "<f2")
    texels = texels.reshape(7, nz + 2, ny, nx, 4)
    decoder = model.decoder()
    for x, y, z in [(0, 0, 0), (5, 2, 4), (3, 1, 2)]:
        place = box[0] + (np.array([x, y, z]) + 0.5) * 4 / 3
        got = texels[:, 1 + z, y, x].reshape(-1)
        np.testing.assert_allclose(got[:27], decoder.decode(place[None])[0], rtol=1e-3, atol=1e-6)
        assert got[27] == 0.0
    np.testing.assert_array_equal(texels[:, 0], texels[:, 1])
    np.testing.assert_array_equal(texels[:, -1], texels[:, -2])


def test_export_refuses(tmp_path):
    for model, settings, message in [
        (random_model(outputs=12), {}, "expected L2 in RGB"),
        (random_model(), {"cells": 0}, "cells: expected"),
        (random_model(), {"cells": 257}, "cells: expected"),
    ]:
        with pytest.raises(WlmError, match=message):
            export(model, tmp_path / "out", "three", **settings)
    assert not (tmp_path / "out").exists()


def shade(sh: np.ndarray, n: np.ndarray) -> np.ndarray:
    """What Unity shows: SphericalHarmonicsL2.Evaluate of sh[channel, coefficient] at normals [M, 3]."""
    x, y, z = n.T
    terms = [x * 0 + 1, y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y]
    return np.stack([sum(sh[channel, c] * terms[c] for c in range(9)) for channel in range(3)], -1)


@pytest.mark.parametrize("mirror", [None, "x", "y", "z"])
@pytest.mark.parametrize("outputs", [27, 12])
def test_unity_shows_the_same_light(mirror, outputs, tmp_path):
    model = random_model(outputs=outputs, probes=20, positions=True)
    export(model, tmp_path / "out", "unity", mirror=mirror)
    content = json.loads((tmp_path / "out" / "probes.json").read_text())
    position = np.array(content["position"]).reshape(-1, 3)
    sh = np.array(content["sh"]).reshape(-1, 3, 9)
    flip = np.array([-1.0 if axis == mirror else 1.0 for axis in "xyz"])
    np.testing.assert_allclose(position * flip, model.stored_positions(), rtol=1e-6)
    normals = fibonacci_sphere(16)
    values = model.decoder().decode_probes()
    expected = irradiance(values.reshape(20, -1, 3), normals) / np.pi
    seen = np.stack([shade(each, normals * flip) for each in sh])
    np.testing.assert_allclose(seen, expected, atol=1e-5 * np.abs(expected).max())
    assert (sh[model.dead] == 0).all()
    script = (tmp_path / "out" / "WlmLightProbes.cs").read_text()
    assert f'"{content["format"]}"' in script and f"version != {content['version']}" in script


def test_what_unity_refuses(tmp_path):
    np.savez(tmp_path / "other.npz", position=np.zeros((3, 3)))
    for model, settings, message in [
        (random_model(outputs=48, positions=True), {}, "expected L0, L1 or L2"),
        (random_model(outputs=5, positions=True), {}, "expected L0, L1 or L2"),
        (random_model(positions=True), {"mirror": "w"}, "mirror: expected x, y or z"),
        (random_model(), {}, "stores no positions"),
        (random_model(), {"original": tmp_path / "other.npz"}, "expected the 200 probes"),
    ]:
        with pytest.raises(WlmError, match=message):
            export(model, tmp_path / "out", "unity", **settings)
    assert not (tmp_path / "out").exists()
