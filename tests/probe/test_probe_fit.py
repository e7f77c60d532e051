"""Fits of Gaussians and of principal components: hard sets, dropped Gaussians, and the choice between the two."""

import dataclasses
import re

import numpy as np
import pytest
from builders.checks import error_of
from builders.probe_sets import synthetic
from reference.components import decode as reference_decode

import wlm
from wlm.errors import WlmError
from wlm.formats.parts import Part
from wlm.probe.data import from_arrays
from wlm.probe.evaluation import evaluate
from wlm.probe.fit import compress, open_checkpoint
from wlm.probe.gaussian import trainer as training
from wlm.probe.gaussian.trainer import Trainer
from wlm.probe.model import Profile, box_of
from wlm.probe.pca.fit import ENOUGH, fit_components
from wlm.probe.pca.model import Components, unit_of
from wlm.probe.selection import least_count

SMALL = Profile(name="small", method="gaussians", ratio=0.1, latent=3, hidden=16, steps=60)
RANDOM = np.random.default_rng(7)


def test_it_learns_and_says_how_well():
    probes = synthetic(300)
    reports = []
    model = compress(probes, SMALL, steps=600, error="absolute", progress=reports.append)
    flat = 10 * np.log10(np.ptp(probes.values) ** 2 / np.mean((probes.values - probes.values.mean(0)) ** 2))
    psnr = evaluate(model, probes).psnr
    assert psnr > flat + 8
    assert reports[-1].done == reports[-1].total == 600
    # The last report is of the model before it is packed, which may cost a little, and fits what a short fit has left.
    assert psnr - 1.0 < reports[-1].figures["PSNR dB"] < psnr + 0.1
    model = compress(probes, SMALL, steps=300, progress=reports.append)
    assert reports[-1].figures["error"] == pytest.approx(evaluate(model, probes).relative_error, rel=0.1)


def _input(probes):
    box = box_of(probes.position)
    x = ((probes.position - box["origin"]) / box["extent"]).astype(np.float32)
    return x[probes.live], probes.values[probes.live]


PLACES = RANDOM.random((40, 3)) * 4
VALUES = RANDOM.normal(size=(40, 27)).astype(np.float32)


def changed(values, index, number):
    values = values.copy()
    values[index] = number
    return values


def lit(values):
    """The values with ambient light that is not negative, as all decoders return it; float64."""
    values = values.astype(np.float64)
    if values.shape[1] in (3, 12, 27):
        values[:, :3] = np.maximum(values[:, :3], 0.0)
    return values


HARD = {
    "one probe": (PLACES[:1], VALUES[:1]),
    "coincident": (np.repeat(PLACES[:1], 40, 0), VALUES),
    "a plane": (PLACES * [1, 0, 1], VALUES),
    "far away": (PLACES + 1e6, VALUES),
    "tiny": (PLACES * 1e-6, VALUES),
    "constant": (PLACES, np.full_like(VALUES, 0.25)),
    "one constant channel": (PLACES, changed(VALUES, (slice(None), 5), 3.0)),
    "huge values": (PLACES, VALUES * np.float32(1e17)),
    "one number": (PLACES, VALUES[:, :1]),
    "most dead": (PLACES, changed(VALUES, slice(3, None), 0.0)),
    "NaN": (PLACES, changed(VALUES, (7, 3), np.nan)),
}


@pytest.mark.parametrize("kind", HARD)
def test_hard_sets(kind, tmp_path):
    probes = from_arrays(*HARD[kind])
    compress(probes, SMALL, steps=150, ratio=0.5, positions=True).save(tmp_path / "a.wlm")
    back = wlm.load(tmp_path / "a.wlm")
    decoded = back.decoder(position=probes.position).decode_probes()
    assert decoded.shape == probes.values.shape and np.isfinite(decoded).all()
    assert (decoded[~probes.live] == 0).all()
    live = lit(probes.values[probes.live])
    error = np.sqrt(np.mean((decoded[probes.live] - live) ** 2))
    # Half floats are 1e-3 off at most; but for them no fit may be worse than the mean.
    mean = np.sqrt(np.mean((live - live.mean(0)) ** 2))
    assert error <= mean * 1.05 + 2e-3 * np.abs(live).max()
    if kind == "coincident":
        assert np.ptp(decoded, axis=0).max() == 0
    np.testing.assert_allclose(back.decoder().decode_probes(), decoded, rtol=0, atol=0.3 * np.abs(live).max())


def test_more_gaussians_than_places_are_not_made():
    probes = from_arrays(np.repeat(RANDOM.random((6, 3)), 5, 0), RANDOM.normal(size=(30, 27)).astype(np.float32))
    model = compress(probes, SMALL, ratio=1.0)
    assert model.content.count + model.content.dropped == 6


def test_useless_gaussians_are_dropped_within_the_bound(monkeypatch):
    probes = synthetic(200)
    monkeypatch.setattr(training, "_PRUNE", 0.03)
    profile = SMALL.override({"steps": 100, "ratio": 0.3})
    x, values = _input(probes)
    trainer = Trainer(x, values, profile, 0, "cpu")
    try:
        trainer.run(profile.steps)
        dropped = int((~trainer.needed).sum())
        # The trainer measured the change itself; here the features are summed by other kernels.
        assert dropped > 0 and 0 < trainer.dropped_change <= 0.03 * np.ptp(values) * 1.2
    finally:
        trainer.close()
    model = compress(probes, profile)
    assert model.content.dropped == dropped and model.content.count == 60 - dropped
    # Only Gaussians that no probe needs are dropped where nothing may change.
    monkeypatch.setattr(training, "_PRUNE", 0.0)
    assert compress(probes, profile).content.dropped < dropped


def test_a_fit_that_diverges_is_an_error(monkeypatch):
    monkeypatch.setattr(Trainer, "mse", lambda self: float("nan"))
    assert "room: the fit diverged; use smaller learning rates" in error_of(compress, synthetic(60), SMALL)


def brighter(factor, chosen):
    probes = synthetic(130)
    values = probes.values.copy()
    values[chosen(probes.position)] *= np.float32(factor)
    return from_arrays(probes.position, values, name="room")


@pytest.mark.parametrize(
    "probes",
    [brighter(1e4, lambda position: [100]), brighter(1e-4, lambda position: position[:, 0] > 4.0)],
    ids=["one bright probe", "two rooms"],
)
def test_dark_probes_keep_their_light_beside_bright_ones(probes):
    paper = compress(probes, SMALL, steps=800, ratio=0.5, error="absolute")
    (warning,) = paper.warnings
    assert re.fullmatch(
        r"room: [\d.]+% of the live probes are off by more than 50% of their light; the worst is probe \d+ at \(.*\), "
        r"whose light of \S+ decodes to \S+",
        warning,
    )
    report = evaluate(paper, probes)
    assert report.psnr > 30.0 and report.off > 0.45 and report.warnings == [warning]
    model = compress(probes, SMALL, steps=800, ratio=0.5)
    assert evaluate(model, probes).off < 0.1 and np.median(relative_error(model, probes)) < 0.35
    assert (model.decoder(position=probes.position).decode_probes()[:, :3] >= 0.0).all()


def test_a_fit_that_diverged_keeps_no_state():
    trainer = Trainer(*_input(synthetic(60)), SMALL, 0, "cpu")
    trainer._tensors["net"][5] = np.nan
    assert "the fit diverged; use smaller learning rates than profile small" in error_of(trainer.state)


NORMAL = np.random.default_rng(3)


def relative_error(model, probes):
    decoded = model.decoder(position=probes.position).decode_probes()[probes.live]
    values = probes.values[probes.live].astype(np.float64)
    return np.linalg.norm(decoded - lit(values), axis=1) / np.linalg.norm(values, axis=1)


@pytest.mark.parametrize("count", [1, 2, 7, 40, 300])
def test_small_sets_keep_each_probes_light(count):
    probes = synthetic(count, dead=3 if count > 5 else 0)
    model = wlm.probe.compress(probes)
    assert model.method == "pca" and "principal components: " in model.choice and "Gaussians take" in model.choice
    error = relative_error(model, probes)
    assert np.sqrt(np.mean(error**2)) <= ENOUGH and error.max() < 5 * ENOUGH
    assert (model.decoder().decode_probes()[~probes.live] == 0).all()


def test_a_bright_probe_costs_the_others_nothing():
    probes = synthetic(300)
    values = probes.values.copy()
    values[17] *= 1e6
    bright = from_arrays(probes.position, values)
    model = wlm.probe.compress(bright)
    assert model.method == "pca" and np.median(relative_error(model, bright)) < ENOUGH
    assert wlm.probe.evaluate(model, bright).warnings == []


def referred(content, ambient=0):
    """The light of a content by the reference."""
    stored = (content.cluster, content.code, content.bounds, content.basis)
    return reference_decode(*stored, unit_of(content.basis), ambient)


@pytest.mark.parametrize("outputs", [1, 3, 5, 27])
def test_the_decode_is_that_of_the_formula(outputs, device):
    values = NORMAL.normal(size=(60, outputs)).astype(np.float32) * np.exp(NORMAL.normal(size=(60, 1)))
    values[[4, 31]] = 0.0
    probes = from_arrays(NORMAL.random((60, 3)), values)
    for profile in ("pca", Profile(name="x", method="pca")):
        model = wlm.probe.compress(probes, profile)
        content = model.content
        exact = np.zeros((60, outputs))
        exact[model.live] = referred(content, 3 if outputs in (3, 27) else 0)
        decoded = model.decoder(device).decode_probes()
        np.testing.assert_allclose(decoded, exact, rtol=0, atol=3e-6 * np.abs(exact).max())


def test_few_components_are_the_best_directions():
    directions = np.linalg.qr(NORMAL.normal(size=(27, 3)))[0].T
    values = (NORMAL.normal(size=(500, 3)) @ directions).astype(np.float32)
    components, error = fit_components(values)
    assert components.clusters == 1 and components.count <= 4 and error < ENOUGH
    fewer, error = fit_components(values, most_bytes=components.nbytes * 3 // 4)
    assert fewer.nbytes <= components.nbytes * 3 // 4 and error > ENOUGH


@pytest.fixture(scope="module")
def clustered():
    """Probes of eight kinds, each with its own directions, and a brightness of its own."""
    basis = NORMAL.normal(size=(8, 3, 27))
    values = 0.2 * np.einsum("vk,vkd->vd", NORMAL.normal(size=(2000, 3)), basis[np.arange(2000) % 8])
    values += 3.0 * NORMAL.normal(size=(8, 27))[np.arange(2000) % 8]
    return (values * np.exp(NORMAL.normal(size=(2000, 1)))).astype(np.float32)


def test_clusters_and_bits_have_the_error_that_is_stated(clustered):
    components, error = fit_components(clustered, 14 * len(clustered))
    assert components.clusters > 1 and components.nbytes <= 14 * len(clustered)
    decoded = referred(components)
    scale = np.linalg.norm(clustered, axis=1)
    found = np.linalg.norm(decoded - clustered, axis=1) / scale
    assert np.sqrt(np.mean(found**2)) == pytest.approx(error, rel=1e-3)
    one = np.linalg.svd(clustered / scale[:, None], full_matrices=False)[2][:12]
    rest = clustered - clustered @ one.T @ one  # what 12 directions of all probes leave, in more bytes
    assert error < 0.5 * np.sqrt(np.mean((np.linalg.norm(rest, axis=1) / scale) ** 2))


def test_the_absolute_error_counts_bright_probes(clustered):
    light = np.where(np.arange(2000) % 8 < 2, 100.0, 1.0) / np.linalg.norm(clustered, axis=1)
    values = clustered * light.astype(np.float32)[:, None]
    scale = np.sqrt(np.square(values, dtype=np.float64).sum(1).mean())

    def found(decoded):
        return np.sqrt(np.square(decoded - values).sum(1).mean()) / scale

    components, error = fit_components(values, 4500, enough=0.0, relative=False)
    assert components.nbytes <= 4500 and not components.width[:, 0].any()
    assert found(referred(components)) == pytest.approx(error, rel=5e-3)  # half floats round the scale
    assert error < 0.5 * found(referred(fit_components(values, 4500, enough=0.0)[0]))
    probes = from_arrays(NORMAL.random((2000, 3)), values)
    model = compress(probes, "pca", error="absolute", target=0.05)
    assert model.content.nbytes < 0.6 * compress(probes, "pca", target=0.05).content.nbytes
    assert 0.03 < found(model.decoder().decode_probes() - lit(values) + values) < 0.0501


def test_one_dark_probe_does_not_multiply_the_bytes():
    """Its magnitude, without bits, is off by a factor of a million, which no prediction of errors covers."""
    values = (1.0 + 0.1 * NORMAL.normal(size=(2000, 27))).astype(np.float32)
    values[0] *= 1e-6
    sizes = [fit_components(values, enough=enough)[0].nbytes for enough in (0.2, 0.5)]
    assert sizes[1] <= sizes[0]


@pytest.mark.parametrize("live", (9, 40, 300))
def test_more_bytes_have_less_error(live, clustered):
    values = clustered[:live]
    errors = [fit_components(values, share * values.nbytes // 8, enough=0.0)[1] for share in (2, 4, 8)]
    assert errors[0] > errors[1] >= errors[2] and errors[2] < 1e-4


NINE = PLACES[:9]
HARD_COMPONENTS = HARD | {
    "huge values": (NINE, VALUES[:9] * 1e18),
    "tiny values": (NINE, VALUES[:9] * 1e-30),
    "HDR": (NINE, VALUES[:9] * 10.0 ** np.arange(-18, 18, 4)[:, None]),
    "negative": (NINE, -np.ones((9, 12))),
    "one live": (NINE, np.eye(9)[:, :1] * np.ones(27)),
}


@pytest.mark.parametrize("kind", HARD_COMPONENTS)
def test_hard_sets_of_components(kind, tmp_path):
    position, values = HARD_COMPONENTS[kind]
    probes = from_arrays(position, values)
    model = wlm.probe.compress(probes, positions=True)
    model.save(tmp_path / "a.wlm")
    back = wlm.load(tmp_path / "a.wlm")
    decoded = back.decoder().decode_probes()
    np.testing.assert_array_equal(decoded, model.decoder().decode_probes())
    assert np.isfinite(decoded).all() and (relative_error(back, probes) < 0.04).all()
    assert np.isfinite(back.decoder().decode(position.mean(0, keepdims=True))).all()


def test_light_between_probes_is_read_from_a_volume(tmp_path):
    probes = synthetic(300)
    model = wlm.probe.compress(probes)
    assert model.method == "pca"
    assert "stores no positions" in error_of(model.decoder().decode, probes.position)
    decoder = model.decoder(position=probes.position)
    report = wlm.probe.evaluate(model, probes)
    at = wlm.probe.score(decoder.decode(probes.position), probes, 1).psnr
    assert 35.0 < at < report.psnr and report.between_psnr > 35.0
    # Points outside of the box are moved to it, and no point is black.
    far = decoder.decode(np.array([[1e6, 0.0, 0.0], [4.0, 1.5, 3.0]]))
    assert np.isfinite(far).all() and (np.abs(far) > 0).any(1).all()
    assert "expected the positions of its own 300 probes" in error_of(model.decoder, position=probes.position[:7])
    assert "expected the positions of its own 300 probes" in error_of(decoder.light, probes.position + 1.0)


def test_the_choice_is_by_error_at_equal_gpu_bytes():
    # Light that is smooth over thousands of probes suits Gaussians; white noise suits neither, and stays PCA's.
    smooth = synthetic(1500)
    model = wlm.probe.compress(smooth, Profile(name="tiny", ratio=0.01, latent=3, hidden=8, steps=600))
    assert model.method == "gaussians" and model.choice.startswith("Gaussians have an error of ")
    assert model.profile.method == "gaussians"
    unfinished = wlm.probe.compress(smooth, Profile(name="tiny", ratio=0.3, latent=3, hidden=16, steps=10))
    assert unfinished.method == "pca" and "principal components: " in unfinished.choice
    assert unfinished.profile == Profile(name="tiny", method="pca")


def test_components_that_overflow_are_not_exported():
    model = wlm.probe.compress(synthetic(20))
    content = model.content
    bounds = content.bounds.copy()
    bounds[0, 0] = 1000.0
    broken = dataclasses.replace(model, content=dataclasses.replace(content, bounds=bounds))
    assert isinstance(content, Components)
    assert "cannot export: the model decodes to NaN or infinity" in error_of(broken.bundle)


@pytest.mark.parametrize("power", [0.2, 1.3])
@pytest.mark.parametrize("first", [3, 4000])
@pytest.mark.parametrize("wanted", [7, 3900])
def test_the_least_number_that_reaches_a_target(power, first, wanted):
    fits = []

    def error_of(count):
        fits.append(count)
        return (count / wanted) ** -power * 0.07

    found = least_count(error_of, first, 4000, 0.07)
    assert wanted <= found <= 1.15 * wanted + 1 and len(fits) <= 8 and max(fits) <= 4000
    assert least_count(error_of, first, wanted // 2, 0.07) is None


SEARCH = SMALL.override({"method": "auto", "steps": 50, "ratio": 0.05})


def test_a_target_and_a_number_of_bytes_choose_the_model():
    probes = synthetic(200)
    exact = compress(probes, SEARCH, target=0.03, method="pca")
    assert exact.method == "pca" and evaluate(exact, probes).relative_error <= 0.03 and exact.warnings == ()
    coarse = compress(probes, SEARCH, target=0.65, method="gaussians")
    assert coarse.method == "gaussians" and evaluate(coarse, probes).relative_error <= 0.65
    assert coarse.content.count + coarse.content.dropped < 60 and coarse.profile.target is None
    for most in (900, 2600):
        model = compress(probes, SEARCH, max_bytes=most)
        assert 0.5 * most < model.content.nbytes <= most
        assert re.match(r"(principal components|Gaussians): .* an error of [\d.]+% in [\d,]+", model.choice)
    warning = compress(probes, SEARCH, target=0.03, max_bytes=900, method="pca").warnings[0]
    assert re.fullmatch(r"room: target: the relative error is [\d.]+%, more than the 3.0% asked for", warning)
    with pytest.raises(WlmError, match="room: max_bytes: expected more bytes, as no model of 200 probes fits 60"):
        compress(probes, SEARCH, max_bytes=60)


def test_the_network_takes_at_most_half_of_the_bytes():
    probes = synthetic(200)
    settings = Profile(name="x", method="gaussians", steps=10, latent=4, hidden=40)
    models = {most: compress(probes, settings, max_bytes=most) for most in (2000, 3000, 10000, 20000)}
    assert [model.content.hidden for model in models.values()] == [16, 16, 32, 40]
    assert all(model.content.nbytes <= most for most, model in models.items())
    assert models[10000].profile.hidden == 32 and compress(probes, settings).content.hidden == 40


def test_a_search_is_resumed(tmp_path):
    probes, out = synthetic(200), tmp_path / "a.wlm"
    settings = SEARCH.override({"target": 0.65, "method": "gaussians", "ratio": 0.01})
    whole = compress(probes, settings)
    fits = []

    def stop(progress):
        fits.append(progress.done)
        if fits.count(50) == 2 or len(fits) > 500:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compress(probes, settings, progress=stop, checkpoint=open_checkpoint(out, probes, settings, every=0))
    resumed = open_checkpoint(out, probes, settings, resume=True)
    assert resumed.resumed and resumed.finished(0, {"error": Part(np.float64, (1,))}) is not None
    model = compress(probes, settings, checkpoint=resumed)
    model.save(tmp_path / "b.wlm")
    whole.save(out)
    assert out.read_bytes() == (tmp_path / "b.wlm").read_bytes()
