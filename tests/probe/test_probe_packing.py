"""Packed Gaussians: what packing costs, what the whole numbers stand for, and their file."""

import dataclasses

import numpy as np
import pytest
from builders.checks import assert_same
from builders.probe_models import random_model
from scipy.spatial.transform import Rotation

import wlm
from wlm.errors import WlmError
from wlm.formats.artifact import read_artifact
from wlm.probe.codec import decode, encode
from wlm.probe.exact import decode64
from wlm.probe.volume.index import morton_keys
from wlm.probe.packed import LATENT, MOST, SIZE, TURN, Packed, least_turned
from wlm.probe.gaussian.packing import DROP, pack_model


def packed_model(count=40, seed=0, **settings):
    """A model of random whole numbers."""
    plain = random_model(count=count, seed=seed, **settings)
    rng, latent = np.random.default_rng(seed), plain.profile.latent
    numbers = np.concatenate(
        [
            rng.integers(0, 2**11, (count, 3)),
            rng.integers(-300, -100, (count, 3)),
            rng.integers(-20, 21, (count, 3)),
            rng.integers(-90, 91, (count, latent)),
        ],
        1,
    )
    numbers = numbers[np.argsort(morton_keys(numbers[:, :3] - numbers[:, :3].min(0)))]
    latents = 2.0 ** -rng.integers(4, 7, latent)
    step = np.concatenate([np.full(3, 2.0**-11), np.full(3, 2.0**-6), np.full(3, 2.0**-7), latents])
    net = tuple(rng.integers(-40, 41, layer.shape) for layer in plain.layers())
    packed = Packed(numbers, step, net, np.full(latent + 6, 2.0**-6))
    return dataclasses.replace(plain, source="abcd", packed=packed, **packed.arrays())


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"positions": True, "dead": 0},
        {"count": 1, "probes": 1, "dead": 0},
        {"outputs": 5, "latent": 1, "hidden": 8},
    ],
    ids=str,
)
def test_what_is_written_comes_back(settings, tmp_path):
    model = packed_model(**settings)
    assert model.save(tmp_path / "random.wlm") == model.file_bytes()
    back = wlm.load(tmp_path / "random.wlm")
    assert_same(back, model)
    back.save(tmp_path / "again.wlm")
    assert (tmp_path / "random.wlm").read_bytes() == (tmp_path / "again.wlm").read_bytes()


def test_codes_stand_for_the_whole_numbers():
    model = packed_model(count=200)
    rows, expected = model.rows(), model.packed.rows()
    np.testing.assert_allclose(rows[:, :6], expected[:, :6], atol=1e-6)
    np.testing.assert_allclose(rows[:, 10:], expected[:, LATENT], atol=1e-6)
    turned = Rotation.from_quat(rows[:, [7, 8, 9, 6]]) * Rotation.from_mrp(expected[:, TURN]).inv()
    assert turned.magnitude().max() < 4.0 / MOST
    position = model.origin + model.extent * model.size * np.random.default_rng(1).random((50, 3))
    np.testing.assert_allclose(model.decoder().decode(position), decode64(model, position), atol=2e-4)


def test_the_least_rotation_gives_the_same_ellipsoids():
    rows = random_model(count=500).rows()
    least = least_turned(rows)
    before, after = Rotation.from_quat(rows[:, [7, 8, 9, 6]]).as_matrix(), Rotation.from_mrp(least[:, TURN]).as_matrix()
    pairs = ((before, rows[:, 3:6]), (after, least[:, SIZE]))
    spread = [np.einsum("kij,kj,klj->kil", turn, np.exp(2 * scale), turn) for turn, scale in pairs]
    np.testing.assert_allclose(spread[0], spread[1], atol=1e-6)
    assert np.linalg.norm(least[:, TURN], axis=1).max() < 0.28


def test_packing_halves_a_file_and_costs_next_to_nothing():
    plain = random_model(count=60, latent=3)
    position = plain.origin + plain.extent * plain.size * np.random.default_rng(1).random((400, 3))
    # Its own light, a little off: the error of a fit.
    light = plain.decoder().decode(position)
    noise = np.random.default_rng(2).standard_normal(light.shape).astype(np.float32)
    values = light + np.float32(0.01 * np.ptp(light)) * noise
    packed = pack_model(plain, position, values, "cpu")
    assert packed.packed is not None and packed.file_bytes() < 0.6 * plain.file_bytes()
    error = [float(np.square(model.decoder().decode(position) - values).mean()) for model in (plain, packed)]
    assert 10 * np.log10(error[1] / error[0]) <= DROP + 1e-6


def test_a_model_that_cannot_be_packed_stays_as_it_was():
    # Light that the model gives exactly: any rounding is seen, and there is none that costs as little.
    plain = random_model(count=3, latent=1, hidden=8, outputs=3, bits=4)
    position = plain.origin + plain.extent * plain.size * np.random.default_rng(0).random((500, 3))
    found = pack_model(plain, position, plain.decoder().decode(position), "cpu")
    assert found.file_bytes() <= plain.file_bytes()
    np.testing.assert_allclose(found.decoder().decode(position), plain.decoder().decode(position), atol=1e-4)


@pytest.mark.parametrize("at", range(0, 60, 2))
def test_damage_is_one_line_or_another_model(at, tmp_path):
    packed_model(positions=True).save(tmp_path / "a.wlm")
    artifact = read_artifact(tmp_path / "a.wlm")
    body = artifact.tensors["body"].copy()
    body[at] ^= 0xFF
    for damaged in (body, body[: len(body) - 20], body[:at]):
        artifact.tensors["body"] = damaged
        try:
            model = decode(artifact)
        except (WlmError, ValueError) as error:
            assert "\n" not in str(error)
        else:
            encode(model)
            assert np.isfinite(model.rows()).all()


def test_steps_beyond_floats_are_refused(tmp_path):
    model = packed_model()
    step = model.packed.step.copy()
    step[LATENT] *= 2.0**127
    packed = dataclasses.replace(model.packed, step=step)
    with pytest.raises(WlmError, match="part bounds"), np.errstate(over="ignore"):
        dataclasses.replace(model, packed=packed).save(tmp_path / "a.wlm")
    assert not (tmp_path / "a.wlm").exists()
