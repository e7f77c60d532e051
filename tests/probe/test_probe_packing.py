"""Quantised Gaussians: the cost of quantising, and the light of the whole numbers."""

import numpy as np
from builders.probe_models import random_model, whole_model
from scipy.spatial.transform import Rotation

from wlm.probe.exact import decode64
from wlm.probe.gaussian.model import STORED_LATENT, STORED_ROTATION, STORED_SCALE, least_turned
from wlm.probe.gaussian.packing import DROP, pack_model
from wlm.probe.model import CODES


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
    before, after = (
        Rotation.from_quat(rows[:, [7, 8, 9, 6]]).as_matrix(),
        Rotation.from_mrp(least[:, STORED_ROTATION]).as_matrix(),
    )
    pairs = ((before, rows[:, 3:6]), (after, least[:, STORED_SCALE]))
    spread = [np.einsum("kij,kj,klj->kil", turn, np.exp(2 * scale), turn) for turn, scale in pairs]
    np.testing.assert_allclose(spread[0], spread[1], atol=1e-6)
    assert np.linalg.norm(least[:, STORED_ROTATION], axis=1).max() < 0.28


def test_quantising_costs_next_to_nothing():
    plain = random_model(count=60, latent=3)
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
    plain = random_model(count=3, latent=1, hidden=8, outputs=3, bits=4)
    position = plain.origin + plain.extent * plain.size * np.random.default_rng(0).random((500, 3))
    found = pack_model(plain, position, plain.decoder().decode(position), "cpu")
    assert found.content.whole is not None
    np.testing.assert_allclose(found.decoder().decode(position), plain.decoder().decode(position), atol=1e-3)
