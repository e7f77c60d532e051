"""Fits of lightmaps and probes in plain torch: they compute what the product's kernels do."""

import numpy as np
import pytest
import torch
from builders.probe_sets import synthetic
from builders.small_sets import moving_light, tiny_profile
from scipy.spatial.transform import Rotation

from benchmarks.lightmap_exact import decode_tile64
from benchmarks.rivals.lightmap_torch import Features, PlainFit, dynamic_targets
from benchmarks.rivals.probe_torch import DenseFit
from wlm.lightmap.fit import compress
from wlm.lightmap.profile import TimeAxis
from wlm.lightmap.sheet import LIGHT
from wlm.lightmap.trainer import Trainer


def plain_fit(lightmaps, profile, seed: int = 0, features: Features | None = None) -> PlainFit:
    axis = TimeAxis(lightmaps.times, lightmaps.period, profile.time_axis)
    return PlainFit(profile, axis, dynamic_targets(lightmaps, profile), features, seed=seed)


def put_into_trainer(fit: PlainFit, trainer: Trainer) -> None:
    """Copies the parameters of a hybrid fit."""
    *maps, w1, b1, w2, b2, w3, b3 = (values.detach() for values in fit.parameters)
    maps[4:] = (plane.movedim(1, -1) for plane in maps[4:])
    names = ("uv_endpoints", "uv_weights", "uvt_endpoints", "uvt_weights", "ut", "vt")
    for name, values in zip(names, maps, strict=True):
        trainer.views[name].copy_(values.reshape(trainer.views[name].shape))
    with torch.no_grad():
        trainer.hidden.copy_(torch.cat([w1, b1, w2, b2], 2).transpose(1, 2))
        trainer.output.copy_(torch.cat([w3, b3], 2).transpose(1, 2))


def test_what_it_decodes_to_is_what_the_product_decodes():
    """Sampling, wrapping at midnight, levels, network and scales, against the float64 decode of the same parameters."""
    whole, profile = moving_light(128, 256), tiny_profile()
    lightmaps = whole.light
    fit = plain_fit(lightmaps, profile)
    for _ in range(profile.steps):
        fit.step()
    decoded = fit.decode()
    assert decoded.shape == (2, len(lightmaps.times), 128, 128, 3)
    model = compress(whole, profile).sheets[LIGHT]
    trainer = Trainer(profile, model.axis, dynamic_targets(lightmaps, profile), 0, "cpu")
    put_into_trainer(fit, trainer)
    for name, values in trainer.quantised().items():
        setattr(model, name, values)
    trainer.close()
    assert fit.tile_bytes * 2 == sum(value.nbytes for value in model.parts.values()) - model.kind.nbytes
    for tile, k in ((0, 0), (1, 4)):
        exact = decode_tile64(model, tile, lightmaps.times[k])
        np.testing.assert_allclose(decoded[tile, k], exact, rtol=1e-4, atol=1e-4)


def test_its_loss_is_that_of_the_kernels():
    """The mean over many samples; both weight texels half-way to the metric."""
    lightmaps = moving_light(128, 128).light
    profile = tiny_profile(samples=16384, steps=10, map_rate=1e-12, net_rate=1e-12)
    fit, targets = plain_fit(lightmaps, profile), dynamic_targets(lightmaps, profile)
    trainer = Trainer(profile, TimeAxis(lightmaps.times, 24.0, "frames"), targets, 0, "cpu")
    put_into_trainer(fit, trainer)
    trainer.run(1)
    theirs = 50.0 * float(trainer.losses()[0])  # a running mean that begins at 0
    trainer.close()
    assert float(fit.step()) == pytest.approx(theirs, rel=0.05)


def dense(x, values, steps=40, count=12, seed=0, device="cpu", **changes):
    settings = {"latent": 4, "hidden": 16, "rates": (1e-3, 1e-2, 1e-2, 3e-2, 2e-2), "final": 1e-3, "bits": 10}
    return DenseFit(x, values, count=count, steps=steps, seed=seed, device=device, **(settings | changes))


def room(count=150):
    probes = synthetic(count)
    low = probes.position.min(0)
    return (probes.position - low) / (probes.position - low).max(), probes.values


def answer64(fit, x, values, levels=None):
    """What the fit's parameters come to, in float64, a Gaussian at a time; on levels for [centre, others] if given."""
    parameters = [p.detach().numpy().astype(np.float64) for p in fit.parameters]
    if levels is not None:
        for i, part in enumerate(parameters[:4]):
            low, high = part.min(0), part.max(0)
            step = (high - low) / levels[min(i, 1)]
            parameters[i] = np.where(step > 0, low + np.rint((part - low) / np.where(step > 0, step, 1)) * step, part)
    centre, log_scale, q, latent, *net = parameters
    f = np.zeros((len(x), latent.shape[1]))
    for k in range(len(centre)):
        turn = Rotation.from_quat(q[k, [1, 2, 3, 0]]).as_matrix()
        covariance = turn @ np.diag(np.exp(2 * log_scale[k])) @ turn.T
        away = x - centre[k]
        f += np.exp(-0.5 * (away * np.linalg.solve(covariance, away.T).T).sum(1))[:, None] * latent[k]
    h = np.concatenate([f, x], 1)
    for weight, bias in zip(net[0:4:2], net[1:4:2], strict=True):
        h = 1.0 / (1.0 + np.exp(-(h @ weight + bias)))
    return (h @ net[4] + net[5]) * values.astype(np.float64).std(0) + values.astype(np.float64).mean(0)


def stretched(fit):
    """Makes the Gaussians turned ellipsoids of strong latents, so that no axis and no sign goes unnoticed."""
    random = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for part in fit.parameters[1:4]:
            part += torch.randn(part.shape, generator=random)
    return fit


def test_the_sum_and_the_loss_are_those_of_float64():
    x, values = room()
    fit = stretched(dense(x, values))
    x = x.astype(np.float32).astype(np.float64)
    spread = values.astype(np.float64).std(0)
    error = answer64(fit, x, values) - values
    loss = (error**2).mean() / spread.max() ** 2
    assert float(fit.step()) == pytest.approx(loss, rel=1e-4)


def test_decoded_is_on_the_levels_of_a_file():
    x, values = room()
    fit = stretched(dense(x, values, bits=6))
    x = x.astype(np.float32).astype(np.float64)
    exact = answer64(fit, x, values, (2**16 - 1, 2**6 - 1))
    peak = np.ptp(values)
    assert np.abs(fit.decoded() - exact).max() < 1e-6 * peak
    # Levels this coarse are not lost in rounding.
    assert np.abs(fit.decoded() - answer64(fit, x, values)).max() > 1e-4 * peak
