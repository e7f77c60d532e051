"""Probes for Unity: its own evaluation of the numbers gives the light of ours, mirrored or not."""

import json

import numpy as np
import pytest
from builders.probe_models import random_model

from wlm.errors import WlmError
from wlm.export import export
from wlm.probe.sphere import fibonacci_sphere, irradiance


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


def test_what_is_refused(tmp_path):
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
