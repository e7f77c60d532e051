"""The plain torch peer: it fits what the kernels fit, and its maps can be others."""

import numpy as np
import pytest
import torch
from builders.small_sets import moving_light, tiny_profile

from benchmarks.lightmap_exact import decode_tile64
from benchmarks.rivals.lightmap_torch import Features, PlainFit, dynamic_targets
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
