"""Scores of decoded probes against plain sums, and of pictures that they light."""

import math

import numpy as np
import pytest
from builders.checks import error_of, misuse_of
from builders.probe_models import whole_model
from builders.probe_sets import ROOM, synthetic

from wlm.formats.geometry import Geometry
from wlm.metrics import PSNR_CAP_DB
from wlm.ops.views import clip_from
from wlm.probe import evaluation as module
from wlm.probe.data import ProbeSet, from_arrays
from wlm.probe.evaluation import NORMALS, evaluate, score
from wlm.probe.sphere import fibonacci_sphere, irradiance
from wlm.probe.views import KINDS, score_views


def probe_set(values, live=None, position=None):
    """A set without the checks of its reader, so that it may be odd."""
    values = np.asarray(values, np.float32)
    live = np.ones(len(values), bool) if live is None else np.asarray(live)
    position = np.arange(3.0 * len(values)).reshape(-1, 3) if position is None else position
    return ProbeSet("room", position, values, "sh", live, "0f", ())


@pytest.fixture
def pair():
    rng = np.random.default_rng(2)
    values = rng.normal(size=(50, 27)).astype(np.float32)
    values[[3, 40]] = 0.0
    live = np.ones(50, bool)
    live[[3, 40]] = False
    decoded = values + (0.1 * rng.normal(size=values.shape)).astype(np.float32)
    decoded[~live] = 0.0
    return decoded, probe_set(values, live)


def decibels(error, peak):
    return 10 * math.log10(peak**2 / np.mean(np.square(error, dtype=np.float64)))


def test_the_scores_are_those_of_plain_sums(pair):
    decoded, probes = pair
    report = score(decoded, probes, 1000)
    error = decoded.astype(np.float64) - probes.values
    peak = float(probes.values.max()) - float(probes.values.min())
    assert report.peak == peak
    assert report.psnr == pytest.approx(decibels(error, peak))
    assert report.psnr_live == pytest.approx(decibels(error[probes.live], peak))
    assert report.psnr_live < report.psnr, "the dead are exact"
    assert report.mse == pytest.approx(np.mean(error**2))
    assert report.max_abs_error == np.abs(error).max()
    lengths = [math.dist(row, [0.0] * 27) for row in probes.values.tolist()]
    typical = math.exp(sum(math.log(length) for length in lengths if length) / 48)
    rows = zip(decoded, probes.values, lengths, strict=True)
    relative = [math.dist(a, b) / math.hypot(c, 1e-4 * typical) for a, b, c in rows]
    worst = int(np.argmax(relative))
    assert report.worst_probe == {
        "probe": worst,
        "error": pytest.approx(relative[worst]),
        "position": probes.position[worst].tolist(),
        "light": pytest.approx(lengths[worst]),
        "decoded": pytest.approx(math.dist(decoded[worst], [0.0] * 27)),
    }
    relative = np.array(relative)[probes.live]
    assert report.relative_error == pytest.approx(math.sqrt((relative**2).mean()))
    assert report.relative_median == pytest.approx(np.median(relative))
    assert report.relative_p95 == pytest.approx(np.quantile(relative, 0.95))
    for band, part in enumerate((slice(0, 3), slice(3, 12), slice(12, 27))):
        assert report.psnr_by_band[band] == pytest.approx(decibels(error[:, part], peak))
    assert (report.name, report.probes, report.live, report.outputs) == ("room", 50, 48, 27)
    assert report.bits_per_probe == 1000 * 8 / 50 and report.ratio == 1000 / (50 * 27 * 4)
    normals, live = fibonacci_sphere(NORMALS), probes.live
    exact = irradiance(probes.values[live].reshape(-1, 9, 3), normals)
    predicted = irradiance(decoded[live].reshape(-1, 9, 3), normals)
    exact, predicted = np.maximum(exact, 0.0), np.maximum(predicted, 0.0)
    assert report.irradiance_psnr == pytest.approx(decibels(predicted - exact, np.ptp(exact)))


def test_an_error_that_no_diffuse_surface_sees_costs_no_irradiance():
    rng = np.random.default_rng(3)
    probes = probe_set(rng.normal(size=(8, 48)))
    decoded = probes.values.copy()
    decoded[:, 27:] += 1.0  # the third band
    report = score(decoded, probes, 100)
    assert report.psnr < 20 and report.psnr_by_band[:3] == [PSNR_CAP_DB] * 3
    assert report.irradiance_psnr == PSNR_CAP_DB


def test_an_exact_copy_has_the_capped_score(pair):
    _, probes = pair
    report = score(probes.values, probes, 1000)
    assert report.psnr == report.psnr_live == report.irradiance_psnr == PSNR_CAP_DB
    assert report.worst_probe is None and report.max_abs_error == 0.0
    assert report.psnr_by_band == [PSNR_CAP_DB] * 3 and report.mse == 0.0


def test_a_model_is_scored_as_its_decode_is(device):
    model = whole_model(positions=True, dead=5)
    decoded = model.decoder(device).decode_probes()
    noise = np.random.default_rng(0).normal(size=decoded.shape).astype(np.float32)
    probes = probe_set(decoded + noise, position=model.stored_positions())
    figures = []
    report = evaluate(model, probes, device=device, progress=figures.append)
    plain = score(decoded, probes, model.file_bytes()).to_json()
    assert report.between_psnr is not None
    assert report.to_json() | {"between_psnr": None, "gpu_bytes": 0} == plain and report.gpu_bytes > 0
    assert figures[-1].figures == {"PSNR dB": report.psnr}
    assert evaluate(model, probes, device=device, file_bytes=7).bytes == 7


@pytest.mark.parametrize("offset", [0.0, 0.5])
def test_without_a_range_there_is_no_psnr(offset):
    probes = probe_set(np.full((3, 27), 0.25))
    report = score(probes.values + np.float32(offset), probes, 100)
    assert math.isnan(report.psnr) and math.isnan(report.psnr_live) and report.to_json()["psnr"] is None
    assert all(math.isnan(score) for score in report.psnr_by_band)
    assert report.max_abs_error == offset


@pytest.mark.parametrize("outputs", [1, 2, 6, 28])
def test_numbers_that_are_no_bands_have_no_irradiance(outputs):
    values = np.arange(5.0 * outputs).reshape(5, outputs)
    report = score(values.astype(np.float32) + 1, probe_set(values), 10)
    assert report.psnr_by_band is None and report.irradiance_psnr is None
    assert report.psnr == pytest.approx(20 * math.log10(5 * outputs - 1))


def test_one_probe_and_none():
    report = score(np.ones((1, 1), np.float32), probe_set([[3.0]]), 10)
    assert math.isnan(report.psnr) and report.mse == 4.0
    assert report.worst_probe["light"] == 3.0 and report.worst_probe["decoded"] == 1.0 and report.off == 1.0
    probes = probe_set(np.zeros((2, 27)), live=[False, False])
    report = score(probes.values, probes, 10)
    assert math.isnan(report.psnr_live) and math.isnan(report.irradiance_psnr) and report.live == 0
    assert math.isnan(report.off) and report.worst_probe is None and report.warnings == []


def test_many_probes_are_scored_in_pieces(pair, monkeypatch):
    whole = score(*pair, 1000).to_json()
    monkeypatch.setattr(module, "_ROWS", 7)
    pieces = score(*pair, 1000).to_json()
    for name, value in whole.items():
        assert pieces[name] == (value if isinstance(value, str | dict | None) else pytest.approx(value, rel=1e-12))


def test_large_and_tiny_values_keep_their_score(pair):
    decoded, probes = pair
    middle = score(decoded, probes, 1000)
    for scale in (1e-30, 1e18):
        other = probe_set(probes.values.astype(np.float64) * scale, probes.live)
        report = score((decoded.astype(np.float64) * scale).astype(np.float32), other, 1000)
        assert report.psnr == pytest.approx(middle.psnr, abs=1e-4)
        assert report.irradiance_psnr == pytest.approx(middle.irradiance_psnr, abs=1e-4)


def test_what_cannot_be_scored_is_one_line(pair):
    decoded, probes = pair
    for spoilt in (np.nan, np.inf):
        broken = decoded.copy()
        broken[[7, 20], 4] = spoilt
        assert "2 probes decode to NaN or infinity, first probe 7" in error_of(score, broken, probes, 1000)
    assert "room: has 50 probes of 27 numbers, but 49 of 27 were decoded" in error_of(score, decoded[:-1], probes, 1000)
    assert "of 12 were decoded" in error_of(score, decoded[:, :12], probes, 1000)
    for size in (0, -1):
        assert "file_bytes" in misuse_of(score, decoded, probes, size)
    assert "[N, D]" in misuse_of(score, decoded.reshape(50, 9, 3), probes, 1000)


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
    for each in score_views(flat, flat.values, _room(), **SETTINGS):
        assert each.mse < 1e-9 and math.isfinite(each.ssim)


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
        assert "views: expected" in error_of(score_views, probes, probes.values, **settings)
    odd = from_arrays(probes.position, probes.values[:, :7])
    assert "spherical harmonics" in error_of(score_views, odd, odd.values)
