"""Pictures under probes: no error without one, and what each light is compared with."""

import math

import numpy as np
import pytest
from builders.probe_sets import ROOM, synthetic

from wlm.errors import WlmError
from wlm.formats.geometry import Geometry
from wlm.ops.views import clip_from
from wlm.probe.data import from_arrays
from wlm.probe.views import KINDS, score_views

SETTINGS = {"views": 3, "resolution": 32}


def _room() -> Geometry:
    """The floor and a wall of the builders' room."""
    x, y, z = ROOM
    corners = [[0, 0, 0], [x, 0, 0], [x, 0, z], [0, 0, z], [0, y, 0], [x, y, 0]]
    triangles = [[0, 1, 2], [0, 2, 3], [0, 4, 1], [1, 4, 5]]
    return Geometry(np.array(corners, np.float32), np.array(triangles, np.uint32))


def test_lights_apart(device: str):
    """Probes that decode exactly have no error of their own, the volume's is the same for both; noise adds to each."""
    probes = synthetic(300, dead=20)
    exact = score_views(probes, probes.values, _room(), device=device, **SETTINGS)
    assert [(s.drawn, s.light) for s in exact] == [(drawn, kind) for drawn in ("balls", "mesh") for kind in KINDS]
    noise = np.random.default_rng(0).normal(size=probes.values.shape).astype(np.float32)
    decoded = probes.values * (1 + 0.2 * noise)
    noisy = score_views(probes, decoded, _room(), device=device, **SETTINGS)
    for direct, lossless, ours in (exact[:3], exact[3:]):
        assert direct.psnr == 120.0 and direct.ssim == pytest.approx(1.0) and direct.flip == 0.0 and direct.views == 3
        assert 0.0 < lossless.mse == ours.mse and lossless.psnr < 60.0
    for (direct, lossless, ours), (_, before, _) in zip((noisy[:3], noisy[3:]), (exact[:3], exact[3:]), strict=True):
        assert lossless == before
        assert max(direct.psnr, ours.psnr) < 60.0 and ours.mse > before.mse and direct.flip > 0.0


def test_constant_light_is_seen_as_it_is():
    """Whatever reads it: the same light everywhere leaves nothing to err."""
    probes = synthetic(200)
    flat = from_arrays(probes.position, np.tile(probes.values[:1], (200, 1)).reshape(200, 9, 3))
    for score in score_views(flat, flat.values, _room(), **SETTINGS):
        assert score.mse < 1e-9 and math.isfinite(score.ssim)


def test_a_viewer_sees_what_is_ahead():
    """Up is up, right is right, and what lies behind has w below 0."""
    eye, forward = np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, -2.0])
    points = eye + np.array([[0, 0, -5], [1, 0, -5], [0, 1, -5], [0, 0, 5], [0, 0, -50]])
    clip = clip_from(points, eye, forward)
    np.testing.assert_allclose(clip[:3, :2] / clip[:3, 3:], [[0, 0], [0.2, 0], [0, 0.2]], atol=1e-7)
    assert clip[3, 3] == -5.0 and clip[0, 2] / clip[0, 3] < clip[4, 2] / clip[4, 3] < 1.0


def test_views_refuse():
    probes = synthetic(30)
    for settings in ({"views": 0}, {"resolution": 8}):
        with pytest.raises(WlmError, match="views: expected"):
            score_views(probes, probes.values, **settings)
    odd = from_arrays(probes.position, probes.values[:, :7])
    with pytest.raises(WlmError, match="spherical harmonics"):
        score_views(odd, odd.values)
