"""Principal components: their error, their decode against float64, light between probes, and when they are taken."""

import dataclasses

import numpy as np
import pytest
from builders.probe_sets import synthetic
from reference.components import decode as reference_decode

import wlm
from wlm.errors import WlmError
from wlm.probe.data import from_arrays
from wlm.probe.exact import components64
from wlm.probe.model import Profile
from wlm.probe.pca.model import ENOUGH, Components, fit_components

RANDOM = np.random.default_rng(3)


def relative(model, probes):
    decoded = model.decoder().decode_probes().astype(np.float64)
    live = probes.live
    norm = np.linalg.norm(probes.values[live].astype(np.float64), axis=1)
    return np.linalg.norm(decoded[live] - probes.values[live], axis=1) / norm


@pytest.mark.parametrize("count", [1, 2, 7, 40, 300])
def test_small_sets_keep_each_probes_light(count):
    probes = synthetic(count, dead=3 if count > 5 else 0)
    model = wlm.probe.compress(probes)
    assert model.method == "pca" and model.choice.startswith("PCA: ") and "Gaussians take" in model.choice
    error = relative(model, probes)
    assert np.sqrt(np.mean(error**2)) <= ENOUGH and error.max() < 5 * ENOUGH
    assert (model.decoder().decode_probes()[~probes.live] == 0).all()


def test_a_bright_probe_costs_the_others_nothing():
    probes = synthetic(300)
    values = probes.values.copy()
    values[17] *= 1e6
    bright = from_arrays(probes.position, values)
    model = wlm.probe.compress(bright)
    assert model.method == "pca" and np.median(relative(model, bright)) < ENOUGH
    assert wlm.probe.evaluate(model, bright).warnings == []


@pytest.mark.parametrize("outputs", [1, 3, 5, 27])
def test_the_decode_is_that_of_the_formula(outputs, device):
    values = RANDOM.normal(size=(60, outputs)).astype(np.float32) * np.exp(RANDOM.normal(size=(60, 1)))
    values[[4, 31]] = 0.0
    probes = from_arrays(RANDOM.random((60, 3)), values)
    for profile in ("pca", Profile(name="x", method="pca")):
        model = wlm.probe.compress(probes, profile)
        exact = components64(model)
        content = model.content
        plain = np.zeros_like(exact)
        plain[model.live] = reference_decode(content.code, content.bounds, content.basis)
        np.testing.assert_allclose(exact, plain, rtol=1e-12, atol=1e-300)
        decoded = model.decoder(device).decode_probes()
        np.testing.assert_allclose(decoded, exact, rtol=0, atol=3e-6 * np.abs(exact).max())


def test_few_components_are_the_best_directions():
    directions = np.linalg.qr(RANDOM.normal(size=(27, 3)))[0].T
    values = (RANDOM.normal(size=(500, 3)) @ directions).astype(np.float32)
    components, error = fit_components(values)
    assert components.count == 3 and components.basis.shape == (3, 27) and error < ENOUGH
    fewer, error = fit_components(values, most_bytes=components.nbytes - 1)
    assert fewer.count == 2 and fewer.nbytes < components.nbytes and error > ENOUGH


HARD = {
    "coincident": (np.zeros((9, 3)), RANDOM.normal(size=(9, 27))),
    "constant": (RANDOM.random((9, 3)), np.full((9, 27), 0.25)),
    "huge": (RANDOM.random((9, 3)), RANDOM.normal(size=(9, 27)) * 1e18),
    "tiny": (RANDOM.random((9, 3)), RANDOM.normal(size=(9, 27)) * 1e-30),
    "HDR": (RANDOM.random((9, 3)), RANDOM.normal(size=(9, 27)) * 10.0 ** np.arange(-18, 18, 4)[:, None]),
    "negative": (RANDOM.random((9, 3)), -np.ones((9, 12))),
    "one live": (RANDOM.random((9, 3)), np.eye(9)[:, :1] * np.ones(27)),
    "far away": (RANDOM.random((9, 3)) + 1e9, RANDOM.normal(size=(9, 27))),
}


@pytest.mark.parametrize("kind", HARD)
def test_hard_sets(kind, tmp_path):
    position, values = HARD[kind]
    values = values.copy()
    probes = from_arrays(position, values)
    model = wlm.probe.compress(probes, positions=True)
    model.save(tmp_path / "a.wlm")
    back = wlm.load(tmp_path / "a.wlm")
    decoded = back.decoder().decode_probes()
    np.testing.assert_array_equal(decoded, model.decoder().decode_probes())
    assert np.isfinite(decoded).all() and (relative(back, probes) < 0.03).all()
    assert np.isfinite(back.decoder().decode(position.mean(0, keepdims=True))).all()


def test_light_between_probes_is_read_from_a_volume(tmp_path):
    probes = synthetic(400)
    model = wlm.probe.compress(probes)
    assert model.method == "pca"
    with pytest.raises(WlmError, match="stores no positions"):
        model.decoder().decode(probes.position)
    decoder = model.decoder(position=probes.position)
    report = wlm.probe.evaluate(model, probes)
    at = wlm.probe.score(decoder.decode(probes.position), probes, 1).psnr
    assert 35.0 < at < report.psnr and report.between_psnr > 35.0
    # Points outside of the box are moved to it, and no point is black.
    far = decoder.decode(np.array([[1e6, 0.0, 0.0], [4.0, 1.5, 3.0]]))
    assert np.isfinite(far).all() and (np.abs(far) > 0).any(1).all()
    with pytest.raises(WlmError, match="expected the positions of its own 400 probes"):
        model.decoder(position=probes.position[:7])
    with pytest.raises(WlmError, match="expected the positions of its own 400 probes"):
        decoder.light(probes.position + 1.0)


def test_the_choice_is_by_error_at_equal_gpu_bytes():
    # Light that is smooth over thousands of probes suits Gaussians; white noise suits neither, and stays PCA's.
    smooth = synthetic(900)
    model = wlm.probe.compress(smooth, Profile(name="tiny", ratio=0.02, latent=3, hidden=8, steps=1500))
    assert model.method == "gaussians" and model.choice.startswith("Gaussians: ")
    assert model.profile.method == "gaussians"
    unfinished = wlm.probe.compress(smooth, Profile(name="tiny", ratio=0.3, latent=3, hidden=8, steps=10))
    assert unfinished.method == "pca" and "PCA: " in unfinished.choice
    assert unfinished.profile == Profile(name="tiny", method="pca")


def test_components_that_overflow_are_not_exported():
    model = wlm.probe.compress(synthetic(20))
    content = model.content
    bounds = content.bounds.copy()
    bounds[0, 0] = 1000.0
    broken = dataclasses.replace(model, content=dataclasses.replace(content, bounds=bounds))
    assert isinstance(content, Components)
    with pytest.raises(WlmError, match="cannot export: the model decodes to NaN or infinity"):
        broken.bundle()
