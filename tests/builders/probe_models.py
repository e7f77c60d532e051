"""Probe models of random Gaussians and a random network, for tests that only decode or store them."""

import dataclasses

import numpy as np

from wlm.probe.gaussian.model import STORED_CENTRE, Gaussians, WholeNumbers, layer_shapes
from wlm.probe.model import CODES, ProbeModel, Profile
from wlm.probe.morton import morton_keys

ORIGIN, EXTENT, SIZE = np.array([-3.0, 1.0, 20.0]), 8.0, np.array([1.0, 0.375, 0.75])


def random_model(
    count=40, probes=200, outputs=27, dead=3, positions=False, seed=0, origin=ORIGIN, turn=1.0, bits=10, **settings
) -> ProbeModel:
    """Makes a model of a box of 8 x 3 x 6, as a fit is before it is quantised for its file."""
    rng = np.random.default_rng(seed)
    profile = Profile(name="random", method="gaussians", **{"hidden": 16} | settings)
    latent, hidden = profile.latent, profile.hidden
    scales = np.log([0.05, 0.4])
    low = np.concatenate([np.zeros(3), np.full(3, scales[0]), np.full(4, -turn), np.full(latent, -1.0)])
    high = np.concatenate([SIZE, np.full(3, scales[1]), np.full(4, turn), np.full(latent, 2.0)])
    levels = np.array([CODES] * 3 + [2**bits - 1] * (7 + latent))
    code = rng.integers(0, 2**bits, (count, 7 + latent)).astype(np.uint16)
    shapes = layer_shapes(latent, hidden, profile.columns(outputs))
    inputs = np.repeat([latent + 3, hidden, hidden], [rows * columns for rows, columns in shapes])
    zero = np.zeros(probes if dead else 0, bool)
    zero[np.linspace(0, probes - 1, dead).astype(int)] = dead > 0
    stored = rng.integers(0, 2**16, (probes if positions else 0, 3)).astype(np.uint16)
    stored[:2] = np.array([[0], [CODES]], np.uint16)[: len(stored)]  # they span the box
    content = Gaussians(
        latent=latent,
        hidden=hidden,
        outputs=outputs,
        support=profile.support,
        relative=profile.error == "relative",
        gain=2.5,
        code=np.concatenate([rng.integers(0, 2**16, (count, 3)).astype(np.uint16), code], 1),
        levels=levels,
        bounds=np.stack([low, high]).astype(np.float32),
        net=(rng.standard_normal(len(inputs)) * 2.0 * inputs**-0.5).astype(np.float16),
        dropped=2,
    )
    return ProbeModel(
        name="random",
        source="01234567",
        profile=profile,
        probes=probes,
        outputs=outputs,
        origin=np.array(origin, np.float64),
        extent=EXTENT,
        size=SIZE,
        dead=zero,
        positions=stored,
        content=content,
    )


def whole_model(count=40, seed=0, **settings) -> ProbeModel:
    """Makes a model of random whole numbers, which a file can store; `settings` as for `random_model`."""
    plain = random_model(count=count, seed=seed, **settings)
    rng, latent = np.random.default_rng(seed), plain.content.latent
    numbers = np.concatenate(
        [
            rng.integers(0, 2**11, (count, 3)),
            rng.integers(-300, -100, (count, 3)),
            rng.integers(-20, 21, (count, 3)),
            rng.integers(-90, 91, (count, latent)),
        ],
        1,
    )
    numbers = numbers[np.argsort(morton_keys(numbers[:, STORED_CENTRE] - numbers[:, STORED_CENTRE].min(0)))]
    latents = 2.0 ** -rng.integers(4, 7, latent)
    step = np.concatenate([np.full(3, 2.0**-11), np.full(3, 2.0**-6), np.full(3, 2.0**-7), latents])
    net = tuple(rng.integers(-40, 41, layer.shape) for layer in plain.content.layers())
    return with_whole(plain, WholeNumbers(numbers, step, net, np.full(latent + 6, 2.0**-6)))


def with_whole(model: ProbeModel, whole: WholeNumbers) -> ProbeModel:
    """Returns a model with other whole numbers."""
    return dataclasses.replace(model, content=dataclasses.replace(model.content, whole=whole, **whole.codes()))


def with_content(model: ProbeModel, **changes) -> ProbeModel:
    """Returns a model with some arrays of its Gaussians replaced."""
    return dataclasses.replace(model, content=dataclasses.replace(model.content, **changes))
