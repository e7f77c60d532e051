"""The limits of settings, stored codes, bounds and positions, and the cost of quantising Gaussians."""

from dataclasses import replace

import numpy as np
import pytest
from builders.checks import error_of
from builders.probe_models import EXTENT, ORIGIN, SIZE, random_model, whole_model
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from benchmarks.probe_exact import decode64
from wlm.probe.gaussian.model import (
    CENTRE,
    CUT,
    LATENT,
    STORED_LATENT,
    STORED_ROTATION,
    STORED_SCALE,
    layer_shapes,
    least_turned,
)
from wlm.probe.gaussian.packing import DROP, pack_model
from wlm.probe.gaussian.trainer import CENTRE_BITS, CODE_BITS
from wlm.probe.model import CODES, Profile


def test_codes_in_between_are_those_of_the_equation():
    content = random_model().content
    rows = content.rows()
    low, high = content.bounds.astype(np.float64)
    # Eq. 14 in float64: two roundings of float32 at values up to 3 wide.
    expected = low[LATENT] + content.code[:, LATENT] * (high - low)[LATENT] / 1023.0
    np.testing.assert_allclose(rows[:, LATENT], expected, rtol=0, atol=1e-6)
    expected = low[CENTRE] + content.code[:, CENTRE] * (high - low)[CENTRE] / 65535.0
    np.testing.assert_allclose(rows[:, CENTRE], expected, rtol=0, atol=1e-6)


def test_positions_are_normalised_and_moved_into_the_box():
    model = random_model()
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.5, 0.25, 0.75]]) * SIZE * EXTENT + ORIGIN
    inside = model.normalise(corners)
    assert inside.dtype == np.float32
    np.testing.assert_allclose(inside, np.array([[0, 0, 0], [1, 1, 1], [0.5, 0.25, 0.75]]) * SIZE, atol=1e-7)
    outside = model.normalise(np.array([[-100.0, 2.0, 100.0], [1e300, -1e300, 21.0]]))
    np.testing.assert_allclose(outside, [[0.0, 0.125, 0.75], [1.0, 0.0, 0.125]], atol=1e-7)
    assert model.normalise(np.zeros((0, 3))).shape == (0, 3)


def test_a_box_far_from_the_origin_loses_nothing():
    near, far = random_model(origin=(0, 0, 0)), random_model(origin=(2.0**30, 0, -(2.0**30)))
    points = np.random.default_rng(0).random((50, 3)) * SIZE * EXTENT
    # 2**30 leaves float64 23 bits behind the point.
    np.testing.assert_allclose(far.normalise(points + far.origin), near.normalise(points), rtol=0, atol=2e-7)


def test_a_box_without_a_width():
    model = replace(random_model(positions=True), size=np.array([1.0, 0.0, 0.0]))
    flat = model.stored_positions()
    np.testing.assert_array_equal(flat[:, 1:], np.broadcast_to(ORIGIN[1:], (200, 2)))
    np.testing.assert_array_equal(model.normalise(flat + 1.0)[:, 1:], 0.0)


def test_positions_are_recognised_as_the_models_own():
    model = random_model(probes=3, dead=0)
    position = ORIGIN + EXTENT * SIZE * np.array([[0, 0, 0], [1, 1, 1], [0.5, 0.5, 0.5]])
    assert model.has_probes_at(position) and model.has_probes_at(position.astype(np.float32).astype(np.float64))
    moved = position + [[0, 0, 0], [1e-3, 0, 0], [0, 0, 0]]
    assert not model.has_probes_at(moved) and not model.has_probes_at(position[:2])
    assert "random: the file stores no positions" in error_of(model.stored_positions)


def test_sizes_are_those_of_the_paper():
    # 9 + 3 inputs, two layers of 64, 27 numbers, a bias each.
    assert layer_shapes(9, 64, 27) == [(13, 64), (65, 64), (65, 27)]
    assert (CENTRE_BITS, CODE_BITS, CUT) == (16, 10, 3.0)
    # As half floats, table 3: 19 numbers a Gaussian for 5% of 15,000 probes and the network, within 10% of 50.1 KB.
    assert pytest.approx(50.1, rel=0.2) == (2 * 19 * 750 + 2 * (13 * 64 + 65 * 64 + 65 * 27)) / 1024
    paper = Profile.load("paper")
    assert (paper.ratio, paper.latent, paper.hidden) == (0.05, 9, 64)
    assert (paper.support, paper.optimiser, paper.steps) == ("sphere", "adan", 12000)


@pytest.mark.parametrize(
    "settings",
    [{"ratio": 0.0}, {"ratio": float("nan")}, {"method": "transform"}, {"hidden": 20}, {"steps": 9}, {"colour": 1}],
    ids=str,
)
def test_settings_out_of_range(settings):
    with pytest.raises(ValidationError):
        Profile(name="x", **settings)


def test_codes_stand_for_the_whole_numbers():
    model = whole_model(count=200)
    rows, whole = model.content.rows(), model.content.whole
    expected = whole.gaussians * whole.step
    np.testing.assert_allclose(rows[:, :6], expected[:, :6], atol=1e-6)
    np.testing.assert_allclose(rows[:, 10:], expected[:, STORED_LATENT], atol=1e-6)
    turned = Rotation.from_quat(rows[:, [7, 8, 9, 6]]) * Rotation.from_mrp(expected[:, STORED_ROTATION]).inv()
    assert turned.magnitude().max() < 4.0 / CODES
    position = model.origin + model.extent * model.size * np.random.default_rng(1).random((50, 3))
    np.testing.assert_allclose(model.decoder().decode(position), decode64(model, position), atol=2e-4)


def test_the_least_rotation_gives_the_same_ellipsoids():
    rows = random_model(count=500).content.rows()
    least = least_turned(rows)
    before = Rotation.from_quat(rows[:, [7, 8, 9, 6]]).as_matrix()
    after = Rotation.from_mrp(least[:, STORED_ROTATION]).as_matrix()
    pairs = ((before, rows[:, 3:6]), (after, least[:, STORED_SCALE]))
    spread = [np.einsum("kij,kj,klj->kil", turn, np.exp(2 * scale), turn) for turn, scale in pairs]
    np.testing.assert_allclose(spread[0], spread[1], atol=1e-6)
    assert np.linalg.norm(least[:, STORED_ROTATION], axis=1).max() < 0.28


def test_quantising_costs_next_to_nothing():
    plain = random_model(count=60, latent=3, outputs=26, error="absolute")
    position = plain.origin + plain.extent * plain.size * np.random.default_rng(1).random((400, 3))
    # Its own light, a little off: the error of a fit.
    light = plain.decoder().decode(position)
    noise = np.random.default_rng(2).standard_normal(light.shape).astype(np.float32)
    values = light + np.float32(0.01 * np.ptp(light)) * noise
    packed = pack_model(plain, position, values, "cpu")
    # 10 bits a code and half floats: the whole numbers take about half of that.
    plain_bytes = (60 * (3 * 16 + 10 * 10)) // 8 + plain.content.net.nbytes
    assert packed.file_bytes() < 0.7 * plain_bytes
    error = [float(np.square(model.decoder().decode(position) - values).mean()) for model in (plain, packed)]
    assert 10 * np.log10(error[1] / error[0]) <= DROP + 1e-6


def test_a_model_without_error_gets_fine_steps():
    # Light that the model gives exactly: any rounding shows, and no coarse step costs as little as allowed.
    plain = random_model(count=3, latent=1, hidden=8, outputs=5, bits=4, error="absolute")
    position = plain.origin + plain.extent * plain.size * np.random.default_rng(0).random((500, 3))
    found = pack_model(plain, position, plain.decoder().decode(position), "cpu")
    assert found.content.whole is not None
    np.testing.assert_allclose(found.decoder().decode(position), plain.decoder().decode(position), atol=2e-3)
